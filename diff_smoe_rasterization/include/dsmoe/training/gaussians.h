// What a training step does to every Gaussian: activations, passes over all of them, and Adam around the activations.
#pragma once

#include <cstdint>

#include "dsmoe/gate.h"
#include "dsmoe/hd.h"
#include "dsmoe/training/adam.h"
#include "dsmoe/vec.h"

namespace dsmoe {

// From the numbers that an optimizer moves freely to a Gaussian's: opacity = sigmoid(logit), scale = exp(log),
// rotation = quaternion / |quaternion|. Each backward function returns dL/dinput from the output and dL/doutput.

template <class S> DSMOE_HD S sigmoid(S logit) { return S(1) / (S(1) + exp(-logit)); }

template <class S> DSMOE_HD S sigmoid_backward(S value, S dL_dvalue) { return dL_dvalue * value * (S(1) - value); }

template <class S> DSMOE_HD S exp_backward(S value, S dL_dvalue) { return dL_dvalue * value; }

// A quaternion that is shorter than this is divided by this instead of its length, as torch's normalize does.
constexpr double kShortestQuaternion = 1e-12;

template <class S> DSMOE_HD S quaternion_length(const S* q) {
  return sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
}

template <class S> DSMOE_HD void normalize_quaternion(const S* q, S* unit) {
  const S inverse = S(1) / max(quaternion_length(q), S(kShortestQuaternion));
  for (int i = 0; i < 4; ++i) unit[i] = q[i] * inverse;
}

// dL/dq = (g - u (u . g)) / |q| with g = dL/dunit. A quaternion that is too short was divided by a constant: there
// dL/dq is g divided by it.
template <class S> DSMOE_HD void normalize_quaternion_backward(const S* q, const S* dL_dunit, S* dL_dq) {
  const S length = quaternion_length(q);
  const bool normalized = length > S(kShortestQuaternion);
  const S inverse = S(1) / max(length, S(kShortestQuaternion));
  S along = 0;
  for (int i = 0; i < 4; ++i) along += q[i] * inverse * dL_dunit[i];
  for (int i = 0; i < 4; ++i) dL_dq[i] = inverse * (dL_dunit[i] - (normalized ? q[i] * inverse * along : S(0)));
}

// Passes of a training step over all Gaussians, or over what else a step has many of, on the CPU and on a GPU.

// What the optimizer moves and what the rasterizer takes, of N Gaussians; or the gradients of both.
template <class S> struct GaussianParameters {
  S* opacities;  // [N]
  S* scales;     // [N, 3]
  S* rotations;  // [N, 4]
};

// The passes. Each is called once for every Gaussian i.

// values = activation(raw)
template <class S> struct Activate {
  GaussianParameters<const S> raw;  // read
  GaussianParameters<S> values;     // written

  DSMOE_HD void operator()(int64_t i) const {
    values.opacities[i] = sigmoid(raw.opacities[i]);
    for (int k = 0; k < 3; ++k) values.scales[3 * i + k] = exp(raw.scales[3 * i + k]);
    normalize_quaternion(raw.rotations + 4 * i, values.rotations + 4 * i);
  }
};

// From the gradients by the values to those by `raw`.
template <class S> struct ActivateBackward {
  GaussianParameters<const S> raw;         // read
  GaussianParameters<const S> values;      // read; what Activate wrote
  GaussianParameters<const S> dL_dvalues;  // read; a null pointer stands for a gradient of zero
  GaussianParameters<S> dL_draw;           // written

  DSMOE_HD void operator()(int64_t i) const {
    dL_draw.opacities[i] =
        dL_dvalues.opacities == nullptr ? S(0) : sigmoid_backward(values.opacities[i], dL_dvalues.opacities[i]);
    for (int k = 0; k < 3; ++k) {
      dL_draw.scales[3 * i + k] =
          dL_dvalues.scales == nullptr ? S(0) : exp_backward(values.scales[3 * i + k], dL_dvalues.scales[3 * i + k]);
    }
    if (dL_dvalues.rotations == nullptr) {
      for (int k = 0; k < 4; ++k) dL_draw.rotations[4 * i + k] = 0;
    } else {
      normalize_quaternion_backward(raw.rotations + 4 * i, dL_dvalues.rotations + 4 * i, dL_draw.rotations + 4 * i);
    }
  }
};

// Adds one view to what densification knows: where the radius is positive, the length of the gradient on the screen,
// and 1.
template <class S> struct AddView {
  const S* dL_dmeans2D;  // [N, 3]; z is not read
  const int32_t* radii;  // [N]
  S* gradient_sum;       // [N] added to
  S* view_count;         // [N] added to

  DSMOE_HD void operator()(int64_t i) const {
    if (radii[i] <= 0) return;
    const S x = dL_dmeans2D[3 * i], y = dL_dmeans2D[3 * i + 1];
    gradient_sum[i] += sqrt(x * x + y * y);
    view_count[i] += S(1);
  }
};

// How far from its centre a footprint is felt: by this a panorama has copies of those that cross its seam.
template <class S> struct PixelReach {
  const int32_t* radii;      // [N]
  const S* opacities;        // [N]
  const S* squared_reaches;  // [N]
  S* reach;                  // [N] pixels, written

  DSMOE_HD void operator()(int64_t i) const { reach[i] = pixel_reach(S(radii[i]), opacities[i], squared_reaches[i]); }
};

// One step of Adam on the background's gate lambda = bound + exp(p), and lambda anew. There is one i.
template <class S> struct GateStep {
  S* logarithm;       // [1] p
  S* moment;          // [1] mean gradient
  S* square;          // [1] mean squared gradient
  S* gate;            // [1] lambda, written
  const S* gradient;  // [1] by lambda; one that is not finite, as of a scaled loss that overflowed, counts as 0
  S bound;
  S limit;  // of |p|
  AdamConstants<S> constants;
  AdamRates<S> rates;

  DSMOE_HD void operator()(int64_t) const {
    S p = *logarithm;
    const S by_gate = is_finite(*gradient) ? *gradient : S(0);
    adam_step(constants, rates, by_gate * exp(p), p, *moment, *square);
    p = p < -limit ? -limit : p > limit ? limit : p;
    *logarithm = p;
    *gate = exp(p) + bound;
  }
};

// What a step that repeats reads anew each time: numbers of the host, and copies of some arrays. There is an i for each
// number, and for each piece of the arrays.
template <class S> struct StepInputs {
  static constexpr int kMostArrays = 8, kMostNumbers = 32;
  struct alignas(16) Piece {
    uint32_t words[4];
  };
  struct Array {
    const unsigned char* from;
    unsigned char* to;
    int64_t bytes;
    int64_t end;   // pieces of this array and of those before
    bool aligned;  // both begin where a piece may
  };
  Array arrays[kMostArrays];
  int num_arrays;
  int num_numbers;
  S* numbers;  // [num_numbers] written
  S new_numbers[kMostNumbers];

  static constexpr int64_t num_pieces(int64_t bytes) {
    return (bytes + static_cast<int64_t>(sizeof(Piece)) - 1) / static_cast<int64_t>(sizeof(Piece));
  }
  int64_t count() const { return num_numbers + (num_arrays > 0 ? arrays[num_arrays - 1].end : 0); }

  DSMOE_HD void operator()(int64_t i) const {
    if (i < num_numbers) {
      numbers[i] = new_numbers[i];
      return;
    }
    int64_t piece = i - num_numbers;
    int a = 0;
    while (piece >= arrays[a].end) ++a;
    const Array& array = arrays[a];
    const int64_t size = sizeof(Piece), begin = size * (a > 0 ? piece - arrays[a - 1].end : piece);
    if (array.aligned && begin + size <= array.bytes) {
      *reinterpret_cast<Piece*>(array.to + begin) = *reinterpret_cast<const Piece*>(array.from + begin);
    } else {
      for (int64_t k = begin; k < begin + size && k < array.bytes; ++k) array.to[k] = array.from[k];
    }
  }
};

namespace cuda {

// Calls pass(i) for all i below `count`, on the current device and asynchronously on `stream`, a cudaStream_t.
// Pass: one of those above, of float or double, with pointers to memory of the device. Throws std::runtime_error if
// the launch fails.
template <class Pass> void for_each_gaussian(const Pass& pass, int64_t count, void* stream);

}  // namespace cuda

// A step of Adam on what the projection reads of every Gaussian in every step, with the activations around it: from the
// gradients by the activated numbers to the activated numbers of the next step, in one pass over memory.

// How a raw number becomes what the rasterizer takes. Those of a quaternion go together.
enum class Activation { kNone, kSigmoid, kExp, kUnitQuaternion };

// One parameter tensor [N, row_size] with its moments, all dense.
template <class S> struct ActivatedTensor {
  S* raw;
  S* value;            // activated; if there is an activation: read, and written anew
  const S* dL_dvalue;  // read in rows of Gaussians that were seen
  S* moment;           // mean gradient
  S* square;           // mean squared gradient
  int row_size;        // numbers per row
  Activation activation;
  AdamRates<S> rates;

  // How many numbers are stepped together.
  DSMOE_HD int group() const { return activation == Activation::kUnitQuaternion ? 4 : 1; }
};

constexpr int kGaussianAdamTensors = 4;  // means, opacities, scales, rotations

template <class S> struct GaussianAdam {
  ActivatedTensor<S> tensors[kGaussianAdamTensors];
  int64_t num_gaussians;            // N
  const int32_t* radii;             // [N] above 0 if a Gaussian was seen; the others have no gradient
  const AdamRates<S>* given_rates;  // [kGaussianAdamTensors] in place of the tensors', or null
  AdamConstants<S> constants;

  // Of tensor t.
  DSMOE_HD AdamRates<S> rates(int t) const { return given_rates != nullptr ? given_rates[t] : tensors[t].rates; }
};

// What a step reads and changes of kSize numbers.
template <class S, int kSize> struct ActivatedNumbers {
  S raw[kSize], value[kSize], dL_dvalue[kSize], moment[kSize], square[kSize];
};

template <class S>
DSMOE_HD void step_number(const AdamConstants<S>& constants, Activation activation, const AdamRates<S>& rates,
                          ActivatedNumbers<S, 1>& n) {
  S gradient = n.dL_dvalue[0];
  if (activation == Activation::kSigmoid) gradient = sigmoid_backward(n.value[0], gradient);
  if (activation == Activation::kExp) gradient = exp_backward(n.value[0], gradient);
  adam_step(constants, rates, gradient, n.raw[0], n.moment[0], n.square[0]);
  if (activation == Activation::kSigmoid) n.value[0] = sigmoid(n.raw[0]);
  if (activation == Activation::kExp) n.value[0] = exp(n.raw[0]);
}

template <class S>
DSMOE_HD void step_quaternion(const AdamConstants<S>& constants, const AdamRates<S>& rates, bool seen,
                              ActivatedNumbers<S, 4>& n) {
  S gradient[4] = {};
  if (seen) normalize_quaternion_backward(n.raw, n.dL_dvalue, gradient);
  for (int k = 0; k < 4; ++k) adam_step(constants, rates, gradient[k], n.raw[k], n.moment[k], n.square[k]);
  normalize_quaternion(n.raw, n.value);
}

template <class S> void refuse_step_gaussians(const char* function, const GaussianAdam<S>& adam);  // as refuse_adam

namespace cpu {

template <class S> void step_gaussians(const GaussianAdam<S>& adam, int num_threads);

}  // namespace cpu

namespace cuda {

// The same on the current device, asynchronously on `stream`, a cudaStream_t. All pointers are to memory of the device;
// those of quaternions are aligned to whole quaternions. Throws std::runtime_error if a launch fails.
template <class S> void step_gaussians(const GaussianAdam<S>& adam, void* stream);

}  // namespace cuda

}  // namespace dsmoe

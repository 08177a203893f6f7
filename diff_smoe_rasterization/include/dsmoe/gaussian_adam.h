// A step of Adam on what the projection reads of every Gaussian in every step, with the activations around it: from the
// gradients by the activated numbers to the activated numbers of the next step, in one pass over memory.
#pragma once

#include <cstdint>

#include "dsmoe/activations.h"
#include "dsmoe/adam.h"

namespace dsmoe {

// How a raw number becomes what the rasterizer takes. Those of a quaternion go together.
enum class Activation { kNone, kSigmoid, kExp, kUnitQuaternion };

// One parameter tensor [N, row_size] with its moments, all dense.
template <class S> struct ActivatedTensor {
  S* raw;
  S* value;            // activated; where there is an activation: read, and written anew
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
  const int32_t* radii;             // [N] above 0 where a Gaussian was seen; the others have no gradient
  const AdamRates<S>* given_rates;  // [kGaussianAdamTensors] in place of those of the tensors, or null
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

namespace cpu {

template <class S> void step_gaussians(const GaussianAdam<S>& adam, int num_threads);

}  // namespace cpu

namespace cuda {

// The same on the current device, asynchronously on `stream`, a cudaStream_t. All pointers are to memory of the device;
// those of quaternions are aligned to whole quaternions. Throws std::runtime_error where a launch fails.
template <class S> void step_gaussians(const GaussianAdam<S>& adam, void* stream);

}  // namespace cuda
}  // namespace dsmoe

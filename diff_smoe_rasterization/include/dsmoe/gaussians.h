// Passes over all Gaussians between the optimizer and the rasterizer, on the CPU and on a GPU.
#pragma once

#include <cstdint>

#include "dsmoe/activations.h"

namespace dsmoe {

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

namespace cuda {

// Calls pass(i) for all of `count` Gaussians, on the current device and asynchronously on `stream`, a cudaStream_t.
// Pass: one of those above, of float or double, with pointers to memory of the device. Throws std::runtime_error where
// the launch fails.
template <class Pass> void for_each_gaussian(const Pass& pass, int64_t count, void* stream);

}  // namespace cuda
}  // namespace dsmoe

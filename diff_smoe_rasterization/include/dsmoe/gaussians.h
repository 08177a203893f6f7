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

// values = activation(raw)
template <class S>
DSMOE_HD void activate(const GaussianParameters<const S>& raw, const GaussianParameters<S>& values, int64_t i) {
  values.opacities[i] = sigmoid(raw.opacities[i]);
  for (int k = 0; k < 3; ++k) values.scales[3 * i + k] = exp(raw.scales[3 * i + k]);
  normalize_quaternion(raw.rotations + 4 * i, values.rotations + 4 * i);
}

// The gradients by `raw` from those by the values; a null pointer among the latter is a gradient of zero.
template <class S>
DSMOE_HD void activate_backward(const GaussianParameters<const S>& raw, const GaussianParameters<const S>& values,
                                const GaussianParameters<const S>& dL_dvalues, const GaussianParameters<S>& dL_draw,
                                int64_t i) {
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

// Adds one view to what densification knows: where the radius is positive, the length of the screen-space gradient
// (dL_dmeans2D [N, 3], of which x and y count) and 1.
template <class S>
DSMOE_HD void add_view(const S* dL_dmeans2D, const int32_t* radii, S* gradient_sum, S* view_count, int64_t i) {
  if (radii[i] <= 0) return;
  const S x = dL_dmeans2D[3 * i], y = dL_dmeans2D[3 * i + 1];
  gradient_sum[i] += sqrt(x * x + y * y);
  view_count[i] += S(1);
}

namespace cuda {

// The functions above for all of `count` Gaussians, on the current device. stream: a cudaStream_t.
template <class S>
void activate(const GaussianParameters<const S>& raw, const GaussianParameters<S>& values, int64_t count, void* stream);
template <class S>
void activate_backward(const GaussianParameters<const S>& raw, const GaussianParameters<const S>& values,
                       const GaussianParameters<const S>& dL_dvalues, const GaussianParameters<S>& dL_draw,
                       int64_t count, void* stream);
template <class S>
void add_view(const S* dL_dmeans2D, const int32_t* radii, S* gradient_sum, S* view_count, int64_t count, void* stream);

}  // namespace cuda
}  // namespace dsmoe

// Mean absolute and squared difference and SSIM of two images with the gradient, on the CPU and on a GPU.
#pragma once

#include <cstdint>

#include "dsmoe/ssim.h"

namespace dsmoe {

// loss = offset + l1_weight mean |x - y| + l2_weight mean (x - y)^2 + ssim_weight mean SSIM(x, y)
template <class S> struct ImageLoss {
  const S* image;               // [planes, height, width] x
  const S* target;              // [planes, height, width] y, or null
  const uint8_t* target_bytes;  // y times 255 instead
  int64_t planes;
  int height, width;
  int margin;  // pixels at each side of a plane that the mean of SSIM leaves out
  double l1_weight, l2_weight, ssim_weight, offset;
  S* loss;         // [1]
  S* gradient;     // [planes, height, width] by x, or null
  S* derivatives;  // [3, planes, height, width] scratch of the gradient, or null
  double* sums;    // [num_image_loss_sums(...)] scratch

  // What one pixel's terms are multiplied by.
  double l1_scale() const { return l1_weight / static_cast<double>(planes * height * width); }
  double l2_scale() const { return l2_weight / static_cast<double>(planes * height * width); }
  double ssim_scale() const {
    return ssim_weight / static_cast<double>(planes * (height - 2 * margin) * (width - 2 * margin));
  }
};

// Whether the mean of SSIM counts a pixel.
template <class S> DSMOE_HD bool in_margins(const ImageLoss<S>& loss, int row, int column) {
  return row >= loss.margin && row < loss.height - loss.margin && column >= loss.margin &&
         column < loss.width - loss.margin;
}

template <class S> DSMOE_HD S target_value(const ImageLoss<S>& loss, int64_t index) {
  return loss.target != nullptr ? loss.target[index] : S(loss.target_bytes[index]) / S(255);
}

template <class S> DSMOE_HD S sign(S value) { return S(value > 0) - S(value < 0); }

namespace cpu {

// How many numbers ImageLoss::sums must have.
int64_t num_image_loss_sums(int64_t planes, int height, int width);

// Writes the loss, and the gradient where it is not null. All pointers are to memory of the host.
template <class S> void image_loss(const ImageLoss<S>& loss, int num_threads);

}  // namespace cpu

namespace cuda {

// The same on the current device, asynchronously on `stream`, a cudaStream_t. All pointers are to memory of the device.
// Throws std::runtime_error where a launch fails.
template <class S> int64_t num_image_loss_sums(int64_t planes, int height, int width);
template <class S> void image_loss(const ImageLoss<S>& loss, void* stream);

}  // namespace cuda
}  // namespace dsmoe

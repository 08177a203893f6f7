// Mean absolute and squared difference and SSIM of two images with the gradient, on the CPU and on a GPU.
#pragma once

#include <cstdint>

#include "dsmoe/hd.h"

namespace dsmoe {

// Structural similarity of two images (Wang et al. 2004) at one pixel, and its derivatives.

// Local moments are means under an 11 x 11 Gaussian window, zeros outside the image.
constexpr int kSsimRadius = 5;
constexpr int kSsimTaps = 2 * kSsimRadius + 1;
constexpr double kSsimSigma = 1.5;

// (0.01 L)^2 and (0.03 L)^2 for the range L = 1.
constexpr double kSsimC1 = 1e-4;
constexpr double kSsimC2 = 9e-4;

// The window along one axis; it sums to 1.
template <class S> struct SsimWindow { S taps[kSsimTaps]; };

template <class S> inline SsimWindow<S> ssim_window() {
  double weights[kSsimTaps], sum = 0;
  for (int i = 0; i < kSsimTaps; ++i) {
    const double offset = i - kSsimRadius;
    sum += weights[i] = exp(-offset * offset / (2 * kSsimSigma * kSsimSigma));
  }
  SsimWindow<S> window;
  for (int i = 0; i < kSsimTaps; ++i) window.taps[i] = static_cast<S>(weights[i] / sum);
  return window;
}

// Windowed means of x, y, x^2, y^2 and x y.
constexpr int kNumSsimMoments = 5;
template <class S> struct SsimMoments { S mean_x, mean_y, square_x, square_y, product; };

// SSIM of a pixel, and its derivatives by mean_x, square_x and product.
constexpr int kNumSsimDerivatives = 3;
template <class S> struct Ssim { S value, d_mean, d_square, d_product; };

// A1 A2 / (B1 B2) with A1 = 2 mu_x mu_y + C1, A2 = 2 cov + C2, B1 = mu_x^2 + mu_y^2 + C1, B2 = var_x + var_y + C2.
template <class S> DSMOE_HD Ssim<S> ssim(const SsimMoments<S>& m) {
  const S xx = m.mean_x * m.mean_x, yy = m.mean_y * m.mean_y, xy = m.mean_x * m.mean_y;
  const S a1 = S(2) * xy + S(kSsimC1);
  const S a2 = S(2) * (m.product - xy) + S(kSsimC2);
  const S b1 = xx + yy + S(kSsimC1);
  const S b2 = (m.square_x - xx) + (m.square_y - yy) + S(kSsimC2);
  const S inverse = S(1) / (b1 * b2);
  const S value = a1 * a2 * inverse;
  return {value, S(2) * inverse * (m.mean_y * (a2 - a1) + m.mean_x * value * (b1 - b2)), -value * b1 * inverse,
          S(2) * a1 * inverse};
}

// Derivative of a sum of SSIM values by the pixel x, from the windowed means of their derivatives around it: the window
// is symmetric, its own adjoint.
template <class S> DSMOE_HD S ssim_gradient(S x, S y, S d_mean, S d_square, S d_product) {
  return d_mean + S(2) * x * d_square + y * d_product;
}

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

// What both backends refuse: null pointers, by name, and sizes that would have them read elsewhere. Throws
// std::invalid_argument.
template <class S> void refuse_image_loss(const char* function, const ImageLoss<S>& loss);

namespace cpu {

// How many numbers ImageLoss::sums must have.
int64_t num_image_loss_sums(int64_t planes, int height, int width);

// Writes the loss, and the gradient if it is not null. All pointers are to memory of the host.
template <class S> void image_loss(const ImageLoss<S>& loss, int num_threads);

}  // namespace cpu

namespace cuda {

// The same on the current device, asynchronously on `stream`, a cudaStream_t. All pointers are to memory of the device.
// Throws std::runtime_error if a launch fails.
template <class S> int64_t num_image_loss_sums(int64_t planes, int height, int width);
template <class S> void image_loss(const ImageLoss<S>& loss, void* stream);

}  // namespace cuda

}  // namespace dsmoe

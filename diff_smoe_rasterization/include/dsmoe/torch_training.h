// What a trainer in LibTorch needs beside the rasterizer: functions of the Python package, each a few kernels, on the
// device of their tensors. Types are float32 and float64. Errors as in dsmoe/torch.h.
#pragma once

#include <ATen/ATen.h>

#include <cstdint>
#include <utility>
#include <vector>

namespace dsmoe {

/// What the rasterizer takes from what an optimizer moves freely.
struct Activated {
  at::Tensor opacities;  // [N, 1] sigmoid
  at::Tensor scales;     // [N, 3] exp
  at::Tensor rotations;  // [N, 4] of length 1
};

/// opacities: [N, 1] logits. scales: [N, 3] logarithms. rotations: [N, 4] of any length. Differentiable.
Activated activate(const at::Tensor& opacities, const at::Tensor& scales, const at::Tensor& rotations);

/// (1 - lambda) mean |image - target| + lambda (1 - SSIM), the loss of 3D Gaussian Splatting. image: [..., H, W].
/// target: of the same shape and type, or uint8 (then 255 is 1). Differentiable by the image.
at::Tensor l1_ssim_loss(const at::Tensor& image, const at::Tensor& target, double lambda_dssim = 0.2);

/// Mean structural similarity: 11x11 Gaussian window of sigma 1.5, zeros outside the image. Differentiable by img1.
at::Tensor fused_ssim(const at::Tensor& img1, const at::Tensor& img2);

/// One parameter of Adam and its state.
struct AdamParameter {
  at::Tensor value;           // stepped in place if it has a gradient
  double lr = 1e-3;           // learning rate
  at::Tensor moment, square;  // mean gradient and mean squared gradient; undefined before the first step
  int64_t step = 0;           // how many steps it has made
};

/// One step of Adam (Kingma and Ba 2015) over all parameters, in one pass over memory. They have one type and device.
void adam_step(std::vector<AdamParameter>& parameters, double epsilon = 1e-8, double beta1 = 0.9, double beta2 = 0.999);

/// Adds one view to the statistics of densification, in place: where radii [N] (int32) is positive, gradient_sum [N]
/// grows by the length of the first two components of dL_dmeans2D [N, 3], and view_count [N] by 1.
void add_view(const at::Tensor& dL_dmeans2D, const at::Tensor& radii, const at::Tensor& gradient_sum,
              const at::Tensor& view_count);

/// Mean squared distance of each point [N, 3] to its three nearest others, as many as there are: [N]. No gradient.
at::Tensor distCUDA2(const at::Tensor& points);

}  // namespace dsmoe

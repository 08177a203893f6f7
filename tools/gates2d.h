// A picture as a mixture of K kernels in the plane, and its gradient: what the paper's Figures 2, 3 and 10 show.
//
// With G_i = exp(-1/2 |L_i (x - m_i)|^2), L_i lower triangular, a weight p_i and an expert c_i, a pixel is
//
//   gated          C(x) = sum_i g_i c_i,   g_i = p_i G_i / sum_j p_j G_j      (Eq. 6, without opacity and depth)
//   weighted sum   C(x) = sum_i G_i c_i
//
// The rasterizer's blend does not serve here: by its cut at G < 1e-5 a pixel beyond 4.8 sigma is background. The sharp
// edge between two gates is made by tails far beyond. So exponents are kept as logarithms, and the
// gates are their softmax: no tail is too faint.
//
// Positions are in pixels divided by the longer side of the picture, so that all parameters are of one order.
#pragma once

#include <cstdint>
#include <string>
#include <vector>

namespace dsmoe::tools {

enum class KernelShape {
  kEqual,    // round, one bandwidth for all
  kRound,    // round, each with its own
  kSteered,  // ellipses
};

enum class Mixture { kGated, kWeightedSum };

constexpr int kKernelNumbers = 9;  // parameters of a kernel

/// Parameters of a kernel, or their gradients; to the optimizer, an array of numbers.
struct Kernel {
  double x, y;                // m
  double log_xx, yx, log_yy;  // L = [[exp(log_xx), 0], [yx, exp(log_yy)]]
  double log_weight;          // log p
  double red, green, blue;    // c
};
static_assert(sizeof(Kernel) == kKernelNumbers * sizeof(double), "an array of kernels is an array of numbers");

struct Mixture2d {
  int width = 0, height = 0;  // pixels
  Mixture mixture = Mixture::kGated;
  KernelShape shape = KernelShape::kSteered;
  std::vector<Kernel> kernels;
};

/// The picture, [3, H, W], and per pixel the kernel with the greatest gate (or the greatest p G).
struct Drawing {
  std::vector<float> color;
  std::vector<int32_t> greatest;  // [H, W]
};
Drawing draw(const Mixture2d& model, int num_threads);

/// The gates at a pixel, [K]; for the weighted sum the kernels G.
std::vector<double> gates_at(const Mixture2d& model, int x, int y);

/// The mean squared error against `target` [3, H, W], and its gradient by each kernel. If kernels share a parameter,
/// each gets the sum; what their shape does not have gets 0. The result does not depend on num_threads.
double loss_and_gradient(const Mixture2d& model, const std::vector<float>& target, int num_threads,
                         std::vector<Kernel>& gradient);

struct FitOptions {
  int kernels = 2;
  Mixture mixture = Mixture::kGated;
  KernelShape shape = KernelShape::kSteered;
  int iterations = 2000;
  double rate = 0.02;  // of Adam; it falls to a hundredth in the end
  unsigned seed = 0;
  int num_threads = 1;
};

/// A fit under way, by Adam. It begins with kernels at random pixels, in the colours of these.
class Fit {
 public:
  /// target: [3, H, W]; must outlive the object.
  Fit(const std::vector<float>& target, int width, int height, const FitOptions& options);

  /// Returns the mean squared error before the step.
  double step();
  const Mixture2d& model() const { return model_; }

 private:
  const std::vector<float>& target_;
  const FitOptions options_;
  Mixture2d model_;
  int done_ = 0;
  std::vector<Kernel> gradient_, moment_, square_;
};

/// 10 log10(1 / mean squared error)
double psnr(double mean_squared_error);

}  // namespace dsmoe::tools

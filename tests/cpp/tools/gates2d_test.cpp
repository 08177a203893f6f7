// The 2D mixture: its pixels by the equations, its gradient by finite differences, and what it can and cannot fit.
#include "gates2d.h"

#include <gtest/gtest.h>

#include <cmath>

#include "finite_difference.h"

namespace dsmoe::tools {
namespace {

constexpr int kWidth = 37, kHeight = 21;  // several tiles, not whole ones

Mixture2d make_mixture(Mixture mixture, KernelShape shape, int count) {
  Random random(5);
  Mixture2d model = {kWidth, kHeight, mixture, shape, {}};
  for (int i = 0; i < count; ++i) {
    const double bandwidth = shape == KernelShape::kEqual ? 2 : random.uniform(1.2, 2.5);
    Kernel kernel = {random.uniform(0, 1), random.uniform(0, 0.6), bandwidth, 0, bandwidth, 0, 0, 0, 0};
    if (shape == KernelShape::kSteered) kernel.yx = random.uniform(-4, 4), kernel.log_yy = random.uniform(1.2, 2.5);
    if (mixture == Mixture::kGated) kernel.log_weight = random.uniform(-1, 1);
    kernel.red = random.uniform(0, 1), kernel.green = random.uniform(0, 1), kernel.blue = random.uniform(-1, 2);
    model.kernels.push_back(kernel);
  }
  return model;
}

std::vector<float> make_target() {
  Random random(6);
  const std::vector<double> values = random.uniforms(3 * kWidth * kHeight, 0, 1);
  return {values.begin(), values.end()};
}

struct Case {
  Mixture mixture;
  KernelShape shape;
};
struct Mixture2dOf : testing::TestWithParam<Case> {};
INSTANTIATE_TEST_SUITE_P(All, Mixture2dOf,
                         testing::Values(Case{Mixture::kGated, KernelShape::kEqual},
                                         Case{Mixture::kGated, KernelShape::kRound},
                                         Case{Mixture::kGated, KernelShape::kSteered},
                                         Case{Mixture::kWeightedSum, KernelShape::kEqual},
                                         Case{Mixture::kWeightedSum, KernelShape::kRound},
                                         Case{Mixture::kWeightedSum, KernelShape::kSteered}));

TEST_P(Mixture2dOf, DrawsWhatItsEquationSays) {
  const Mixture2d model = make_mixture(GetParam().mixture, GetParam().shape, 7);
  const Drawing drawing = draw(model, 1);
  for (int y = 0; y < kHeight; ++y) {
    for (int x = 0; x < kWidth; ++x) {
      // All in pixels over the longer side; the centre of the first pixel is at half a pixel.
      const double px = (x + 0.5) / kWidth, py = (y + 0.5) / kWidth;
      double sum = 0, red = 0, blue = 0, greatest = -1;
      int32_t expected = -1;
      for (std::size_t i = 0; i < model.kernels.size(); ++i) {
        const Kernel& k = model.kernels[i];
        const double u = std::exp(k.log_xx) * (px - k.x), v = k.yx * (px - k.x) + std::exp(k.log_yy) * (py - k.y);
        const double weight = std::exp(k.log_weight - 0.5 * (u * u + v * v));
        sum += weight, red += weight * k.red, blue += weight * k.blue;
        if (weight > greatest) greatest = weight, expected = static_cast<int32_t>(i);
      }
      if (model.mixture == Mixture::kGated) red /= sum, blue /= sum;
      const std::size_t pixel = static_cast<std::size_t>(y) * kWidth + x;
      // Images are float32, and kernels below exp(-20) are left out.
      EXPECT_NEAR(drawing.color[pixel], red, 3e-7);
      EXPECT_NEAR(drawing.color[2 * kWidth * kHeight + pixel], blue, 6e-7);
      EXPECT_EQ(drawing.greatest[pixel], expected);
    }
  }
}

TEST_P(Mixture2dOf, HasTheGradientOfFiniteDifferences) {
  Mixture2d model = make_mixture(GetParam().mixture, GetParam().shape, 5);
  const std::vector<float> target = make_target();
  std::vector<Kernel> gradient;
  loss_and_gradient(model, target, 1, gradient);
  const auto numbers = [](std::vector<Kernel>& kernels) { return reinterpret_cast<double*>(kernels.data()); };

  // A free parameter is a number of one kernel, or what shapes share: both bandwidths of a kernel, or those of all.
  const int log_xx = 2, yx = 3, log_yy = 4, log_weight = 5, count = static_cast<int>(model.kernels.size());
  std::vector<std::vector<int>> groups;
  std::vector<int> bandwidths;
  for (int i = 0; i < count; ++i) {
    for (int k = 0; k < kKernelNumbers; ++k) {
      const bool tied = model.shape != KernelShape::kSteered && (k == log_xx || k == yx || k == log_yy);
      if (tied || (model.mixture == Mixture::kWeightedSum && k == log_weight)) continue;
      groups.push_back({kKernelNumbers * i + k});
    }
    const std::vector<int> both = {kKernelNumbers * i + log_xx, kKernelNumbers * i + log_yy};
    if (model.shape == KernelShape::kRound) groups.push_back(both);
    if (model.shape == KernelShape::kEqual) bandwidths.insert(bandwidths.end(), both.begin(), both.end());
  }
  if (!bandwidths.empty()) groups.push_back(bandwidths);

  std::vector<double> actual, start(groups.size());
  for (const auto& group : groups) actual.push_back(numbers(gradient)[group[0]]);
  const std::vector<Kernel> kernels = model.kernels;
  const auto loss = [&](const std::vector<double>& offsets) {
    model.kernels = kernels;
    for (std::size_t g = 0; g < groups.size(); ++g) {
      for (const int index : groups[g]) numbers(model.kernels)[index] += offsets[g];
    }
    std::vector<Kernel> unused;
    return loss_and_gradient(model, target, 1, unused);
  };
  // Kernels below exp(-20) = 2e-9 come and go with the offset: over a step of 1e-3 that is 2e-6 of a gradient near 1.
  expect_gradient(actual, loss, start, 1e-3, 1e-5);
}

TEST_P(Mixture2dOf, DoesNotDependOnThreads) {
  const Mixture2d model = make_mixture(GetParam().mixture, GetParam().shape, 7);
  const std::vector<float> target = make_target();
  std::vector<Kernel> expected, actual;
  const double loss = loss_and_gradient(model, target, 1, expected);
  EXPECT_EQ(loss_and_gradient(model, target, 3, actual), loss);
  for (std::size_t i = 0; i < expected.size(); ++i) {
    EXPECT_EQ(actual[i].x, expected[i].x);
    EXPECT_EQ(actual[i].log_yy, expected[i].log_yy);
  }
}

// Red above the diagonal, blue below.
std::vector<float> edge(int size) {
  std::vector<float> target(3 * size * size);
  for (int y = 0; y < size; ++y) {
    for (int x = 0; x < size; ++x) target[(x > y ? 0 : 2) * size * size + y * size + x] = 1;
  }
  return target;
}

double fitted_psnr(int kernels, Mixture mixture, KernelShape shape) {
  constexpr int kSize = 32;
  const std::vector<float> target = edge(kSize);
  FitOptions options;
  options.kernels = kernels, options.mixture = mixture, options.shape = shape;
  Fit fit(target, kSize, kSize, options);
  for (int i = 0; i < options.iterations; ++i) fit.step();
  std::vector<Kernel> unused;
  return psnr(loss_and_gradient(fit.model(), target, 1, unused));
}

TEST(Fit2d, MakesASharpEdgeOfTwoEqualKernelsUnderTheGate) {
  EXPECT_GE(fitted_psnr(2, Mixture::kGated, KernelShape::kEqual), 40);
}

TEST(Fit2d, NeedsMoreSteeredKernelsUnderTheWeightedSumAndStaysBlurred) {
  const double two = fitted_psnr(2, Mixture::kWeightedSum, KernelShape::kSteered);
  const double six = fitted_psnr(6, Mixture::kWeightedSum, KernelShape::kSteered);
  EXPECT_LT(two, 20);
  EXPECT_GT(six, two + 2);
}

}  // namespace
}  // namespace dsmoe::tools

// SSIM of one pixel and its derivatives; the window.
#include "dsmoe/training/image_loss.h"

#include <gtest/gtest.h>

#include <cmath>
#include <vector>

#include "finite_difference.h"

namespace dsmoe {
namespace {

using Vector = std::vector<double>;

// Moments of some samples x, y of equal weight: a real covariance.
SsimMoments<double> moments_of(const Vector& x, const Vector& y) {
  SsimMoments<double> m = {};
  for (size_t i = 0; i < x.size(); ++i) {
    m.mean_x += x[i] / x.size();
    m.mean_y += y[i] / x.size();
    m.square_x += x[i] * x[i] / x.size();
    m.square_y += y[i] * y[i] / x.size();
    m.product += x[i] * y[i] / x.size();
  }
  return m;
}

TEST(SsimWindow, SumsToOneAndIsSymmetric) {
  const SsimWindow<double> window = ssim_window<double>();
  double sum = 0;
  for (int i = 0; i < kSsimTaps; ++i) {
    sum += window.taps[i];
    EXPECT_EQ(window.taps[i], window.taps[kSsimTaps - 1 - i]);
  }
  EXPECT_NEAR(sum, 1, 1e-15);
  // One step from the centre: exp(-1 / (2 1.5^2)).
  EXPECT_NEAR(window.taps[kSsimRadius + 1] / window.taps[kSsimRadius], std::exp(-1 / 4.5), 1e-15);
}

TEST(Ssim, IsOneForEqualImages) {
  const Vector x = {0.1, 0.7, 0.4};
  EXPECT_NEAR(ssim(moments_of(x, x)).value, 1, 1e-14);
}

TEST(Ssim, IsSymmetricAndFallsWithTheDifference) {
  const Vector x = {0.1, 0.7, 0.4}, near = {0.15, 0.65, 0.45}, far = {0.8, 0.1, 0.5};
  EXPECT_NEAR(ssim(moments_of(x, near)).value, ssim(moments_of(near, x)).value, 1e-14);
  EXPECT_LT(ssim(moments_of(x, near)).value, 1);
  EXPECT_LT(ssim(moments_of(x, far)).value, ssim(moments_of(x, near)).value);
}

TEST(Ssim, ConstantImagesByHand) {
  const Vector x = {0.2, 0.2}, y = {0.6, 0.6};  // no variance: the second factor is C2 / C2
  EXPECT_NEAR(ssim(moments_of(x, y)).value, (2 * 0.12 + 1e-4) / (0.04 + 0.36 + 1e-4), 1e-14);
}

TEST(Ssim, DerivativesMatchFiniteDifferences) {
  Random random(1);
  for (int i = 0; i < 20; ++i) {
    const SsimMoments<double> m = moments_of(random.uniforms(6, 0, 1), random.uniforms(6, 0, 1));
    const Ssim<double> pixel = ssim(m);
    const auto value = [&](const Vector& p) {
      SsimMoments<double> moved = m;
      moved.mean_x = p[0], moved.square_x = p[1], moved.product = p[2];
      return ssim(moved).value;
    };
    // Third derivatives reach 1e4 if the variance is small: a shorter step.
    expect_gradient({pixel.d_mean, pixel.d_square, pixel.d_product}, value, {m.mean_x, m.square_x, m.product}, 1e-4,
                    1e-6);
  }
}

// A window of one pixel: mean x, square x^2, product x y.
TEST(Ssim, GradientByThePixelMatchesFiniteDifferences) {
  const double y = 0.3;
  const auto moments = [&](double x) {
    return SsimMoments<double>{0.5 * x + 0.2, y, 0.5 * x * x + 0.1, y * y + 0.05, 0.5 * x * y + 0.06};
  };
  const auto value = [&](const Vector& p) { return ssim(moments(p[0])).value; };
  const Ssim<double> pixel = ssim(moments(0.7));
  const double gradient = ssim_gradient(0.7, y, 0.5 * pixel.d_mean, 0.5 * pixel.d_square, 0.5 * pixel.d_product);
  expect_gradient({gradient}, value, {0.7});
}

}  // namespace
}  // namespace dsmoe

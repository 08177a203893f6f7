// Lenses: known points, Jacobians and backward passes by finite differences, and calibrations that are refused.
#include "dsmoe/lens.h"

#include <gtest/gtest.h>

#include <cmath>
#include <limits>
#include <vector>

#include "finite_difference.h"
#include "refusal.h"

namespace dsmoe {
namespace {

using Vector = std::vector<double>;
constexpr double kPi = 3.14159265358979323846;

LensCalibration calibration(LensModel model, Vector distortion = {}) {
  return {model, 100, 80, 60, 55, 51, 38, std::move(distortion)};
}

const Vector kOfOpencv = {-0.2, 0.05, 0.01, -0.02, 0.03, 0.01, 0.02, -0.01, 0.01, -0.005, 0.004, 0.003};
const Vector kOfFisheye = {0.02, -0.01, 0.003, -0.0002};
const Vector kOfThinPrism = {0.02, -0.01, 0.003, -0.002, 0.01, 0.001, 0.02, -0.01};

std::vector<LensCalibration> every_lens() {
  return {calibration(LensModel::kOrthographic), calibration(LensModel::kOpencv, kOfOpencv),
          calibration(LensModel::kFisheye, kOfFisheye), calibration(LensModel::kThinPrismFisheye, kOfThinPrism),
          calibration(LensModel::kEquirectangular)};
}

// Directions from the axis to beyond the plane of the camera, on both sides of where a series ends, for lenses that see
// them.
std::vector<Vector> views(LensModel model) {
  std::vector<Vector> all = {{0, 0, 2}, {1e-4, -2e-4, 2}, {0.1, 0.05, 1.2}, {-0.1, 0.06, 1.3}, {0.7, -0.5, 1.1}};
  if (sees_around(model)) all.insert(all.end(), {{1.2, -0.3, -0.1}, {0.1, 1.5, 0.2}, {-0.9, 0.4, -0.2}});
  return all;
}

Vec3<double> vec3(const Vector& v) { return {v[0], v[1], v[2]}; }

TEST(Lens, TheJacobianIsTheDerivativeOfThePixel) {
  for (const LensCalibration& of : every_lens()) {
    const Lens<double> lens = lens_of(of);
    for (const Vector& view : views(of.model)) {
      const auto point = through_lens(lens, vec3(view));
      ASSERT_TRUE(point.seen) << kLensNames[int(of.model)];
      const auto& [x, y] = point.jacobian;
      expect_gradient(
          {x.x, x.y, x.z}, [&](const Vector& v) { return through_lens(lens, vec3(v)).pixel.x; }, view);
      expect_gradient(
          {y.x, y.y, y.z}, [&](const Vector& v) { return through_lens(lens, vec3(v)).pixel.y; }, view);
    }
  }
}

TEST(Lens, BackwardIsTheDerivativeOfPixelAndJacobian) {
  Random random(3);
  for (const LensCalibration& of : every_lens()) {
    const Lens<double> lens = lens_of(of);
    for (const Vector& view : views(of.model)) {
      const Vector w = random.uniforms(8);
      const Mat23<double> by_jacobian = {{w[2], w[3], w[4]}, {w[5], w[6], w[7]}};
      const auto loss = [&](const Vector& v) {
        const auto point = through_lens(lens, vec3(v));
        return w[0] * point.pixel.x + w[1] * point.pixel.y + dot(by_jacobian.r0, point.jacobian.r0) +
               dot(by_jacobian.r1, point.jacobian.r1);
      };
      const auto g = through_lens_backward(lens, vec3(view), {w[0], w[1]}, by_jacobian);
      expect_gradient({g.x, g.y, g.z}, loss, view, 3e-4);  // higher derivatives are large near the camera
    }
  }
}

TEST(Lens, TheSlopeOfTheJacobianIsClampedAndHasNoDerivativeThere) {
  const Lens<double> lens = lens_of(calibration(LensModel::kOpencv));
  const double limit = 1.3 * 51 / 60;  // the image's wider side of the principal point
  EXPECT_NEAR(lens.slope_limit.x, limit, 1e-12);
  const auto point = through_lens<double>(lens, {20, 0.1, 2});
  EXPECT_NEAR(point.jacobian.r0.z, -60 * limit / 2, 1e-11);
  EXPECT_NEAR(point.pixel.x, 60 * 10 + 50.5, 1e-11);
  const auto loss = [&](const Vector& v) { return through_lens(lens, vec3(v)).jacobian.r0.z; };
  const auto g = through_lens_backward<double>(lens, {20, 0.1, 2}, {0, 0}, {{0, 0, 1}, {0, 0, 0}});
  expect_gradient({g.x, g.y, g.z}, loss, {20, 0.1, 2});
}

void expect_pixel(const LensCalibration& of, Vec3<double> view, double x, double y) {
  const auto pixel = through_lens(lens_of(of), view).pixel;
  EXPECT_NEAR(pixel.x, x, 1e-11) << kLensNames[int(of.model)];
  EXPECT_NEAR(pixel.y, y, 1e-11) << kLensNames[int(of.model)];
}

// By hand from the equations of OpenCV and COLMAP. Pixel centres are integers, so all are half a pixel less.
TEST(Lens, PutsKnownPointsWhereTheyBelong) {
  expect_pixel(calibration(LensModel::kOrthographic), {0.5, -0.25, 7}, 30 + 50.5, -13.75 + 37.5);
  const double a = 0.5, b = -0.25, q = a * a + b * b;
  {
    const Vector& k = kOfOpencv;
    const double radial =
        (1 + k[0] * q + k[1] * q * q + k[4] * q * q * q) / (1 + k[5] * q + k[6] * q * q + k[7] * q * q * q);
    const double u = a * radial + 2 * k[2] * a * b + k[3] * (q + 2 * a * a) + k[8] * q + k[9] * q * q;
    const double v = b * radial + k[2] * (q + 2 * b * b) + 2 * k[3] * a * b + k[10] * q + k[11] * q * q;
    expect_pixel(calibration(LensModel::kOpencv, k), {2 * a, 2 * b, 2}, 60 * u + 50.5, 55 * v + 37.5);
  }
  const double right_angle = kPi / 2;
  expect_pixel(calibration(LensModel::kFisheye), {3, 0, 0}, 60 * right_angle + 50.5, 37.5);
  {
    const Vector& k = kOfFisheye;
    const double t = std::atan2(std::hypot(3, 4), 2), t2 = t * t;
    const double r = t * (1 + t2 * (k[0] + t2 * (k[1] + t2 * (k[2] + t2 * k[3]))));
    expect_pixel(calibration(LensModel::kFisheye, k), {3, -4, 2}, 60 * r * 0.6 + 50.5, -55 * r * 0.8 + 37.5);
  }
  {
    const Vector& k = kOfThinPrism;
    const double t = std::atan2(5, 2), u = 0.6 * t, v = -0.8 * t, s = t * t;
    const double radial = 1 + s * (k[0] + s * (k[1] + s * (k[4] + s * k[5])));
    expect_pixel(calibration(LensModel::kThinPrismFisheye, k), {3, -4, 2},
                 60 * (u * radial + 2 * k[2] * u * v + k[3] * (s + 2 * u * u) + k[6] * s) + 50.5,
                 55 * (v * radial + 2 * k[3] * u * v + k[2] * (s + 2 * v * v) + k[7] * s) + 37.5);
  }
  const auto around = calibration(LensModel::kEquirectangular);
  expect_pixel(around, {0, 0, 1}, 49.5, 39.5);
  expect_pixel(around, {2, 0, 0}, 74.5, 39.5);
  expect_pixel(around, {-2, 0, 0}, 24.5, 39.5);
  expect_pixel(around, {0, 1, 1}, 49.5, 59.5);  // y points down
}

TEST(Lens, EndsWhereTheDistortedRadiusStopsRising) {
  // r (1 - r^2 / 3) rises to r = 1.
  for (const LensModel model : {LensModel::kOpencv, LensModel::kFisheye}) {
    const Lens<double> lens = lens_of(calibration(model, {-1.0 / 3}));
    EXPECT_NEAR(lens.range, 1, 1e-9);
    const auto seen = [&](double r) {
      return through_lens<double>(lens, {r * 0.6, r * 0.8, model == LensModel::kOpencv ? 1 : r / std::tan(r)}).seen;
    };
    EXPECT_TRUE(seen(0.999));
    EXPECT_FALSE(seen(1.001));
  }
  EXPECT_NEAR(lens_of(calibration(LensModel::kFisheye)).range, 0.97 * kPi, 1e-12);
  // A pole of the denominator, at r^2 = 1 / 4.
  EXPECT_LE(lens_of(calibration(LensModel::kOpencv, {0, 0, 0, 0, 0, -4, 0, 0})).range, 0.5);
}

TEST(Lens, RefusesWhatIsNone) {
  const double nan = std::numeric_limits<double>::quiet_NaN();
  const auto with = [](auto change) {
    LensCalibration of = calibration(LensModel::kFisheye, kOfFisheye);
    change(of);
    return of;
  };
  const std::vector<std::pair<LensCalibration, std::string>> cases = {
      {calibration(LensModel::kOpencv, {1, 2, 3}),
       "lens_of: distortion has 3 numbers; it must have 0, 1, 2, 4, 5, 8 or 12: k1 k2 p1 p2 k3 k4 k5 k6 s1 s2 s3 s4 "
       "(camera_model opencv)"},
      {calibration(LensModel::kThinPrismFisheye, {1, 2, 3, 4}),
       "lens_of: distortion has 4 numbers; it must have 0 or 8: k1 k2 p1 p2 k3 k4 sx1 sy1 (camera_model "
       "thin_prism_fisheye)"},
      {calibration(LensModel::kEquirectangular, {1}),
       "lens_of: distortion has 1 numbers; it must have 0 (camera_model equirectangular)"},
      {calibration(LensModel::kFisheye, {0, nan, 0, 0}),
       "lens_of: distortion[1] is nan; it must be finite (camera_model fisheye)"},
      {with([](auto& of) { of.fx = 0; }),
       "lens_of: the focal lengths are 0 and 55; they must be positive and finite (camera_model fisheye)"},
      {with([&](auto& of) { of.cy = nan; }),
       "lens_of: principal_point is 51, nan; it must be finite (camera_model fisheye)"},
      {with([](auto& of) { of.model = static_cast<LensModel>(9); }), "lens_of: camera_model is 9; it must be 0 to 5"}};
  for (const auto& [of, message] : cases) {
    expect_refusal([&of = of] { lens_of(of); }, message);
  }
  expect_refusal(
      [] { lens_of(calibration(LensModel::kOpencv, {-3e4 / 4})); },
      "lens_of: distortion folds the image back at 0.266667 pixels from the principal point; it must rise over "
      "1 or more (camera_model opencv)");
}

}  // namespace
}  // namespace dsmoe

// One Gaussian from world to image plane and its gradient back, and which Gaussians are culled.
#include <gtest/gtest.h>

#include <cmath>
#include <limits>
#include <vector>

#include "all_modes.h"
#include "dsmoe/arrays.h"
#include "test_scene.h"

namespace dsmoe {
namespace {

using Vector = std::vector<double>;

// A single Gaussian well inside the image, 3 pixels across or more, with harmonics up to degree 3.
Scene<double> single_gaussian() {
  Scene<double> scene = make_scene(1, 1, 40, 30);
  scene.config.depth = scene.config.inverse_depth = true;
  scene.means3D = {0.2, -0.1, 0.3};
  scene.opacities = {0.7};
  scene.scales = {0.5, 0.2, 0.3};
  scene.rotations = {0.9, -0.4, 0.5, 0.3};  // length 1.14
  scene.sh_degree = 3;
  scene.shs = Random(2).uniforms(48, -0.15, 0.15);
  return scene;
}

struct Projected : Projection<double> {
  Vector features;
};

template <class S> Projection<S> project_first(const Scene<S>& scene, S* features) {
  return project_gaussian<S>({scene.inputs(), scene.camera, scene.raster_config(), 0}, features);
}

Projected project(const Scene<double>& scene) {
  Vector features(scene.config.num_features());
  return {project_first(scene, features.data()), features};
}

Vector flat(const Projected& p) {
  const auto& g = p.gaussian;
  Vector out = {g.mean.x, g.mean.y, g.conic.xx, g.conic.xy, g.conic.yy, g.opacity};
  out.insert(out.end(), p.features.begin(), p.features.end());
  return out;
}

// All outputs, weighted, by all inputs and the camera.
void expect_backward_is_the_derivative(Scene<double> scene) {
  const Projected forward = project(scene);
  ASSERT_GT(forward.radius, 0);
  Vector w = Random(3).uniforms(6 + scene.config.num_features());
  for (int k = 2; k < 5; ++k) w[k] *= 10;  // the conic is small: let it weigh
  const Vector x = scene.flat();
  auto loss = [&](const Vector& v) {
    scene.set_flat(v);
    return weighted_sum(w, flat(project(scene)));
  };
  const Vector expected = finite_differences(loss, x, 1e-4);  // coordinates of 0.1 to 1, so smaller steps
  scene.set_flat(x);

  SceneGradient<double> gradient(scene);
  gradient.camera = {};
  std::fill(gradient.by.background.begin(), gradient.by.background.end(), 0);
  std::fill(gradient.by.shs.begin(), gradient.by.shs.end(), 0);  // written for the active degree only
  const PixelSums<double> sums = {{{w[0], w[1]}, {w[2], w[3], w[4]}, w[5]}, {forward.features.data(), &w[6]}};
  gradient.camera.add(project_gaussian_backward<double>({scene.inputs(), scene.camera, scene.raster_config(), 0}, sums,
                                                        gradient.gradients()));
  // Steps of 1e-4 and pixel coordinates of 20 round at 1e-11.
  expect_near_all(gradient.flat(), expected, kGradientTolerance);
}

TEST(ProjectGaussian, BackwardIsTheDerivativeByGaussianAndCamera) {
  expect_backward_is_the_derivative(single_gaussian());
}

TEST(ProjectGaussian, BackwardIsTheDerivativeWithAGivenCovariance) {
  Scene<double> scene = single_gaussian();
  scene.scales.clear();
  scene.rotations.clear();
  scene.cov3D_precomp = {0.25, 0.05, -0.03, 0.1, 0.02, 0.2};
  expect_backward_is_the_derivative(scene);
}

TEST(ProjectGaussian, BackwardIsTheDerivativeThroughEveryLens) {
  for (const Lens<double>& lens : make_lenses(40, 30)) {
    for (const bool given : {false, true}) {
      Scene<double> scene = single_gaussian();
      scene.camera.lens = lens;
      scene.config.antialiasing = true;
      if (given) {
        scene.scales.clear(), scene.rotations.clear();
        scene.cov3D_precomp = {0.25, 0.05, -0.03, 0.1, 0.02, 0.2};
      }
      expect_backward_is_the_derivative(scene);
    }
  }
}

TEST(ProjectGaussian, BackwardIsTheDerivativeWithARollingShutter) {
  for (const Lens<double>& lens : make_lenses(40, 30)) {
    for (const Shutter shutter : kRolling) {
      Scene<double> scene = single_gaussian();
      scene.camera.lens = lens;
      scene.config.antialiasing = true;
      set_shutter(scene.camera, shutter);
      if (shutter == Shutter::kBottomToTop) {
        scene.scales.clear(), scene.rotations.clear();
        scene.cov3D_precomp = {0.25, 0.05, -0.03, 0.1, 0.02, 0.2};
      }
      expect_backward_is_the_derivative(scene);
    }
  }
}

// With slopes clamped the Jacobian is not the derivative of the pixel, and beyond the image the pose stands still.
TEST(ProjectGaussian, BackwardIsTheDerivativeBesideARollingImage) {
  for (const double aside : {2.8, -5.5}) {
    for (const Shutter shutter : {Shutter::kTopToBottom, Shutter::kLeftToRight}) {
      Scene<double> scene = single_gaussian();
      scene.camera.lens = make_lenses(40, 30)[1];
      set_shutter(scene.camera, shutter);
      scene.means3D[0] = aside, scene.scales = {1.5, 0.9, 0.8};
      const auto point = through_lens(scene.camera.lens, transform_point(scene.camera.view, load3(&scene.means3D[0])));
      ASSERT_TRUE(point.pixel.x < -0.2 * 40 || point.pixel.x > 1.2 * 40) << point.pixel.x;
      expect_backward_is_the_derivative(scene);
    }
  }
}

TEST(ProjectGaussian, ARollingShutterReadsEachRowByThePoseOfItsTime) {
  Scene<double> scene = single_gaussian();
  for (const Lens<double>& lens : make_lenses(40, 30)) {
    for (const Shutter shutter : kRolling) {
      scene.camera.lens = lens;
      set_shutter(scene.camera, shutter);
      const auto rolled = project(scene).gaussian;
      const double place = shutter == Shutter::kTopToBottom   ? rolled.mean.y / 29
                           : shutter == Shutter::kBottomToTop ? 1 - rolled.mean.y / 29
                           : shutter == Shutter::kLeftToRight ? rolled.mean.x / 39
                                                              : 1 - rolled.mean.x / 39;
      ASSERT_GT(place, 0.1);
      ASSERT_LT(place, 0.9);
      Scene<double> still = scene;
      still.camera.shutter = Shutter::kGlobal;
      for (int k = 0; k < 16; ++k) still.camera.view[k] += place * (scene.camera.view_end[k] - scene.camera.view[k]);
      const auto expected = project(still).gaussian;
      EXPECT_NEAR(rolled.mean.x, expected.mean.x, 1e-11);
      EXPECT_NEAR(rolled.mean.y, expected.mean.y, 1e-11);
      EXPECT_NEAR(rolled.depth, expected.depth, 1e-12);
      const double off = std::abs(rolled.conic.xx / expected.conic.xx - 1);
      EXPECT_GT(off + std::abs(rolled.conic.yy / expected.conic.yy - 1), 1e-3) << "stretched with the shutter";
    }
  }
}

// By a parallel projection, in the middle of the image at half time.
TEST(ProjectGaussian, WhatMovesWithTheShutterIsCulled) {
  Scene<double> scene = single_gaussian();
  scene.camera.lens = lens_of({LensModel::kOrthographic, 40, 30, 5, 5, 20, 15, {}});
  scene.camera.shutter = Shutter::kTopToBottom;
  const double* view = scene.camera.view;
  for (const auto& [share, seen] : std::vector<std::pair<double, bool>>{{-3, true}, {0.5, true}, {0.95, false}}) {
    const double moves = share * 29 / 5, point[3] = {0, -moves / 2, 3};
    std::copy_n(view, 16, scene.camera.view_end);
    scene.camera.view_end[13] += moves;
    for (int axis = 0; axis < 3; ++axis) {
      scene.means3D[axis] = 0;
      for (int k = 0; k < 3; ++k) scene.means3D[axis] += view[4 * axis + k] * (point[k] - view[12 + k]);
    }
    EXPECT_EQ(project(scene).radius > 0, seen) << share;
  }
}

// However wildly the camera turns: where Newton's steps end elsewhere, nothing is drawn.
TEST(ProjectGaussian, WhatARollingShutterShowsIsSeenAtTheTimeOfItsRow) {
  Random random(12);
  for (const Lens<double>& lens : make_lenses(40, 30)) {
    int shown = 0;
    for (int i = 0; i < 2000; ++i) {
      Scene<double> scene = single_gaussian();
      scene.scales = {0.01, 0.01, 0.01};
      scene.camera.lens = lens;
      for (double& place : scene.means3D) place = random.uniform(-3, 3);
      set_shutter(scene.camera, kRolling[i % 4]);
      for (double& number : scene.camera.view_end) number += random.uniform(-0.7, 0.7);
      if (project(scene).radius == 0) continue;
      const Vec2<double> at = project(scene).gaussian.mean;
      const bool columns =
          scene.camera.shutter == Shutter::kLeftToRight || scene.camera.shutter == Shutter::kRightToLeft;
      double time = columns ? at.x / 39 : at.y / 29;
      if (scene.camera.shutter == Shutter::kBottomToTop || scene.camera.shutter == Shutter::kRightToLeft)
        time = 1 - time;
      if (time < kFirstTime || time > kLastTime) continue;
      double pose[16];
      for (int k = 0; k < 16; ++k) {
        pose[k] = scene.camera.view[k] + time * (scene.camera.view_end[k] - scene.camera.view[k]);
      }
      const Vec2<double> then = through_lens(lens, transform_point(pose, load3(&scene.means3D[0]))).pixel;
      EXPECT_LT(std::hypot(then.x - at.x, then.y - at.y), 1) << i << " by " << kLensNames[int(lens.model)];
      ++shown;
    }
    EXPECT_GT(shown, 100);
  }
}

TEST(ProjectGaussian, BeyondTheRangeOfALensIsCulledAndNotFoldedBack) {
  Scene<double> scene = single_gaussian();
  const double* view = scene.camera.view;
  // On the right of the camera, by the camera's own axes.
  for (int axis = 0; axis < 3; ++axis) scene.means3D[axis] = scene.camera.position[axis] + 2 * view[4 * axis];
  for (const auto& [distortion, seen] :
       std::vector<std::pair<std::vector<double>, bool>>{{{}, true}, {{-0.2}, false}}) {
    scene.camera.lens = lens_of({LensModel::kFisheye, 40, 30, 10, 10, 20, 15, distortion});
    EXPECT_EQ(project(scene).radius > 0, seen);
  }
  scene.camera.lens = {};
  EXPECT_EQ(project(scene).radius, 0);
}

TEST(ProjectGaussian, BackwardIsTheDerivativeWithGivenColoursOfAnyNumber) {
  Scene<double> scene = single_gaussian();
  scene.shs.clear();
  scene.colors_precomp = {0.1, -0.5, 2, 0.3, 0.7};
  scene.config.num_channels = 5;
  scene.background.resize(6);
  expect_backward_is_the_derivative(scene);
}

TEST(ProjectGaussian, BackwardIsTheDerivativeWithDegreeZeroApart) {
  Scene<double> scene = single_gaussian();
  scene.dc.assign(scene.shs.begin(), scene.shs.begin() + 3);
  scene.shs.erase(scene.shs.begin(), scene.shs.begin() + 3);
  expect_backward_is_the_derivative(scene);
  EXPECT_EQ(project(scene).features, project(single_gaussian()).features);
}

TEST(ProjectGaussian, BackwardIsTheDerivativeWithDegreeZeroAlone) {
  Scene<double> scene = single_gaussian();
  scene.dc.assign(scene.shs.begin(), scene.shs.begin() + 3);
  scene.shs.clear();
  scene.sh_degree = 0;
  expect_backward_is_the_derivative(scene);
}

TEST(ProjectGaussian, BackwardIsTheDerivativeBelowTheStoredDegree) {
  for (const int degree : {0, 1, 2}) {
    Scene<double> scene = single_gaussian();
    scene.sh_degree = degree;
    expect_backward_is_the_derivative(scene);
  }
}

TEST(ProjectGaussian, BackwardIsTheDerivativeWhereAColourIsClamped) {
  Scene<double> scene = single_gaussian();
  scene.shs[1] = -5;
  ASSERT_EQ(project(scene).features[1], 0);
  expect_backward_is_the_derivative(scene);
}

TEST(ProjectGaussian, BackwardIsTheDerivativeWhereANegativeColourIsNotClamped) {
  Scene<double> scene = single_gaussian();
  scene.shs[1] = -5;
  scene.config.clamp_color = false;
  ASSERT_LT(project(scene).features[1], 0);
  expect_backward_is_the_derivative(scene);
}

TEST(ProjectGaussian, BackwardIsTheDerivativeWithScaleModifierAndAntialiasing) {
  Scene<double> scene = single_gaussian();
  scene.config.scale_modifier = 0.3;
  scene.config.antialiasing = true;
  expect_backward_is_the_derivative(scene);
}

TEST(ProjectGaussian, BackwardIsTheDerivativeAtTheFloorOfTheAntialiasing) {
  Scene<double> scene = single_gaussian();
  scene.scales = {1e-3, 1e-3, 1e-3};
  scene.config.antialiasing = true;
  // The opacity rests on the floor.
  EXPECT_NEAR(project(scene).gaussian.opacity, 0.7 * 0.005, 1e-9);
  expect_backward_is_the_derivative(scene);
}

TEST(ProjectGaussian, BackwardIsTheDerivativeOutsideTheFrustumWhereTheJacobianIsClamped) {
  for (const auto& mean : {Vector{4, -0.1, 0.3}, Vector{-5, 0.2, 0.1}, Vector{0.2, 4, 0.3}, Vector{4, -4, 0.3}}) {
    Scene<double> scene = single_gaussian();
    scene.means3D = mean;
    scene.scales = {3, 2, 2.5};  // still reaches the image
    scene.config.blend.mode = BlendMode::kSmoe;
    expect_backward_is_the_derivative(scene);
  }
}

TEST(ProjectGaussian, DoesNotNormaliseTheQuaternion) {
  Scene<double> scene = single_gaussian();
  const auto before = project(scene).gaussian.conic;
  for (double& component : scene.rotations) component *= 1.2;
  EXPECT_GT(std::abs(project(scene).gaussian.conic.xx / before.xx - 1), 0.01);
}

TEST(ProjectGaussian, ScaleModifierMultipliesTheScales) {
  Scene<double> scene = single_gaussian(), scaled = scene;
  scene.config.scale_modifier = 0.5;
  for (double& scale : scaled.scales) scale *= 0.5;
  EXPECT_EQ(flat(project(scene)), flat(project(scaled)));
}

TEST(ProjectGaussian, RadiusDoesNotDependOnModeOpacityOrAntialiasing) {
  Scene<double> scene = single_gaussian();
  const int32_t radius = project(scene).radius;
  scene.config.antialiasing = true;
  EXPECT_EQ(project(scene).radius, radius);
  for (const double opacity : {-1.0, 0.0, 1e-9, 3.0}) {
    scene.opacities = {opacity};
    for (const auto mode : all_modes()) {
      scene.config.blend.mode = mode;
      EXPECT_EQ(project(scene).radius, radius);
    }
  }
}

TEST(ProjectGaussian, IsCulledAtTheNearPlane) {
  Scene<double> scene = single_gaussian();
  // The camera looks along the third row of its rotation; 0.2 is the near plane.
  auto at_depth = [&](double z) {
    for (int k = 0; k < 3; ++k) scene.means3D[k] = scene.camera.position[k] + z * scene.camera.view[4 * k + 2];
    return project(scene).radius;
  };
  EXPECT_GT(at_depth(0.2 + 1e-9), 0);
  EXPECT_EQ(at_depth(0.2 - 1e-9), 0);
  EXPECT_EQ(at_depth(-1), 0);
  scene.camera.near = 0.5;
  EXPECT_EQ(at_depth(0.4), 0);
  EXPECT_GT(at_depth(0.6), 0);
}

TEST(ProjectGaussian, IsCulledWhereAnAttributeIsNotFinite) {
  Scene<double> with_covariance = single_gaussian(), with_colors = single_gaussian(), with_dc = single_gaussian();
  with_covariance.scales.clear(), with_covariance.rotations.clear();
  with_covariance.cov3D_precomp = {0.25, 0.05, -0.03, 0.1, 0.02, 0.2};
  with_colors.shs.clear(), with_colors.colors_precomp = {0.1, 0.5, 2};
  with_dc.dc.assign(with_dc.shs.begin(), with_dc.shs.begin() + 3);
  with_dc.shs.erase(with_dc.shs.begin(), with_dc.shs.begin() + 3);
  using Attribute = Vector Scene<double>::*;
  for (Scene<double> scene : {single_gaussian(), with_covariance, with_colors, with_dc}) {
    ASSERT_GT(project(scene).radius, 0);
    for (const Attribute attribute :
         {&Scene<double>::means3D, &Scene<double>::opacities, &Scene<double>::scales, &Scene<double>::rotations,
          &Scene<double>::cov3D_precomp, &Scene<double>::colors_precomp, &Scene<double>::dc, &Scene<double>::shs}) {
      for (double& value : scene.*attribute) {
        const double kept = value;
        for (const double bad : {std::nan(""), HUGE_VAL, -HUGE_VAL}) {
          value = bad;
          EXPECT_EQ(project(scene).radius, 0);
        }
        value = kept;
      }
    }
  }
}

TEST(ProjectGaussian, IsCulledWhereTheCovarianceIsNoCovariance) {
  Scene<double> scene = single_gaussian();
  scene.scales.clear(), scene.rotations.clear();
  scene.cov3D_precomp = {0.1, 5, 0, 0.1, 5, 0.1};  // indefinite: the determinant in the image is negative
  EXPECT_EQ(project(scene).radius, 0);
}

TEST(ProjectGaussian, IsCulledWhereTheImagePlaneOverflows) {
  Scene<float> scene = convert<float>(single_gaussian());
  float features[5];
  for (const float huge : {1e20f, 1e38f}) {
    scene.scales = {huge, huge, huge};
    EXPECT_EQ(project_first(scene, features).radius, 0);
  }
}

// Needles of 10^4 px, 10^5 times as long as wide: as a product of rounded covariances, the conic would be wrong from
// the first digit on.
TEST(ProjectGaussian, KeepsTheDigitsOfANeedleInFloat) {
  Random random(3);
  for (int i = 0; i < 200; ++i) {
    Scene<double> wide = single_gaussian();
    wide.config.blend.mode = BlendMode::kSmoe;
    wide.scales = {float(random.uniform(500, 1000)), 0.007f, 0.009f};
    for (double& component : wide.rotations) component = float(random.uniform(-0.5, 0.5));
    const Scene<float> scene = convert<float>(wide);
    float features[5];
    const auto narrow = project_first(scene, features);
    const auto& actual = narrow.gaussian.conic;
    const auto expected = project(convert<double>(scene)).gaussian.conic;
    ASSERT_GT(narrow.radius, 0);
    // The camera's turn, the rotation and the product with the scales round some twenty times.
    const double tolerance = 20 * 6e-8 * (expected.xx + expected.yy);
    EXPECT_NEAR(actual.xx, expected.xx, tolerance);
    EXPECT_NEAR(actual.xy, expected.xy, tolerance);
    EXPECT_NEAR(actual.yy, expected.yy, tolerance);
  }
}

// Slides along the camera's x axis, over both sides of the image.
TEST(ProjectGaussian, RadiusIsPositiveExactlyWhereTheFootprintMeetsTheImage) {
  for (const auto mode : {BlendMode::kAlpha, BlendMode::kSmoe, BlendMode::kSmoeEq7}) {
    Scene<double> scene = single_gaussian();
    const auto& camera = scene.camera;
    scene.config.blend.mode = mode;
    scene.scales = {0.1, 0.04, 0.2};
    int seen = 0, unseen = 0;
    for (double shift = -6; shift < 6; shift += 0.02) {
      for (int k = 0; k < 3; ++k) {
        scene.means3D[k] = camera.position[k] + shift * camera.view[4 * k] + 3 * camera.view[4 * k + 2];
      }
      const Gaussian<double> gaussian = load_gaussian(scene.inputs(), 0);
      const auto view = transform_point(camera.view, gaussian.mean);
      const auto conic = covariances(gaussian, ByMatrix<double>{camera}, view, scene.config.projection_rules()).conic;
      const auto pixel = project_to_pixel(camera, gaussian.mean);
      bool expected = false;
      if (mode != BlendMode::kSmoeEq7) {  // x range of Inria's rectangle against 3 columns of tiles; y is on the image
        const double r = screen_radius(conic);
        expected = std::max(0.0, std::floor((pixel.x - r) / 16)) < std::min(3.0, std::floor((pixel.x + r + 15) / 16));
      } else {  // the ellipse of G = 1e-5, somewhere between the outermost pixel centres
        for (double y = 0; y <= 29; y += 0.1) {
          for (const double x : {0.0, 39.0, std::min(39.0, std::max(0.0, pixel.x))}) {
            const double dx = x - pixel.x, dy = y - pixel.y;
            const auto& k = conic.inverse;
            expected |= k.xx * dx * dx + 2 * k.xy * dx * dy + k.yy * dy * dy <= 2 * std::log(1e5);
          }
        }
      }
      ++(expected ? seen : unseen);
      EXPECT_EQ(project(scene).radius > 0, expected) << "x " << pixel.x;
    }
    EXPECT_GT(seen, 20);
    EXPECT_GT(unseen, 20);
  }
}

}  // namespace
}  // namespace dsmoe

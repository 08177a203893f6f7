// World to view and to pixels, against the definitions and finite differences.
#include "dsmoe/camera.h"

#include <gtest/gtest.h>

#include <algorithm>

#include "finite_difference.h"

namespace dsmoe {
namespace {

Camera<double> random_camera(Random& random) {
  Camera<double> camera;
  camera.width = 37;
  camera.height = 23;
  for (double& entry : camera.view) entry = random.uniform(-1, 1);
  for (double& entry : camera.projection) entry = random.uniform(-1, 1);
  camera.projection[15] = 5;  // w stays away from 0 for points in [-1, 1]^3
  return camera;
}

Vec3<double> vec3(const double* p) { return {p[0], p[1], p[2]}; }

TEST(TransformPoint, IsARowVectorTimesTheMatrix) {
  double m[16];
  for (int i = 0; i < 16; ++i) m[i] = i + 1;
  const Vec3<double> out = transform_point(m, {1.0, 10.0, 100.0});
  EXPECT_EQ(out.x, 1 + 50 + 900 + 13);
  EXPECT_EQ(out.y, 2 + 60 + 1000 + 14);
  EXPECT_EQ(out.z, 3 + 70 + 1100 + 15);
}

// The gradients of the camera's numbers, of one share.
std::vector<double> flat(const CameraGradient<double>& g) {
  std::vector<double> out(g.view, g.view + 16);
  out.insert(out.end(), g.projection, g.projection + 16);
  out.insert(out.end(), g.position, g.position + 3);
  out.insert(out.end(), g.view_end, g.view_end + 16);
  return out;
}

// x: point, then matrix.
TEST(TransformPoint, BackwardIsTheDerivative) {
  Random random(1);
  const auto x = random.uniforms(19), weights = random.uniforms(3);
  auto loss = [&](const std::vector<double>& v) {
    return dot(vec3(weights.data()), transform_point(&v[3], vec3(&v[0])));
  };
  const Vec3<double> dL_dp = transform_point_backward(&x[3], vec3(weights.data()));
  CameraShare<double> share = {};
  share.point = vec3(&x[0]), share.dL_dview = vec3(weights.data());
  CameraGradient<double> by_camera;
  by_camera.add(share);
  std::vector<double> actual = {dL_dp.x, dL_dp.y, dL_dp.z};
  actual.insert(actual.end(), by_camera.view, by_camera.view + 16);
  expect_gradient(actual, loss, x);
}

TEST(CameraGradient, AddsSharesAndOthersOfItsKind) {
  Random random(2);
  const auto x = random.uniforms(33);
  const auto mat3 = [&](int i) { return Mat3<double>{vec3(&x[i]), vec3(&x[i + 3]), vec3(&x[i + 6])}; };
  const CameraShare<double> share = {vec3(&x[0]),  vec3(&x[3]),  mat3(6), vec3(&x[15]),
                                     vec3(&x[18]), vec3(&x[21]), mat3(24)};
  CameraGradient<double> once, shares, whole;
  once.add(share);
  for (int i = 0; i < 2; ++i) shares.add(share), whole.add(once);
  for (int i = 0; i < 51; ++i) {
    EXPECT_EQ(flat(whole)[i], 2 * flat(once)[i]);
    EXPECT_NEAR(flat(shares)[i], 2 * flat(once)[i], 1e-15);  // sums of four numbers below 1
  }
}

TEST(ViewRotation, TurnsDirectionsAsTransformPointDoes) {
  Random random(3);
  const auto m = random.uniforms(16);
  const Vec3<double> d = {0.3, -0.7, 0.2};
  const Vec3<double> turned = view_rotation(m.data()) * d;
  const Vec3<double> difference = transform_point(m.data(), d) - transform_point<double>(m.data(), {0, 0, 0});
  // Both are sums of three products of numbers below 1: rounding only.
  EXPECT_NEAR(turned.x, difference.x, 1e-15);
  EXPECT_NEAR(turned.y, difference.y, 1e-15);
  EXPECT_NEAR(turned.z, difference.z, 1e-15);
}

TEST(ViewRotation, BackwardIsTheDerivative) {
  Random random(4);
  const auto x = random.uniforms(16), w = random.uniforms(9);
  auto loss = [&](const std::vector<double>& m) {
    const auto r = view_rotation(m.data());
    return dot(vec3(&w[0]), r.r0) + dot(vec3(&w[3]), r.r1) + dot(vec3(&w[6]), r.r2);
  };
  CameraShare<double> share = {};
  share.dL_drotation = {vec3(&w[0]), vec3(&w[3]), vec3(&w[6])};
  CameraGradient<double> actual;
  actual.add(share);
  expect_gradient(std::vector<double>(actual.view, actual.view + 16), loss, x);
}

TEST(ProjectToPixel, PutsTheEdgesOfNdcOnTheEdgesOfTheBorderPixels) {
  Camera<double> camera;
  camera.width = 40;
  camera.height = 30;
  // Clip = (x, y, z, z): NDC is x / z, y / z.
  camera.projection[0] = camera.projection[5] = camera.projection[10] = camera.projection[11] = 1;
  // 1e-7 is added to w = 2, which moves an edge by 1e-7 / 2 of half the image.
  const double tolerance = 1e-6;
  const auto low = project_to_pixel(camera, {-2.0, -2.0, 2.0});
  EXPECT_NEAR(low.x, -0.5, tolerance);
  EXPECT_NEAR(low.y, -0.5, tolerance);
  const auto high = project_to_pixel(camera, {2.0, 2.0, 2.0});
  EXPECT_NEAR(high.x, 39.5, tolerance);
  EXPECT_NEAR(high.y, 29.5, tolerance);
}

// x: point, then projection.
TEST(ProjectToPixel, BackwardIsTheDerivative) {
  Random random(5);
  Camera<double> camera = random_camera(random);
  std::vector<double> x = random.uniforms(3);
  x.insert(x.end(), camera.projection, camera.projection + 16);
  auto loss = [&](const std::vector<double>& v) {
    std::copy(v.begin() + 3, v.end(), camera.projection);
    const auto pixel = project_to_pixel(camera, vec3(&v[0]));
    return 0.7 * pixel.x - 0.4 * pixel.y;
  };
  const auto by = project_to_pixel_backward<double>(camera, vec3(&x[0]), {0.7, -0.4});
  CameraShare<double> share = {};
  share.point = vec3(&x[0]), share.dL_dclip = by.clip;
  CameraGradient<double> by_camera;
  by_camera.add(share);
  std::vector<double> actual = {by.point.x, by.point.y, by.point.z};
  actual.insert(actual.end(), by_camera.projection, by_camera.projection + 16);
  expect_gradient(actual, loss, x);
}

// ---- Pinhole cameras ----

// Turned about a skew axis, with focal lengths and a principal point that differ by axis.
Pinhole skew_pinhole() {
  Pinhole of;
  of.width = 1280, of.height = 720;
  of.fx = 900, of.fy = 800, of.cx = 600, of.cy = 400;
  of.rotation = {2 / 3.0, -1 / 3.0, 2 / 3.0, 2 / 3.0, 2 / 3.0, -1 / 3.0, -1 / 3.0, 2 / 3.0, 2 / 3.0};
  of.translation = {0.1, -0.2, 3};
  return of;
}

TEST(PinholeCamera, SeesAPointWhereItsNumbersSay) {
  const Pinhole of = skew_pinhole();
  const Vec3<double> p = {0.2, -0.1, 0.3};
  double expected[3];
  for (int row = 0; row < 3; ++row) {
    const double* r = &of.rotation[3 * row];
    expected[row] = r[0] * p.x + r[1] * p.y + r[2] * p.z + of.translation[row];
  }
  const auto camera = pinhole_camera<double>(of);
  EXPECT_EQ(camera.width, 1280);
  EXPECT_EQ(camera.height, 720);
  EXPECT_EQ(camera.tan_fov_x, 1280 / (2 * 900.0));
  EXPECT_EQ(camera.tan_fov_y, 720 / (2 * 800.0));
  const Vec3<double> actual = transform_point(camera.view, p);
  EXPECT_NEAR(actual.x, expected[0], 1e-15);  // sums of four terms below 4
  EXPECT_NEAR(actual.y, expected[1], 1e-15);
  EXPECT_NEAR(actual.z, expected[2], 2e-15);
  // The rasterizer's pixel centres are whole numbers, a pinhole's lie half a pixel further. The rasterizer adds 1e-7 to
  // w, which is 3: 3e-8 of at most 200 pixels from the axis.
  const Vec2<double> pixel = project_to_pixel(camera, p);
  EXPECT_NEAR(pixel.x, 900 * expected[0] / expected[2] + 600 - 0.5, 1e-5);
  EXPECT_NEAR(pixel.y, 800 * expected[1] / expected[2] + 400 - 0.5, 1e-5);
  const Vec3<double> origin =
      transform_point(camera.view, {camera.position[0], camera.position[1], camera.position[2]});
  EXPECT_NEAR(origin.x, 0, 2e-15);
  EXPECT_NEAR(origin.y, 0, 2e-15);
  EXPECT_NEAR(origin.z, 0, 2e-15);
}

TEST(PinholeCamera, InFloatIsTheRoundedOne) {
  const auto wide = pinhole_camera<double>(skew_pinhole());
  const auto narrow = pinhole_camera<float>(skew_pinhole());
  for (int i = 0; i < 16; ++i) {
    EXPECT_EQ(narrow.view[i], float(wide.view[i]));
    EXPECT_EQ(narrow.projection[i], float(wide.projection[i]));
  }
  for (int i = 0; i < 3; ++i) EXPECT_EQ(narrow.position[i], float(wide.position[i]));
}

}  // namespace
}  // namespace dsmoe

// Covariances in space and in the image, conic, antialiasing and radius.
#include "dsmoe/covariance.h"

#include <gtest/gtest.h>

#include <cmath>
#include <vector>

#include "finite_difference.h"

namespace dsmoe {
namespace {

using Vector = std::vector<double>;

Vec3<double> vec3(const double* p) { return {p[0], p[1], p[2]}; }
Mat3<double> mat3(const double* p) { return {vec3(p), vec3(p + 3), vec3(p + 6)}; }
Mat23<double> mat23(const double* p) { return {vec3(p), vec3(p + 3)}; }
Sym2<double> sym2(const double* p) { return {p[0], p[1], p[2]}; }
Sym3<double> sym3(const double* p) { return {p[0], p[1], p[2], p[3], p[4], p[5]}; }
Vec4<double> vec4(const double* p) { return {p[0], p[1], p[2], p[3]}; }

void append(Vector& out, Vec3<double> v) { out.insert(out.end(), {v.x, v.y, v.z}); }
Vector flat(const Mat3<double>& m) {
  Vector out;
  for (const auto& row : {m.r0, m.r1, m.r2}) append(out, row);
  return out;
}
Vector flat(const Mat23<double>& m) {
  Vector out;
  for (const auto& row : {m.r0, m.r1}) append(out, row);
  return out;
}
Vector flat(const Sym2<double>& s) { return {s.xx, s.xy, s.yy}; }
Vector flat(const Sym3<double>& s) { return {s.xx, s.xy, s.xz, s.yy, s.yz, s.zz}; }

// Few roundings of numbers near 1.
constexpr double kRounding = 1e-14;

TEST(QuaternionToRotation, TurnsAroundTheAxis) {
  const double half = std::sqrt(0.5);  // 90 degrees around z: x goes to y
  const Vec3<double> turned = quaternion_to_rotation<double>({half, 0, 0, half}) * Vec3<double>{1, 0, 0};
  EXPECT_NEAR(turned.x, 0, kRounding);
  EXPECT_NEAR(turned.y, 1, kRounding);
  EXPECT_NEAR(turned.z, 0, kRounding);
}

TEST(QuaternionToRotation, IsOrthonormalForUnitQuaternions) {
  Random random(1);
  for (int i = 0; i < 20; ++i) {
    Vector q = random.uniforms(4);
    const double length = std::sqrt(weighted_sum(q, q));
    for (double& component : q) component /= length;
    const Mat3<double> r = quaternion_to_rotation(vec4(q.data()));
    const Vec3<double> rows[3] = {r.r0, r.r1, r.r2};
    for (int a = 0; a < 3; ++a) {
      for (int b = 0; b < 3; ++b) EXPECT_NEAR(dot(rows[a], rows[b]), a == b, kRounding);
    }
  }
}

TEST(QuaternionToRotation, UsesTheQuaternionAsGiven) {
  // Off the unit sphere the entries are still 1 - 2(...) and 2(...): quadratic in q around the identity.
  const Vector q = {0.3, -0.5, 0.2, 0.6};
  const Vector r = flat(quaternion_to_rotation(vec4(q.data())));
  const Vector scaled = flat(quaternion_to_rotation<double>({0.9, -1.5, 0.6, 1.8}));
  for (int i = 0; i < 9; ++i) EXPECT_NEAR(scaled[i] - (i % 4 == 0), 9 * (r[i] - (i % 4 == 0)), kRounding);
}

TEST(QuaternionToRotation, BackwardIsTheDerivativeOffTheUnitSphere) {
  Random random(2);
  for (const double size : {0.3, 1.0, 2.5}) {
    const Vector q = random.uniforms(4, -size, size), w = random.uniforms(9);
    auto loss = [&](const Vector& v) { return weighted_sum(w, flat(quaternion_to_rotation(vec4(v.data())))); };
    const Vec4<double> g = quaternion_to_rotation_backward(vec4(q.data()), mat3(w.data()));
    expect_gradient({g.x, g.y, g.z, g.w}, loss, q);
  }
}

// x: axes, scale, rotation.
ImageFactor<double> factor_of(const Vector& x) { return image_factor(mat23(&x[0]), vec3(&x[6]), mat3(&x[9])); }

TEST(ImageFactor, IsHalfOfTheProductOfTheMatrices) {
  const Vector x = Random(3).uniforms(18);
  double half[2][3] = {}, expected[2][2] = {};
  for (int a = 0; a < 2; ++a) {
    for (int k = 0; k < 3; ++k) {
      for (int i = 0; i < 3; ++i) half[a][k] += x[3 * a + i] * x[9 + 3 * i + k] * x[6 + k];
    }
  }
  for (int a = 0; a < 2; ++a) {
    for (int b = 0; b < 2; ++b) {
      for (int k = 0; k < 3; ++k) expected[a][b] += half[a][k] * half[b][k];
    }
  }
  const auto cov = covariance_2d(factor_of(x));
  EXPECT_NEAR(cov.xx, expected[0][0], kRounding);
  EXPECT_NEAR(cov.xy, expected[0][1], kRounding);
  EXPECT_NEAR(cov.yy, expected[1][1], kRounding);
  const auto conic = conic_of(factor_of(x)), by_covariance = make_conic(cov);
  EXPECT_NEAR(conic.unfiltered, by_covariance.unfiltered, kRounding);
  EXPECT_NEAR(conic.determinant, by_covariance.determinant, kRounding);
}

// A loss of the conic and of the image covariance itself, by three weights each.
double loss_of(const Vector& w, const Conic<double>& conic, const Sym2<double>& cov) {
  return weighted_sum({w.begin(), w.begin() + 3}, flat(conic.inverse)) +
         weighted_sum({w.begin() + 3, w.end()}, flat(cov));
}
ImageGradient<double> gradient_of(const Vector& w, const Conic<double>& conic) {
  return {conic.inverse, sym2(&w[0]), sym2(&w[3])};
}

TEST(ImageFactor, BackwardIsTheDerivative) {
  Random random(4);
  const Vector x = random.uniforms(18), w = random.uniforms(6);
  auto loss = [&](const Vector& v) { return loss_of(w, conic_of(factor_of(v)), covariance_2d(factor_of(v))); };
  const auto g = image_factor_backward(mat23(&x[0]), vec3(&x[6]), mat3(&x[9]), factor_of(x),
                                       gradient_of(w, conic_of(factor_of(x))));
  Vector actual = flat(g.axes);
  append(actual, g.scale);
  for (const double entry : flat(g.rotation)) actual.push_back(entry);
  expect_gradient(actual, loss, x);
}

// A loss of only the determinant before the low-pass filter; by_adjugate is its derivative.
TEST(ImageFactor, BackwardOfTheDeterminantIsTheDerivative) {
  const Vector x = Random(14).uniforms(18);
  auto loss = [&](const Vector& v) { return 1.7 * conic_of(factor_of(v)).unfiltered; };
  const auto g = image_factor_backward(mat23(&x[0]), vec3(&x[6]), mat3(&x[9]), factor_of(x),
                                       ImageGradient<double>{conic_of(factor_of(x)).inverse, {}, {}, 1.7});
  Vector actual = flat(g.axes);
  append(actual, g.scale);
  for (const double entry : flat(g.rotation)) actual.push_back(entry);
  expect_gradient(actual, loss, x);
}

// The factor on the opacity of a needle of 100 x 0.1 px: in float too its gradients have nearly all digits.
TEST(ImageFactor, KeepsTheDigitsOfANeedlesCompensation) {
  const auto backward = [](auto zero) {
    using S = decltype(zero);
    const Mat23<S> axes = {{S(62.5f), S(0), S(-3.25f)}, {S(0), S(62.5f), S(1.5f)}};
    const Vec3<S> scale = {S(1.6f), S(0.0016f), S(0.0011f)};
    const Mat3<S> rotation = quaternion_to_rotation<S>({S(0.8f), S(0.05f), S(-0.03f), S(0.5971599f)});
    const auto factor = image_factor(axes, scale, rotation);
    const auto conic = conic_of(factor);
    const auto by = opacity_compensation_backward(conic, S(kLowPass), S(1));
    const auto g = image_factor_backward(
        axes, scale, rotation, factor,
        ImageGradient<S>{conic.inverse, {}, {by.by_identity, S(0), by.by_identity}, by.by_adjugate});
    return std::make_pair(Mat23<double>{{double(g.axes.r0.x), double(g.axes.r0.y), double(g.axes.r0.z)},
                                        {double(g.axes.r1.x), double(g.axes.r1.y), double(g.axes.r1.z)}},
                          Mat3<double>{{double(g.rotation.r0.x), double(g.rotation.r0.y), double(g.rotation.r0.z)},
                                       {double(g.rotation.r1.x), double(g.rotation.r1.y), double(g.rotation.r1.z)},
                                       {double(g.rotation.r2.x), double(g.rotation.r2.y), double(g.rotation.r2.z)}});
  };
  const auto found = backward(0.0f), exact = backward(0.0);
  const auto compare = [](const Vector& actual, const Vector& expected) {
    double error = 0, size = 0;
    for (size_t i = 0; i < actual.size(); ++i) {
      error += std::pow(actual[i] - expected[i], 2), size += std::pow(expected[i], 2);
    }
    EXPECT_LT(std::sqrt(error / size), 2e-6);  // some 10 roundings
  };
  compare(flat(found.first), flat(exact.first));
  compare(flat(found.second), flat(exact.second));
}

// Adam makes a whole step of any gradient, of rounding too: a sphere must not be turned before it has another shape.
TEST(ImageFactor, DoesNotTurnASphereInFloat) {
  Random random(5);
  const Vec4<float> unturned = {1, 0, 0, 0};
  const Mat3<float> rotation = quaternion_to_rotation(unturned);
  for (int i = 0; i < 100; ++i) {
    const Vector x = random.uniforms(14);
    const std::vector<float> f(x.begin(), x.end());
    const Mat23<float> axes = {{f[0], f[1], f[2]}, {f[3], f[4], f[5]}};
    const Vec3<float> scale = {f[6], f[6], f[6]};
    const auto factor = image_factor(axes, scale, rotation);
    const ImageGradient<float> by_image = {conic_of(factor).inverse, {f[7], f[8], f[9]}, {f[10], f[11], f[12]}, f[13]};
    const auto g = image_factor_backward(axes, scale, rotation, factor, by_image);
    const auto q = quaternion_to_rotation_backward(unturned, g.rotation);
    EXPECT_EQ(q.y, 0.0f);
    EXPECT_EQ(q.z, 0.0f);
    EXPECT_EQ(q.w, 0.0f);
  }
}

Camera<double> wide_camera() {
  Camera<double> camera;
  camera.width = 64;
  camera.height = 48;
  camera.tan_fov_x = 0.8;
  camera.tan_fov_y = 0.5;
  return camera;
}

TEST(ProjectionJacobian, IsTheDerivativeOfThePerspectiveInsideTheFrustum) {
  const Camera<double> camera = wide_camera();
  const Vector view = {0.9, -0.4, 2.5};
  // Pixels per unit slope: half the image spans tan_fov.
  const double focal_x = 32 / 0.8, focal_y = 24 / 0.5;
  const Vector jacobian = flat(projection_jacobian(camera, vec3(view.data())).jacobian);
  auto x = [&](const Vector& v) { return focal_x * v[0] / v[2]; };
  auto y = [&](const Vector& v) { return focal_y * v[1] / v[2]; };
  expect_gradient({jacobian.begin(), jacobian.begin() + 3}, x, view);
  expect_gradient({jacobian.begin() + 3, jacobian.end()}, y, view);
}

TEST(ProjectionJacobian, ClampsTheSlopeAtOnePointThreeTimesTheHalfFieldOfView) {
  const Camera<double> camera = wide_camera();
  for (const double sign : {-1.0, 1.0}) {
    const auto far_out = flat(projection_jacobian<double>(camera, {sign * 1000, sign * 1000, 2}).jacobian);
    const double x = sign * 1.3 * 0.8 * 2, y = sign * 1.3 * 0.5 * 2;  // on the margin at z = 2
    const auto margin = flat(projection_jacobian<double>(camera, {x, y, 2}).jacobian);
    for (int i = 0; i < 6; ++i) EXPECT_NEAR(far_out[i], margin[i], 1e-13);  // entries up to 60
  }
}

TEST(ProjectionJacobian, BackwardIsTheDerivativeInsideAndClamped) {
  const Camera<double> camera = wide_camera();
  Random random(5);
  const Vector w = random.uniforms(6);
  // Only J's four free entries are functions of the view point.
  auto loss = [&](const Vector& v) {
    return weighted_sum(w, flat(projection_jacobian(camera, vec3(v.data())).jacobian));
  };
  const std::vector<std::pair<Vector, int>> cases = {{{0.9, -0.4, 2.5}, 0},
                                                     {{5.0, -0.4, 2.5}, 1},
                                                     {{-5.0, 0.3, 2.5}, 1},
                                                     {{0.9, 4.0, 2.5}, 2},
                                                     {{-5.0, -4.0, 2.5}, 3}};
  for (const auto& [view, clamped] : cases) {
    const auto forward = projection_jacobian(camera, vec3(view.data()));
    EXPECT_EQ(forward.clamped_x + 2 * forward.clamped_y, clamped);
    const auto g = projection_jacobian_backward(forward, mat23(w.data()));
    expect_gradient({g.x, g.y, g.z}, loss, view);
  }
}

TEST(ImageAxes, AreTheJacobianTimesTheRotation) {
  Random random(6);
  const Vector j = random.uniforms(6), r = random.uniforms(9);
  const Vector axes = flat(image_axes(mat23(j.data()), mat3(r.data())));
  for (int row = 0; row < 2; ++row) {
    for (int column = 0; column < 3; ++column) {
      double expected = 0;
      for (int k = 0; k < 3; ++k) expected += j[3 * row + k] * r[3 * k + column];
      EXPECT_NEAR(axes[3 * row + column], expected, kRounding);
    }
  }
}

TEST(Covariance2D, IsTheProductOfTheMatrices) {
  Random random(7);
  const Vector m = random.uniforms(6), c = random.uniforms(6);
  const double full[3][3] = {{c[0], c[1], c[2]}, {c[1], c[3], c[4]}, {c[2], c[4], c[5]}};
  double expected[2][2] = {};
  for (int a = 0; a < 2; ++a) {
    for (int b = 0; b < 2; ++b) {
      for (int i = 0; i < 3; ++i) {
        for (int j = 0; j < 3; ++j) expected[a][b] += m[3 * a + i] * full[i][j] * m[3 * b + j];
      }
    }
  }
  const auto cov = covariance_2d(mat23(m.data()), sym3(c.data()));
  EXPECT_NEAR(cov.xx, expected[0][0], kRounding);
  EXPECT_NEAR(cov.xy, expected[0][1], kRounding);
  EXPECT_NEAR(cov.yy, expected[1][1], kRounding);
}

// x: axes, then the covariance's six numbers.
TEST(Covariance2D, BackwardIsTheDerivative) {
  Random random(8);
  Vector x = random.uniforms(12);
  const Vector w = random.uniforms(6);
  x[6] += 2, x[9] += 2, x[11] += 2;  // positive definite
  auto cov = [](const Vector& v) { return covariance_2d(mat23(&v[0]), sym3(&v[6])); };
  auto loss = [&](const Vector& v) { return loss_of(w, make_conic(cov(v)), cov(v)); };
  const auto g = covariance_2d_backward(mat23(&x[0]), sym3(&x[6]), gradient_of(w, make_conic(cov(x))));
  Vector actual = flat(g.axes);
  for (const double entry : flat(g.cov)) actual.push_back(entry);
  expect_gradient(actual, loss, x);
}

TEST(Conic, IsTheInverseOfTheFilteredCovariance) {
  const Conic<double> conic = make_conic<double>({5, 2, 3});
  EXPECT_DOUBLE_EQ(conic.filtered.xx, 5.3);  // + 0.3 px^2, Inria's low-pass
  EXPECT_DOUBLE_EQ(conic.filtered.xy, 2);
  EXPECT_DOUBLE_EQ(conic.filtered.yy, 3.3);
  const auto &c = conic.filtered, &k = conic.inverse;
  EXPECT_NEAR(c.xx * k.xx + c.xy * k.xy, 1, kRounding);
  EXPECT_NEAR(c.xx * k.xy + c.xy * k.yy, 0, kRounding);
  EXPECT_NEAR(c.xy * k.xx + c.yy * k.xy, 0, kRounding);
  EXPECT_NEAR(c.xy * k.xy + c.yy * k.yy, 1, kRounding);
}

TEST(Conic, KeepsANeedlesDeterminantInFloat) {
  // A needle of 2000 x 0 px along the diagonal: the products of its covariance agree to six digits, so a determinant
  // from rounded products would be wrong from the first digit on. Expected: the float inputs, multiplied exactly.
  const float variance = 2e6f;
  const auto conic = make_conic<float>({variance, variance, variance});
  const long double side = conic.filtered.xx, off = conic.filtered.xy;
  const long double expected = side * side - off * off;
  EXPECT_NEAR(conic.determinant / expected, 1, 2e-7L);  // 1.5 ulp
}

double compensation(const Vector& v) { return opacity_compensation(make_conic(sym2(v.data()))); }

TEST(OpacityCompensation, IsTheRootOfTheDeterminants) {
  EXPECT_NEAR(compensation({5, 2, 3}), std::sqrt((5.0 * 3 - 4) / (5.3 * 3.3 - 4)), kRounding);
}

TEST(OpacityCompensation, BackwardIsTheDerivative) {
  for (const Vector& cov : {Vector{5, 2, 3}, Vector{0.05, 0.02, 0.03}}) {
    const auto c = sym2(cov.data());
    auto loss = [](const Vector& v) { return 1.7 * compensation(v); };
    // The small covariance is 0.02 across, so the steps must be smaller too: 1e-4.
    expect_gradient(flat(opacity_compensation_backward(make_conic(c), kLowPass, 1.7).dense(c)), loss, cov, 1e-4);
  }
}

TEST(OpacityCompensation, HasAFloorWithoutGradient) {
  for (const Vector& cov :
       {Vector{1e-4, 0, 1e-4}, Vector{4, 2, 1}, Vector{0.1, 0.15, 0.1}}) {  // tiny; a needle; indefinite
    const auto c = sym2(cov.data());
    EXPECT_DOUBLE_EQ(compensation(cov), std::sqrt(static_cast<double>(2.5e-5f)));
    for (const double g : flat(opacity_compensation_backward(make_conic(c), kLowPass, 1.7).dense(c))) EXPECT_EQ(g, 0);
  }
}

TEST(ScreenRadius, IsThreeSigmaOfTheLongAxisRoundedUp) {
  // Eigenvalues 25 and 4 (low-pass included), turned by 30 degrees.
  const double c = std::cos(0.5235987755982988), s = std::sin(0.5235987755982988);
  const Sym2<double> cov = {25 * c * c + 4 * s * s - 0.3, 21 * c * s, 25 * s * s + 4 * c * c - 0.3};
  EXPECT_EQ(screen_radius(make_conic<double>({cov.xx + 1e-3, cov.xy, cov.yy + 1e-3})), 16);  // just above 15
  EXPECT_EQ(screen_radius(make_conic<double>({cov.xx - 1e-3, cov.xy, cov.yy - 1e-3})), 15);
}

TEST(ScreenRadius, TreatsRoundGaussiansByTheFlooredRoot) {
  // mid^2 - det = 0 is taken as 0.1, so that sigma^2 = 0.3 counts as 0.3 + sqrt(0.1): ceil(3 sqrt(0.616)) = 3.
  EXPECT_EQ(screen_radius(make_conic<double>({0, 0, 0})), 3);
  // 99.7 + 0.3 + 0.316: ceil(30.047) = 31, where an exact eigenvalue would give 30.
  EXPECT_EQ(screen_radius(make_conic<double>({99.7, 0, 99.7})), 31);
}

}  // namespace
}  // namespace dsmoe

// Spherical harmonics and colours.
#include "dsmoe/sh.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

#include "dsmoe/arrays.h"
#include "finite_difference.h"

namespace dsmoe {
namespace {

using Vector = std::vector<double>;

Vec3<double> vec3(const double* p) { return {p[0], p[1], p[2]}; }

std::vector<Vec3<double>> random_directions(int count) {
  Random random(1);
  std::vector<Vec3<double>> out;
  while (static_cast<int>(out.size()) < count) {
    const Vec3<double> v = {random.uniform(-1, 1), random.uniform(-1, 1), random.uniform(-1, 1)};
    const double length = std::sqrt(dot(v, v));
    if (length > 0.1 && length < 1) out.push_back((1 / length) * v);
  }
  return out;
}

#if defined(__STDCPP_MATH_SPEC_FUNCS__) || __cpp_lib_math_special_functions >= 201603L
TEST(ShBasis, IsTheRealHarmonicsWithTheCondonShortleyPhase) {
  for (const auto& d : random_directions(50)) {
    const auto basis = sh_basis(kMaxShDegree, d);
    const double theta = std::acos(d.z), phi = std::atan2(d.y, d.x);
    for (int l = 0; l <= kMaxShDegree; ++l) {
      for (int m = -l; m <= l; ++m) {
        const double polar = std::sph_legendre(l, std::abs(m), theta);  // carries the phase (-1)^m
        const double expected =
            m == 0 ? polar : std::sqrt(2.0) * polar * (m > 0 ? std::cos(m * phi) : std::sin(-m * phi));
        // A dozen roundings of numbers near 1, and those of acos and the recurrence.
        EXPECT_NEAR(basis[l * (l + 1) + m], expected, 1e-13) << "l " << l << " m " << m;
      }
    }
  }
}
#endif

// x: a direction, which need not have length 1 here.
TEST(ShBasis, BackwardIsTheDerivativeAtEveryDegree) {
  Random random(2);
  for (int degree = 0; degree <= kMaxShDegree; ++degree) {
    const Vector d = random.uniforms(3), w = random.uniforms(kMaxShCoefficients);
    auto loss = [&](const Vector& v) {
      const auto basis = sh_basis(degree, vec3(v.data()));
      double sum = 0;
      for (int k = 0; k < sh_coefficients(degree); ++k) sum += w[k] * basis[k];
      return sum;
    };
    ShNumbers<double> dL_dbasis;
    std::copy(w.begin(), w.end(), dL_dbasis.values);
    const auto g = sh_basis_backward(degree, vec3(d.data()), dL_dbasis);
    if (degree == 0) {
      EXPECT_EQ(dot(g, g), 0);
    } else {
      expect_gradient({g.x, g.y, g.z}, loss, d);
    }
  }
}

// x: mean 3, camera position 3, then 16 x 3 coefficients.
constexpr int kCoefficients = 6;

ShReader<double> joint(const double* sh) { return {sh, sh + 3}; }

ShRules<double> rules_of(int degree, const Vector& x, bool clamp) { return {degree, clamp, vec3(&x[3])}; }

Vector flat(Vec3<double> v) { return {v.x, v.y, v.z}; }

Vector color_of(int degree, const Vector& x, bool clamp = true) {
  return flat(sh_color(rules_of(degree, x, clamp), vec3(&x[0]), joint(&x[kCoefficients])));
}

// Colours near 1/2 unless the degree 0 coefficient says otherwise.
Vector random_color_inputs(unsigned seed) {
  Random random(seed);
  Vector x = random.uniforms(6);
  for (const double coefficient : random.uniforms(48, -0.1, 0.1)) x.push_back(coefficient);
  return x;
}

Vector color_gradient(int degree, const Vector& x, const Vector& dL_dcolor, bool clamp = true) {
  Vector out(x.size());
  const Vector color = color_of(degree, x, clamp);
  const ShWriter<double> write = {&out[kCoefficients], &out[kCoefficients + 3]};
  const auto mean = sh_color_backward(rules_of(degree, x, clamp), vec3(&x[0]), joint(&x[kCoefficients]),
                                      vec3(color.data()), vec3(dL_dcolor.data()), write);
  out[0] = mean.x, out[1] = mean.y, out[2] = mean.z;
  for (int k = 0; k < 3; ++k) out[3 + k] = -out[k];
  return out;
}

TEST(ShColor, BackwardIsTheDerivativeAtEveryDegreeAndLeavesHigherDegreesAlone) {
  for (int degree = 0; degree <= kMaxShDegree; ++degree) {
    const Vector x = random_color_inputs(3 + degree), w = {0.7, -1.1, 0.4};
    auto loss = [&](const Vector& v) { return weighted_sum(w, color_of(degree, v)); };
    expect_gradient(color_gradient(degree, x, w), loss, x);
  }
}

TEST(ShColor, PassesNoGradientWhereClamped) {
  Vector x = random_color_inputs(10);
  x[kCoefficients + 1] = -4;  // green: 1/2 - 4 * 0.28 + at most 15 * 0.1 * 0.9 in the worst case, clamped here
  const Vector w = {0.7, -1.1, 0.4};
  EXPECT_EQ(color_of(3, x)[1], 0);
  auto loss = [&](const Vector& v) { return weighted_sum(w, color_of(3, v)); };
  const Vector actual = color_gradient(3, x, w);
  expect_gradient(actual, loss, x);
  for (int k = 0; k < kMaxShCoefficients; ++k) EXPECT_EQ(actual[kCoefficients + 3 * k + 1], 0);
}

TEST(ShColor, WithoutTheClampColoursMayBeNegativeAndPassTheirGradient) {
  Vector x = random_color_inputs(10);
  x[kCoefficients + 1] = -4;
  const Vector w = {0.7, -1.1, 0.4};
  EXPECT_LT(color_of(3, x, false)[1], 0);
  auto loss = [&](const Vector& v) { return weighted_sum(w, color_of(3, v, false)); };
  expect_gradient(color_gradient(3, x, w, false), loss, x);
}

TEST(ShColor, DegreeZeroMayLieApart) {
  const Vector x = random_color_inputs(11), w = {0.7, -1.1, 0.4};
  const Vector dc(x.begin() + kCoefficients, x.begin() + kCoefficients + 3),
      rest(x.begin() + kCoefficients + 3, x.end());
  const ShReader<double> apart = {dc.data(), rest.data()};
  Vector dL_ddc(3), dL_drest(45);
  const auto color = sh_color(rules_of(3, x, true), vec3(&x[0]), apart);
  EXPECT_EQ(flat(color), color_of(3, x));
  sh_color_backward(rules_of(3, x, true), vec3(&x[0]), apart, color, vec3(w.data()),
                    ShWriter<double>{dL_ddc.data(), dL_drest.data()});
  Vector joined = dL_ddc;
  joined.insert(joined.end(), dL_drest.begin(), dL_drest.end());
  const Vector expected = color_gradient(3, x, w);
  EXPECT_EQ(joined, Vector(expected.begin() + kCoefficients, expected.end()));
}

TEST(ShColor, EitherCoefficientGradientMayBeLeftOut) {
  const Vector x = random_color_inputs(12), w = {0.7, -1.1, 0.4};
  const Vector color = color_of(3, x), expected = color_gradient(3, x, w);
  const auto g = sh_color_backward(rules_of(3, x, true), vec3(&x[0]), joint(&x[kCoefficients]), vec3(color.data()),
                                   vec3(w.data()), ShWriter<double>{nullptr, nullptr});
  EXPECT_EQ(g.x, expected[0]);
  EXPECT_EQ(g.y, expected[1]);
  EXPECT_EQ(g.z, expected[2]);
}

TEST(ShColor, AGaussianAtTheCameraShowsItsDegreeZero) {
  Vector x = random_color_inputs(13);
  for (int k = 0; k < 3; ++k) x[3 + k] = x[k];
  EXPECT_EQ(color_of(3, x), color_of(0, x));
  for (const double g : color_gradient(3, x, {0.7, -1.1, 0.4})) EXPECT_TRUE(std::isfinite(g));
}

}  // namespace
}  // namespace dsmoe

// One (Gaussian, pixel) pair: exponent, gate logit, which pairs count, gradients.
#include "dsmoe/gate.h"

#include <gtest/gtest.h>

#include <cmath>
#include <limits>
#include <string>
#include <vector>

#include "all_modes.h"
#include "finite_difference.h"

namespace dsmoe {
namespace {

using Vector = std::vector<double>;

double quadratic_power(const Sym2<double>& conic, double dx, double dy) {
  return -0.5 * (conic.xx * dx * dx + 2 * conic.xy * dx * dy + conic.yy * dy * dy);
}

TEST(ColumnExponent, IsTheQuadraticForm) {
  Random random(1);
  for (int i = 0; i < 200; ++i) {
    const double xx = random.log_uniform(1e-4, 3), yy = random.log_uniform(1e-4, 3);
    const Sym2<double> conic = {xx, random.uniform(-0.99, 0.99) * std::sqrt(xx * yy), yy};
    const double dx = random.uniform(-50, 50), dy = random.uniform(-50, 50);
    const double expected = quadratic_power(conic, dx, dy);
    // Rounding of the largest of the three terms, in double and in float.
    const double terms = xx * dx * dx + yy * dy * dy;
    EXPECT_NEAR((ColumnExponent<double, double>(conic, dx).at(dy)), expected, 1e-15 * terms);
    const Sym2<float> narrow = {float(conic.xx), float(conic.xy), float(conic.yy)};
    EXPECT_NEAR((ColumnExponent<float, float>(narrow, float(dx)).at(float(dy))), expected, 1e-6 * terms);
  }
}

template <class Mode> struct GateOfMode : testing::Test {};
TYPED_TEST_SUITE(GateOfMode, AllModes);

// Opacities over the whole legal range; thresholds that never, sometimes and always bind.
template <class S> std::vector<S> test_opacities() {
  const S cut = S(kAlphaCut);
  std::vector<S> out = {S(1e-30), S(1e-6), std::nextafter(cut, S(0)), cut, std::nextafter(cut, S(1)), S(0.99),
                        S(1),     S(7)};
  Random random(2);
  for (int i = 0; i < 200; ++i) out.push_back(S(random.log_uniform(1e-5, 2)));
  return out;
}

template <BlendMode kMode, class S> void expect_squared_reach_is_exact(S margin) {
  int bounded = 0, without = 0;
  for (const S opacity : test_opacities<S>()) {
    for (const S alpha_min : {S(0), S(1e-4), S(0.01), S(0.5)}) {
      const S reach = squared_reach(Blend<kMode>::kCut, opacity, alpha_min);
      auto counts = [&](S squared_distance) {
        return evaluate_gate<kMode>(S(-0.5) * squared_distance, opacity, alpha_min).counts;
      };
      if (reach < -margin) {
        ++without;
        EXPECT_FALSE(counts(0)) << "opacity " << opacity << " alpha_min " << alpha_min;
      } else {
        ++bounded;
        EXPECT_FALSE(counts(reach + margin)) << "opacity " << opacity << " alpha_min " << alpha_min;
        if (reach > margin) {
          EXPECT_TRUE(counts(reach - margin)) << "opacity " << opacity << " alpha_min " << alpha_min;
        }
      }
    }
  }
  EXPECT_GT(bounded, 100);
  EXPECT_GT(without, 10);
}

// A pair that counts is near if alpha >= 1/255, and within 3 sigma if alpha >= 1/1020: by the least alpha, by the
// reach, and as kernels ask.
template <BlendMode kMode, class S> void expect_near_pairs(S margin) {
  int near_pairs = 0, faint_pairs = 0;
  Random random(7);
  for (const S opacity : test_opacities<S>()) {
    for (const S alpha_min : {S(0), S(1e-3), S(0.01)}) {
      const S reach = squared_reach(Blend<kMode>::kCut, opacity, alpha_min);
      const S near = near_reach(opacity, reach);
      const LogGate<S> gate({S(1), S(0), S(1)}, opacity, reach);
      for (int n = 0; n < 20; ++n) {
        const S squared = S(random.uniform(0, 20)), power = S(-0.5) * squared;
        const auto all = evaluate_gate<kMode>(power, opacity, alpha_min);
        const bool in_core = exp(power) >= S(kCoreKernel) && all.alpha >= S(1 / 1020.0f);
        const bool expected = all.counts && (all.alpha >= S(kAlphaCut) || in_core);
        if (std::abs(squared - near) < margin) continue;
        EXPECT_EQ(evaluate_gate<kMode>(power, opacity, near_alpha(opacity, alpha_min)).counts, expected);
        EXPECT_EQ(squared <= near, expected);
        EXPECT_EQ(gate.evaluate(gate.column(sqrt(squared)).at(S(0)), gate.near_least()).counts, expected);
        (expected ? near_pairs : faint_pairs) += all.counts;
      }
    }
  }
  EXPECT_GT(near_pairs, 1000);
  EXPECT_GT(faint_pairs, Blend<kMode>::kCut == Cut::kAlpha ? -1 : 100);
}

TYPED_TEST(GateOfMode, NearPairsAreThoseOf255thsAndThoseWithinThreeSigma) {
  expect_near_pairs<TypeParam::value>(1e-4f);
  expect_near_pairs<TypeParam::value>(1e-11);
}

// Margins: k^2 is up to 25, its logarithm and the exponential round at epsilon each, so 25 epsilon and a few more.
TYPED_TEST(GateOfMode, SquaredReachBoundsExactlyThePairsThatCount) {
  expect_squared_reach_is_exact<TypeParam::value>(1e-5f);
  expect_squared_reach_is_exact<TypeParam::value>(1e-13);
}

// A round footprint of sigma 1, so of radius 3. It is felt where a pair counts or is a tail.
TYPED_TEST(GateOfMode, PixelReachBoundsWhateverAPixelFeels) {
  using Policy = Blend<TypeParam::value>;
  int by_tails = 0;
  for (const double opacity : test_opacities<double>()) {
    const double squared = squared_reach(Policy::kCut, opacity, 0.0), reach = pixel_reach(3.0, opacity, squared);
    EXPECT_GE(reach, 3);
    for (double distance = reach + 1e-9; distance < reach + 3; distance += 0.1) {
      const auto gate = evaluate_gate<TypeParam::value>(-0.5 * distance * distance, opacity, 0.0);
      EXPECT_FALSE(gate.counts);
      EXPECT_EQ(tail_of(gate, true, double(kEveryTailAlpha)), 0);
    }
    if (reach <= 3) continue;
    const double inside = reach - 1e-9, logit = opacity * std::exp(-0.5 * inside * inside);
    by_tails += logit < 1.001 * kEveryTailAlpha;
    EXPECT_TRUE(logit >= kEveryTailAlpha || inside * inside < squared) << "further than it must";
  }
  EXPECT_GT(by_tails, 100);
  EXPECT_EQ(pixel_reach(7.5f, 1e-6f, 36.0f), 15.0f);  // 6 sigma by a pair, 4.6 by the tails
  for (const double opacity : {0.0, -1.0}) EXPECT_EQ(pixel_reach(6.0, opacity, double(kNoReach)), 6);
}

// The gate by its binary logarithm against the gate by the exponent, at squared distances that are not within `margin`
// of the reach, where rounding decides. tolerance: of o G, relative.
template <BlendMode kMode, class S> void expect_log_gate_is_the_gate(S margin, S tolerance) {
  Random random(3);
  int counted = 0, cut = 0;
  for (const S opacity : test_opacities<S>()) {
    const S least_alpha = S(random.log_uniform(1e-5, 0.1)), dx = S(random.uniform(-9, 9));
    const S xx = S(random.log_uniform(1e-2, 1)), yy = S(random.log_uniform(1e-2, 1));
    const Sym2<S> conic = {xx, S(random.uniform(-0.9, 0.9)) * std::sqrt(xx * yy), yy};
    const S reach = squared_reach(Blend<kMode>::kCut, opacity, least_alpha);
    const LogGate<S> log_gate(conic, opacity, reach);
    for (const S dy : {S(-9), S(-2), S(-0.5), S(0), S(1), S(5)}) {
      const S power = ColumnExponent<S, S>(conic, dx).at(dy);
      const auto expected = evaluate_gate<kMode>(power, opacity, least_alpha);
      const auto gate = log_gate.evaluate(log_gate.column(dx).at(dy));
      if (std::abs(S(-2) * power - reach) < margin) continue;
      EXPECT_EQ(gate.counts, expected.counts) << "opacity " << opacity << " power " << power << " reach " << reach;
      (expected.counts ? counted : cut) += 1;
      if (!expected.counts) continue;
      EXPECT_NEAR(gate.logit, expected.logit, tolerance * expected.logit);
      EXPECT_NEAR(gate.alpha, expected.alpha, tolerance * expected.alpha);
    }
  }
  EXPECT_GT(counted, 100);
  EXPECT_GT(cut, 100);
}

// Exponents of pairs that count, and their terms, are up to some 30 times the result's last digit; margins as above,
// and the terms are up to 100.
TYPED_TEST(GateOfMode, LogGateIsTheGate) {
  expect_log_gate_is_the_gate<TypeParam::value>(1e-4f, 2e-5f);
  expect_log_gate_is_the_gate<TypeParam::value>(1e-12, 4e-14);
}

// If the form is not an ellipse the exponent may be positive: such a pair does not count, and has no infinite gate that
// matters. Nor does a pair of a Gaussian that reaches no pixel.
TYPED_TEST(GateOfMode, LogGateLeavesOutPositiveExponents) {
  const LogGate<double> no_ellipse({0.5, 2.0, 0.5}, 0.9, 11.0);
  EXPECT_GT((ColumnExponent<double, double>(Sym2<double>{0.5, 2.0, 0.5}, 30.0).at(-30.0)), 0);
  EXPECT_FALSE(no_ellipse.evaluate(no_ellipse.column(30.0).at(-30.0)).counts);
  EXPECT_TRUE(no_ellipse.evaluate(no_ellipse.column(0.0).at(0.0)).counts);
  const LogGate<double> none({0.5, 0.0, 0.5}, 0.9, -1.0);
  EXPECT_FALSE(none.evaluate(none.column(0.0).at(0.0)).counts);
}

template <class S> void expect_the_threshold_is_inclusive() {
  const S cut = S(kAlphaCut);
  EXPECT_EQ(squared_reach(Cut::kAlpha, cut, S(0)), 0);
  EXPECT_TRUE((evaluate_gate<Cut::kAlpha>(S(0), cut, S(0)).counts)) << "alpha = 1/255 counts";
  const S below = std::nextafter(cut, S(0));
  EXPECT_FALSE((evaluate_gate<Cut::kAlpha>(S(0), below, S(0)).counts));
  EXPECT_LE(squared_reach(Cut::kAlpha, below, S(0)), 0);
}

TEST(Gate, AnOpacityOfExactlyOneIn255CountsAtTheCentreOnly) {
  expect_the_threshold_is_inclusive<float>();
  expect_the_threshold_is_inclusive<double>();
}

TYPED_TEST(GateOfMode, OpacityNotAboveZeroReachesNothing) {
  for (const double opacity : {0.0, -0.0, -1.0, std::nan("")}) {
    EXPECT_LT(squared_reach(Blend<TypeParam::value>::kCut, opacity, 0.0), 0);
    EXPECT_LT(squared_reach(Blend<TypeParam::value>::kCut, opacity, 0.5), 0);
  }
}

TYPED_TEST(GateOfMode, AlphaIsTheLogitClampedAt99Percent) {
  const auto low = evaluate_gate<TypeParam::value>(-1.0, 0.8, 0.0);
  EXPECT_DOUBLE_EQ(low.logit, 0.8 * std::exp(-1.0));
  EXPECT_EQ(low.alpha, low.logit);
  const auto high = evaluate_gate<TypeParam::value>(-0.25, 3.0, 0.0);
  EXPECT_DOUBLE_EQ(high.logit, 3 * std::exp(-0.25));
  EXPECT_EQ(high.alpha, static_cast<double>(0.99f));
}

TYPED_TEST(GateOfMode, APositiveExponentNeverCounts) {
  EXPECT_TRUE((evaluate_gate<TypeParam::value>(0.0, 0.5, 0.0).counts));
  EXPECT_FALSE((evaluate_gate<TypeParam::value>(1e-300, 0.5, 0.0).counts));
  EXPECT_FALSE((evaluate_gate<TypeParam::value>(std::nan(""), 0.5, 0.0).counts));
}

TYPED_TEST(GateOfMode, GateCutOffIsOnTheKernelAndAlphaCutOffOnTheAlpha) {
  const bool smoe = Blend<TypeParam::value>::kCut == Cut::kKernel;
  // o G = 1e-6, G = 1e-3.
  EXPECT_EQ((evaluate_gate<TypeParam::value>(std::log(1e-3), 1e-3, 0.0).counts), smoe);
  // G = 0.9e-5 and o G = 9e-3 at an opacity of 1000.
  EXPECT_EQ((evaluate_gate<TypeParam::value>(std::log(0.9e-5), 1000.0, 0.0).counts), !smoe);
}

TYPED_TEST(GateOfMode, ClampPassesTheGradientStraightThrough) {
  for (const double opacity : {0.3, 0.99, 1.0, 4.0}) {
    const auto gate = evaluate_gate<TypeParam::value>(-0.1, opacity, 0.0);
    const double value = -1.3;  // g'.c
    PixelBackward<double> pixel = {1 - gate.alpha, 0.2, 0.1}, same = pixel;
    const auto pair = Blend<TypeParam::value>::backward(pixel, gate, value, true);
    const Gate<double> of_alpha = {gate.alpha, gate.alpha, true};
    const auto unclamped = Blend<TypeParam::value>::backward(same, of_alpha, value, true);
    EXPECT_NE(unclamped.power, 0);
    // dL/dalpha is that of alpha, and dL/dpower is o G times that. Some roundings of numbers up to 4 x 1.3 / 0.01.
    EXPECT_NEAR(pair.power, opacity * std::exp(-0.1) / gate.alpha * unclamped.power, 1e-12);
    EXPECT_EQ(pair.weight, unclamped.weight);
  }
}

TYPED_TEST(GateOfMode, APairThatDoesNotCountHandsBackZeroWhateverItsExponent) {
  // An indefinite covariance (cov3D_precomp is the caller's) gives exponents without bound.
  const auto expect_zero = [](auto power) {
    using S = decltype(power);
    const auto gate = evaluate_gate<TypeParam::value>(power, S(0.5), S(0));
    ASSERT_FALSE(gate.counts);
    PixelBackward<S> pixel = {S(0.25), S(0.2), S(0.1)};
    const auto pair = Blend<TypeParam::value>::backward(pixel, gate, S(0.7), false);
    EXPECT_EQ(pair.power, 0) << "power " << power;
    EXPECT_EQ(pair.weight, 0) << "power " << power;
    EXPECT_EQ(pixel.transmittance, S(0.25));
    EXPECT_EQ(pixel.suffix, S(0.2));
  };
  for (const double power : {1.0, 100.0, 1000.0}) {
    expect_zero(power);
    expect_zero(static_cast<float>(power));
  }
}

// lambda = 0.255: pairs of alpha >= 1e-3 count, and all with G >= exp(-4.5), which faint Gaussians still have.
TEST(AlphaCut, CutsFaintPairsOutsideThreeSigmaAlone) {
  const AlphaCut<double> cut(0, 0.255f);
  EXPECT_NEAR(cut.of(1), 1e-3, 1e-9);
  EXPECT_NEAR(squared_reach(Cut::kKernel, 1.0, cut.of(1)), -2 * std::log(1e-3), 1e-5);
  for (const double opacity : {0.05, 1e-3, 1e-9}) {  // 1e-3 is reached inside 3 sigma
    EXPECT_NEAR(squared_reach(Cut::kKernel, opacity, cut.of(opacity)), 9, 1e-5);
  }
  EXPECT_EQ(AlphaCut<double>(0.5, 0.255f).of(1e-9), 0.5) << "the caller's alpha_min cuts everywhere";
  EXPECT_EQ(AlphaCut<double>(0, 0).of(0.7), 0) << "Eq. 7 cuts only on G";
  EXPECT_EQ((AlphaCut<float>(0, 0.1f).faint), static_cast<float>((AlphaCut<double>(0, 0.1).faint)));
}

// x: mean 2, conic 3, opacity. The loss is a weighted sum of squares of o G over a few pixels.
TEST(Gate, MomentsAreAllThatTheShapeNeeds) {
  Random random(3);
  const Vector w = random.uniforms(30), px = random.uniforms(30, -3, 3), py = random.uniforms(30, -3, 3);
  auto logit = [&](const Vector& v, int k) {
    return v[5] * std::exp(quadratic_power({v[2], v[3], v[4]}, px[k] - v[0], py[k] - v[1]));
  };
  auto loss = [&](const Vector& v) {
    double sum = 0;
    for (int k = 0; k < 30; ++k) sum += w[k] * logit(v, k) * logit(v, k);
    return sum;
  };
  const Vector x = {0.3, -0.2, 0.5, 0.1, 0.3, 0.7};
  GateMoments<double> m = {};
  for (int k = 0; k < 30; ++k) {
    const double g = w[k] * 2 * logit(x, k) * logit(x, k);  // dL/dpower
    const double dx = px[k] - x[0], dy = py[k] - x[1];
    m = {m.one + g, m.x + g * dx, m.y + g * dy, m.xx + g * dx * dx, m.xy + g * dx * dy, m.yy + g * dy * dy};
  }
  const auto g = moments_backward({x[2], x[3], x[4]}, x[5], m);
  expect_gradient({g.mean.x, g.mean.y, g.conic.xx, g.conic.xy, g.conic.yy, g.opacity}, loss, x);
}

TEST(Gate, MomentsMoveToAnotherCentre) {
  Random random(4);
  const Vector w = random.uniforms(30, -1, 1), px = random.uniforms(30, -3, 3), py = random.uniforms(30, -3, 3);
  auto moments_about = [&](double x, double y) {
    GateMoments<double> m = {};
    for (int k = 0; k < 30; ++k) {
      const double dx = px[k] - x, dy = py[k] - y;
      m = {m.one + w[k],          m.x + w[k] * dx,       m.y + w[k] * dy,
           m.xx + w[k] * dx * dx, m.xy + w[k] * dx * dy, m.yy + w[k] * dy * dy};
    }
    return m;
  };
  const auto moved = shift_moments(moments_about(0.4, -0.3), {0.4 - 2.5, -0.3 - 1.5});
  const auto expected = moments_about(2.5, 1.5);
  const double tolerance = 1e-12;  // sums of 30 terms of up to 30
  EXPECT_NEAR(moved.one, expected.one, tolerance);
  EXPECT_NEAR(moved.x, expected.x, tolerance);
  EXPECT_NEAR(moved.y, expected.y, tolerance);
  EXPECT_NEAR(moved.xx, expected.xx, tolerance);
  EXPECT_NEAR(moved.xy, expected.xy, tolerance);
  EXPECT_NEAR(moved.yy, expected.yy, tolerance);
}

}  // namespace
}  // namespace dsmoe

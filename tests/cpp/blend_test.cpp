// The blend modes against the paper's sums, written out, and against finite differences of those sums.

#include "dsmoe/blend.h"

#include <gtest/gtest.h>

#include <cmath>
#include <limits>
#include <vector>

#include "all_modes.h"
#include "dsmoe/pixel.h"
#include "finite_difference.h"

namespace dsmoe {
namespace {

using Vector = std::vector<double>;

// What one pixel blends: pairs front to back, each with an alpha and the features colour, z and 1 / z.
struct Pixel {
  std::vector<bool> counts;
  Vector alpha;
  Vector color, depth, inverse_depth;
  double background = 0.35;
  double lambda = 0;  // read by smoe and smoe_eq7 alone
  double tails = 0;   // B, read by smoe alone
  int size() const { return static_cast<int>(alpha.size()); }
};

struct Finished {
  double color = 0, depth = 0, inverse_depth = 0;
  double gate_sum = 0;          // the alpha image
  double denominator_part = 0;  // W; ablations: sum alpha
  double transmittance = 1;
  int last = 0;  // one past the last pair of the numerator
};

// What a pair adds to the sums of a mode: Equations 3, 7, 8 and 6.
struct Terms {
  double numerator, denominator;
};

// t: the transmittance in front of the pair. full: the pixel takes no more pairs.
Terms terms_of(BlendMode mode, double alpha, double t, bool full) {
  switch (mode) {
    case BlendMode::kAlpha:
    case BlendMode::kSmoe:
    case BlendMode::kSmoeEq7:
      return full ? Terms{0, 0} : Terms{alpha * t, alpha * t};
    case BlendMode::kSmoeTn:
      return {full ? 0 : alpha * t, alpha};
    case BlendMode::kSmoeStd:
      return {alpha, alpha};
  }
  ADD_FAILURE() << "mode " << static_cast<int>(mode) << " has no equation here";
  return {NAN, NAN};
}

// The sums as the paper writes them, of Equation 7 with the background as one more expert, which weighs the tails too
// in smoe. stop: the pair before which the numerator ends.
Finished paper(BlendMode mode, const Pixel& pixel, int stop) {
  Finished out;
  double sum_color = 0, sum_z = 0, sum_inverse_z = 0;
  for (int i = 0; i < pixel.size(); ++i) {
    if (!pixel.counts[i]) continue;
    double t = 1;
    for (int j = 0; j < i; ++j) t *= pixel.counts[j] ? 1 - pixel.alpha[j] : 1;
    const auto terms = terms_of(mode, pixel.alpha[i], t, i >= stop);
    out.gate_sum += terms.denominator;
    if (i >= stop && terms.numerator == 0) continue;
    sum_color += terms.numerator * pixel.color[i];
    sum_z += terms.numerator * pixel.depth[i];
    sum_inverse_z += terms.numerator * pixel.inverse_depth[i];
    out.transmittance = t * (1 - pixel.alpha[i]);
    out.last = i + 1;
  }
  const bool gated = out.gate_sum >= static_cast<double>(1e-30f);
  out.depth = gated ? sum_z / out.gate_sum : 0;
  const double of_background = pixel.lambda * out.transmittance + (mode == BlendMode::kSmoe ? pixel.tails : 0);
  if (mode == BlendMode::kAlpha) {
    out.color = sum_color + out.transmittance * pixel.background;
    out.inverse_depth = sum_inverse_z;
  } else if (gated && (mode == BlendMode::kSmoe || mode == BlendMode::kSmoeEq7)) {
    out.color = (sum_color + of_background * pixel.background) / (out.gate_sum + of_background);
    out.inverse_depth = sum_inverse_z / (out.gate_sum + of_background);
    if (mode == BlendMode::kSmoe) out.gate_sum /= out.gate_sum + of_background;  // the alpha image
  } else {
    out.color = gated ? sum_color / out.gate_sum : pixel.background;
    out.inverse_depth = gated ? sum_inverse_z / out.gate_sum : 0;
  }
  return out;
}

// The first pair that would leave less than 1e-4 of the light, in the arithmetic of Real.
template <class Real> int paper_stop(const Pixel& pixel) {
  Real t = 1;
  for (int i = 0; i < pixel.size(); ++i) {
    if (!pixel.counts[i]) continue;
    t *= Real(1) - Real(pixel.alpha[i]);
    if (t < Real(1e-4f)) return i;
  }
  return pixel.size();
}

template <class Real> Gate<Real> gate_of(const Pixel& pixel, int i) {
  return {Real(pixel.alpha[i]), Real(pixel.alpha[i]), pixel.counts[i]};
}

template <BlendMode kMode, class Real> Finished blended(const Pixel& pixel) {
  auto state = PixelState<Real>::open();
  Real color = 0, depth = 0, inverse_depth = 0;
  Finished out;
  for (int i = 0; i < pixel.size(); ++i) {
    auto gate = gate_of<Real>(pixel, i);
    gate.logit = std::numeric_limits<Real>::quiet_NaN();  // not every walk has one
    const auto pair = Blend<kMode>::accumulate(state, gate);
    color += pair.weight * Real(pixel.color[i]);
    depth += pair.weight * Real(pixel.depth[i]);
    inverse_depth += pair.weight * Real(pixel.inverse_depth[i]);
    if (pair.contributes) out.last = i + 1;
  }
  auto end = state.end(Real(pixel.lambda));
  end.tails = Real(pixel.tails);
  out.color = finish_feature<kMode>(FeatureRule::kBlended, end, color, Real(pixel.background));
  out.depth = finish_feature<kMode>(FeatureRule::kAveraged, end, depth, Real(0));
  out.inverse_depth = finish_feature<kMode>(FeatureRule::kBlended, end, inverse_depth, Real(0));
  out.gate_sum = finish_alpha<kMode>(end);
  out.denominator_part = state.gate_sum;
  out.transmittance = abs(state.transmittance);
  return out;
}

Pixel random_pixel(Random& random, int count, double largest_alpha) {
  Pixel pixel;
  pixel.lambda = random.uniform(0, 1) < 0.5 ? 0 : random.log_uniform(1e-3, 3);
  pixel.tails = random.uniform(0, 1) < 0.5 ? 0 : random.log_uniform(1e-6, 1e-1);
  for (int i = 0; i < count; ++i) {
    const double z = random.uniform(1, 4);
    pixel.counts.push_back(random.uniform(0, 1) < 0.8);
    pixel.alpha.push_back(random.log_uniform(1e-5, largest_alpha));
    pixel.color.push_back(random.uniform(0, 1));
    pixel.depth.push_back(z);
    pixel.inverse_depth.push_back(1 / z);
  }
  return pixel;
}

// Fills a pixel after a few pairs, and goes on.
Pixel saturated_pixel() {
  Pixel pixel;
  pixel.counts = {true, true, false, true, true, true, true};
  pixel.alpha = {0.3, 0.9, 0.5, 0.98, 0.94, 0.2, 0.6};  // T: 0.7, 0.07, 0.0014; the fifth would leave 8.4e-5
  pixel.color = {0.1, 0.9, 0.4, 0.6, 0.2, 0.8, 0.3};
  pixel.depth = {1, 1.5, 2, 2.5, 3, 3.5, 4};
  for (const double z : pixel.depth) pixel.inverse_depth.push_back(1 / z);
  pixel.lambda = 0.4;
  pixel.tails = 0.02;
  return pixel;
}

void expect_near(const Finished& actual, const Finished& expected, double tolerance) {
  EXPECT_NEAR(actual.color, expected.color, tolerance);
  EXPECT_NEAR(actual.depth, expected.depth, 4 * tolerance);  // depths reach 4
  EXPECT_NEAR(actual.inverse_depth, expected.inverse_depth, tolerance);
  EXPECT_NEAR(actual.gate_sum, expected.gate_sum, tolerance * std::max(1.0, expected.gate_sum));
  EXPECT_EQ(actual.last, expected.last);
}

template <class Mode> struct BlendOf : testing::Test {};
TYPED_TEST_SUITE(BlendOf, AllModes);
template <class Mode> struct GatedBlendOf : testing::Test {};
TYPED_TEST_SUITE(GatedBlendOf, GatedModes);
template <class Mode> struct ResumingBlendOf : testing::Test {};
TYPED_TEST_SUITE(ResumingBlendOf, ResumingModes);

template <BlendMode kMode, class Real> void expect_the_papers_sums(const Pixel& pixel, double tolerance) {
  const Finished expected = paper(kMode, pixel, paper_stop<Real>(pixel));
  const Finished actual = blended<kMode, Real>(pixel);
  expect_near(actual, expected, tolerance);
  if (Blend<kMode>::kNeedsDepthOrder) {
    EXPECT_NEAR(actual.transmittance, expected.transmittance, tolerance);
  }
}

// Sums of 40 positive terms: 40 roundings at most, in weighted means of numbers near 1.
TYPED_TEST(BlendOf, EqualsThePapersSums) {
  Random random(1);
  for (int i = 0; i < 50; ++i) {
    const Pixel pixel = random_pixel(random, 40, i % 2 ? 0.05 : 0.9);  // half of them fill up
    expect_the_papers_sums<TypeParam::value, double>(pixel, 40 * 1.2e-16);
    expect_the_papers_sums<TypeParam::value, float>(pixel, 40 * 6e-8);
  }
}

TYPED_TEST(BlendOf, LeavesOutThePairThatWouldFillThePixelAndAllBehindIt) {
  const Pixel pixel = saturated_pixel();
  ASSERT_EQ(paper_stop<double>(pixel), 4);
  const Finished actual = blended<TypeParam::value, double>(pixel);
  expect_near(actual, paper(TypeParam::value, pixel, 4), 1e-14);
  EXPECT_EQ(actual.last, TypeParam::value == BlendMode::kSmoeStd ? 7 : 4);
}

TYPED_TEST(BlendOf, StopsAtTheSamePairInEveryScalarType) {
  Pixel pixel;  // (1 - 0.99f)^2 < 1e-4f, though (1 - 0.99)^2 is not below 1e-4 in double
  pixel.alpha.assign(3, static_cast<double>(kAlphaMax));
  pixel.counts.assign(3, true);
  pixel.color = pixel.depth = pixel.inverse_depth = {1, 1, 1};
  const int expected = TypeParam::value == BlendMode::kSmoeStd ? 3 : 1;
  EXPECT_EQ((blended<TypeParam::value, float>(pixel).last), expected);
  EXPECT_EQ((blended<TypeParam::value, double>(pixel).last), expected);
}

TYPED_TEST(BlendOf, KeepsASmallGateSumToSixDigits) {
  // As 1 - T, a sum of 2.6e-6 would be off by 1.5 %.
  Pixel pixel;
  pixel.alpha = {1.1e-6, 0.9e-6, 0.6e-6};
  pixel.counts = {true, true, true};
  pixel.color = {0.2, 0.7, 0.9};
  pixel.depth = {1, 2, 3};
  pixel.inverse_depth = {1, 0.5, 1.0 / 3};
  const Finished actual = blended<TypeParam::value, float>(pixel);
  const Finished expected = paper(TypeParam::value, pixel, 3);
  EXPECT_NEAR(actual.gate_sum, expected.gate_sum, 1e-6 * expected.gate_sum);
  EXPECT_NEAR(actual.depth, expected.depth, 1e-6 * expected.depth);
  EXPECT_NEAR(actual.color, expected.color, 1e-6);
}

TYPED_TEST(GatedBlendOf, OpensNoGateBelow1e30AndOneAt1e30) {
  Pixel pixel;
  pixel.counts = {true};
  pixel.color = {0.8};
  pixel.depth = {2};
  pixel.inverse_depth = {0.5};
  pixel.alpha = {0.9e-30};
  const Finished closed = blended<TypeParam::value, double>(pixel);
  EXPECT_EQ(closed.color, pixel.background);
  EXPECT_EQ(closed.depth, 0);
  EXPECT_EQ(closed.inverse_depth, 0);
  pixel.alpha = {static_cast<double>(1e-30f)};
  EXPECT_DOUBLE_EQ((blended<TypeParam::value, double>(pixel).color), 0.8);
}

TYPED_TEST(BlendOf, AnEmptyPixelIsBackground) {
  const Finished empty = blended<TypeParam::value, float>(Pixel{});
  EXPECT_EQ(empty.color, 0.35f);
  EXPECT_EQ(empty.depth, 0);
  EXPECT_EQ(empty.inverse_depth, 0);
  EXPECT_EQ(empty.gate_sum, 0);
}

// The loss is a weighted sum of the pixel's outputs.
struct Weights {
  double color = 0.7, depth = -0.4, inverse_depth = 0.9, gate_sum = 0.3;
};

struct PixelGradient {
  Vector power;  // dL/dpower, which is alpha dL/dalpha: no alpha is clamped
  Vector color, depth, inverse_depth;
  double background = 0, lambda = 0;
};

// The pairs in front of `middle` belong to another walk, which knows only the sum of those behind.
template <BlendMode kMode, class Real> PixelGradient backward(const Pixel& pixel, const Weights& g, int middle = 0) {
  const Finished forward = blended<kMode, Real>(pixel);
  const PixelEnd<Real> end = {Real(forward.transmittance), Real(forward.denominator_part), Real(pixel.lambda),
                              Real(pixel.tails)};
  const auto begin = begin_backward<kMode>(end, Real(g.gate_sum));
  auto constants = begin.pixel;
  const auto by_color = add_feature<kMode>(FeatureRule::kBlended, constants, end, Real(g.color), Real(forward.color),
                                           Real(pixel.background));
  const auto by_depth =
      add_feature<kMode>(FeatureRule::kAveraged, constants, end, Real(g.depth), Real(forward.depth), Real(0));
  const auto by_inverse_depth = add_feature<kMode>(FeatureRule::kBlended, constants, end, Real(g.inverse_depth),
                                                   Real(forward.inverse_depth), Real(0));
  const Real color = by_color.scaled, depth = by_depth.scaled, inverse_depth = by_inverse_depth.scaled;
  const auto start = constants;
  Real behind = 0;
  PixelGradient out;
  out.background = by_color.background;
  out.lambda = begin.lambda + by_color.lambda + by_depth.lambda + by_inverse_depth.lambda;
  out.power = out.color = out.depth = out.inverse_depth = Vector(pixel.size());
  for (int i = pixel.size() - 1; i >= 0; --i) {
    if constexpr (kResumes<kMode>) {
      if (i == middle - 1) {
        Pixel front = pixel;
        front.alpha.resize(middle);
        constants = start;
        resume_backward<kMode>(constants, Real(blended<kMode, Real>(front).transmittance), behind);
      }
    }
    const Real value =
        color * Real(pixel.color[i]) + depth * Real(pixel.depth[i]) + inverse_depth * Real(pixel.inverse_depth[i]);
    const auto gate = gate_of<Real>(pixel, i);
    const auto pair = Blend<kMode>::backward(constants, gate, value, gate.counts & (i < forward.last));
    behind += pair.weight * value;
    out.power[i] = pair.power;
    out.color[i] = pair.weight * color;
    out.depth[i] = pair.weight * depth;
    out.inverse_depth[i] = pair.weight * inverse_depth;
  }
  // Back to front, the transmittance arrives where it began: one rounding for each of at most 300 pairs.
  if (Blend<kMode>::kNeedsDepthOrder) {
    EXPECT_NEAR(constants.transmittance, 1, sizeof(Real) == 4 ? 300 * 6e-8 : 300 * 1.2e-16);
  }
  return out;
}

Vector flat(const Pixel& pixel, const PixelGradient& g) {
  Vector out;
  for (int i = 0; i < pixel.size(); ++i) out.push_back(g.power[i] / pixel.alpha[i]);
  for (const Vector* part : {&g.color, &g.depth, &g.inverse_depth}) out.insert(out.end(), part->begin(), part->end());
  out.push_back(g.background);
  out.push_back(g.lambda);
  return out;
}

// Finite differences of the paper's sums by alpha, colour, depth, inverse depth, background and its gate, in that
// order.
Vector paper_gradient(BlendMode mode, const Pixel& pixel, const Weights& g, double step) {
  const int n = pixel.size(), stop = paper_stop<double>(pixel);
  Vector x = pixel.alpha;
  for (const Vector* part : {&pixel.color, &pixel.depth, &pixel.inverse_depth}) {
    x.insert(x.end(), part->begin(), part->end());
  }
  x.push_back(pixel.background);
  x.push_back(pixel.lambda);
  auto loss = [&](const Vector& v) {
    Pixel moved = pixel;
    moved.alpha.assign(v.begin(), v.begin() + n);
    moved.color.assign(v.begin() + n, v.begin() + 2 * n);
    moved.depth.assign(v.begin() + 2 * n, v.begin() + 3 * n);
    moved.inverse_depth.assign(v.begin() + 3 * n, v.begin() + 4 * n);
    moved.background = v[4 * n];
    moved.lambda = v[4 * n + 1];
    const Finished f = paper(mode, moved, stop);
    return g.color * f.color + g.depth * f.depth + g.inverse_depth * f.inverse_depth + g.gate_sum * f.gate_sum;
  };
  return finite_differences(loss, x, step);
}

// Alphas well above the step, so that the differences judge dL/dalpha itself.
Pixel differentiable_pixel(Random& random, double largest_alpha) {
  Pixel pixel = random_pixel(random, 12, largest_alpha);
  pixel.lambda = random.uniform(0.05, 2);
  for (double& alpha : pixel.alpha) alpha = random.uniform(0.02, largest_alpha);
  return pixel;
}

TYPED_TEST(BlendOf, BackwardIsTheDerivativeOfThePapersSums) {
  Random random(2);
  for (int i = 0; i < 10; ++i) {
    const Pixel pixel = differentiable_pixel(random, i % 2 ? 0.3 : 0.8);
    const Weights g = {random.uniform(-1, 1), random.uniform(-1, 1), random.uniform(-1, 1), random.uniform(-1, 1)};
    // 1 / gate sum to the fifth power enters the truncation error: a step of 1e-4.
    expect_near_all(flat(pixel, backward<TypeParam::value, double>(pixel, g)),
                    paper_gradient(TypeParam::value, pixel, g, 1e-4), kGradientTolerance);
  }
}

TYPED_TEST(BlendOf, BackwardIsTheDerivativeBehindAFullPixel) {
  const Pixel pixel = saturated_pixel();
  const PixelGradient g = backward<TypeParam::value, double>(pixel, {});
  expect_near_all(flat(pixel, g), paper_gradient(TypeParam::value, pixel, {}, 1e-4), kGradientTolerance);
  // Hidden pairs move the denominator of smoe_tn and nothing else.
  for (const int hidden : {4, 5, 6}) {
    const bool moves = TypeParam::value == BlendMode::kSmoeTn || TypeParam::value == BlendMode::kSmoeStd;
    EXPECT_EQ(g.power[hidden] != 0, moves);
    EXPECT_EQ(g.color[hidden] != 0, TypeParam::value == BlendMode::kSmoeStd);
  }
}

TYPED_TEST(ResumingBlendOf, InTheMiddleItHasTheSameDerivative) {
  Random random(4);
  for (const Pixel& pixel : {differentiable_pixel(random, 0.3), saturated_pixel()}) {
    const Weights g = {random.uniform(-1, 1), random.uniform(-1, 1), random.uniform(-1, 1), random.uniform(-1, 1)};
    const Vector whole = flat(pixel, backward<TypeParam::value, double>(pixel, g));
    for (int middle = 1; middle < pixel.size(); ++middle) {
      // Sums of a dozen terms near 1, divided by alphas of 0.02 at least.
      expect_near_all(flat(pixel, backward<TypeParam::value, double>(pixel, g, middle)), whole, 1e-12);
    }
  }
}

// CUDA's walk puts b into the value, once a pixel.
TYPED_TEST(BlendOf, ReadsTheBaseInNothingButTheSuffixAboutIt) {
  if (!Blend<TypeParam::value>::kSuffixAboutBase) return;
  const Gate<double> gate = {0.3, 0.3, true};
  PixelBackward<double> apart = {0.5, 0.2, 0.75}, together = {0.5, 0.2, 0};
  const auto expected = Blend<TypeParam::value>::backward(apart, gate, 0.5, true);
  const auto actual = Blend<TypeParam::value>::backward(together, gate, 0.5 - 0.75, true);
  EXPECT_EQ(actual.power, expected.power);
  EXPECT_EQ(actual.weight, expected.weight);
  EXPECT_EQ(together.suffix, apart.suffix);
}

TYPED_TEST(BlendOf, EachOutputAloneHasItsOwnDerivative) {
  Random random(3);
  const Pixel pixel = differentiable_pixel(random, 0.6);
  const Weights alone[] = {{1, 0, 0, 0}, {0, 1, 0, 0}, {0, 0, 1, 0}, {0, 0, 0, 1}};
  for (const Weights& g : alone) {
    expect_near_all(flat(pixel, backward<TypeParam::value, double>(pixel, g)),
                    paper_gradient(TypeParam::value, pixel, g, 1e-4), kGradientTolerance);
  }
}

// Sums of integers (csrc/cuda/integer_sums.cuh) have room for so much, and for 8 times as much of another law.
TYPED_TEST(BlendOf, GradientsAreBoundedByThoseOfTheImageAndTheLargestFeature) {
  using Policy = Blend<TypeParam::value>;
  const double spare = Policy::kLaw == Law::kGates ? 1 + 1e-12 : 8;  // sums of 40 terms in double
  Random random(5);
  for (int i = 0; i < 400; ++i) {
    const Pixel pixel = random_pixel(random, 1 + i % 40, i % 2 ? 1e-3 : 0.98);
    const Weights g = {random.uniform(-1, 1), random.uniform(-1, 1), random.uniform(-1, 1), random.uniform(-1, 1)};
    const PixelGradient actual = backward<TypeParam::value, double>(pixel, g);
    double most = (Policy::kTails ? 2 : 1) * abs(g.gate_sum);
    const auto feature = [&](double gradient, const Vector& values, double background, const Vector& by_value) {
      double largest = abs(background);
      for (const double value : values) largest = std::max(largest, abs(value));
      most += 2 * abs(gradient) * largest;
      for (const double value : by_value) EXPECT_LE(abs(value), spare * abs(gradient));
    };
    feature(g.color, pixel.color, pixel.background, actual.color);
    feature(g.depth, pixel.depth, 0, actual.depth);
    feature(g.inverse_depth, pixel.inverse_depth, 0, actual.inverse_depth);
    most *= 2 * std::max(1.0, Policy::background_gate(pixel.lambda));
    for (const double power : actual.power) EXPECT_LE(abs(power), spare * most);
  }
}

// Alphas near 1e-6 under one gate: dL/dalpha is near 1e6, and dL/dpower is what leaves the pair.
TYPED_TEST(BlendOf, FloatGradientsOfAFaintPixelKeepFiveDigits) {
  Pixel pixel;
  pixel.counts.assign(3, true);
  pixel.alpha = {1.1e-6, 0.9e-6, 0.6e-6};
  pixel.color = {0.2, 0.7, 0.9};
  pixel.depth = {1, 2, 3};
  pixel.inverse_depth = {1, 0.5, 1.0 / 3};
  const Vector wide = backward<TypeParam::value, double>(pixel, {}).power;
  // Differences between features of equal size lose about one digit to cancellation.
  expect_near_all(backward<TypeParam::value, float>(pixel, {}).power, wide, 1e-5);
}

TYPED_TEST(BlendOf, FloatGradientsReachTheDeepestPair) {
  // Front to back, the last of 300 pairs would lose percents to cancellation.
  Random random(4);
  const Pixel pixel = random_pixel(random, 300, 0.05);
  const Vector wide = backward<TypeParam::value, double>(pixel, {}).power;
  const Vector narrow = backward<TypeParam::value, float>(pixel, {}).power;
  const Vector deepest_wide(wide.end() - 20, wide.end()), deepest_narrow(narrow.end() - 20, narrow.end());
  // T is rebuilt by at most 300 divisions, each off by 6e-8: 2e-5, and u cancels a digit or so.
  expect_near_all(deepest_narrow, deepest_wide, 1e-4);
}

TYPED_TEST(GatedBlendOf, AClosedGateGivesItsGradientToTheBackground) {
  Pixel pixel;
  pixel.counts = {true, true};
  pixel.alpha = {1e-32, 2e-32};
  pixel.color = {0.2, 0.7};
  pixel.depth = {1, 2};
  pixel.inverse_depth = {1, 0.5};
  const PixelGradient g = backward<TypeParam::value, double>(pixel, {0.7, -0.4, 0.9, 0});
  EXPECT_EQ(g.background, 0.7);
  for (int i = 0; i < 2; ++i) {
    EXPECT_EQ(g.power[i], 0);
    EXPECT_EQ(g.color[i], 0);
    EXPECT_EQ(g.depth[i], 0);
    EXPECT_EQ(g.inverse_depth[i], 0);
  }
  // The gate sum itself is an output too, and still moves; its share of the pixel does not.
  const PixelGradient on_sum = backward<TypeParam::value, double>(pixel, {0, 0, 0, 0.3});
  EXPECT_DOUBLE_EQ(on_sum.power[1], Blend<TypeParam::value>::kTails ? 0 : 0.3 * 2e-32);
}

// A mode's parameters as one value.

template <class S> BlendRules<S> rules_of(BlendMode mode) {
  BlendRules<S> rules;
  rules.mode = mode;
  return rules;
}

TEST(BlendRules, LambdaIsTheNumberWhereItLiesNowhere) {
  auto rules = rules_of<float>(BlendMode::kSmoe);
  rules.background_gate = 0.25f;
  EXPECT_EQ(rules.lambda(), 0.25f);
  const float at = 0.5f;
  rules.background_gate_at = &at;
  EXPECT_EQ(rules.lambda(), 0.5f);
}

TEST(BlendRules, LambdaCutsFaintPairsInSmoeEq7Only) {
  for (const BlendMode mode : {BlendMode::kAlpha, BlendMode::kSmoe, BlendMode::kSmoeEq7}) {
    auto rules = rules_of<double>(mode);
    rules.alpha_min = 1e-6, rules.background_gate = 0.255;
    // At opacity 1, alpha is 0.011 at 3 sigma: all pairs of alpha < lambda / 255 lie outside. 1e-9: of float32.
    EXPECT_NEAR(rules.alpha_cut().of(1), mode == BlendMode::kSmoeEq7 ? 1e-3 : 1e-6, 1e-9) << static_cast<int>(mode);
  }
}

TEST(BlendRules, WidePixelsAreThoseOfTheModeUnlessTheCallerSays) {
  EXPECT_EQ(rules_of<double>(BlendMode::kSmoe).wide_below(), 0.25f);
  EXPECT_TRUE(rules_of<double>(BlendMode::kSmoe).blends_near_first());
  EXPECT_FALSE(rules_of<double>(BlendMode::kSmoeEq7).blends_near_first());
  for (const BlendMode mode : {BlendMode::kSmoe, BlendMode::kSmoeEq7}) {
    auto rules = rules_of<double>(mode);
    rules.faint_below = 0;
    EXPECT_EQ(rules.wide_below(), 0);
    EXPECT_TRUE(rules.blends_near_first());
    rules.faint_below = 2;  // all pixels are wide: no near pairs first
    EXPECT_FALSE(rules.blends_near_first());
  }
  auto alpha = rules_of<double>(BlendMode::kAlpha);
  alpha.faint_below = 0;
  EXPECT_FALSE(alpha.blends_near_first());
}

TEST(BlendRules, TailsReachFromTheLeastStrongPairToTheLeastThatIsFelt) {
  auto rules = rules_of<double>(BlendMode::kSmoe);
  // A tail of alpha a lies where the squared distance is 2 log(opacity / a).
  const auto reach = [&] { return squared_reach(Cut::kStrong, 0.8, rules.alpha_min) + rules.tail_reach(); };
  for (const float below : {kFaintBelow, kFaintEverywhere}) {
    rules.faint_below = below;
    const double tails_end = 2 * std::log(0.8 / (below < 1 ? 1 / (2040.0 * 255) : 0x1p-35));
    for (const double alpha_min : {0.0, 0.01}) {
      rules.alpha_min = alpha_min;
      EXPECT_NEAR(reach(), tails_end, 1e-6);
    }
  }
  EXPECT_EQ(rules_of<double>(BlendMode::kSmoeEq7).tail_reach(), 0);
}

TEST(BlendRules, KeepTheirValuesInAnotherPrecision) {
  const float gate = 0.5f;
  auto rules = rules_of<float>(BlendMode::kSmoeEq7);
  rules.alpha_min = 0.25f, rules.background_gate_at = &gate;
  auto wide = rules.as<double>();
  EXPECT_EQ(wide.mode, BlendMode::kSmoeEq7);
  EXPECT_EQ(wide.alpha_min, 0.25);
  EXPECT_EQ(wide.lambda(), 0.5);
  EXPECT_EQ(wide.faint_below, kFaintBelowOfMode);
  rules.faint_below = 0.75f;
  wide = rules.as<double>();
  EXPECT_EQ(wide.faint_below, 0.75);
  EXPECT_EQ(wide.wide_below(), 0.75);
}

}  // namespace
}  // namespace dsmoe

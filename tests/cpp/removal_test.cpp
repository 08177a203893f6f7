// A pixel without one of its pairs: against the paper's sums over the others.
#include "dsmoe/removal.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

#include "all_modes.h"

namespace dsmoe {
namespace {

struct Pixel {
  std::vector<double> alpha, color;  // front to back
  double background = 0.3, lambda = 0, tails = 0;
  int size() const { return static_cast<int>(alpha.size()); }
};

// The colour by Eq. 3, 6, 7 or 8 without pair `omitted`, -1 for none.
double color_of(BlendMode mode, const Pixel& pixel, int omitted) {
  double numerator = 0, sum_weight = 0, sum_alpha = 0, transmittance = 1;
  for (int i = 0; i < pixel.size(); ++i) {
    if (i == omitted) continue;
    const double weight = mode == BlendMode::kSmoeStd ? pixel.alpha[i] : pixel.alpha[i] * transmittance;
    numerator += weight * pixel.color[i];
    sum_weight += weight;
    sum_alpha += pixel.alpha[i];
    transmittance *= 1 - pixel.alpha[i];
  }
  if (mode == BlendMode::kAlpha) return numerator + transmittance * pixel.background;
  const bool by_weight = mode == BlendMode::kSmoe || mode == BlendMode::kSmoeEq7;
  const double gate = by_weight ? pixel.lambda * transmittance + pixel.tails : 0;
  const double denominator = (by_weight ? sum_weight : sum_alpha) + gate;
  return denominator > 0 ? (numerator + gate * pixel.background) / denominator : pixel.background;
}

// dC/dc of pair i: the colour of a pixel in which that pair has 1, and all else 0.
double share_of(BlendMode mode, Pixel pixel, int i) {
  for (int j = 0; j < pixel.size(); ++j) pixel.color[j] = i == j;
  pixel.background = 0;
  return color_of(mode, pixel, -1);
}

template <BlendMode kMode, class S> void expect_omissions(const Pixel& pixel, double tolerance) {
  std::vector<Gate<S>> gates;
  for (const double alpha : pixel.alpha) gates.push_back({S(alpha), S(alpha), true});
  // The tails' sum, which stays, stands in front of all pairs, with the background's colour.
  const PixelState<S> open = {S(1), S(pixel.tails)};
  PixelState<S> state = open;
  for (const auto& gate : gates) Blend<kMode>::accumulate(state, gate);
  const PixelEnd<S> end = state.end(S(pixel.lambda));
  const S value = S(color_of(kMode, pixel, -1)), background = S(pixel.background);
  state = open;
  S front = S(pixel.tails) * (background - value);
  for (int i = 0; i < pixel.size(); ++i) {
    const auto removal = remove_pair<kMode>(state, end, gates[i], true);
    const S distance = S(pixel.color[i]) - value;
    const S to_rest = channel_change<kMode>(removal, distance, front, value), to_background = background - value;
    const S change = removal.left ? to_rest : to_background;
    Importance<S> sum = {};
    add_pair(sum, removal, to_rest * to_rest, to_background * to_background, S(1), S(1));
    front = fma(removal.weight, distance, front);
    EXPECT_TRUE(removal.takes);
    EXPECT_NEAR(removal.share, share_of(kMode, pixel, i), tolerance) << i;
    const double expected = color_of(kMode, pixel, i) - color_of(kMode, pixel, -1);
    EXPECT_NEAR(change, expected, tolerance) << i;
    EXPECT_NEAR(std::sqrt(sum.removal_cost), std::abs(expected), tolerance) << i;
  }
}

template <BlendMode kMode> void expect_in_range(const Pixel& pixel) {
  PixelState<float> state = PixelState<float>::open();
  std::vector<Gate<float>> gates;
  float sum = 0;
  for (int i = 0; i < pixel.size(); ++i) {
    const float alpha = static_cast<float>(pixel.alpha[i]);
    gates.push_back({alpha, alpha, true});
    sum += Blend<kMode>::accumulate(state, gates[i]).weight * static_cast<float>(pixel.color[i]);
  }
  const PixelEnd<float> end = state.end(0.0f);
  const float value = finish_feature<kMode>(FeatureRule::kBlended, end, sum, static_cast<float>(pixel.background));
  state = PixelState<float>::open();
  float front = 0;
  for (int i = 0; i < pixel.size(); ++i) {
    const auto removal = remove_pair<kMode>(state, end, gates[i], true);
    const float distance = static_cast<float>(pixel.color[i]) - value;
    const float change = channel_change<kMode>(removal, distance, front, value);
    front = fma(removal.weight, distance, front);
    if (removal.left) EXPECT_LT(std::abs(change), 1.5) << i << " of " << pixel.alpha[0] << ", " << pixel.alpha[1];
  }
}

// Far from full: (1 - 0.6)^8 > 1e-4.
Pixel layers(double opacity) {
  Pixel pixel;
  for (int i = 0; i < 8; ++i) {
    pixel.alpha.push_back(opacity * (0.5 + 0.5 * std::sin(7 * i + 1)));
    pixel.color.push_back(0.5 + 0.5 * std::cos(5 * i));
  }
  return pixel;
}

template <class Mode> struct RemovalIn : testing::Test {};
TYPED_TEST_SUITE(RemovalIn, RemovableModes);

TYPED_TEST(RemovalIn, EqualsTheSumsOverTheOthers) {
  constexpr BlendMode kMode = TypeParam::value;
  for (const double gate : {0.0, 0.03, 1.0}) {
    for (const double opacity : {0.6, 0.01}) {
      Pixel pixel = layers(opacity);
      if (Blend<kMode>::kLearnsGate) pixel.lambda = gate;
      if (Blend<kMode>::kTails) pixel.tails = 0.01;
      // Some dozens of roundings; if the sums are small, of transmittances near 1 in place of them.
      expect_omissions<kMode, double>(pixel, 1e-15 * 20 / opacity);
      expect_omissions<kMode, float>(pixel, 6e-8 * 20 / opacity);
    }
  }
}

TYPED_TEST(RemovalIn, ShowsTheBackgroundWithoutTheOnlyOwner) {
  for (const double alpha : {0.99, 0.3, 1e-6}) {
    Pixel pixel;
    pixel.alpha = {alpha}, pixel.color = {0.9};
    // The background behind the owner is seen through 1 - alpha, and its digits with it.
    expect_omissions<TypeParam::value, double>(pixel, 4e-16 / (1 - alpha));
    expect_omissions<TypeParam::value, float>(pixel, 2e-7 / (1 - alpha));
  }
}

TYPED_TEST(RemovalIn, ShowsTheVeilInFrontOfAWall) {
  for (const double veil : {0.1, 1e-3, 1e-5, 1e-24}) {  // the square of the last one is not a float
    Pixel pixel;
    pixel.alpha = {veil, 0.9}, pixel.color = {0.2, 0.8};
    // smoe_tn keeps no sum of the weights in front. It takes 1 - T, which has lost digits, or less by at most veil / 2.
    const auto lost = [veil](double rounding) {
      return TypeParam::value == BlendMode::kSmoeTn ? std::min(rounding / veil, veil / 2) : 0;
    };
    expect_omissions<TypeParam::value, double>(pixel, 1e-14 + lost(1e-15));
    expect_omissions<TypeParam::value, float>(pixel, 2e-6 + lost(6e-7));
  }
}

// In float, if digits of faint owners are lost, a cost is still one of colours between 0 and 1. The rounding of 8
// operations is divided by the owners that are known, which are 1e-6 of the sum or more: that may add 0.5.
TYPED_TEST(RemovalIn, StaysInTheRangeOfTheColorsInFloat) {
  constexpr BlendMode kMode = TypeParam::value;
  for (double faint = 1e-8; faint < 1e-3; faint *= 1.37) {
    for (const double strong : {0.3, 0.9, 0.989}) {
      for (const auto& alpha :
           std::vector<std::vector<double>>{{faint, strong}, {strong, faint}, {faint, strong, faint}}) {
        Pixel pixel;
        pixel.alpha = alpha, pixel.color = {1.0, 0.0, 1.0};
        pixel.color.resize(alpha.size());
        expect_in_range<kMode>(pixel);
      }
    }
  }
}

TEST(Removal, OfAPairThatIsNotThereIsNothing) {
  PixelState<double> state = PixelState<double>::open();
  const PixelEnd<double> end = {0.5, 0.5, 0.0};
  const Gate<double> absent = {0.7, 0.7, false};
  Importance<double> sum = {};
  const double nan = std::numeric_limits<double>::quiet_NaN();
  add_pair(sum, remove_pair<BlendMode::kSmoe>(state, end, absent, true), nan, nan, nan, nan);
  EXPECT_EQ(sum.share, 0);
  EXPECT_EQ(sum.squared_share, 0);
  EXPECT_EQ(sum.removal_cost, 0);
}

TEST(Removal, WeighsItsThreeSums) {
  PixelState<double> state = PixelState<double>::open();
  const Gate<double> gate = {0.5, 0.5, true};
  Importance<double> sum = {};
  add_pair(sum, remove_pair<BlendMode::kAlpha>(state, {0.5, 0.5, 1.0}, gate, true), 9.0, 8.0, 3.0, 2.0);
  EXPECT_EQ(sum.share, 1.5);
  EXPECT_EQ(sum.squared_share, 0.5);
  EXPECT_EQ(sum.removal_cost, 18);
}

}  // namespace
}  // namespace dsmoe

// A mode's parameters as one value.
#include "dsmoe/blend_rules.h"

#include <gtest/gtest.h>

#include <cmath>

namespace dsmoe {
namespace {

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

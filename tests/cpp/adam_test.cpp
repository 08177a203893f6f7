// One number under Adam, by hand.
#include "dsmoe/adam.h"

#include <gtest/gtest.h>

#include <cmath>

namespace dsmoe {
namespace {

constexpr double kRounding = 1e-14;  // few roundings of numbers near 1

AdamConstants<double> constants(double epsilon) { return {0.9, 0.999, 1 - 0.9, 1 - 0.999, epsilon}; }

TEST(Adam, ItsConstantsAreRoundedFromDouble) {
  const auto narrow = adam_constants<float>(0.9, 0.999, 1e-8);
  EXPECT_FLOAT_EQ(narrow.one_minus_beta2, 1e-3f);  // 1 - 0.999f is 5e-5 off
  EXPECT_FLOAT_EQ(narrow.one_minus_beta1, 0.1f);
  for (const int64_t t : {1, 7, 1000}) {
    double beta1_t = 1, beta2_t = 1;
    for (int64_t i = 0; i < t; ++i) beta1_t *= 0.9, beta2_t *= 0.999;
    const auto rates = adam_rates<double>(0.25, t);
    EXPECT_NEAR(rates.rate, 0.25 / (1 - beta1_t), kRounding);
    EXPECT_NEAR(rates.root_scale * std::sqrt(1 - beta2_t), 1, 1e-12);  // 1 - beta2 cancels three digits
  }
}

// Rates of step t with the moments corrected for their start at zero.
AdamRates<double> corrected(double rate, int t) {
  return {rate / (1 - std::pow(0.9, t)), 1 / std::sqrt(1 - std::pow(0.999, t))};
}

TEST(Adam, FirstStepIsTheRateAgainstTheGradient) {
  for (double gradient : {3.0, -0.02}) {
    double parameter = 1.5, moment = 0, square = 0;
    adam_step(constants(0), corrected(0.25, 1), gradient, parameter, moment, square);
    EXPECT_NEAR(parameter, 1.5 - std::copysign(0.25, gradient), kRounding);
    EXPECT_NEAR(moment, 0.1 * gradient, kRounding);
    EXPECT_NEAR(square, 0.001 * gradient * gradient, kRounding);
  }
}

TEST(Adam, ConstantGradientKeepsTheStep) {
  double parameter = 0, moment = 0, square = 0;
  for (int t = 1; t <= 50; ++t) adam_step(constants(0), corrected(0.01, t), 7.0, parameter, moment, square);
  EXPECT_NEAR(parameter, -0.5, 50 * kRounding);
}

TEST(Adam, EpsilonIsAddedToTheCorrectedRoot) {
  double parameter = 0, moment = 0, square = 0;
  adam_step(constants(2.0), corrected(1, 1), 2.0, parameter, moment, square);
  EXPECT_NEAR(parameter, -2.0 / (2.0 + 2.0), kRounding);
}

TEST(Adam, WithoutCorrection) {
  double parameter = 0, moment = 0, square = 0;
  adam_step<double>(constants(0), {0.5, 1}, 4.0, parameter, moment, square);
  // 0.5 (0.1 * 4) / sqrt(0.001 * 16)
  EXPECT_NEAR(parameter, -0.5 * 0.4 / std::sqrt(0.016), kRounding);
}

}  // namespace
}  // namespace dsmoe

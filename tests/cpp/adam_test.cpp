// One number under Adam, by hand.
#include "dsmoe/adam.h"

#include <gtest/gtest.h>

#include <cmath>

namespace dsmoe {
namespace {

constexpr double kRounding = 1e-14;  // few roundings of numbers near 1

AdamConstants<double> constants(double epsilon) { return {0.9, 0.999, 1 - 0.9, 1 - 0.999, epsilon}; }

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

// One number under Adam, by hand.
#include "dsmoe/training/adam.h"

#include <gtest/gtest.h>

#include <cmath>
#include <vector>

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

// Lazy Adam on the CPU against dense steps by hand.

constexpr AdamConstants<double> kConstants = {0.9, 0.999, 1 - 0.9, 1 - 0.999, 1e-15};

// Two tensors of three rows. Row 0 has a gradient in step 0, row 1 in step 2, row 2 never.
struct Rows {
  std::vector<double> parameter = {1, 2, 3, 4, 5, 6}, moment = {0, 0, 0.5, 0.5, 0.25, 0.25}, square = moment;
  std::vector<double> gradient = {0.3, -0.4, 0.5, 0.6, 99, 99};
};

LazyAdamTensor<double> tensor_of(Rows& rows) {
  return {rows.parameter.data(), rows.moment.data(), rows.square.data(), rows.gradient.data(), 2};
}

// given: whether the number of steps and their rates come as they do in memory of the device.
void expect_steps_of_dense_adam(bool given) {
  Rows rows[2], expected[2];
  rows[1].gradient = {-1, 1, 0, 2, 99, 99};
  const std::vector<AdamRates<double>> rates = {{0.1, 3}, {0.2, 4}, {0.3, 2}, {0.4, 1}, {0.5, 1}, {0.6, 2}};
  const int32_t no_row[] = {0, 0, 0}, first[] = {5, 0, 0}, second[] = {0, 1, 0};
  std::vector<int32_t> marks = {0, 0, 0};
  std::vector<AdamRates<double>> noted(rates.size());
  LazyAdam<double> adam = {
      {tensor_of(rows[0]), tensor_of(rows[1])}, 2, 3, marks.data(), nullptr, noted.data(), 0, nullptr, kConstants};
  const int32_t* const radii[] = {first, no_row, second};
  for (int step = 0; step < 3; ++step) {
    const double number = step;
    adam.steps = step, adam.radii = radii[step];
    LazyAdamStep<double> last = {3, marks.data(), radii[step], noted.data(), {rates[2 * step], rates[2 * step + 1]},
                                 2, step,         nullptr,     nullptr};
    if (given) {
      adam.steps = -1, adam.given_steps = &number;
      last.steps = -1, last.given_steps = &number, last.given_rates = &rates[2 * step];
      last.new_rates[0] = last.new_rates[1] = {};
    }
    cpu::catch_up(adam, 1);
    cpu::note_step(last);
  }
  EXPECT_EQ(marks, (std::vector<int32_t>{~0, ~2, 0})) << "two gradients wait, and one row has missed all";
  EXPECT_EQ(rows[0].parameter[0], 1) << "nothing has read it";
  adam.steps = 3, adam.given_steps = nullptr, adam.radii = nullptr;
  cpu::catch_up(adam, 2);
  EXPECT_EQ(marks, (std::vector<int32_t>{3, 3, 3}));
  for (int t = 0; t < 2; ++t) {
    for (int i = 0; i < 6; ++i) {
      for (int step = 0; step < 3; ++step) {
        const bool has_gradient = (i / 2 == 0 && step == 0) || (i / 2 == 1 && step == 2);
        adam_step(kConstants, rates[2 * step + t], has_gradient ? rows[t].gradient[i] : 0.0, expected[t].parameter[i],
                  expected[t].moment[i], expected[t].square[i]);
      }
    }
    EXPECT_EQ(rows[t].parameter, expected[t].parameter);
    EXPECT_EQ(rows[t].moment, expected[t].moment);
    EXPECT_EQ(rows[t].square, expected[t].square);
  }
}

TEST(LazyAdam, RowsThatWaitMakeTheStepsOfDenseAdam) { expect_steps_of_dense_adam(false); }

TEST(LazyAdam, TakesNumbersOfTheDevice) { expect_steps_of_dense_adam(true); }

TEST(LazyAdam, AStepOfNoRowsNotesItsRates) {
  AdamRates<double> noted[] = {{7, 7}, {7, 7}};
  cpu::note_step<double>({0, nullptr, nullptr, noted, {{0.1, 3}, {0.2, 4}}, 1, 0, nullptr, nullptr});
  EXPECT_EQ(noted[0].rate, 0.1);
  EXPECT_EQ(noted[1].rate, 7) << "of one tensor";
}

}  // namespace
}  // namespace dsmoe

// Central finite differences in double: the judge of every backward function.
#pragma once

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <random>
#include <vector>

namespace dsmoe {

// Of fourth order: with steps of 1e-3 and functions whose values and derivatives are near 1, truncation (step^4 / 30)
// and rounding (1e-16 / step) both stay near 1e-13.
template <class Loss>
std::vector<double> finite_differences(const Loss& loss, std::vector<double> x, double step = 1e-3) {
  std::vector<double> gradient(x.size());
  for (size_t i = 0; i < x.size(); ++i) {
    const double centre = x[i];
    auto at = [&](double offset) {
      x[i] = centre + offset;
      return loss(x);
    };
    gradient[i] = (8 * (at(step) - at(-step)) - (at(2 * step) - at(-2 * step))) / (12 * step);
    x[i] = centre;
  }
  return gradient;
}

// Five digits above the 1e-13 of finite_differences: room for values and higher derivatives that are not near 1.
constexpr double kGradientTolerance = 1e-8;

// Relative to the largest component; a gradient that is zero everywhere judges nothing and fails.
inline void expect_near_all(const std::vector<double>& actual, const std::vector<double>& expected, double tolerance) {
  ASSERT_EQ(actual.size(), expected.size());
  double largest = 0;
  for (const double value : expected) largest = std::max(largest, std::abs(value));
  ASSERT_GT(largest, 0);
  for (size_t i = 0; i < actual.size(); ++i) EXPECT_NEAR(actual[i], expected[i], tolerance * largest) << "entry " << i;
}

template <class Loss>
void expect_gradient(const std::vector<double>& actual, const Loss& loss, const std::vector<double>& x,
                     double step = 1e-3, double tolerance = kGradientTolerance) {
  expect_near_all(actual, finite_differences(loss, x, step), tolerance);
}

// Reproducible random numbers.
class Random {
 public:
  explicit Random(unsigned seed) : engine_(seed) {}
  double uniform(double low, double high) { return low + (high - low) * (engine_() / 4294967296.0); }
  double log_uniform(double low, double high) { return std::exp(uniform(std::log(low), std::log(high))); }
  std::vector<double> uniforms(size_t count, double low = -1, double high = 1) {
    std::vector<double> out(count);
    for (double& value : out) value = uniform(low, high);
    return out;
  }

 private:
  std::mt19937 engine_;
};

inline double weighted_sum(const std::vector<double>& weights, const std::vector<double>& values) {
  double sum = 0;
  for (size_t i = 0; i < weights.size(); ++i) sum += weights[i] * values[i];
  return sum;
}

}  // namespace dsmoe

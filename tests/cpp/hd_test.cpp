// Scalar functions of the math headers.
#include "dsmoe/hd.h"

#include <gtest/gtest.h>

#include <cmath>
#include <limits>

#include "finite_difference.h"

namespace dsmoe {
namespace {

// a b and c d agree to that many bits, so that the naive difference has lost them.
template <class S> void expect_accurate_differences(int cancelled_bits) {
  constexpr long double kEpsilon = std::numeric_limits<S>::epsilon();
  Random random(1);
  double worst_naive = 0;
  for (int i = 0; i < 2000; ++i) {
    const S a = S(random.log_uniform(1e-3, 1e3)), b = S(random.log_uniform(1e-3, 1e3));
    const S c = S(a * random.uniform(0.5, 2));
    const S d = S(static_cast<long double>(a) * b / c * (1 + std::ldexp(random.uniform(-1, 1), -cancelled_bits)));
    const long double cd = static_cast<long double>(c) * d;
    const long double expected = static_cast<long double>(a) * b - cd;
    // Kahan's bound is 1.5 ulp, and an ulp is at most epsilon; the long double products round at 2^-64 of their own.
    const long double tolerance = 1.5L * kEpsilon * std::abs(expected) + std::ldexp(std::abs(cd), -62);
    EXPECT_LE(std::abs(difference_of_products(a, b, c, d) - expected), tolerance);
    if (expected != 0) {
      const volatile S first = a * b, second = c * d;
      worst_naive = std::max<double>(worst_naive, std::abs((first - second - expected) / expected) / kEpsilon);
    }
  }
  EXPECT_GT(worst_naive, 100) << "the cases do not cancel";
}

TEST(DifferenceOfProducts, KeepsFullPrecisionUnderCancellation) {
  expect_accurate_differences<float>(20);
  expect_accurate_differences<double>(40);
}

TEST(DifferenceOfProducts, IsExactWhereNothingRounds) {
  EXPECT_EQ(difference_of_products(3.0f, 5.0f, 2.0f, 7.0f), 1.0f);
  EXPECT_EQ(difference_of_products(0.1, 0.3, 0.3, 0.1), 0.0);
}

TEST(DifferenceOfProducts, SeesTheDeterminantOfANeedle) {
  // (1 + e)(1 - e) - 1 = -e^2 with e = 2^-13: the product 1 - 2^-26 needs more bits than a float has.
  const float e = std::ldexp(1.0f, -13);
  EXPECT_EQ(difference_of_products(1 + e, 1 - e, 1.0f, 1.0f), -e * e);
}

TEST(Clamp, StaysInTheIntervalAndTakesNanToItsLowerEnd) {
  EXPECT_EQ(clamp(5.0, -1.0, 2.0), 2.0);
  EXPECT_EQ(clamp(-5.0, -1.0, 2.0), -1.0);
  EXPECT_EQ(clamp(0.5, -1.0, 2.0), 0.5);
  EXPECT_EQ(clamp(std::numeric_limits<double>::infinity(), -1.0, 2.0), 2.0);
  // floor_to_int and ceil_to_int rely on this: NaN must not reach a conversion to int.
  EXPECT_EQ(clamp(std::numeric_limits<double>::quiet_NaN(), -1.0, 2.0), -1.0);
}

}  // namespace
}  // namespace dsmoe

// Thresholds.
#include "dsmoe/constants.h"

#include <gtest/gtest.h>

#include <cmath>

namespace dsmoe {
namespace {

// Every pixel that starts with two clamped pairs would differ if this depended on the scalar type.
template <class S> bool two_clamped_pairs_fill_a_pixel() {
  const S left = S(1) - S(kAlphaMax);
  return left * left < S(kTransmittanceCut);
}

TEST(Thresholds, AreTheSameNumbersInEveryScalarType) {
  EXPECT_TRUE(two_clamped_pairs_fill_a_pixel<float>());
  EXPECT_TRUE(two_clamped_pairs_fill_a_pixel<double>());
  EXPECT_TRUE(two_clamped_pairs_fill_a_pixel<long double>());
}

TEST(Thresholds, HaveTheirLogarithms) {
  EXPECT_DOUBLE_EQ(kLog2AlphaCut, std::log2(double(kAlphaCut)));
  EXPECT_DOUBLE_EQ(kLog2CoreAlpha, std::log2(double(kCoreAlpha)));
  EXPECT_DOUBLE_EQ(kLog2CoreKernel, std::log2(double(kCoreKernel)));
  EXPECT_NEAR(kCoreKernel, std::exp(-4.5), 1e-9);  // a float32 of 0.01
}

}  // namespace
}  // namespace dsmoe

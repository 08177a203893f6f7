// Small algebra.
#include "dsmoe/vec.h"

#include <gtest/gtest.h>

#include <cmath>
#include <limits>

#include "finite_difference.h"

namespace dsmoe {
namespace {

TEST(Mat3, ActsLikeAMatrixFromEitherSide) {
  const Mat3<double> m = {{1, 2, 3}, {4, 5, 6}, {7, 8, 10}};
  const Vec3<double> v = {1, -2, 3};
  const Vec3<double> right = m * v, left = transposed_times(m, v);
  EXPECT_EQ(right.x, 1 - 4 + 9);
  EXPECT_EQ(right.y, 4 - 10 + 18);
  EXPECT_EQ(right.z, 7 - 16 + 30);
  EXPECT_EQ(left.x, 1 - 8 + 21);
  EXPECT_EQ(left.y, 2 - 10 + 24);
  EXPECT_EQ(left.z, 3 - 12 + 30);
}

TEST(Sym3, ActsLikeItsFullMatrix) {
  const Sym3<double> s = {1, 2, 3, 4, 5, 6};
  const Mat3<double> full = {{1, 2, 3}, {2, 4, 5}, {3, 5, 6}};
  const Vec3<double> v = {0.5, -2, 3}, a = s * v, b = full * v;
  EXPECT_EQ(a.x, b.x);
  EXPECT_EQ(a.y, b.y);
  EXPECT_EQ(a.z, b.z);
}

template <class S> void expect_non_finite_is_seen() {
  const S infinity = std::numeric_limits<S>::infinity(), nan = std::numeric_limits<S>::quiet_NaN();
  const S largest = std::numeric_limits<S>::max();
  for (const S bad : {infinity, -infinity, nan}) {
    EXPECT_FALSE(is_finite(bad));
    for (int place = 0; place < 5; ++place) {
      S values[5] = {1, -2, 0, largest, largest};
      EXPECT_TRUE(all_finite(values, 5)) << "large values whose sum would overflow";
      values[place] = bad;
      EXPECT_FALSE(all_finite(values, 5)) << bad << " at " << place;
    }
    const S opposite[2] = {bad, -bad};
    EXPECT_FALSE(all_finite(opposite, 2));
  }
  EXPECT_TRUE(is_finite(largest));
  EXPECT_TRUE(is_finite(std::numeric_limits<S>::denorm_min()));
  EXPECT_TRUE(all_finite<S>(nullptr, 0));
}

TEST(AllFinite, SeesNanAndInfinityAnywhereAndNothingElse) {
  expect_non_finite_is_seen<float>();
  expect_non_finite_is_seen<double>();
}

}  // namespace
}  // namespace dsmoe

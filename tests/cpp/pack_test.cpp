// The exponential of the SIMD packs, at every level that this processor has.
#include <gtest/gtest.h>

#include <cmath>
#include <limits>
#include <vector>

#include "finite_difference.h"
#include "pack_exp.h"
#include "simd_levels.h"

namespace dsmoe {
namespace {

std::vector<const PackExp*> available_levels() {
  std::vector<const PackExp*> out = {&kBaselinePackExp};
#if defined(__x86_64__)
  if (processor_has_avx2()) out.push_back(&kAvx2PackExp);
  if (processor_has_avx512()) out.push_back(&kAvx512PackExp);
#endif
  return out;
}

std::vector<float> exp_of(const PackExp& level, const std::vector<float>& x) {
  std::vector<float> out(x.size());
  level.in_float(x.data(), out.data(), static_cast<int>(x.size()));
  return out;
}
std::vector<double> exp_of(const PackExp& level, const std::vector<double>& x) {
  std::vector<double> out(x.size());
  level.in_double(x.data(), out.data(), static_cast<int>(x.size()));
  return out;
}

// From 0 to `end`, denser below 0, with the borders of the reduction by ln 2 where rounding is worst.
template <class S> std::vector<S> sample(double end) {
  std::vector<S> x;
  for (int i = 0; i < 60000; ++i) x.push_back(S(end * i / 59999.0));
  for (double scale = 1e-8; scale < 1; scale *= 1.001) x.push_back(S(-scale));
  for (int n = 0; n * 0.6931471805599453 < std::abs(end) - 1; ++n) {
    const S border = S(std::copysign((n + 0.5) * 0.6931471805599453, end));
    for (const S near_border : {std::nextafter(border, S(0)), border, std::nextafter(border, S(end))}) {
      x.push_back(near_border);
    }
  }
  while (x.size() % 64 != 0) x.push_back(S(0));
  return x;
}

template <class S> double worst_ulps(const PackExp& level, double end) {
  const std::vector<S> x = sample<S>(end), y = exp_of(level, x);
  long double worst = 0;
  for (size_t i = 0; i < x.size(); ++i) {
    const long double exact = std::exp(static_cast<long double>(x[i]));
    const S nearest = S(exact);
    const long double ulp = std::nextafter(nearest, std::numeric_limits<S>::infinity()) - nearest;
    worst = std::max(worst, std::abs(y[i] - exact) / ulp);
  }
  return static_cast<double>(worst);
}

// The last step, 1 + p r, rounds at half an ulp of 1, which below 1 is a whole ulp; the products before it and r itself
// add up to as much again, weighed by r <= 0.35.
constexpr double kWorstUlps = 2;

TEST(PackExp, IsAccurateToTwoUlpsAtEveryLevel) {
  for (const PackExp* level : available_levels()) {
    EXPECT_LT(worst_ulps<float>(*level, -80), kWorstUlps) << level->bits;
    EXPECT_LT(worst_ulps<double>(*level, -700), kWorstUlps) << level->bits;
    EXPECT_LT(worst_ulps<float>(*level, 40), kWorstUlps) << level->bits;
    EXPECT_LT(worst_ulps<double>(*level, 40), kWorstUlps) << level->bits;
  }
}

template <class S> void expect_exact_at_zero_and_never_above_one(const PackExp& level) {
  const std::vector<S> x = sample<S>(-80), y = exp_of(level, x);
  EXPECT_EQ(y[0], 1) << level.bits;
  // An opacity of exactly 1/255 must count at its centre, so o G may not round below o there, nor G above 1.
  for (const S value : y) ASSERT_LE(value, 1) << level.bits;
}

TEST(PackExp, IsOneAtZeroAndNeverAbove) {
  for (const PackExp* level : available_levels()) {
    expect_exact_at_zero_and_never_above_one<float>(*level);
    expect_exact_at_zero_and_never_above_one<double>(*level);
  }
}

TEST(PackExp, StaysBelowEveryCutOffFarBelowZero) {
  const float infinity = std::numeric_limits<float>::infinity();
  for (const PackExp* level : available_levels()) {
    std::vector<float> x(64, -1e30f);
    x[0] = -81, x[1] = -std::numeric_limits<float>::max(), x[2] = -infinity;
    for (const float value : exp_of(*level, x)) {
      EXPECT_GE(value, 0) << level->bits;
      EXPECT_LT(value, 1e-30f) << level->bits;
    }
    std::vector<double> wide(64, -1e300);
    wide[0] = -std::numeric_limits<double>::infinity();
    for (const double value : exp_of(*level, wide)) {
      EXPECT_GE(value, 0) << level->bits;
      EXPECT_LT(value, 1e-300) << level->bits;
    }
  }
}

}  // namespace
}  // namespace dsmoe

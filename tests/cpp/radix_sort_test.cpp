// The depth sort.
#include "cpu/radix_sort.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <limits>
#include <vector>

#include "dsmoe/depth_bits.h"
#include "finite_difference.h"

namespace dsmoe {
namespace cpu {
namespace {

template <class S> void expect_stable_sort(const std::vector<S>& depths) {
  std::vector<KeyedIndex<DepthBits<S>>> items;
  std::vector<int32_t> expected;
  for (size_t i = 0; i < depths.size(); ++i) {
    items.push_back({depth_bits(depths[i]), static_cast<int32_t>(i)});
    expected.push_back(static_cast<int32_t>(i));
  }
  radix_sort(items);
  std::stable_sort(expected.begin(), expected.end(), [&](int32_t a, int32_t b) { return depths[a] < depths[b]; });
  ASSERT_EQ(items.size(), expected.size());
  for (size_t i = 0; i < items.size(); ++i) {
    ASSERT_EQ(items[i].index, expected[i]) << "place " << i;
    ASSERT_EQ(items[i].key, depth_bits(depths[expected[i]]));
  }
}

template <class S> void expect_stable_sort_of_everything() {
  expect_stable_sort<S>({});
  expect_stable_sort<S>({S(3)});
  expect_stable_sort<S>(std::vector<S>(1000, S(2.5)));  // all equal: the order of the indices
  const S smallest = std::numeric_limits<S>::denorm_min(), largest = std::numeric_limits<S>::max();
  expect_stable_sort<S>({largest, S(1), smallest, S(0), std::nextafter(S(1), S(2)), std::numeric_limits<S>::infinity(),
                         std::numeric_limits<S>::min(), std::nextafter(S(1), S(0))});
  expect_stable_sort<S>({S(2), S(-4), -smallest, S(0), S(-0.0), S(0), smallest, -largest, largest, S(-4.5), S(-4),
                         -std::numeric_limits<S>::infinity(), std::numeric_limits<S>::infinity()});
  Random random(1);
  std::vector<S> depths;
  for (int i = 0; i < 20000; ++i) depths.push_back(S(random.log_uniform(1e-30, 1e30)));
  expect_stable_sort<S>(depths);
  for (size_t i = 0; i < depths.size(); i += 3) depths[i] = -depths[i];
  expect_stable_sort<S>(depths);
  for (S& depth : depths) depth = S(static_cast<int>(random.uniform(1, 50)));  // many ties
  expect_stable_sort<S>(depths);
  for (S& depth : depths) depth = S(5 + random.uniform(0, 1e-3));  // high digits all the same
  expect_stable_sort<S>(depths);
}

TEST(RadixSort, EqualsAStableSortByDepth) {
  expect_stable_sort_of_everything<float>();
  expect_stable_sort_of_everything<double>();
}

}  // namespace
}  // namespace cpu
}  // namespace dsmoe

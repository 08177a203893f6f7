// The kernels' radix sort, compiled for the host, against std::stable_sort.
#include <gtest/gtest.h>

#include <algorithm>
#include <numeric>
#include <random>
#include <vector>

#include "diff_smoe_rasterization/csrc/cuda/radix_sort.cuh"

namespace dsmoe {
namespace cuda {
namespace {

// Strips of several tiles; more strips than a group has; one strip that is not full.
constexpr int64_t kSizes[] = {100'000, 20'001, 100};

template <class Key> std::vector<Key> random_keys(int64_t count, int bits) {
  std::mt19937_64 random(count + bits);
  std::vector<Key> keys(count);
  for (Key& key : keys) key = static_cast<Key>(random() & ((uint64_t(1) << bits) - 1));
  return keys;
}

// The pairs' values in the order of one pass; `room` as the pass's, and `total` what it says.
template <int kBits, class Key>
std::vector<int32_t> one_pass(const std::vector<Key>& keys, const int32_t* values, int64_t room, int64_t& total) {
  const int64_t count = keys.size();
  std::vector<uint32_t> strips(num_strips(room) << kBits), groups(num_groups(room) << kBits);
  std::vector<int32_t> sorted(room, -1);
  std::vector<Key> padded = keys, sorted_keys(room);
  padded.resize(std::max(room, count));  // what is not filled has no order
  RadixPass<Key> pass = {};
  pass.capacity = room;
  pass.count = values != nullptr ? &count : nullptr;
  pass.keys = padded.data();
  pass.values = values;
  pass.sorted_keys = sorted_keys.data();
  pass.sorted_values = sorted.data();
  pass.total = &total;
  pass.strips = strips.data();
  pass.groups = groups.data();
  pass.shift = 2;
  launch_radix_pass<kBits>(pass, nullptr);
  sorted.resize(total);
  for (int64_t i = 0; i < total; ++i) EXPECT_EQ(sorted_keys[i], keys[sorted[i]]) << i;
  return sorted;
}

template <int kBits, class Key> std::vector<int32_t> stable(const std::vector<Key>& keys, std::vector<int32_t> values) {
  const auto digit = [&](int32_t i) { return keys[i] >> 2 & ((Key(1) << kBits) - 1); };
  std::stable_sort(values.begin(), values.end(), [&](int32_t a, int32_t b) { return digit(a) < digit(b); });
  return values;
}

template <int kBits, class Key> void expect_sorted() {
  for (const int64_t count : kSizes) {
    const std::vector<Key> keys = random_keys<Key>(count, kBits + 3);
    std::vector<int32_t> values(count);
    std::iota(values.begin(), values.end(), 0);
    int64_t total = -1;
    EXPECT_EQ((one_pass<kBits>(keys, values.data(), count + 5000, total)), (stable<kBits>(keys, values))) << count;
    EXPECT_EQ(total, count);
  }
}

TEST(RadixPass, SortsByItsDigitAndKeepsTheOrderOfEqualOnes) {
  expect_sorted<8, uint32_t>();
  expect_sorted<8, uint64_t>();
  expect_sorted<9, uint16_t>();
}

TEST(RadixPass, SortsOnCardsOfOtherSizes) {
  for (const int multiprocessors : {1, 200}) {  // two strips; more groups of strips than a thread reads at once
    emulator::multiprocessors = multiprocessors;
    expect_sorted<8, uint32_t>();
  }
  emulator::multiprocessors = 10;
}

TEST(RadixPass, LeavesOutTheGreatestKeyWhereValuesAreTheirPlaces) {
  for (const int64_t count : kSizes) {
    std::vector<uint32_t> keys = random_keys<uint32_t>(count, 11);
    std::vector<int32_t> kept;
    for (int32_t i = 0; i < count; ++i) keys[i] % 3 == 0 ? void(keys[i] = ~0u) : kept.push_back(i);
    int64_t total = -1;
    EXPECT_EQ((one_pass<8>(keys, nullptr, count, total)), (stable<8>(keys, kept))) << count;
    EXPECT_EQ(total, int64_t(kept.size()));
  }
}

TEST(RadixPass, SortsNothingThatDoesNotFit) {
  const std::vector<uint32_t> keys = random_keys<uint32_t>(1000, 11);
  const std::vector<int32_t> values(1000);
  int64_t total = -1;
  EXPECT_TRUE((one_pass<8>(keys, values.data(), 999, total)).empty());
  EXPECT_EQ(total, 0);
}

// As the tiles of an image are added up, where config.most_instances allows more than 2^32 of their instances.
TEST(SumBeforeThread, CountsBeyond32Bits) {
  const unsigned long long own = 1ull << 30;
  unsigned long long warp_sums[kSortBlock / kWarp], sums[kSortBlock], totals[kSortBlock];
  const auto thread = [&] { sums[threadIdx.x] = sum_before_thread(own, warp_sums, totals[threadIdx.x]); };
  emulator::launch(thread, 1, kSortBlock, 0, nullptr);
  for (unsigned long long i = 0; i < kSortBlock; ++i) {
    EXPECT_EQ(sums[i], i * own);
    EXPECT_EQ(totals[i], kSortBlock * own);
  }
}

}  // namespace
}  // namespace cuda
}  // namespace dsmoe

// Sorts indices by integer keys, least significant digit first. The sort is stable, so equal depths keep the order of
// their indices.
#pragma once

#include <cstdint>
#include <vector>

namespace dsmoe {
namespace cpu {

template <class Key> struct KeyedIndex {
  Key key;
  int32_t index;
};

template <class Key> void radix_sort(std::vector<KeyedIndex<Key>>& items) {
  constexpr int kDigitBits = 11;
  constexpr int kDigits = (8 * sizeof(Key) + kDigitBits - 1) / kDigitBits;
  constexpr Key kMask = (Key(1) << kDigitBits) - 1;
  std::vector<KeyedIndex<Key>> sorted(items.size());
  std::vector<int64_t> counts(kDigits << kDigitBits);
  for (const auto& item : items) {
    for (int d = 0; d < kDigits; ++d) ++counts[(d << kDigitBits) + ((item.key >> (d * kDigitBits)) & kMask)];
  }
  for (int d = 0; d < kDigits; ++d) {
    int64_t* offsets = counts.data() + (d << kDigitBits);
    int64_t total = 0;
    bool one_value = false;
    for (Key value = 0; value <= kMask; ++value) {
      const int64_t count = offsets[value];
      one_value |= count == static_cast<int64_t>(items.size());
      offsets[value] = total;
      total += count;
    }
    if (one_value) continue;  // this digit is the same in all keys
    for (const auto& item : items) sorted[offsets[(item.key >> (d * kDigitBits)) & kMask]++] = item;
    items.swap(sorted);
  }
}

}  // namespace cpu
}  // namespace dsmoe

// Depths as integers, for sorts by radix.
#pragma once

#include <cstdint>
#include <cstring>
#include <type_traits>

#include "dsmoe/hd.h"

namespace dsmoe {

template <class S> using DepthBits = std::conditional_t<sizeof(S) == 4, uint32_t, uint64_t>;

// An integer that is in the order of the depths, negative ones too. The bits of positive floats are in their order, and
// those of negative floats in the reverse order. -0 gets the integer of 0.
template <class S> DSMOE_HD DepthBits<S> depth_bits(S depth) {
  constexpr DepthBits<S> kSign = DepthBits<S>(1) << (8 * sizeof(S) - 1);
  const S without_negative_zero = depth + S(0);
  DepthBits<S> bits;
  memcpy(&bits, &without_negative_zero, sizeof(bits));
  return (bits & kSign) != 0 ? ~bits : bits | kSign;
}

}  // namespace dsmoe

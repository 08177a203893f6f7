// Depths as integers, for sorts by radix.
#pragma once

#include <cstdint>
#include <cstring>
#include <type_traits>

#include "dsmoe/hd.h"

namespace dsmoe {

// The bits of a positive float, read as an integer, are in the order of the float.
template <class S> using DepthBits = std::conditional_t<sizeof(S) == 4, uint32_t, uint64_t>;

template <class S> DSMOE_HD DepthBits<S> depth_bits(S depth) {
  DepthBits<S> bits;
  memcpy(&bits, &depth, sizeof(bits));
  return bits;
}

}  // namespace dsmoe

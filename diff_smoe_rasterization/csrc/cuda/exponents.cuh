// Powers of two, for sums of integers.
#pragma once

#include "device.cuh"

namespace dsmoe {
namespace cuda {

// The least e with |x| < 2^e.
constexpr int kNoExponent = -4096;  // of 0
template <class S> __device__ int exponent_of(S x) {
  int exponent = 0;
  frexp(x, &exponent);
  return x == S(0) ? kNoExponent : exponent;
}

// 2^e, or the nearest power of two that is a normal number.
inline __device__ float power_of_two(int e, float) { return __int_as_float((min(max(e, -126), 127) + 127) << 23); }
inline __device__ double power_of_two(int e, double) {
  return __hiloint2double((min(max(e, -1022), 1023) + 1023) << 20, 0);
}

// x 2^e, in two steps: 2^e alone may be beyond the type.
template <class S> __device__ S scaled_by_power(S x, int e) {
  return x * power_of_two(e / 2, S()) * power_of_two(e - e / 2, S());
}

}  // namespace cuda
}  // namespace dsmoe

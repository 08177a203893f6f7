// The packs' exponential for AVX2. Empty if the target is not x86-64.
#if defined(__x86_64__)

#include <cmath>
#include <cstdint>

#if defined(__clang__)
#pragma clang attribute push(__attribute__((target("avx2,fma"))), apply_to = function)
#else
#pragma GCC push_options
#pragma GCC target("avx2,fma")
#endif

#define DSMOE_SIMD avx2
#define DSMOE_SIMD_BYTES 32
#include "pack_exp_impl.h"

namespace dsmoe {
const PackExp kAvx2PackExp = avx2::pack_exp("avx2");
}  // namespace dsmoe

#if defined(__clang__)
#pragma clang attribute pop
#else
#pragma GCC pop_options
#endif

#endif  // __x86_64__

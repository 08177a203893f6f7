// The packs' exponential for AVX-512. Empty if the target is not x86-64.
#if defined(__x86_64__)

#include <cmath>
#include <cstdint>

#if defined(__clang__)
#pragma clang attribute push(__attribute__((target("avx512f,avx512vl,avx512bw,avx512dq,avx2,fma"))), \
                             apply_to = function)
#else
#pragma GCC diagnostic ignored "-Wmaybe-uninitialized"  // GCC 12's AVX-512 header leaves masked-out lanes undefined
#pragma GCC push_options
#pragma GCC target("avx512f,avx512vl,avx512bw,avx512dq,avx2,fma")
#endif

#define DSMOE_SIMD avx512
#define DSMOE_SIMD_BYTES 64
#include "pack_exp_impl.h"

namespace dsmoe {
const PackExp kAvx512PackExp = avx512::pack_exp("avx512");
}  // namespace dsmoe

#if defined(__clang__)
#pragma clang attribute pop
#else
#pragma GCC pop_options
#endif

#endif  // __x86_64__

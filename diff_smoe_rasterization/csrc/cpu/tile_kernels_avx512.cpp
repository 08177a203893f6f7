// The tile kernels for AVX-512: 64-byte packs. Empty if the target is not x86-64.
#if defined(__x86_64__)

// Everything below is compiled for this instruction set, so nothing here may define code that other files share:
// the math headers are always inlined, and the standard headers come first.
#include <cmath>
#include <cstdint>
#include <type_traits>

#if defined(__clang__)
#pragma clang attribute push(__attribute__((target("avx512f,avx512vl,avx512bw,avx512dq,avx2,fma"))), \
                             apply_to = function)
#else
#pragma GCC push_options
#pragma GCC diagnostic ignored "-Wmaybe-uninitialized"  // of the intrinsics' own placeholders (GCC bug 105593)
#pragma GCC target("avx512f,avx512vl,avx512bw,avx512dq,avx2,fma")
#endif

#define DSMOE_SIMD avx512
#define DSMOE_SIMD_BYTES 64
#include "tile_kernels_impl.h"

namespace dsmoe {
namespace cpu {
constexpr TileKernels<float> kAvx512Float = DSMOE_SIMD::kernels<float>();
}  // namespace cpu
}  // namespace dsmoe

#if defined(__clang__)
#pragma clang attribute pop
#else
#pragma GCC pop_options
#endif

#endif  // __x86_64__

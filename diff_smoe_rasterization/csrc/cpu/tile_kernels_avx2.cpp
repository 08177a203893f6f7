// The tile kernels for AVX2: 32-byte packs. Empty if the target is not x86-64.
#if defined(__x86_64__)

// Everything below is compiled for this instruction set, so nothing here may define code that other files share:
// the math headers are always inlined, and the standard headers come first.
#include <cmath>
#include <cstdint>
#include <type_traits>

#if defined(__clang__)
#pragma clang attribute push(__attribute__((target("avx2,fma"))), apply_to = function)
#else
#pragma GCC push_options
#pragma GCC target("avx2,fma")
#endif

#ifdef DSMOE_DOUBLE
#define DSMOE_SIMD avx2_double
#else
#define DSMOE_SIMD avx2
#endif
#define DSMOE_SIMD_BYTES 32
#include "tile_kernels_impl.h"

namespace dsmoe {
namespace cpu {
#ifdef DSMOE_DOUBLE
constexpr TileKernels<double> kAvx2Double = DSMOE_SIMD::kernels<double>();
#else
constexpr TileKernels<float> kAvx2Float = DSMOE_SIMD::kernels<float>();
#endif
}  // namespace cpu
}  // namespace dsmoe

#if defined(__clang__)
#pragma clang attribute pop
#else
#pragma GCC pop_options
#endif

#endif  // __x86_64__

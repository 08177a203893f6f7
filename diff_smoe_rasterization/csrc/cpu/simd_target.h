// Compiles the header DSMOE_SIMD_CODE for one instruction set. The file that includes this has set
//   DSMOE_SIMD        the namespace of that code, so that each instruction set has symbols of its own
//   DSMOE_SIMD_BYTES  the size of a register: 64 is AVX-512, 32 is AVX2 with FMA, 16 is any machine (SSE2, NEON)
//   DSMOE_SIMD_CODE   the header
// That code may define nothing that other files share, as the linker keeps one of two equal functions, from any of
// them: so the math headers are always inlined, and the standard headers come first. Empty for AVX on other machines.
#pragma once

#include <cmath>
#include <cstdint>
#include <type_traits>

#if DSMOE_SIMD_BYTES == 16
#include DSMOE_SIMD_CODE
#elif defined(__x86_64__)

#if defined(__clang__)
#if DSMOE_SIMD_BYTES == 64
#pragma clang attribute push(__attribute__((target("avx512f,avx512vl,avx512bw,avx512dq,avx2,fma"))), \
                             apply_to = function)
#else
#pragma clang attribute push(__attribute__((target("avx2,fma"))), apply_to = function)
#endif
#else
#pragma GCC push_options
#if DSMOE_SIMD_BYTES == 64
#pragma GCC diagnostic ignored "-Wmaybe-uninitialized"  // of the intrinsics' own placeholders (GCC bug 105593)
#pragma GCC target("avx512f,avx512vl,avx512bw,avx512dq,avx2,fma")
#else
#pragma GCC target("avx2,fma")
#endif
#endif

#include DSMOE_SIMD_CODE

#if defined(__clang__)
#pragma clang attribute pop
#else
#pragma GCC pop_options
#endif

#endif

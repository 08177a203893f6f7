// The packs' exponential for AVX-512.
#define DSMOE_SIMD avx512
#define DSMOE_SIMD_BYTES 64
#define DSMOE_PACK_EXP kAvx512PackExp
#define DSMOE_SIMD_CODE "pack_exp_impl.h"
#include "cpu/simd_target.h"

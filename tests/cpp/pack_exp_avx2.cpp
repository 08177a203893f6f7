// The packs' exponential for AVX2.
#define DSMOE_SIMD avx2
#define DSMOE_SIMD_BYTES 32
#define DSMOE_PACK_EXP kAvx2PackExp
#define DSMOE_SIMD_CODE "pack_exp_impl.h"
#include "cpu/simd_target.h"

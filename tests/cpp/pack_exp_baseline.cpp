// The packs' exponential for any machine.
#define DSMOE_SIMD baseline
#define DSMOE_SIMD_BYTES 16
#define DSMOE_PACK_EXP kBaselinePackExp
#define DSMOE_SIMD_CODE "pack_exp_impl.h"
#include "cpu/simd_target.h"

// The tile kernels for AVX2: 32-byte packs.
#define DSMOE_SIMD avx2
#define DSMOE_SIMD_BYTES 32
#define DSMOE_NUMBER float
#define DSMOE_TILE_KERNELS kAvx2Float
#define DSMOE_SIMD_CODE "tile_kernels_impl.h"
#include "simd_target.h"

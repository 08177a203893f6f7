// The tile kernels for AVX-512: 64-byte packs.
#define DSMOE_SIMD avx512
#define DSMOE_SIMD_BYTES 64
#define DSMOE_NUMBER float
#define DSMOE_TILE_KERNELS kAvx512Float
#define DSMOE_SIMD_CODE "tile_kernels_impl.h"
#include "simd_target.h"

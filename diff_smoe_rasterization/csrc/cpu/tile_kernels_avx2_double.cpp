// Likewise for double. Their namespace is their own, because they are compiled with other flags.
#define DSMOE_SIMD avx2_double
#define DSMOE_SIMD_BYTES 32
#define DSMOE_NUMBER double
#define DSMOE_TILE_KERNELS kAvx2Double
#define DSMOE_SIMD_CODE "tile_kernels_impl.h"
#include "simd_target.h"

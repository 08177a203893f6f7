// The tile kernels for any machine: 16-byte packs.
#define DSMOE_SIMD baseline
#define DSMOE_SIMD_BYTES 16
#define DSMOE_NUMBER float
#define DSMOE_TILE_KERNELS kBaselineFloat
#define DSMOE_SIMD_CODE "tile_kernels_impl.h"
#include "simd_target.h"

// Likewise for double. Their namespace is their own, because they are compiled with other flags.
#define DSMOE_SIMD baseline_double
#define DSMOE_SIMD_BYTES 16
#define DSMOE_NUMBER double
#define DSMOE_TILE_KERNELS kBaselineDouble
#define DSMOE_SIMD_CODE "tile_kernels_impl.h"
#include "simd_target.h"

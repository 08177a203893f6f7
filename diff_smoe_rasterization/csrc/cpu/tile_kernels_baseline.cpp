// The tile kernels for any machine: 16-byte packs, which SSE2 and NEON have.
#ifdef DSMOE_DOUBLE
#define DSMOE_SIMD baseline_double
#else
#define DSMOE_SIMD baseline
#endif
#define DSMOE_SIMD_BYTES 16
#include "tile_kernels_impl.h"

namespace dsmoe {
namespace cpu {
#ifdef DSMOE_DOUBLE
constexpr TileKernels<double> kBaselineDouble = DSMOE_SIMD::kernels<double>();
#else
constexpr TileKernels<float> kBaselineFloat = DSMOE_SIMD::kernels<float>();
#endif
}  // namespace cpu
}  // namespace dsmoe

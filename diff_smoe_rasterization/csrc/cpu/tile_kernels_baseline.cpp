// The tile kernels for any machine: 16-byte packs, which SSE2 and NEON have.
#define DSMOE_SIMD baseline
#define DSMOE_SIMD_BYTES 16
#include "tile_kernels_impl.h"

namespace dsmoe {
namespace cpu {
constexpr SimdLevel kBaselineLevel = {"baseline", baseline::kernels<float>(), baseline::kernels<double>()};
}  // namespace cpu
}  // namespace dsmoe

// The tile kernels for any machine: 16-byte packs, which SSE2 and NEON have.
#define DSMOE_SIMD baseline
#define DSMOE_SIMD_BYTES 16
#include "tile_backward_impl.h"
#include "tile_contributions_impl.h"
#include "tile_forward_impl.h"
#include "tile_gate_map_impl.h"

namespace dsmoe {
namespace cpu {
const SimdLevel kBaselineLevel = {
    "baseline",
    {baseline::forward<float>, baseline::backward<float>, baseline::contributions<float>, baseline::gate_map<float>},
    {baseline::forward<double>, baseline::backward<double>, baseline::contributions<double>,
     baseline::gate_map<double>}};
}  // namespace cpu
}  // namespace dsmoe

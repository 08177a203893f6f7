// The packs' exponential for any machine.
#define DSMOE_SIMD baseline
#define DSMOE_SIMD_BYTES 16
#include "pack_exp_impl.h"

namespace dsmoe {
const PackExp kBaselinePackExp = {"baseline", baseline::exp_each<float>, baseline::exp_each<double>};
}  // namespace dsmoe

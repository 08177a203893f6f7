// The packs' exponential for any machine.
#define DSMOE_SIMD baseline
#define DSMOE_SIMD_BYTES 16
#include "pack_exp_impl.h"

namespace dsmoe {
const PackExp kBaselinePackExp = baseline::pack_exp("baseline");
}  // namespace dsmoe

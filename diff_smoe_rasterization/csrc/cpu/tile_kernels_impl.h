// The kernels of one instruction set. Included once per instruction set that the compiler can build for.
#pragma once

#include "tile_backward_impl.h"
#include "tile_forward_impl.h"
#include "tile_pass_impl.h"

namespace dsmoe {
namespace cpu {
namespace DSMOE_SIMD {

// A constant expression: no code of this instruction set runs before it is known to be there.
template <class S> constexpr TileKernels<S> kernels() {
  return {forward<S>, backward<S>, pass<S, ContributionPass<S>>, importance<S>, pass<S, GateMapPass<S>>};
}

}  // namespace DSMOE_SIMD
}  // namespace cpu
}  // namespace dsmoe

// The kernels of one instruction set (simd_target.h), for numbers of type DSMOE_NUMBER, as constant DSMOE_TILE_KERNELS.
#pragma once

#include "tile_backward_impl.h"
#include "tile_forward_impl.h"
#include "tile_pass_impl.h"

namespace dsmoe {
namespace cpu {
namespace DSMOE_SIMD {

template <class S, class... Passes> constexpr KernelsOfPasses<S, PassList<Passes...>> kernels_of(PassList<Passes...>) {
  return {{static_cast<PassKernel<S, Passes>>(pass)}...};
}

// A constant expression: no code of this instruction set runs before it is known to be there.
template <class S> constexpr TileKernels<S> kernels() {
  return {forward<S>, backward<S>, kernels_of<S>(AllPasses<S>())};
}

}  // namespace DSMOE_SIMD

constexpr TileKernels<DSMOE_NUMBER> DSMOE_TILE_KERNELS = DSMOE_SIMD::kernels<DSMOE_NUMBER>();

}  // namespace cpu
}  // namespace dsmoe

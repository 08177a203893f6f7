// Included once per instruction set (cpu/simd_target.h), with DSMOE_PACK_EXP: the name of the result.
#pragma once

#include "cpu/pack.h"
#include "pack_exp.h"

namespace dsmoe {
namespace DSMOE_SIMD {

template <class T> void exp_each(const T* x, T* result, int count) {
  using P = Pack<T>;
  alignas(DSMOE_SIMD_BYTES) T lanes[P::kLanes];
  for (int i = 0; i < count; i += P::kLanes) {
    for (int k = 0; k < P::kLanes; ++k) lanes[k] = x[i + k];
    exp(P::load(lanes)).store(lanes);
    for (int k = 0; k < P::kLanes; ++k) result[i + k] = lanes[k];
  }
}

// A constant expression: no code of this instruction set runs before it is known to be there.
constexpr PackExp pack_exp() { return {8 * DSMOE_SIMD_BYTES, exp_each<float>, exp_each<double>}; }

}  // namespace DSMOE_SIMD

const PackExp DSMOE_PACK_EXP = DSMOE_SIMD::pack_exp();

}  // namespace dsmoe

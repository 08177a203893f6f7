// How the SH coefficients of a warp reach its lanes. If they are floats they go row by row through shared memory,
// else each lane reads global memory. The two shapes that trainers use most are known when compiling.
#pragma once

#include "dsmoe/arrays.h"
#include "tuning.cuh"
#include "warp_rows.cuh"

namespace dsmoe {
namespace cuda {

constexpr int kAllShLength = 3 * kMaxShCoefficients, kShRestLength = kAllShLength - 3;  // with degree 0, and without

// kStaged: the rows go through shared memory. kLength: numbers a row, or 0 if that is not known when compiling.
// If it is known, the colours are of degree 3, and scales and rotations give the shapes.
template <bool kStagedRows, int kRowLength> struct ShRows : WarpRows<kRowLength> {
  using WarpRows<kRowLength>::WarpRows;
  static constexpr bool kStaged = kStagedRows, kKnown = kRowLength > 0;
  static constexpr int kLength = kRowLength;

  // Whether degree 0 lies apart. Only for known rows.
  static constexpr bool kDcApart = kLength == kShRestLength;

  // Gaussian i. For known rows, all numbers are read before any of them is used.
  template <class S> static __device__ Gaussian<S> gaussian(const GaussianInputs<S>& in, int64_t i) {
    if constexpr (kKnown) {
      const float4 q = reinterpret_cast<const float4*>(in.rotations)[i];
      return {load3(in.means3D + 3 * i), in.opacities[i], false, load3(in.scales + 3 * i), {q.x, q.y, q.z, q.w}, {}};
    } else {
      return load_gaussian(in, i);
    }
  }

  // The colours of known rows, whose numbers lie in registers; dc: degree 0, if it lies apart.
  static __device__ Colors<float> known_colors(const float* dc, const float* sh) {
    return {nullptr, kDcApart ? dc : nullptr, sh, kLength / 3, kMaxShDegree};
  }
};

template <class... T> bool are_vector_aligned(const T*... pointers) {
  return ((reinterpret_cast<std::uintptr_t>(pointers) % 16 == 0) && ...);
}

// Calls launch(TypeOf<ShRows<...>>, bytes of shared memory) with the rows that fit the inputs. may_know: whether the
// caller's own arrays allow known rows.
template <class S, class Launch> void dispatch_sh_rows(const GaussianInputs<S>& inputs, bool may_know, Launch launch) {
  const auto with = [&](auto type) {
    using Rows = typename decltype(type)::type;
    launch(type, Rows::kStaged ? sizeof(float) * kRowsBlock * Rows::stride(3 * inputs.num_sh) : size_t(0));
  };
  if constexpr (sizeof(S) == sizeof(float)) {
    if (inputs.shs != nullptr && 0 < inputs.num_sh && inputs.num_sh <= kMaxShCoefficients) {
      const bool known = may_know && inputs.sh_degree == kMaxShDegree && inputs.rotations != nullptr &&
                         are_vector_aligned(inputs.rotations, inputs.shs);
      const int length = 3 * inputs.num_sh;
      if (known && inputs.dc == nullptr && length == kAllShLength) return with(TypeOf<ShRows<true, kAllShLength>>{});
      if (known && inputs.dc != nullptr && length == kShRestLength) return with(TypeOf<ShRows<true, kShRestLength>>{});
      return with(TypeOf<ShRows<true, 0>>{});
    }
  }
  with(TypeOf<ShRows<false, 0>>{});
}

}  // namespace cuda
}  // namespace dsmoe

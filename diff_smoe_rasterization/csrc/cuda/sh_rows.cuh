// How the SH coefficients of a warp reach its lanes: row by row through shared memory where they are floats, else
// straight from global memory. What trainers use most is compiled in.
#pragma once

#include "dsmoe/sh.h"
#include "warp_rows.cuh"

namespace dsmoe {
namespace cuda {

constexpr int kRowsBlock = 128;                                                         // threads, one Gaussian each
constexpr int kAllShLength = 3 * kMaxShCoefficients, kShRestLength = kAllShLength - 3;  // with degree 0, and without

// kStaged: through shared memory. kLength: numbers a row, 0 where it is not known; where it is, colours are of degree
// 3, and the shapes are given by scales and rotations.
template <bool kStagedRows, int kRowLength> struct ShRows : WarpRows<kRowLength> {
  using WarpRows<kRowLength>::WarpRows;
  static constexpr bool kStaged = kStagedRows, kKnown = kRowLength > 0;
  static constexpr int kLength = kRowLength;

  // Puts what is known in the place of what was given.
  template <class S> static __device__ void specialise(GaussianInputs<S>& inputs) {
    if constexpr (kKnown) {
      inputs.sh_degree = kMaxShDegree, inputs.num_sh = kLength / 3;
      inputs.cov3D_precomp = inputs.colors_precomp = nullptr;
      if (kLength == kAllShLength) inputs.dc = nullptr;
      inputs.rotations = static_cast<const S*>(__builtin_assume_aligned(inputs.rotations, 16));
    }
  }
};

// A Gaussian's numbers in registers: read at once, where each use of one would wait for memory of its own.
template <class S, class Rows> struct InputRegisters {
  S mean[3], opacity[1], scale[3], rotation[4], dc[3];

  // Points the inputs at them, and reads them where they are wanted.
  __device__ void take(GaussianInputs<S>& inputs, bool wanted) {
    const GaussianInputs<S> from = inputs;
    inputs.means3D = mean;
    if constexpr (Rows::kKnown) inputs.opacities = opacity, inputs.scales = scale, inputs.rotations = rotation;
    if constexpr (Rows::kLength == kShRestLength) inputs.dc = dc;
    if (!wanted) return;
    copy(mean, from.means3D);
    if constexpr (Rows::kKnown) {
      copy(opacity, from.opacities), copy(scale, from.scales), copy(rotation, from.rotations);
      if constexpr (Rows::kLength == kShRestLength) copy(dc, from.dc);
    }
  }

 private:
  template <int kCount> static __device__ void copy(S (&to)[kCount], const S* from) {
#pragma unroll
    for (int k = 0; k < kCount; ++k) to[k] = from[k];
  }
};

template <class T> struct TypeOf { using type = T; };

template <class... T> bool are_vector_aligned(const T*... pointers) {
  return ((reinterpret_cast<std::uintptr_t>(pointers) % 16 == 0) && ...);
}

// Calls launch(TypeOf<ShRows<...>>, bytes of shared memory) with what fits the inputs. may_know: whether the caller's
// own arrays allow the known rows.
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

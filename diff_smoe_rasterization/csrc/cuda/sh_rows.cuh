// How the SH coefficients of a block reach its threads: row by row through shared memory where they are floats, else
// straight from global memory. The common lengths, degree and number of features are compiled in.
#pragma once

#include "device.cuh"
#include "dsmoe/sh.h"

namespace dsmoe {
namespace cuda {

constexpr int kRowsBlock = 128;  // threads, one Gaussian each

// kStaged: through shared memory. kLength: numbers a row, 0 where it is not known. kDegree: the active one, or -1.
template <bool kStagedRows, int kRowLength, int kActiveDegree> struct ShRows {
  static constexpr bool kStaged = kStagedRows;
  static constexpr int kLength = kRowLength;

  // Puts what is known in the place of what was given.
  template <class S> static __device__ void specialise(GaussianInputs<S>& inputs) {
    if (kActiveDegree >= 0) inputs.sh_degree = kActiveDegree;
    if (kLength > 0) inputs.num_sh = kLength / 3;
  }
};

// Calls launch(ShRows<...>, bytes of shared memory) with what fits the inputs.
template <class S, class Launch> void dispatch_sh_rows(const GaussianInputs<S>& inputs, Launch launch) {
  if constexpr (sizeof(S) == sizeof(float)) {
    if (inputs.shs != nullptr && 0 < inputs.num_sh && inputs.num_sh <= kMaxShCoefficients) {
      const int length = 3 * inputs.num_sh;
      const size_t shared = sizeof(float) * kRowsBlock * row_stride(length);
      if (inputs.sh_degree == 3 && length == 48) return launch(ShRows<true, 48, 3>{}, shared);
      if (inputs.sh_degree == 3 && length == 45) return launch(ShRows<true, 45, 3>{}, shared);
      return launch(ShRows<true, 0, -1>{}, shared);
    }
  }
  launch(ShRows<false, 0, -1>{}, size_t(0));
}

}  // namespace cuda
}  // namespace dsmoe

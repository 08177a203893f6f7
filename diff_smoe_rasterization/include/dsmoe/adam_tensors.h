// Adam over several tensors at once, on the CPU and on a GPU.
#pragma once

#include <cstdint>
#include <vector>

#include "dsmoe/adam.h"

namespace dsmoe {

// One parameter tensor, its gradient and its moments, each dense with `size` numbers.
template <class S> struct AdamTensor {
  S* parameter;
  const S* gradient;
  S* moment;  // mean gradient
  S* square;  // mean squared gradient
  int64_t size;
  int64_t row_size;  // numbers per row; row i is stepped where visible[i], if there is a `visible`
  AdamRates<S> rates;
};

namespace cpu {

// visible: a flag per row, or null: all rows.
template <class S>
void adam(const std::vector<AdamTensor<S>>& tensors, const AdamConstants<S>& constants, const bool* visible,
          int num_threads);

}  // namespace cpu

namespace cuda {

// The same on the current device. stream: a cudaStream_t.
template <class S>
void adam(const std::vector<AdamTensor<S>>& tensors, const AdamConstants<S>& constants, const bool* visible,
          void* stream);

}  // namespace cuda
}  // namespace dsmoe

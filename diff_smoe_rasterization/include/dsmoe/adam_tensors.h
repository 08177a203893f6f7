// Adam over several tensors at once, on the CPU and on a GPU.
#pragma once

#include <cstdint>
#include <vector>

#include "dsmoe/adam.h"

namespace dsmoe {

// One parameter tensor, its gradient and its moments. Each is dense and has `size` numbers.
template <class S> struct AdamTensor {
  S* parameter;
  const S* gradient;
  S* moment;  // mean gradient
  S* square;  // mean squared gradient
  int64_t size;
  int64_t row_size;  // numbers per row
  AdamRates<S> rates;
};

// What all tensors of a step have in common.
template <class S> struct AdamStep {
  AdamConstants<S> constants;
  const bool* visible;  // [rows] which rows of every tensor are stepped, or null: all are
};

namespace cpu {

// Steps the parameters and their moments in place. All pointers are to memory of the host.
template <class S> void adam(const std::vector<AdamTensor<S>>& tensors, const AdamStep<S>& step, int num_threads);

}  // namespace cpu

namespace cuda {

// The same on the current device, asynchronously on `stream`, a cudaStream_t. All pointers are to memory of the device.
// Throws std::runtime_error where a launch fails.
template <class S> void adam(const std::vector<AdamTensor<S>>& tensors, const AdamStep<S>& step, void* stream);

}  // namespace cuda
}  // namespace dsmoe

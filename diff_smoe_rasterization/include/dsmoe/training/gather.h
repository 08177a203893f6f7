// Rows of several tensors by one list, in one pass over memory: how densification makes the Gaussians anew.
#pragma once

#include <cstdint>
#include <vector>

namespace dsmoe {

// One tensor, dense.
template <class S> struct GatherTensor {
  const S* from;  // [any, row_size]
  S* to;          // [rows, row_size] written
  int row_size;   // numbers per row
};

// Which rows of `from` become the rows of `to`.
struct GatherRows {
  const int64_t* rows;  // [count]
  int64_t count;
};

// What both backends refuse: null pointers, by name, and sizes that would have them read elsewhere. Throws
// std::invalid_argument.
template <class S>
void refuse_gather(const char* function, const std::vector<GatherTensor<S>>& tensors, const GatherRows& rows);

namespace cpu {

template <class S>
void gather_rows(const std::vector<GatherTensor<S>>& tensors, const GatherRows& rows, int num_threads);

}  // namespace cpu

namespace cuda {

// The same on the current device, asynchronously on `stream`, a cudaStream_t. All pointers are to memory of the device.
// Throws std::runtime_error if a launch fails.
template <class S> void gather_rows(const std::vector<GatherTensor<S>>& tensors, const GatherRows& rows, void* stream);

}  // namespace cuda
}  // namespace dsmoe

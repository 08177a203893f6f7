// Arrays of scratch memory, and numbers that the host waits for.
#pragma once

#include <cuda_runtime_api.h>

#include <cstdint>

#include "check.h"
#include "dsmoe/allocator.h"

namespace dsmoe {
namespace cuda {

// `count` numbers, not filled. Throws std::runtime_error if there is no memory left.
template <class T> T* allocate(Scratch& scratch, int64_t count) {
  void* memory = scratch.allocate(static_cast<size_t>(count) * sizeof(T));
  if (memory == nullptr && count > 0) check(cudaErrorMemoryAllocation, "allocating scratch memory");
  return static_cast<T*>(memory);
}

// Writes a number of the device to pinned memory of the host, later. A kernel does it: in a graph all that follows
// would wait for a copy.
void write_number(const int64_t* number, int64_t* to, cudaStream_t stream);

// Waits for a number of the device.
template <class T> T read(const T* number, const char* what, cudaStream_t stream) {
  T value = 0;
  const BesideCaptures beside;
  check(cudaMemcpyAsync(&value, number, sizeof(value), cudaMemcpyDeviceToHost, stream), what);
  check(cudaStreamSynchronize(stream), what);
  return value;
}

}  // namespace cuda
}  // namespace dsmoe

// Arrays of scratch memory.
#pragma once

#include <cuda_runtime_api.h>

#include <cstdint>

#include "check.h"
#include "dsmoe/allocator.h"

namespace dsmoe {
namespace cuda {

// `count` numbers, not filled. Throws std::runtime_error where there is no memory left.
template <class T> T* allocate(Scratch& scratch, int64_t count) {
  void* memory = scratch.allocate(static_cast<size_t>(count) * sizeof(T));
  if (memory == nullptr && count > 0) check(cudaErrorMemoryAllocation, "allocating scratch memory");
  return static_cast<T*>(memory);
}

}  // namespace cuda
}  // namespace dsmoe

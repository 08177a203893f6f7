#include <cuda_runtime_api.h>

#include "check.h"
#include "dsmoe/rasterize_cuda.h"

namespace dsmoe {
namespace cuda {
namespace {

void* from_pool(size_t bytes, cudaStream_t stream) {
  void* memory = nullptr;
  const cudaError_t status = cudaMallocAsync(&memory, bytes, stream);
  if (status == cudaErrorMemoryAllocation) {
    cudaGetLastError();  // forgets it: the caller says what was wanted
    return nullptr;
  }
  check(status, "allocating memory");
  return memory;
}

void free_all(std::vector<void*>& blocks, cudaStream_t stream) {
  for (void* block : blocks) {
    if (block != nullptr) cudaFreeAsync(block, stream);
  }
  blocks.clear();
}

}  // namespace

StreamMemory::~StreamMemory() {
  free_all(scratch_, stream_);
  free_all(kept_, stream_);
}

void* StreamMemory::allocate(size_t bytes) {
  scratch_.push_back(bytes > 0 ? from_pool(bytes, stream_) : nullptr);
  return scratch_.back();
}

void* StreamMemory::keep(int, const SavedArray& array) {
  kept_.push_back(array.bytes() > 0 ? from_pool(array.bytes(), stream_) : nullptr);
  return kept_.back();
}

void StreamMemory::release() { free_all(scratch_, stream_); }

}  // namespace cuda
}  // namespace dsmoe

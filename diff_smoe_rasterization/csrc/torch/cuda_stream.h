// PyTorch's current CUDA stream of the current device.
#pragma once

#include <cuda_runtime_api.h>

#include "tensor.h"

#ifndef DSMOE_STABLE_ABI
#include <ATen/cuda/CUDAContext.h>
#else
#include <dlfcn.h>
#endif

namespace dsmoe {
namespace binding {

#ifndef DSMOE_STABLE_ABI
inline cudaStream_t current_stream() { return at::cuda::getCurrentCUDAStream(); }
#else
// Looked up when it is called, so that the module loads with a PyTorch that has no CUDA.
inline cudaStream_t current_stream() {
  static const auto function = [] {
    void* const library = dlopen("libtorch_cuda.so", RTLD_LAZY | RTLD_NOLOAD);
    return reinterpret_cast<decltype(&aoti_torch_get_current_cuda_stream)>(
        library == nullptr ? nullptr : dlsym(library, "aoti_torch_get_current_cuda_stream"));
  }();
  DSMOE_CHECK(function != nullptr, "PyTorch's CUDA library is not loaded");
  void* stream;
  TORCH_ERROR_CODE_CHECK(function(torch::stable::accelerator::getCurrentDeviceIndex(), &stream));
  return static_cast<cudaStream_t>(stream);
}
#endif

}  // namespace binding
}  // namespace dsmoe

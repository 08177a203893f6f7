// What CUDA reports, in plain words. Throws std::runtime_error.
#pragma once

#include <cuda_runtime_api.h>

namespace dsmoe {
namespace cuda {

// Throws if `status` is an error; `what` names what was tried.
void check(cudaError_t status, const char* what);

}  // namespace cuda
}  // namespace dsmoe

// After each launch: whether the kernel could be started.
#define DSMOE_CHECK_LAUNCH(kernel) ::dsmoe::cuda::check(cudaGetLastError(), "launching " kernel)

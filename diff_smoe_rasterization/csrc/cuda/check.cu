#include <stdexcept>
#include <string>

#include "check.h"

#define DSMOE_TEXT_OF(...) #__VA_ARGS__
#define DSMOE_TEXT(...) DSMOE_TEXT_OF(__VA_ARGS__)

namespace dsmoe {
namespace cuda {
namespace {

std::string this_card() {
  int device = 0;
  cudaDeviceProp properties;
  if (cudaGetDevice(&device) != cudaSuccess || cudaGetDeviceProperties(&properties, device) != cudaSuccess) {
    return "this GPU";
  }
  return std::string(properties.name) + " (compute capability " + std::to_string(properties.major) + "." +
         std::to_string(properties.minor) + ")";
}

}  // namespace

void check(cudaError_t status, const char* what) {
  if (status == cudaSuccess) return;
  cudaGetLastError();  // forgets it: the next launch must not be blamed for it
  std::string message = std::string("diff_smoe_rasterization: ") + what + ": ";
  if (status == cudaErrorNoKernelImageForDevice || status == cudaErrorInvalidDeviceFunction) {
    message += "this build has no kernels for " + this_card() +
               "; it was built for the architectures " DSMOE_TEXT(__CUDA_ARCH_LIST__) ". Build it again with "
               "TORCH_CUDA_ARCH_LIST set to this card's capability";
  } else if (status == cudaErrorMemoryAllocation) {
    message += "out of memory on " + this_card();
  } else {
    message += std::string(cudaGetErrorString(status)) + " (" + cudaGetErrorName(status) + ") on " + this_card();
  }
  throw std::runtime_error(message);
}

}  // namespace cuda
}  // namespace dsmoe

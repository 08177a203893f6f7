// Passes over all Gaussians, or over what else there are many of: a thread each.
#include "cuda/tuning.cuh"
#include "dsmoe/training/gaussians.h"

namespace dsmoe {
namespace cuda {
namespace {

template <class Pass>
__global__ void __launch_bounds__(kStoreBlock) for_each_kernel(const __grid_constant__ Pass pass, int64_t count) {
  const int64_t i = int64_t(blockIdx.x) * kStoreBlock + threadIdx.x;
  if (i < count) pass(i);
}

}  // namespace

template <class Pass> void for_each_gaussian(const Pass& pass, int64_t count, void* stream) {
  if (count == 0) return;
  for_each_kernel<<<blocks_for(count, kStoreBlock), kStoreBlock, 0, static_cast<cudaStream_t>(stream)>>>(pass, count);
  DSMOE_CHECK_LAUNCH("a pass over the Gaussians");
}

#define DSMOE_INSTANTIATE(S)                                                   \
  template void for_each_gaussian(const Activate<S>&, int64_t, void*);         \
  template void for_each_gaussian(const ActivateBackward<S>&, int64_t, void*); \
  template void for_each_gaussian(const AddView<S>&, int64_t, void*);          \
  template void for_each_gaussian(const PixelReach<S>&, int64_t, void*);       \
  template void for_each_gaussian(const GateStep<S>&, int64_t, void*);         \
  template void for_each_gaussian(const StepInputs<S>&, int64_t, void*);
DSMOE_INSTANTIATE(float)
DSMOE_INSTANTIATE(double)
#undef DSMOE_INSTANTIATE

}  // namespace cuda
}  // namespace dsmoe

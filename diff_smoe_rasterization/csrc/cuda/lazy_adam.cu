// Lazy Adam: a warp finds the rows to bring up to date among 32, and shares out their numbers to its lanes.
#include "dsmoe/lazy_adam.h"
#include "tuning.cuh"

namespace dsmoe {
namespace cuda {
namespace {

constexpr int kWarps = kAdamBlock / kWarp;

template <class S>
__global__ void __launch_bounds__(kAdamBlock) catch_up_kernel(const __grid_constant__ LazyAdam<S> adam) {
  __shared__ int32_t shared_rows[kWarps][kWarp], shared_marks[kWarps][kWarp];
  const int warp = threadIdx.x / kWarp, lane = threadIdx.x % kWarp;
  const int64_t row = int64_t(blockIdx.x) * kAdamBlock + threadIdx.x;
  const bool wanted = row < adam.num_rows && (adam.radii == nullptr || adam.radii[row] > 0);
  const int32_t mark = wanted ? adam.marks[row] : adam.steps;
  const unsigned stale = __ballot_sync(kAllLanes, mark != adam.steps);
  if (stale == 0) return;
  if (stale >> lane & 1) {
    const int place = __popc(stale & ((1u << lane) - 1));
    shared_rows[warp][place] = lane;
    shared_marks[warp][place] = mark;
    adam.marks[row] = adam.steps;
  }
  __syncwarp();
  const int count = __popc(stale);
  for (int t = 0; t < adam.num_tensors; ++t) {
    const LazyAdamTensor<S>& tensor = adam.tensors[t];
    const AdamRates<S>* rates = adam.rates + t;
    const int size = tensor.row_size, total = count * size;
    const int64_t first = (row - lane) * size;
    for (int begin = lane; begin < total; begin += kWarp * kAdamPerThread) {
      S gradient[kAdamPerThread], parameter[kAdamPerThread], moment[kAdamPerThread], square[kAdamPerThread];
      int32_t marks[kAdamPerThread];
      int64_t place[kAdamPerThread];
#pragma unroll
      for (int k = 0; k < kAdamPerThread; ++k) {
        const int i = begin + k * kWarp;
        if (i >= total) continue;
        const int n = i / size;
        place[k] = first + (shared_rows[warp][n] - n) * size + i;
        marks[k] = shared_marks[warp][n];
        gradient[k] = marks[k] < 0 ? tensor.gradient[place[k]] : S(0);
        parameter[k] = tensor.parameter[place[k]];
        moment[k] = tensor.moment[place[k]];
        square[k] = tensor.square[place[k]];
      }
#pragma unroll
      for (int k = 0; k < kAdamPerThread; ++k) {
        if (begin + k * kWarp >= total) continue;
        catch_up(adam, LazyAdamMark(marks[k]), rates, gradient[k], parameter[k], moment[k], square[k]);
        tensor.parameter[place[k]] = parameter[k];
        tensor.moment[place[k]] = moment[k];
        tensor.square[place[k]] = square[k];
      }
    }
  }
}

template <class S>
__global__ void __launch_bounds__(kStoreBlock) note_step_kernel(const __grid_constant__ LazyAdamStep<S> step) {
  const int64_t row = int64_t(blockIdx.x) * kStoreBlock + threadIdx.x;
  if (row < step.num_tensors) step.rates[row] = step.new_rates[row];
  if (row < step.num_rows && step.radii[row] > 0) step.marks[row] = ~step.steps;
}

}  // namespace

template <class S> void catch_up(const LazyAdam<S>& adam, void* stream) {
  if (adam.num_rows == 0) return;
  const unsigned blocks = blocks_for(adam.num_rows, kAdamBlock);
  catch_up_kernel<<<blocks, kAdamBlock, 0, static_cast<cudaStream_t>(stream)>>>(adam);
  DSMOE_CHECK_LAUNCH("lazy Adam");
}

template <class S> void note_step(const LazyAdamStep<S>& step, void* stream) {
  if (step.num_rows == 0) return;
  const unsigned blocks = blocks_for(step.num_rows, kStoreBlock);
  note_step_kernel<<<blocks, kStoreBlock, 0, static_cast<cudaStream_t>(stream)>>>(step);
  DSMOE_CHECK_LAUNCH("a step of lazy Adam");
}

#define DSMOE_INSTANTIATE(S)                         \
  template void catch_up(const LazyAdam<S>&, void*); \
  template void note_step(const LazyAdamStep<S>&, void*);
DSMOE_INSTANTIATE(float)
DSMOE_INSTANTIATE(double)
#undef DSMOE_INSTANTIATE

}  // namespace cuda
}  // namespace dsmoe

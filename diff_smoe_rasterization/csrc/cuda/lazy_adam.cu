// Lazy Adam: a warp finds the rows to bring up to date among 32, and each half of it takes every other one of them.
#include <algorithm>

#include "../refuse_training.h"
#include "dsmoe/lazy_adam.h"
#include "tuning.cuh"

namespace dsmoe {
namespace cuda {
namespace {

constexpr int kWarps = kAdamBlock / kWarp;

// The lanes that take a row together, and how many numbers each holds at a time. All of a row miss the same steps, so
// that lanes wait for each other only where the rows of a warp differ; and 48 numbers are a row of spherical harmonics.
constexpr int kRowLanes = 16;
constexpr int kRowNumbers = 3;

// Blocks that one multiprocessor holds at once: of floats, so many that enough loads are in flight.
template <class S> constexpr int kBlocks = sizeof(S) == 4 ? 4 : 1;

// Where a number of each row lies: one column of one tensor.
template <class S> struct Column {
  LazyAdamTensor<S> tensor;  // that begins at the column
  const AdamRates<S>* rates;
  bool exists;

  // column: counted over all tensors.
  __device__ Column(const LazyAdam<S>& adam, int column) {
    int t = 0;
    while (t < adam.num_tensors && column >= adam.tensors[t].row_size) column -= adam.tensors[t++].row_size;
    exists = t < adam.num_tensors;
    if (!exists) return;
    tensor = adam.tensors[t];
    tensor.parameter += column, tensor.moment += column, tensor.square += column, tensor.gradient += column;
    rates = adam.rates + t;
  }
};

// Makes the steps that a row has missed on the columns of a lane. Those that do not exist compute with zeros.
template <class S>
__device__ void catch_up_row(const LazyAdam<S>& adam, const Column<S> (&columns)[kRowNumbers], int64_t row,
                             LazyAdamMark mark, int32_t steps) {
  S gradient[kRowNumbers], parameter[kRowNumbers] = {}, moment[kRowNumbers] = {}, square[kRowNumbers] = {};
#pragma unroll
  for (int k = 0; k < kRowNumbers; ++k) {
    if (!columns[k].exists) continue;
    const LazyAdamTensor<S>& tensor = columns[k].tensor;
    const int64_t i = row * tensor.row_size;
    gradient[k] = mark.waiting ? tensor.gradient[i] : S(0);
    parameter[k] = tensor.parameter[i], moment[k] = tensor.moment[i], square[k] = tensor.square[i];
  }
  int32_t step = mark.steps;
  if (mark.waiting) {
#pragma unroll
    for (int k = 0; k < kRowNumbers; ++k) {
      if (!columns[k].exists) continue;
      adam_step(adam.constants, columns[k].rates[step * adam.num_tensors], gradient[k], parameter[k], moment[k],
                square[k]);
    }
    ++step;
  }
#pragma unroll 1
  for (; step < steps; ++step) {
#pragma unroll
    for (int k = 0; k < kRowNumbers; ++k) {
      if (!columns[k].exists) continue;
      adam_rest_step(adam.constants, columns[k].rates[step * adam.num_tensors], parameter[k], moment[k], square[k]);
    }
  }
#pragma unroll
  for (int k = 0; k < kRowNumbers; ++k) {
    if (!columns[k].exists) continue;
    const LazyAdamTensor<S>& tensor = columns[k].tensor;
    const int64_t i = row * tensor.row_size;
    tensor.parameter[i] = parameter[k], tensor.moment[i] = moment[k], tensor.square[i] = square[k];
  }
}

template <class S>
__global__ void __launch_bounds__(kAdamBlock, kBlocks<S>) catch_up_kernel(const __grid_constant__ LazyAdam<S> adam) {
  __shared__ int32_t shared_rows[kWarps][kWarp], shared_marks[kWarps][kWarp];
  const int warp = threadIdx.x / kWarp, lane = threadIdx.x % kWarp;
  const int64_t row = int64_t(blockIdx.x) * kAdamBlock + threadIdx.x;
  const int32_t steps = adam.num_steps();
  const bool wanted = row < adam.num_rows && (adam.radii == nullptr || adam.radii[row] > 0);
  const int32_t mark = wanted ? adam.marks[row] : steps;
  const unsigned stale = __ballot_sync(kAllLanes, mark != steps);
  if (stale == 0) return;
  if (stale >> lane & 1) {
    const int place = __popc(stale & ((1u << lane) - 1));
    shared_rows[warp][place] = lane;
    shared_marks[warp][place] = mark;
    adam.marks[row] = steps;
  }
  __syncwarp();
  int numbers = 0;
  for (int t = 0; t < adam.num_tensors; ++t) numbers += adam.tensors[t].row_size;
  for (int begin = lane % kRowLanes; begin < numbers; begin += kRowLanes * kRowNumbers) {
    const Column<S> columns[kRowNumbers] = {Column<S>(adam, begin), Column<S>(adam, begin + kRowLanes),
                                            Column<S>(adam, begin + 2 * kRowLanes)};
    for (int n = lane / kRowLanes; n < __popc(stale); n += kWarp / kRowLanes) {
      catch_up_row(adam, columns, row - lane + shared_rows[warp][n], LazyAdamMark(shared_marks[warp][n]), steps);
    }
  }
}

template <class S>
__global__ void __launch_bounds__(kStoreBlock) note_step_kernel(const __grid_constant__ LazyAdamStep<S> step) {
  const int64_t row = int64_t(blockIdx.x) * kStoreBlock + threadIdx.x;
  const int32_t steps = step.num_steps();
  if (row < step.num_tensors)
    step.rates[int64_t(steps) * step.num_tensors + row] = step.new_rate(static_cast<int>(row));
  if (row < step.num_rows && step.radii[row] > 0) step.marks[row] = ~steps;
}

}  // namespace

template <class S> void catch_up(const LazyAdam<S>& adam, void* stream) {
  refuse_catch_up("cuda::catch_up", adam);
  if (adam.num_rows == 0) return;
  const unsigned blocks = blocks_for(adam.num_rows, kAdamBlock);
  catch_up_kernel<<<blocks, kAdamBlock, 0, static_cast<cudaStream_t>(stream)>>>(adam);
  DSMOE_CHECK_LAUNCH("lazy Adam");
}

template <class S> void note_step(const LazyAdamStep<S>& step, void* stream) {
  refuse_note_step("cuda::note_step", step);
  const unsigned blocks = blocks_for(std::max<int64_t>(step.num_rows, step.num_tensors), kStoreBlock);
  if (blocks == 0) return;
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

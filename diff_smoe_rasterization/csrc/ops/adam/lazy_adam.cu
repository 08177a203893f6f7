// Lazy Adam: a warp finds the rows to bring up to date among up to 32, and each half of it takes every other one of
// them.
#include <algorithm>

#include "cuda/tuning.cuh"
#include "dsmoe/training/adam.h"

namespace dsmoe {
namespace cuda {
namespace {

constexpr int kWarps = kAdamBlock / kWarp;

// The lanes that take a row together, and how many numbers each holds at a time: 48, a row of spherical harmonics. The
// numbers of a row miss the same steps, so lanes wait for each other only if the rows of a warp differ.
constexpr int kRowLanes = 16;
constexpr int kRowNumbers = 3;

// Missed steps that are interleaved: a step's root and reciprocal do not wait for the step before.
constexpr int kStepUnroll = 4;

// Blocks that one multiprocessor holds at once: of floats, so many that enough loads are in flight.
template <class S> constexpr int kBlocks = sizeof(S) == 4 ? 4 : 1;

// Where a number of each row lies: one column of one tensor. Its arrays are looked up in the kernel's arguments, since
// their addresses would fill the registers.
template <class S> struct Column {
  int tensor, place;  // in the row; column 0 of tensor 0 where it does not exist
  bool exists;

  // column: counted over all tensors.
  __device__ Column(const LazyAdam<S>& adam, int column) {
    tensor = 0, place = column;
    while (tensor < adam.num_tensors && place >= adam.tensors[tensor].row_size)
      place -= adam.tensors[tensor++].row_size;
    exists = tensor < adam.num_tensors;
    if (!exists) tensor = place = 0;
  }
};

// Makes the steps that a row has missed on the columns of a lane. Those that do not exist compute with zeros.
template <class S>
__device__ void catch_up_row(const LazyAdam<S>& adam, const Column<S> (&columns)[kRowNumbers], int64_t row,
                             LazyAdamMark mark, int32_t steps) {
  S gradient[kRowNumbers], parameter[kRowNumbers], moment[kRowNumbers], square[kRowNumbers];
#pragma unroll
  for (int k = 0; k < kRowNumbers; ++k) {
    gradient[k] = parameter[k] = moment[k] = square[k] = S(0);
    if (!columns[k].exists) continue;
    const LazyAdamTensor<S>& tensor = adam.tensors[columns[k].tensor];
    const int64_t i = row * tensor.row_size + columns[k].place;
    if (mark.waiting) gradient[k] = tensor.gradient[i];
    parameter[k] = tensor.parameter[i], moment[k] = tensor.moment[i], square[k] = tensor.square[i];
  }
  const AdamRates<S>* rates = adam.rates + int64_t(mark.steps) * adam.num_tensors;
  int32_t missed = steps - mark.steps;
  if (mark.waiting) {
#pragma unroll
    for (int k = 0; k < kRowNumbers; ++k) {
      adam_step(adam.constants, rates[columns[k].tensor], gradient[k], parameter[k], moment[k], square[k]);
    }
    rates += adam.num_tensors, --missed;
  }
#pragma unroll kStepUnroll
  for (int32_t step = 0; step < missed; ++step) {
#pragma unroll
    for (int k = 0; k < kRowNumbers; ++k) {
      adam_rest_step(adam.constants, rates[step * adam.num_tensors + columns[k].tensor], parameter[k], moment[k],
                     square[k]);
    }
  }
#pragma unroll
  for (int k = 0; k < kRowNumbers; ++k) {
    if (!columns[k].exists) continue;
    const LazyAdamTensor<S>& tensor = adam.tensors[columns[k].tensor];
    const int64_t i = row * tensor.row_size + columns[k].place;
    tensor.parameter[i] = parameter[k], tensor.moment[i] = moment[k], tensor.square[i] = square[k];
  }
}

// rows: of a warp, 2 to 32.
template <class S>
__global__ void __launch_bounds__(kAdamBlock, kBlocks<S>)
    catch_up_kernel(const __grid_constant__ LazyAdam<S> adam, int rows) {
  __shared__ int32_t shared_rows[kWarps][kWarp], shared_marks[kWarps][kWarp];
  const int warp = threadIdx.x / kWarp, lane = threadIdx.x % kWarp;
  const int64_t row = (int64_t(blockIdx.x) * kWarps + warp) * rows + lane;
  const int32_t steps = adam.num_steps();
  const bool wanted = lane < rows && row < adam.num_rows && (adam.radii == nullptr || adam.radii[row] > 0);
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
  const int rows = rows_per_warp(adam.num_rows, kWarp / kRowLanes);
  const unsigned blocks = blocks_for(adam.num_rows, kWarps * rows);
  catch_up_kernel<<<blocks, kAdamBlock, 0, static_cast<cudaStream_t>(stream)>>>(adam, rows);
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

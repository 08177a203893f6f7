// Rows by a list, of several tensors in one launch: a block writes a piece of one of them.
#include "cuda/tuning.cuh"
#include "dsmoe/training/gather.h"

namespace dsmoe {
namespace cuda {
namespace {

constexpr int kPerBlock = kAdamBlock * kAdamPerThread;

template <class S> struct Batch {
  GatherTensor<S> tensors[kAdamMaxTensors];
  int64_t first_block[kAdamMaxTensors];  // of each tensor
  int count;                             // tensors
  GatherRows rows;
};

template <class S> __global__ void __launch_bounds__(kAdamBlock) gather_kernel(const __grid_constant__ Batch<S> batch) {
  int t = 0;
  while (t + 1 < batch.count && blockIdx.x >= batch.first_block[t + 1]) ++t;
  const GatherTensor<S>& tensor = batch.tensors[t];
  const int64_t begin = (blockIdx.x - batch.first_block[t]) * kPerBlock, first_row = begin / tensor.row_size;
  const int offset = static_cast<int>(begin - first_row * tensor.row_size) + threadIdx.x;
  const int64_t size = batch.rows.count * tensor.row_size;
  S values[kAdamPerThread];
#pragma unroll
  for (int k = 0; k < kAdamPerThread; ++k) {
    const int local = offset + k * kAdamBlock, row = local / tensor.row_size;
    if (begin + threadIdx.x + k * kAdamBlock >= size) continue;
    const int64_t from = batch.rows.rows[first_row + row];
    values[k] = tensor.from[from * tensor.row_size + (local - row * tensor.row_size)];
  }
#pragma unroll
  for (int k = 0; k < kAdamPerThread; ++k) {
    const int64_t i = begin + threadIdx.x + k * kAdamBlock;
    if (i < size) tensor.to[i] = values[k];
  }
}

template <class S> void launch(const Batch<S>& batch, int64_t num_blocks, cudaStream_t stream) {
  if (num_blocks == 0) return;
  gather_kernel<<<static_cast<unsigned>(num_blocks), kAdamBlock, 0, stream>>>(batch);
  DSMOE_CHECK_LAUNCH("gathering rows");
}

}  // namespace

template <class S> void gather_rows(const std::vector<GatherTensor<S>>& tensors, const GatherRows& rows, void* stream) {
  refuse_gather("cuda::gather_rows", tensors, rows);
  Batch<S> batch = {};
  batch.rows = rows;
  int64_t num_blocks = 0;
  for (const GatherTensor<S>& tensor : tensors) {
    if (rows.count == 0 || tensor.row_size == 0) continue;
    if (batch.count == kAdamMaxTensors) {
      launch(batch, num_blocks, static_cast<cudaStream_t>(stream));
      batch.count = 0, num_blocks = 0;
    }
    batch.tensors[batch.count] = tensor;
    batch.first_block[batch.count] = num_blocks;
    ++batch.count;
    num_blocks += blocks_for(rows.count * tensor.row_size, kPerBlock);
  }
  launch(batch, num_blocks, static_cast<cudaStream_t>(stream));
}

template void gather_rows(const std::vector<GatherTensor<float>>&, const GatherRows&, void*);
template void gather_rows(const std::vector<GatherTensor<double>>&, const GatherRows&, void*);

}  // namespace cuda
}  // namespace dsmoe

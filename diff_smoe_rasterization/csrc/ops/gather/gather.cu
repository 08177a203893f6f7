// Rows by a list, of several tensors in one launch: a block writes a piece of one of them.
#include "dsmoe/training/gather.h"
#include "ops/pieces.cuh"

namespace dsmoe {
namespace cuda {
namespace {

template <class S> struct Batch {
  Pieces<GatherTensor<S>> pieces;
  GatherRows rows;
};

template <class S> __global__ void __launch_bounds__(kAdamBlock) gather_kernel(const __grid_constant__ Batch<S> batch) {
  const int t = batch.pieces.owner();
  const GatherTensor<S>& tensor = batch.pieces.tensors[t];
  const int64_t begin = (blockIdx.x - batch.pieces.first_block[t]) * kPiece, first_row = begin / tensor.row_size;
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

}  // namespace

template <class S> void gather_rows(const std::vector<GatherTensor<S>>& tensors, const GatherRows& rows, void* stream) {
  refuse_gather("cuda::gather_rows", tensors, rows);
  Batch<S> batch = {};
  batch.rows = rows;
  launch_pieces(
      tensors, batch.pieces, [&](const GatherTensor<S>& tensor) { return rows.count * tensor.row_size; },
      [&](unsigned num_blocks) {
        gather_kernel<<<num_blocks, kAdamBlock, 0, static_cast<cudaStream_t>(stream)>>>(batch);
        DSMOE_CHECK_LAUNCH("gathering rows");
      });
}

template void gather_rows(const std::vector<GatherTensor<float>>&, const GatherRows&, void*);
template void gather_rows(const std::vector<GatherTensor<double>>&, const GatherRows&, void*);

}  // namespace cuda
}  // namespace dsmoe

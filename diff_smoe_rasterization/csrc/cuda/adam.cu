// Adam over several tensors in one launch: a block takes a piece of one of them.
#include <algorithm>

#include "../refuse_training.h"
#include "dsmoe/training/adam.h"
#include "tuning.cuh"

namespace dsmoe {
namespace cuda {
namespace {

constexpr int kPerBlock = kAdamBlock * kAdamPerThread;

// The tensors of one launch.
template <class S> struct Batch {
  AdamTensor<S> tensors[kAdamMaxTensors];
  int64_t first_block[kAdamMaxTensors];  // of each tensor
  int count;                             // tensors
  AdamStep<S> step;                      // what they have in common
};

template <class S> __global__ void __launch_bounds__(kAdamBlock) adam_kernel(const __grid_constant__ Batch<S> batch) {
  int t = 0;
  while (t + 1 < batch.count && blockIdx.x >= batch.first_block[t + 1]) ++t;
  const AdamTensor<S>& tensor = batch.tensors[t];
  const int64_t begin = (blockIdx.x - batch.first_block[t]) * kPerBlock + threadIdx.x;

  S gradient[kAdamPerThread], parameter[kAdamPerThread], moment[kAdamPerThread], square[kAdamPerThread];
  bool stepped[kAdamPerThread];
#pragma unroll
  for (int k = 0; k < kAdamPerThread; ++k) {
    const int64_t i = begin + k * kAdamBlock;
    stepped[k] = i < tensor.size && (batch.step.visible == nullptr || batch.step.visible[i / tensor.row_size]);
    if (!stepped[k]) continue;
    gradient[k] = tensor.gradient[i];
    parameter[k] = tensor.parameter[i];
    moment[k] = tensor.moment[i];
    square[k] = tensor.square[i];
  }
#pragma unroll
  for (int k = 0; k < kAdamPerThread; ++k) {
    if (!stepped[k]) continue;
    const int64_t i = begin + k * kAdamBlock;
    adam_step(batch.step.constants, tensor.rates, gradient[k], parameter[k], moment[k], square[k]);
    tensor.parameter[i] = parameter[k];
    tensor.moment[i] = moment[k];
    tensor.square[i] = square[k];
  }
}

template <class S> void launch(const Batch<S>& batch, int64_t num_blocks, cudaStream_t stream) {
  if (num_blocks == 0) return;
  adam_kernel<<<static_cast<unsigned>(num_blocks), kAdamBlock, 0, stream>>>(batch);
  DSMOE_CHECK_LAUNCH("adam");
}

}  // namespace

template <class S> void adam(const std::vector<AdamTensor<S>>& tensors, const AdamStep<S>& step, void* stream) {
  refuse_adam("cuda::adam", tensors);
  Batch<S> batch = {};
  batch.step = step;
  int64_t num_blocks = 0;
  for (const AdamTensor<S>& tensor : tensors) {
    if (tensor.size == 0) continue;
    if (batch.count == kAdamMaxTensors) {
      launch(batch, num_blocks, static_cast<cudaStream_t>(stream));
      batch.count = 0, num_blocks = 0;
    }
    batch.tensors[batch.count] = tensor;
    batch.first_block[batch.count] = num_blocks;
    ++batch.count;
    num_blocks += (tensor.size + kPerBlock - 1) / kPerBlock;
  }
  launch(batch, num_blocks, static_cast<cudaStream_t>(stream));
}

template void adam(const std::vector<AdamTensor<float>>&, const AdamStep<float>&, void*);
template void adam(const std::vector<AdamTensor<double>>&, const AdamStep<double>&, void*);

}  // namespace cuda
}  // namespace dsmoe

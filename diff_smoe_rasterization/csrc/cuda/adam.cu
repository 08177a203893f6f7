// Adam over several tensors in one launch: a block takes a piece of one of them.
#include <algorithm>

#include "check.h"
#include "dsmoe/adam_tensors.h"

namespace dsmoe {
namespace cuda {
namespace {

constexpr int kBlock = 256;
constexpr int kPerThread = 4;  // numbers, a block apart: loads of all of them are in flight together
constexpr int kPerBlock = kBlock * kPerThread;
constexpr int kMaxTensors = 16;  // of one launch

template <class S> struct Batch {
  AdamTensor<S> tensors[kMaxTensors];
  int64_t first_block[kMaxTensors];
  int count;
  AdamConstants<S> constants;
  const bool* visible;  // per row, or null
};

template <class S> __global__ void __launch_bounds__(kBlock) adam_kernel(const __grid_constant__ Batch<S> batch) {
  int t = 0;
  while (t + 1 < batch.count && blockIdx.x >= batch.first_block[t + 1]) ++t;
  const AdamTensor<S>& tensor = batch.tensors[t];
  const int64_t begin = (blockIdx.x - batch.first_block[t]) * kPerBlock + threadIdx.x;

  S gradient[kPerThread], parameter[kPerThread], moment[kPerThread], square[kPerThread];
  bool stepped[kPerThread];
#pragma unroll
  for (int k = 0; k < kPerThread; ++k) {
    const int64_t i = begin + k * kBlock;
    stepped[k] = i < tensor.size && (batch.visible == nullptr || batch.visible[i / tensor.row_size]);
    if (!stepped[k]) continue;
    gradient[k] = tensor.gradient[i];
    parameter[k] = tensor.parameter[i];
    moment[k] = tensor.moment[i];
    square[k] = tensor.square[i];
  }
#pragma unroll
  for (int k = 0; k < kPerThread; ++k) {
    if (!stepped[k]) continue;
    const int64_t i = begin + k * kBlock;
    adam_step(batch.constants, tensor.rates, gradient[k], parameter[k], moment[k], square[k]);
    tensor.parameter[i] = parameter[k];
    tensor.moment[i] = moment[k];
    tensor.square[i] = square[k];
  }
}

template <class S> void launch(const Batch<S>& batch, int64_t num_blocks, cudaStream_t stream) {
  if (num_blocks == 0) return;
  adam_kernel<<<static_cast<unsigned>(num_blocks), kBlock, 0, stream>>>(batch);
  DSMOE_CHECK_LAUNCH("adam");
}

}  // namespace

template <class S>
void adam(const std::vector<AdamTensor<S>>& tensors, const AdamConstants<S>& constants, const bool* visible,
          void* stream) {
  Batch<S> batch = {};
  batch.constants = constants;
  batch.visible = visible;
  int64_t num_blocks = 0;
  for (const AdamTensor<S>& tensor : tensors) {
    if (tensor.size == 0) continue;
    if (batch.count == kMaxTensors) {
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

template void adam<float>(const std::vector<AdamTensor<float>>&, const AdamConstants<float>&, const bool*, void*);
template void adam<double>(const std::vector<AdamTensor<double>>&, const AdamConstants<double>&, const bool*, void*);

}  // namespace cuda
}  // namespace dsmoe

// Adam over several tensors in one launch: a block takes a piece of one of them.
#include <algorithm>

#include "dsmoe/training/adam.h"
#include "dsmoe/training/gaussians.h"
#include "ops/pieces.cuh"

namespace dsmoe {
namespace cuda {
namespace {

template <class S> struct Batch {
  Pieces<AdamTensor<S>> pieces;
  AdamStep<S> step;  // what they have in common
};

template <class S> __global__ void __launch_bounds__(kAdamBlock) adam_kernel(const __grid_constant__ Batch<S> batch) {
  const int t = batch.pieces.owner();
  const AdamTensor<S>& tensor = batch.pieces.tensors[t];
  const int64_t begin = (blockIdx.x - batch.pieces.first_block[t]) * kPiece + threadIdx.x;

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

}  // namespace

template <class S> void adam(const std::vector<AdamTensor<S>>& tensors, const AdamStep<S>& step, void* stream) {
  refuse_adam("cuda::adam", tensors);
  Batch<S> batch = {};
  batch.step = step;
  launch_pieces(
      tensors, batch.pieces, [](const AdamTensor<S>& tensor) { return tensor.size; },
      [&](unsigned num_blocks) {
        adam_kernel<<<num_blocks, kAdamBlock, 0, static_cast<cudaStream_t>(stream)>>>(batch);
        DSMOE_CHECK_LAUNCH("adam");
      });
}

template void adam(const std::vector<AdamTensor<float>>&, const AdamStep<float>&, void*);
template void adam(const std::vector<AdamTensor<double>>&, const AdamStep<double>&, void*);

// Adam with activations: a block takes a piece of one tensor.

namespace {

template <class S> struct Blocks {
  GaussianAdam<S> adam;
  int64_t first[kGaussianAdamTensors];  // block of each tensor
};

template <class S, int kSize> struct alignas(kSize * sizeof(S)) Vector { S numbers[kSize]; };

template <int kSize, class S> __device__ void load(const S* from, S (&to)[kSize]) {
  const auto vector = *reinterpret_cast<const Vector<S, kSize>*>(from);
#pragma unroll
  for (int k = 0; k < kSize; ++k) to[k] = vector.numbers[k];
}

template <int kSize, class S> __device__ void store(const S (&from)[kSize], S* to) {
  Vector<S, kSize> vector;
#pragma unroll
  for (int k = 0; k < kSize; ++k) vector.numbers[k] = from[k];
  *reinterpret_cast<Vector<S, kSize>*>(to) = vector;
}

// Steps what a block has of a tensor: kCount groups of kSize numbers a thread.
template <int kSize, int kCount, class S>
__device__ void step_piece(const GaussianAdam<S>& adam, const ActivatedTensor<S>& tensor, const AdamRates<S>& rates,
                           int64_t block) {
  const int64_t groups = adam.num_gaussians * (tensor.row_size / kSize);
  const int64_t begin = block * (kAdamBlock * kCount) + threadIdx.x;
  const bool activated = tensor.activation != Activation::kNone;
  ActivatedNumbers<S, kSize> numbers[kCount];
  bool seen[kCount];
#pragma unroll
  for (int k = 0; k < kCount; ++k) {
    const int64_t group = begin + k * kAdamBlock, i = group * kSize;
    numbers[k] = {}, seen[k] = false;
    if (group >= groups) continue;
    seen[k] = adam.radii[kSize > 1 ? group : group / tensor.row_size] > 0;
    load(tensor.raw + i, numbers[k].raw);
    load(tensor.moment + i, numbers[k].moment);
    load(tensor.square + i, numbers[k].square);
    if (!seen[k]) continue;
    load(tensor.dL_dvalue + i, numbers[k].dL_dvalue);
    if (kSize == 1 && activated) load(tensor.value + i, numbers[k].value);
  }
#pragma unroll
  for (int k = 0; k < kCount; ++k) {
    const int64_t group = begin + k * kAdamBlock, i = group * kSize;
    if (group >= groups) continue;
    if constexpr (kSize == 1) {
      step_number(adam.constants, tensor.activation, rates, numbers[k]);
    } else {
      step_quaternion(adam.constants, rates, seen[k], numbers[k]);
    }
    store(numbers[k].raw, tensor.raw + i);
    store(numbers[k].moment, tensor.moment + i);
    store(numbers[k].square, tensor.square + i);
    if (activated) store(numbers[k].value, tensor.value + i);
  }
}

template <class S>
__global__ void __launch_bounds__(kAdamBlock) step_gaussians_kernel(const __grid_constant__ Blocks<S> blocks) {
  int t = 0;
  while (t + 1 < kGaussianAdamTensors && blockIdx.x >= blocks.first[t + 1]) ++t;
  const ActivatedTensor<S>& tensor = blocks.adam.tensors[t];
  const AdamRates<S> rates = blocks.adam.rates(t);
  const int64_t block = blockIdx.x - blocks.first[t];
  if (tensor.activation == Activation::kUnitQuaternion) {
    step_piece<4, kAdamPerThread / 4>(blocks.adam, tensor, rates, block);
  } else {
    step_piece<1, kAdamPerThread>(blocks.adam, tensor, rates, block);
  }
}

}  // namespace

template <class S> void step_gaussians(const GaussianAdam<S>& adam, void* stream) {
  refuse_step_gaussians("cuda::step_gaussians", adam);
  if (adam.num_gaussians == 0) return;
  Blocks<S> blocks = {};
  blocks.adam = adam;
  int64_t count = 0;
  for (int t = 0; t < kGaussianAdamTensors; ++t) {
    blocks.first[t] = count;
    count += blocks_for(adam.num_gaussians * adam.tensors[t].row_size, kPiece);
  }
  step_gaussians_kernel<<<static_cast<unsigned>(count), kAdamBlock, 0, static_cast<cudaStream_t>(stream)>>>(blocks);
  DSMOE_CHECK_LAUNCH("Adam with activations");
}

template void step_gaussians(const GaussianAdam<float>&, void*);
template void step_gaussians(const GaussianAdam<double>&, void*);

}  // namespace cuda
}  // namespace dsmoe

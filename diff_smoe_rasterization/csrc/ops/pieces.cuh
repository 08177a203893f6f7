// Several tensors in one launch: a block works on a piece of one of them.
#pragma once

#include <vector>

#include "cuda/tuning.cuh"

namespace dsmoe {
namespace cuda {

constexpr int kPiece = kAdamBlock * kAdamPerThread;  // numbers of a tensor that a block works on

// The tensors of one launch.
template <class Tensor> struct Pieces {
  Tensor tensors[kAdamMaxTensors];
  int64_t first_block[kAdamMaxTensors];  // of each tensor
  int count;                             // tensors

  // The tensor that this block has a piece of.
  __device__ int owner() const {
    int t = 0;
    while (t + 1 < count && blockIdx.x >= first_block[t + 1]) ++t;
    return t;
  }
};

// Calls launch(number of blocks) for as many tensors as one launch takes, in `pieces`, until all had theirs.
// size_of(tensor): its numbers.
template <class Tensor, class SizeOf, class Launch>
void launch_pieces(const std::vector<Tensor>& tensors, Pieces<Tensor>& pieces, SizeOf size_of, Launch launch) {
  int64_t num_blocks = 0;
  for (const Tensor& tensor : tensors) {
    if (size_of(tensor) == 0) continue;
    if (pieces.count == kAdamMaxTensors) {
      launch(static_cast<unsigned>(num_blocks));
      pieces.count = 0, num_blocks = 0;
    }
    pieces.tensors[pieces.count] = tensor;
    pieces.first_block[pieces.count] = num_blocks;
    ++pieces.count;
    num_blocks += blocks_for(size_of(tensor), kPiece);
  }
  if (num_blocks > 0) launch(static_cast<unsigned>(num_blocks));
}

}  // namespace cuda
}  // namespace dsmoe

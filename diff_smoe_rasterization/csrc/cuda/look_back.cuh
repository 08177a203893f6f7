// A running sum over the blocks of one launch (Merrill and Garland, "Single-pass Parallel Prefix Scan with Decoupled
// Look-back", 2016): each block publishes its own sum, looks back over its predecessors until one of them knows the sum
// of all before it, and publishes its own running sum.
#pragma once

#include "device.cuh"

namespace dsmoe {
namespace cuda {

// All zero before the launch.
struct LookBack {
  unsigned long long* states;  // [blocks] what each block has published, its kind in the two upper bits
  unsigned* next_block;  // [1] blocks number themselves in the order in which they start: none waits for a later one
};

constexpr unsigned long long kOwnSum = 1ull << 62, kRunningSum = 2ull << 62, kSumMask = kOwnSum - 1;

// Called by thread 0 of the block.
inline __device__ unsigned take_block_number(const LookBack& look_back) { return atomicAdd(look_back.next_block, 1u); }

// Called by the first warp of the block. Returns the sum over all blocks before this one.
inline __device__ unsigned long long sum_before(const LookBack& look_back, unsigned block, unsigned long long own) {
  volatile unsigned long long* states = look_back.states;
  const int lane = threadIdx.x % kWarp;
  unsigned long long before = 0;
  if (block > 0) {
    if (lane == 0) states[block] = kOwnSum | own;
    for (int64_t first = int64_t(block) - 1;; first -= kWarp) {
      const int64_t predecessor = first - lane;
      unsigned long long state = kRunningSum;  // the sum before the first block is 0
      if (predecessor >= 0) {
        do state = states[predecessor];
        while (state == 0);
      }
      const unsigned running = __ballot_sync(kAllLanes, (state & kRunningSum) != 0);
      const int last = running != 0 ? __ffs(running) - 1 : kWarp - 1;
      unsigned long long share = lane <= last ? state & kSumMask : 0;
      for (int step = kWarp / 2; step > 0; step /= 2) share += __shfl_xor_sync(kAllLanes, share, step);
      before += share;
      if (running != 0) break;
    }
  }
  if (lane == 0) states[block] = kRunningSum | (before + own);
  return before;
}

}  // namespace cuda
}  // namespace dsmoe

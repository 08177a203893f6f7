// One pass of a stable radix sort of pairs whose number only the device knows. (Onesweep, Adinets and Merrill,
// arXiv:2206.01784.) CUB's sort wants the number on the host, and so would sort culled Gaussians, and room that stayed
// empty.
//
// A block takes kSortTile pairs, ranks them by their digit, and learns by looking back how many pairs of each digit lie
// before them. It puts them in order in shared memory first, so that it writes neighbouring places.
#pragma once

#include "device.cuh"
#include "tuning.cuh"

namespace dsmoe {
namespace cuda {

template <class Key> constexpr int kSortItems = sizeof(Key) == 8 ? kSortItemsOfFloats / 2 : kSortItemsOfFloats;
template <class Key> constexpr int kSortTile = kSortBlock* kSortItems<Key>;  // pairs a block

template <class Key> struct RadixPass {
  int64_t capacity;           // pairs there are at most; where there are more, nothing is sorted
  const Key* keys;            // [capacity]
  const int32_t* values;      // [capacity]; null: value i is i, and pairs whose key is the greatest one are left out
  Key* sorted_keys;           // [capacity] written; or null
  int32_t* sorted_values;     // [capacity] written
  const uint32_t* histogram;  // [2^bits] how many pairs have each digit
  uint32_t* states;           // [blocks, 2^bits] for the look-back; zero before
  unsigned* next_block;       // [1] zero before
  int64_t* total;             // [1] how many pairs there are is written; or null
  int shift;                  // of the digit
};

// What a block's thread gets of a sum over the threads before it, in the order of threads. All threads must call it.
// warp_sums: [kSortBlock / kWarp + 1] in shared memory. Returns the sum over all threads in `total`.
inline __device__ uint32_t sum_before_thread(uint32_t own, uint32_t* warp_sums, uint32_t& total) {
  constexpr int kWarps = kSortBlock / kWarp;
  const int warp = threadIdx.x / kWarp, lane = threadIdx.x % kWarp;
  uint32_t sum = own;
#pragma unroll
  for (int step = 1; step < kWarp; step *= 2) {
    const uint32_t before = __shfl_up_sync(kAllLanes, sum, step);
    if (lane >= step) sum += before;
  }
  __syncthreads();  // of an earlier call nobody reads any more
  if (lane == kWarp - 1) warp_sums[warp] = sum;
  __syncthreads();
  uint32_t before = 0;
  total = 0;
#pragma unroll
  for (int w = 0; w < kWarps; ++w) {
    before += w < warp ? warp_sums[w] : 0;
    total += warp_sums[w];
  }
  return before + sum - own;
}

// States of the look-back hold a sum, and its kind in the two upper bits.
constexpr uint32_t kOwnCount = 1u << 30, kRunningCount = 2u << 30, kCountMask = kOwnCount - 1;

// The pairs of one digit in the blocks before this one. Reads several predecessors at a time. states: of the digit.
template <int kBins> __device__ uint32_t look_back(const volatile uint32_t* states, unsigned block) {
  constexpr int kAtOnce = 8;
  uint32_t before = 0;
  int64_t predecessor = int64_t(block) - 1;
  while (predecessor >= 0) {
    uint32_t seen[kAtOnce];
#pragma unroll
    for (int i = 0; i < kAtOnce; ++i) {
      seen[i] = predecessor >= i ? states[(predecessor - i) * kBins] : kRunningCount;
    }
#pragma unroll
    for (int i = 0; i < kAtOnce; ++i) {
      if (seen[i] == 0) break;  // not yet published: read again from here on
      before += seen[i] & kCountMask;
      if (seen[i] & kRunningCount) return before;
      --predecessor;
    }
  }
  return before;
}

template <class Key, int kBits>
__global__ void __launch_bounds__(kSortBlock, kSortBlocks)
    radix_pass_kernel(const __grid_constant__ RadixPass<Key> pass) {
  constexpr int kBins = 1 << kBits, kOwn = kBins / kSortBlock, kItems = kSortItems<Key>, kWarps = kSortBlock / kWarp;
  static_assert(kBins % kSortBlock == 0, "each thread has the same number of digits");
  __shared__ uint32_t warp_counts[kWarps][kBins];    // pairs of each digit, then those in the warps before
  __shared__ uint32_t starts[kBins], places[kBins];  // of each digit: in the block's order; what leads from there out
  __shared__ Key block_keys[kSortTile<Key>];
  __shared__ int32_t block_values[kSortTile<Key>];
  __shared__ uint32_t warp_sums[kWarps];
  __shared__ unsigned shared_block;
  const int warp = threadIdx.x / kWarp, lane = threadIdx.x % kWarp;
  if (threadIdx.x == 0) shared_block = atomicAdd(pass.next_block, 1u);
  for (int i = threadIdx.x; i < kWarps * kBins; i += kSortBlock) warp_counts[i / kBins][i % kBins] = 0;

  // Where each digit begins in the result. A thread has kOwn neighbouring digits.
  uint32_t own[kOwn], base[kOwn], sum = 0, total;
#pragma unroll
  for (int d = 0; d < kOwn; ++d) {
    base[d] = sum;
    sum += pass.histogram[threadIdx.x * kOwn + d];
  }
  const uint32_t digits_before = sum_before_thread(sum, warp_sums, total);
  const unsigned block = shared_block;
  if (block == 0 && threadIdx.x == 0 && pass.total != nullptr) *pass.total = total;
  const int64_t count = pass.values == nullptr ? pass.capacity : int64_t(total);
  if (total > pass.capacity || int64_t(block) * kSortTile<Key> >= count) return;

  // Ranks: pairs of equal digits keep their order. A warp has neighbouring pairs, 32 at a time.
  const int64_t first = int64_t(block) * kSortTile<Key> + warp * kWarp * kItems + lane;
  Key keys[kItems];
  uint32_t ranks[kItems];
  unsigned exist = 0;
#pragma unroll
  for (int i = 0; i < kItems; ++i) {
    const int64_t at = first + i * kWarp;
    keys[i] = at < count ? pass.keys[at] : Key(0);
    if (at < count && (pass.values != nullptr || keys[i] != static_cast<Key>(~Key(0)))) exist |= 1u << i;
  }
  const auto digit = [&](Key key) { return static_cast<uint32_t>(key >> pass.shift) & (kBins - 1); };
#pragma unroll
  for (int i = 0; i < kItems; ++i) {
    const bool exists = exist >> i & 1;
    const uint32_t d = digit(keys[i]);
    unsigned equal = __ballot_sync(kAllLanes, exists);
#pragma unroll
    for (int bit = 0; bit < kBits; ++bit) {
      const bool set = d >> bit & 1;
      const unsigned with = __ballot_sync(kAllLanes, set);
      equal &= set ? with : ~with;
    }
    const int before = __popc(equal & ((1u << lane) - 1));
    const uint32_t counted = warp_counts[warp][d];
    __syncwarp();
    if (exists && before == 0) warp_counts[warp][d] = counted + __popc(equal);
    __syncwarp();
    ranks[i] = counted + before;
  }
  __syncthreads();

  volatile uint32_t* states = pass.states;
  sum = 0;
#pragma unroll
  for (int d = 0; d < kOwn; ++d) {
    const int bin = threadIdx.x * kOwn + d;
    uint32_t running = 0;
#pragma unroll
    for (int w = 0; w < kWarps; ++w) {
      const uint32_t counted = warp_counts[w][bin];
      warp_counts[w][bin] = running;
      running += counted;
    }
    own[d] = running;
    states[int64_t(block) * kBins + bin] = (block > 0 ? kOwnCount : kRunningCount) | running;
    sum += running;
  }
  uint32_t in_block;
  uint32_t start = sum_before_thread(sum, warp_sums, in_block);
#pragma unroll
  for (int d = 0; d < kOwn; ++d) {
    const int bin = threadIdx.x * kOwn + d;
    uint32_t before = 0;
    if (block > 0) {
      before = look_back<kBins>(states + bin, block);
      states[int64_t(block) * kBins + bin] = kRunningCount | (before + own[d]);
    }
    starts[bin] = start;
    places[bin] = digits_before + base[d] + before - start;
    start += own[d];
  }
  __syncthreads();

#pragma unroll
  for (int i = 0; i < kItems; ++i) {
    if (!(exist >> i & 1)) continue;
    const uint32_t d = digit(keys[i]), place = starts[d] + warp_counts[warp][d] + ranks[i];
    const int64_t at = first + i * kWarp;
    block_keys[place] = keys[i];
    block_values[place] = pass.values != nullptr ? pass.values[at] : static_cast<int32_t>(at);
  }
  __syncthreads();
  for (uint32_t k = threadIdx.x; k < in_block; k += kSortBlock) {
    const Key key = block_keys[k];
    const uint32_t place = places[digit(key)] + k;
    if (pass.sorted_keys != nullptr) pass.sorted_keys[place] = key;
    pass.sorted_values[place] = block_values[k];
  }
}

// How many numbers `states` of a pass has.
template <class Key> int64_t radix_states(int64_t capacity, int bins) {
  return int64_t(blocks_for(capacity, kSortTile<Key>)) * bins;
}

template <int kBits, class Key> void launch_radix_pass(const RadixPass<Key>& pass, cudaStream_t stream) {
  radix_pass_kernel<Key, kBits><<<blocks_for(pass.capacity, kSortTile<Key>), kSortBlock, 0, stream>>>(pass);
  DSMOE_CHECK_LAUNCH("radix_pass");
}

}  // namespace cuda
}  // namespace dsmoe

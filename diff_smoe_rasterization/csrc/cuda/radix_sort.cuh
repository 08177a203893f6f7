// One pass of a stable radix sort of pairs whose number only the device knows. CUB's sort wants the number on the host,
// and so would sort culled Gaussians, and room that stayed empty.
//
//   count   a block counts the digits of its strip: neighbouring pairs
//   place   it adds up the pairs of each digit in the strips before, and writes its own behind them
//
// No block waits for another. Sums over groups of strips leave few numbers for a block to add up.
#pragma once

#include "device.cuh"
#include "tuning.cuh"

namespace dsmoe {
namespace cuda {

template <class Key> constexpr int kSortItems = sizeof(Key) == 8 ? kSortItemsOfFloats / 2 : kSortItemsOfFloats;
template <class Key> constexpr int kSortTile = kSortBlock* kSortItems<Key>;  // pairs that a block places at a time

template <class Key> struct RadixPass {
  int64_t capacity;        // pairs there is room for
  const int64_t* count;    // [1] pairs there are; if they do not fit, none is sorted. Null: as many as fit
  const Key* keys;         // [capacity]
  const int32_t* values;   // [capacity]; null: value i is i, and pairs whose key is the greatest one are left out
  Key* sorted_keys;        // [capacity] written; or null
  int32_t* sorted_values;  // [capacity] written
  int64_t* total;          // [1] written: how many pairs were sorted; or null
  uint32_t* strips;        // [num_strips, 2^bits] written: pairs of each digit in each strip
  uint32_t* groups;        // [num_groups, 2^bits] and in each group of strips; zero before
  int shift;               // of the digit
};

inline unsigned num_strips(int64_t capacity) {
  return min(blocks_for(capacity, kSortBlock), kStripsPerMultiprocessor * static_cast<unsigned>(num_multiprocessors()));
}
inline unsigned num_groups(int64_t capacity) { return blocks_for(num_strips(capacity), kStripsPerGroup); }

// A block's pairs.
struct Strip {
  int64_t begin, end;
  template <class Key> __device__ explicit Strip(const RadixPass<Key>& pass) {
    int64_t count = pass.count != nullptr ? *pass.count : pass.capacity;
    if (count > pass.capacity) count = 0;
    const int64_t rounds = (count + int64_t(gridDim.x) * kSortBlock - 1) / (int64_t(gridDim.x) * kSortBlock);
    begin = min(rounds * kSortBlock * blockIdx.x, count);
    end = min(begin + rounds * kSortBlock, count);
  }
};

template <class Key> __device__ bool takes_part(const RadixPass<Key>& pass, Key key) {
  return pass.values != nullptr || key != static_cast<Key>(~Key(0));
}

template <class Key, int kBits>
__global__ void __launch_bounds__(kSortBlock) count_digits_kernel(const __grid_constant__ RadixPass<Key> pass) {
  constexpr int kBins = 1 << kBits;
  __shared__ uint32_t counts[kBins * kDigitCopies];
  for (int i = threadIdx.x; i < kBins * kDigitCopies; i += kSortBlock) counts[i] = 0;
  __syncthreads();
  const Strip strip(pass);
  for (int64_t first = strip.begin + threadIdx.x; first < strip.end; first += kKeysAtOnce * kSortBlock) {
    Key keys[kKeysAtOnce];  // read together, so that the loads do not wait for each other
#pragma unroll
    for (int i = 0; i < kKeysAtOnce; ++i) {
      keys[i] = first + i * kSortBlock < strip.end ? pass.keys[first + i * kSortBlock] : Key(0);
    }
#pragma unroll
    for (int i = 0; i < kKeysAtOnce; ++i) {
      if (first + i * kSortBlock >= strip.end || !takes_part(pass, keys[i])) continue;
      const uint32_t digit = static_cast<uint32_t>(keys[i] >> pass.shift) & (kBins - 1);
      atomicAdd(&counts[digit * kDigitCopies + threadIdx.x % kDigitCopies], 1u);
    }
  }
  __syncthreads();
  for (int bin = threadIdx.x; bin < kBins; bin += kSortBlock) {
    uint32_t sum = 0;
    for (int c = 0; c < kDigitCopies; ++c) sum += counts[bin * kDigitCopies + c];
    pass.strips[blockIdx.x * kBins + bin] = sum;
    if (sum > 0) atomicAdd(pass.groups + blockIdx.x / kStripsPerGroup * kBins + bin, sum);
  }
}

// What a block's thread gets of a sum over the threads before it, in the order of threads. All threads must call it.
// warp_sums: [kSortBlock / kWarp] in shared memory. Returns the sum over all threads in `total`.
template <class T> __device__ T sum_before_thread(T own, T* warp_sums, T& total) {
  constexpr int kWarps = kSortBlock / kWarp;
  const int warp = threadIdx.x / kWarp, lane = threadIdx.x % kWarp;
  T sum = own;
#pragma unroll
  for (int step = 1; step < kWarp; step *= 2) {
    const T before = __shfl_up_sync(kAllLanes, sum, step);
    if (lane >= step) sum += before;
  }
  __syncthreads();  // wait until all reads of the previous call are done
  if (lane == kWarp - 1) warp_sums[warp] = sum;
  __syncthreads();
  T before = 0;
  total = 0;
#pragma unroll
  for (int w = 0; w < kWarps; ++w) {
    before += w < warp ? warp_sums[w] : 0;
    total += warp_sums[w];
  }
  return before + sum - own;
}

// Calls visit(row, number) for a column's numbers in the rows from `begin` to `end`, and with 0 for some rows behind.
template <int kColumns, class Visit>
__device__ void for_each_row(const uint32_t* column, unsigned begin, unsigned end, const Visit& visit) {
  for (unsigned first = begin; first < end; first += kRowsAtOnce) {
    uint32_t numbers[kRowsAtOnce];  // read together, so that the loads do not wait for each other
#pragma unroll
    for (unsigned i = 0; i < kRowsAtOnce; ++i) {
      numbers[i] = first + i < end ? column[(first + i) * kColumns] : 0;
    }
#pragma unroll
    for (unsigned i = 0; i < kRowsAtOnce; ++i) visit(first + i, numbers[i]);
  }
}

template <class Key, int kBits>
__global__ void __launch_bounds__(kSortBlock, kStripsPerMultiprocessor)
    place_pairs_kernel(const __grid_constant__ RadixPass<Key> pass) {
  constexpr int kBins = 1 << kBits, kOwn = kBins / kSortBlock, kItems = kSortItems<Key>, kWarps = kSortBlock / kWarp;
  static_assert(kBins % kSortBlock == 0, "each thread has the same number of digits");
  __shared__ uint32_t warp_counts[kWarps][kBins];  // pairs of each digit, then those in the warps before
  // Per digit: its first slot in the tile, and the offset from tile slot to output slot.
  __shared__ uint32_t starts[kBins], places[kBins];
  __shared__ Key tile_keys[kSortTile<Key>];
  __shared__ int32_t tile_values[kSortTile<Key>];
  __shared__ uint32_t warp_sums[kWarps];
  const int warp = threadIdx.x / kWarp, lane = threadIdx.x % kWarp;
  const Strip strip(pass);
  const bool says_total = blockIdx.x == 0 && threadIdx.x == 0 && pass.total != nullptr;
  if (strip.begin == strip.end) {
    if (says_total) *pass.total = 0;
    return;
  }

  // Where the strip's next pair of each digit goes. A thread has kOwn neighbouring digits.
  uint32_t next[kOwn] = {};
  const auto find_places = [&] {
    const unsigned group = blockIdx.x / kStripsPerGroup, groups = (gridDim.x - 1) / kStripsPerGroup + 1;
    uint32_t smaller = 0, total;
#pragma unroll
    for (int d = 0; d < kOwn; ++d) {
      const int bin = threadIdx.x * kOwn + d;
      uint32_t before = 0, all = 0;
      for_each_row<kBins>(pass.groups + bin, 0, groups, [&](unsigned g, uint32_t counted) {
        if (g < group) before += counted;
        all += counted;
      });
      for_each_row<kBins>(pass.strips + bin, group * kStripsPerGroup, blockIdx.x,
                          [&](unsigned, uint32_t counted) { before += counted; });
      next[d] = smaller + before;
      smaller += all;
    }
    const uint32_t digits_before = sum_before_thread(smaller, warp_sums, total);
#pragma unroll
    for (int d = 0; d < kOwn; ++d) next[d] += digits_before;
    if (says_total) *pass.total = total;
  };

  for (int64_t tile = strip.begin; tile < strip.end; tile += kSortTile<Key>) {
    for (int i = threadIdx.x; i < kWarps * kBins; i += kSortBlock) warp_counts[i / kBins][i % kBins] = 0;

    // Ranks: pairs of equal digits keep their order. A warp has neighbouring pairs, 32 at a time.
    const int rounds = static_cast<int>(min<int64_t>(kItems, (strip.end - tile + kSortBlock - 1) / kSortBlock));
    const int64_t first = tile + warp * kWarp * rounds + lane;
    const auto inside = [&](int i) { return i < rounds && first + i * kWarp < strip.end; };
    Key keys[kItems];
    int32_t values[kItems];
    uint32_t ranks[kItems];
    unsigned exist = 0;
#pragma unroll
    for (int i = 0; i < kItems; ++i) {
      const int64_t at = first + i * kWarp;
      keys[i] = inside(i) ? pass.keys[at] : Key(0);
      values[i] = pass.values == nullptr ? static_cast<int32_t>(at) : inside(i) ? pass.values[at] : 0;
    }
    if (tile == strip.begin) find_places();  // while the pairs are read
#pragma unroll
    for (int i = 0; i < kItems; ++i) {
      if (inside(i) && takes_part(pass, keys[i])) exist |= 1u << i;
    }
    __syncthreads();
    const auto digit = [&](Key key) { return static_cast<uint32_t>(key >> pass.shift) & (kBins - 1); };
#pragma unroll
    for (int i = 0; i < kItems; ++i) {
      if (i >= rounds) break;
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

    uint32_t own[kOwn], sum = 0;
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
      sum += running;
    }
    uint32_t in_tile, start = sum_before_thread(sum, warp_sums, in_tile);
#pragma unroll
    for (int d = 0; d < kOwn; ++d) {
      const int bin = threadIdx.x * kOwn + d;
      starts[bin] = start;
      places[bin] = next[d] - start;
      next[d] += own[d];
      start += own[d];
    }
    __syncthreads();

#pragma unroll
    for (int i = 0; i < kItems; ++i) {
      if (!(exist >> i & 1)) continue;
      const uint32_t d = digit(keys[i]), place = starts[d] + warp_counts[warp][d] + ranks[i];
      tile_keys[place] = keys[i];
      tile_values[place] = values[i];
    }
    __syncthreads();
    for (uint32_t k = threadIdx.x; k < in_tile; k += kSortBlock) {
      const Key key = tile_keys[k];
      const uint32_t place = places[digit(key)] + k;
      if (pass.sorted_keys != nullptr) pass.sorted_keys[place] = key;
      pass.sorted_values[place] = tile_values[k];
    }
    __syncthreads();  // wait until all reads of this tile are done
  }
}

template <int kBits, class Key> void launch_radix_pass(const RadixPass<Key>& pass, cudaStream_t stream) {
  const unsigned strips = num_strips(pass.capacity);
  count_digits_kernel<Key, kBits><<<strips, kSortBlock, 0, stream>>>(pass);
  DSMOE_CHECK_LAUNCH("count_digits");
  place_pairs_kernel<Key, kBits><<<strips, kSortBlock, 0, stream>>>(pass);
  DSMOE_CHECK_LAUNCH("place_pairs");
}

}  // namespace cuda
}  // namespace dsmoe

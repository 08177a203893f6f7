// The kernels of the tile lists; macro_lists.cu launches them in their order. Included there only.
#pragma once

#include "device.cuh"
#include "dsmoe/params.h"
#include "look_back.cuh"
#include "macro_tiles.cuh"
#include "radix_sort.cuh"
#include "reduce.cuh"

namespace dsmoe {
namespace cuda {
namespace {

template <class Key> constexpr int kMacroDigit = sizeof(Key) == 2 ? kShortMacroDigit : kLongMacroDigit;
template <class Key> constexpr int kMacroBins = 1 << kMacroDigit<Key>;

// How many entries the lists of macro tiles have; none if they did not fit.
struct EntryCount {
  const int64_t* listed;  // [1] how many there are
  int64_t capacity;       // there is room for
  __device__ int64_t get() const { return *listed > capacity ? 0 : *listed; }
};

template <class S, class Key> struct ListArguments {
  SavedForward<S> saved;  // projected, order and num_ordered are read
  MacroBounds<S> bounds;  // of footprints
  LookBack look_back;     // zero before
  int64_t capacity;       // entries there is room for
  int64_t* num_entries;   // [1] written: how many there are
  Key* keys;              // [capacity] written: macro tile
  int32_t* values;        // [capacity] written: Gaussian
};

template <class S, class Key>
__global__ void __launch_bounds__(kListBlock)
    list_macro_tiles_kernel(const __grid_constant__ ListArguments<S, Key> list) {
  constexpr int kPerWarp = kWarp * kListedPerLane, kPerBlock = kPerWarp * kListWarps;
  __shared__ unsigned long long warp_totals[kListWarps], shared_before;
  __shared__ unsigned shared_block;
  const int warp = threadIdx.x / kWarp, lane = threadIdx.x % kWarp;
  if (threadIdx.x == 0) shared_block = take_block_number(list.look_back);
  __syncthreads();
  const unsigned block = shared_block;
  const int64_t ordered = *list.saved.num_ordered, block_begin = int64_t(block) * kPerBlock;
  if (block > 0 && block_begin >= ordered) return;

  int32_t gaussians[kListedPerLane];
  MacroRect rects[kListedPerLane];
#pragma unroll
  for (int r = 0; r < kListedPerLane; ++r) {
    const int64_t position = block_begin + warp * kPerWarp + r * kWarp + lane;
    gaussians[r] = position < ordered ? list.saved.order[position] : -1;
  }
  unsigned long long total = 0;
#pragma unroll
  for (int r = 0; r < kListedPerLane; ++r) {
    rects[r] = {};
    if (gaussians[r] >= 0) {
      rects[r] = macro_rect_of(list.bounds, list.saved, gaussians[r]);
    }
    total += rects[r].count();
  }
  for (int step = kWarp / 2; step > 0; step /= 2) total += __shfl_xor_sync(kAllLanes, total, step);
  if (lane == 0) warp_totals[warp] = total;
  __syncthreads();
  unsigned long long before = 0, block_total = 0;
  for (int w = 0; w < kListWarps; ++w) {
    if (w < warp) before += warp_totals[w];
    block_total += warp_totals[w];
  }
  if (warp == 0) {
    const unsigned long long before_block = sum_before(list.look_back, block, block_total);
    if (lane == 0) {
      shared_before = before_block;
      if (block_begin + kPerBlock >= ordered) *list.num_entries = static_cast<int64_t>(before_block + block_total);
    }
  }
  __syncthreads();

  int64_t slot = static_cast<int64_t>(shared_before + before);
#pragma unroll 1
  for (int r = 0; r < kListedPerLane; ++r) {
    // Unrolled, because registers cannot be indexed at run time.
    int32_t gaussian = gaussians[0];
    MacroRect rect = rects[0];
#pragma unroll
    for (int i = 1; i < kListedPerLane; ++i) {
      if (i == r) gaussian = gaussians[i], rect = rects[i];
    }
    const WarpLine line(rect.count(), lane);
    for (unsigned k = lane; k - lane < line.total; k += kWarp) {
      const int owner = line.owner(k);
      const unsigned in_rect = k - from_lane(line.begin, owner);
      const uint32_t corner = from_lane(rect.corner, owner), width = from_lane(rect.size, owner) & 0xffff;
      const int32_t value = from_lane(gaussian, owner);
      if (k >= line.total) continue;
      const unsigned row = in_rect / width, column = in_rect - row * width;
      const uint32_t key = ((corner >> 16) + row) * list.bounds.grid.columns + (corner & 0xffff) + column;
      if (slot + k >= list.capacity) continue;
      list.keys[slot + k] = static_cast<Key>(key);
      list.values[slot + k] = value;
    }
    slot += line.total;
  }
}

template <class S>
__global__ void __launch_bounds__(kListBlock)
    count_macro_entries_kernel(const __grid_constant__ SavedForward<S> saved, MacroBounds<S> bounds,
                               unsigned long long* num_entries) {
  const int64_t position = int64_t(blockIdx.x) * kListBlock + threadIdx.x;
  const int32_t gaussian = position < *saved.num_ordered ? saved.order[position] : -1;
  unsigned long long count = 0;
  if (gaussian >= 0) count = macro_rect_of(bounds, saved, gaussian).count();
  count = sum_lanes(count);
  if (threadIdx.x % kWarp == 0 && count > 0) atomicAdd(num_entries, count);
}

template <class Key> struct MacroOffsetArguments {
  EntryCount entries;
  const Key* keys;   // [entries] sorted
  int64_t macros;    // macro tiles
  int64_t* offsets;  // [macros + 1] written: the first entry of each
};

// A warp searches for one macro tile: it cuts the remaining keys into 32 parts, and continues in the first part whose
// last key is not below the macro tile.
template <class Key>
__global__ void __launch_bounds__(kListBlock)
    macro_offsets_kernel(const __grid_constant__ MacroOffsetArguments<Key> arguments) {
  const int64_t macro = (int64_t(blockIdx.x) * kListBlock + threadIdx.x) / kWarp;
  const int lane = threadIdx.x % kWarp;
  if (macro > arguments.macros) return;
  int64_t low = 0, high = arguments.entries.get();
  while (low < high) {
    const int64_t part = (high - low + kWarp - 1) / kWarp, last = min(low + (lane + 1) * part, high) - 1;
    const int parts_before = __popc(__ballot_sync(kAllLanes, static_cast<int64_t>(arguments.keys[last]) < macro));
    low = min(low + parts_before * part, high);
    high = min(low + part - 1, high);
  }
  if (lane == 0) arguments.offsets[macro] = low;
}

template <class S> struct TestArguments {
  Chunks chunks;
  const int32_t* gaussians;  // [entries] of each entry
  SavedForward<S> saved;     // projected is read
  const int32_t* radii;      // [N] pixels
  BlendMode mode;            // decides the bounds of footprints
  TileGrid image, tiles;     // all tiles; the band's
  int macro_columns;
  S tail_reach;           // of BlendRules
  bool near_first;        // squares are those that near pairs meet
  uint64_t* squares;      // [entries] written: which squares the footprint meets
  uint64_t* listed;       // [entries] written: squares with any pair or tail, also if only wide pixels have it; null
                          // if these are the same
  uint32_t* tile_counts;  // [tiles] entries of each tile; zero before
};

template <class S>
__global__ void __launch_bounds__(kChunk) test_squares_kernel(const __grid_constant__ TestArguments<S> arguments) {
  __shared__ uint32_t counts[kChunk / kWarp][kTilesPerMacro];
  const Chunks& chunks = arguments.chunks;
  const int warp = threadIdx.x / kWarp, lane = threadIdx.x % kWarp;
  for (ChunkWalk chunk(chunks, lane); !chunk.is_done(); chunk.next()) {
    if (chunk.begin >= chunk.end) continue;
    const int macro_x = chunk.macro % arguments.macro_columns, macro_y = chunk.macro / arguments.macro_columns;
    const int64_t entry = chunk.begin + threadIdx.x;
    uint64_t squares = 0;
    if (entry < chunk.end) {
      const int32_t gaussian = arguments.gaussians[entry];
      const ProjectedGaussian<S> projected = arguments.saved.projected[gaussian];
      TileRect bounds = tile_bounds(arguments.mode, arguments.image, projected.mean,
                                    bounding_radius<S>(arguments.mode, arguments.radii, gaussian));
      const TileBand& band = arguments.saved.band;
      bounds = rows_in_band(bounds, band, arguments.tiles.rows);
      ProjectedGaussian<S> near = in_band(projected, band, S(0));
      if (arguments.near_first) near.squared_reach = near_reach(near.opacity, near.squared_reach);
      squares = met_squares(near, bounds, macro_x, macro_y);
      arguments.squares[entry] = squares;
      if (arguments.listed != nullptr) {
        squares |= met_squares(in_band(projected, band, arguments.tail_reach), bounds, macro_x, macro_y);
        arguments.listed[entry] = squares;
      }
    }
    const uint64_t tiles = tiles_of(squares);
    uint32_t own = 0;
#pragma unroll
    for (int t = 0; t < kTilesPerMacro; ++t) {
      const unsigned meet = __ballot_sync(kAllLanes, tiles >> first_square(t) & 1);
      if (lane == t) own = __popc(meet);
    }
    __syncthreads();  // the counts of the chunk before have been read
    if (lane < kTilesPerMacro) counts[warp][lane] = own;
    __syncthreads();
    if (threadIdx.x < kTilesPerMacro) {
      uint32_t sum = 0;
      for (int w = 0; w < kChunk / kWarp; ++w) sum += counts[w][threadIdx.x];
      chunks.counts[chunk.number * kTilesPerMacro + threadIdx.x] = sum;
      if (sum > 0) {
        const int x = macro_x * kMacroTiles + threadIdx.x % kMacroTiles;
        const int y = macro_y * kMacroTiles + threadIdx.x / kMacroTiles;
        atomicAdd(arguments.tile_counts + int64_t(y) * arguments.tiles.columns + x, sum);
      }
    }
  }
}

// Class 0 has the longest lists.
__device__ int length_class(int64_t instances) {
  return kLengthClasses - 1 - static_cast<int>(min<int64_t>(instances / kLengthClass, kLengthClasses - 1));
}

struct TileOffsetArguments {
  int64_t tiles;           // of the image
  const uint32_t* counts;  // [tiles] instances of each tile
  LookBack look_back;      // zero before
  EntryCount entries;      // of macro tiles
  int64_t* offsets;        // [tiles + 1] written
  int64_t* num_instances;  // [1] written: the room needed, the larger of the numbers of instances and of entries
  uint32_t* longer;        // [kLengthClasses] zero before; gets the number of tiles in longer classes
  int32_t* segment_queue;  // its counter is set to 0; or null
};

// Adds up the tiles before each tile, and those that come before each class of lengths.
__global__ void __launch_bounds__(kSortBlock)
    add_up_tiles_kernel(const __grid_constant__ TileOffsetArguments arguments) {
  __shared__ uint32_t classes[kLengthClasses];
  __shared__ unsigned long long warp_sums[kSortBlock / kWarp], shared_before;
  __shared__ unsigned shared_block;
  if (threadIdx.x == 0) shared_block = take_block_number(arguments.look_back);
  if (threadIdx.x < kLengthClasses) classes[threadIdx.x] = 0;
  __syncthreads();
  const unsigned block = shared_block;
  const int64_t tile = int64_t(block) * kSortBlock + threadIdx.x;
  unsigned long long total;  // 256 tiles may have more than 2^32 instances
  const unsigned long long own = tile < arguments.tiles ? arguments.counts[tile] : 0;
  if (tile < arguments.tiles) atomicAdd(&classes[length_class(static_cast<int64_t>(own))], 1u);
  const unsigned long long before = sum_before_thread(own, warp_sums, total);  // waits for the classes too
  if (threadIdx.x < kLengthClasses) {
    uint32_t longer = 0;
    for (unsigned c = 0; c < threadIdx.x; ++c) longer += classes[c];
    if (longer > 0) atomicAdd(arguments.longer + threadIdx.x, longer);
  }
  if (threadIdx.x < kWarp) {
    const unsigned long long before_block = sum_before(arguments.look_back, block, total);
    if (threadIdx.x == 0) shared_before = before_block;
  }
  __syncthreads();
  const auto offset = static_cast<int64_t>(shared_before + before);
  if (tile <= arguments.tiles) arguments.offsets[tile] = offset;
  if (tile == arguments.tiles) {
    *arguments.num_instances = max(*arguments.entries.listed, offset);
    if (arguments.segment_queue != nullptr) arguments.segment_queue[0] = 0;
  }
}

struct GiveArguments {
  Chunks chunks;
  const int32_t* gaussians;  // [entries] of each entry
  const uint64_t* squares;   // [entries] that the footprint meets
  const uint64_t* listed;    // [entries] those in whose tiles it is listed
  TileGrid tiles;
  int macro_columns;
  const int64_t* tile_offsets;   // [tiles + 1]
  const int64_t* num_instances;  // [1]
  int64_t capacity;              // of instances
  bool marked;                   // instances carry the bits of their tile's squares
  int32_t* instances;            // [capacity] written, by tile, front to back
  uint32_t* next_of_class;       // [kLengthClasses] the place in the order of its next tile
  int32_t* tile_order;           // [tiles] written
};

// If the instances do not fit, only the order of tiles is written, because the lists are then not read.
__global__ void __launch_bounds__(kChunk) give_to_tiles_kernel(const __grid_constant__ GiveArguments arguments) {
  __shared__ uint32_t counts[kChunk / kWarp][kTilesPerMacro];
  __shared__ unsigned long long begins[kTilesPerMacro];
  const int num_tiles = arguments.tiles.columns * arguments.tiles.rows;
  for (int tile = blockIdx.x * kChunk + threadIdx.x; tile < num_tiles; tile += gridDim.x * kChunk) {
    const int of_length = length_class(arguments.tile_offsets[tile + 1] - arguments.tile_offsets[tile]);
    arguments.tile_order[atomicAdd(arguments.next_of_class + of_length, 1u)] = tile;
  }
  if (*arguments.num_instances > arguments.capacity) return;
  const Chunks& chunks = arguments.chunks;
  const int warp = threadIdx.x / kWarp, lane = threadIdx.x % kWarp;
  for (ChunkWalk chunk(chunks, lane); !chunk.is_done(); chunk.next()) {
    if (chunk.begin >= chunk.end) continue;
    const int64_t entry = chunk.begin + threadIdx.x;
    const bool exists = entry < chunk.end;
    const uint64_t squares = exists ? arguments.squares[entry] : 0;
    const uint64_t tiles = tiles_of(exists ? arguments.listed[entry] : 0);
    const int32_t gaussian = exists ? arguments.gaussians[entry] : 0;

    // Where this chunk's instances of each tile begin: behind the macro tile's earlier chunks.
    __syncthreads();  // wait until all reads of the previous chunk are done
    if (threadIdx.x < kTilesPerMacro) {
      const int x = chunk.macro % arguments.macro_columns * kMacroTiles + threadIdx.x % kMacroTiles;
      const int y = chunk.macro / arguments.macro_columns * kMacroTiles + threadIdx.x / kMacroTiles;
      const bool inside = x < arguments.tiles.columns && y < arguments.tiles.rows;
      begins[threadIdx.x] = inside ? arguments.tile_offsets[int64_t(y) * arguments.tiles.columns + x] : 0;
    }
    uint32_t own = 0;
#pragma unroll
    for (int t = 0; t < kTilesPerMacro; ++t) {
      const unsigned meet = __ballot_sync(kAllLanes, tiles >> first_square(t) & 1);
      if (lane == t) own = __popc(meet);
    }
    if (lane < kTilesPerMacro) counts[warp][lane] = own;
    __syncthreads();
    unsigned long long earlier = 0;
    for (int64_t c = chunks.first_chunk(chunk.macro) + threadIdx.x / kTilesPerMacro; c < chunk.number;
         c += kChunk / kTilesPerMacro) {
      earlier += chunks.counts[c * kTilesPerMacro + threadIdx.x % kTilesPerMacro];
    }
    earlier += __shfl_xor_sync(kAllLanes, earlier, kTilesPerMacro);
    if (lane < kTilesPerMacro && earlier > 0) atomicAdd(&begins[lane], earlier);
    __syncthreads();

    unsigned long long begin = 0;  // of the warp's instances in the lane's tile
    if (lane < kTilesPerMacro) {
      begin = begins[lane];
      for (int w = 0; w < warp; ++w) begin += counts[w][lane];
    }
#pragma unroll
    for (int t = 0; t < kTilesPerMacro; ++t) {
      const bool meets = tiles >> first_square(t) & 1;
      const unsigned meet = __ballot_sync(kAllLanes, meets);
      const unsigned long long to = __shfl_sync(kAllLanes, begin, t);
      if (!meets) continue;
      const uint32_t mark = arguments.marked ? squares_of(squares, t) << kMarkShift : 0;
      arguments.instances[to + __popc(meet & ((1u << lane) - 1))] = static_cast<int32_t>(gaussian | mark);
    }
  }
}
static_assert(kWarp == 2 * kTilesPerMacro, "two halves of a warp add up each tile's earlier chunks");

}  // namespace
}  // namespace cuda
}  // namespace dsmoe

// Stage 2, the tile lists: in two steps, so that little is sorted, and each footprint is tested where its tiles are.
//
//   list    each Gaussian, in depth order, for the macro tiles of 64x64 pixels that its bounding box meets
//   sort    these entries by macro tile; one pass of a stable radix sort serves most images
//   test    for each entry, which of the macro tile's 8x8 squares of 8x8 pixels the footprint meets: 64 bits
//   give    each entry to the tiles of 16x16 pixels whose squares it meets, in order
//
// (HiGS, arXiv:2606.00352, sorts by macro tiles too, and has masks of small tiles.) An instance carries the bits of its
// tile's four squares, so that the warps of the walk do not test footprints again.
#include <limits>

#include "bands.h"
#include "device.cuh"
#include "dsmoe/params.h"
#include "look_back.cuh"
#include "macro_lists.h"
#include "radix_sort.cuh"
#include "reduce.cuh"
#include "tile_rows.cuh"

namespace dsmoe {
namespace cuda {
namespace {

constexpr int kMacroSize = 64;                       // pixels, each way
constexpr int kMacroTiles = kMacroSize / kTileSize;  // tiles, each way
constexpr int kTilesPerMacro = kMacroTiles * kMacroTiles;
constexpr int kSquares = kMacroSize / kWarpTile;  // squares of warps, each way
static_assert(kMostImageSide <= 0xffff * kMacroSize, "a MacroRect has 16 bits for each of its numbers");
static_assert(kSquares == 8 && kTileSize == 2 * kWarpTile, "a macro tile's squares are 64 bits, a tile's are four");
template <class Key> constexpr int kMacroDigit = sizeof(Key) == 2 ? kShortMacroDigit : kLongMacroDigit;
template <class Key> constexpr int kMacroBins = 1 << kMacroDigit<Key>;

// How many entries the lists of macro tiles have; none where they did not fit.
struct EntryCount {
  const int64_t* listed;  // [1] how many there are
  int64_t capacity;       // there is room for
  __device__ int64_t get() const { return *listed > capacity ? 0 : *listed; }
};

struct MacroGrid {
  int columns, rows;
  MacroGrid() = default;
  explicit MacroGrid(TileGrid tiles)
      : columns((tiles.columns - 1) / kMacroTiles + 1), rows((tiles.rows - 1) / kMacroTiles + 1) {}
  __host__ __device__ int count() const { return columns * rows; }
};

// A Gaussian as seen from the band's first row, whose footprint reaches further by `reach`.
template <class S> __device__ ProjectedGaussian<S> in_band(ProjectedGaussian<S> gaussian, TileBand band, S reach) {
  gaussian.mean.y -= S(band.begin * kTileSize);
  gaussian.squared_reach += reach;
  return gaussian;
}

// What decides for which macro tiles a Gaussian is listed.
template <class S> struct MacroBounds {
  MacroGrid grid;        // of the band
  TileGrid image;        // all its tiles
  const int32_t* radii;  // [N] pixels; null where footprints have no other bounds than their ellipse
  S tail_reach;          // of BlendRules

  MacroBounds() = default;
  explicit MacroBounds(const Frame<S>& frame)
      : grid(band_grid(frame)),
        image(frame.camera.width, frame.camera.height),
        radii(has_tails(frame.config.blend.mode) ? frame.images.radii : nullptr),
        tail_reach(frame.config.blend.tail_reach()) {}
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

// Neighbouring macro tiles, two 16-bit numbers in one.
struct MacroRect {
  uint32_t corner, size;  // columns and rows, the columns in the lower half
  __device__ unsigned count() const { return (size & 0xffff) * (size >> 16); }
};

// Tiles of the image as tiles of a band.
__device__ TileRect rows_in_band(TileRect tiles, TileBand band, int rows) {
  tiles.y0 = max(tiles.y0 - band.begin, 0), tiles.y1 = min(tiles.y1 - band.begin, rows);
  return tiles;
}

// The macro tiles of both.
__device__ MacroRect cut(MacroRect rect, TileRect tiles) {
  const int x = rect.corner & 0xffff, y = rect.corner >> 16;
  const int x0 = max(x, tiles.x0 / kMacroTiles), y0 = max(y, tiles.y0 / kMacroTiles);
  const int x1 = min(x + int(rect.size & 0xffff), (tiles.x1 - 1) / kMacroTiles + 1);
  const int y1 = min(y + int(rect.size >> 16), (tiles.y1 - 1) / kMacroTiles + 1);
  if (tiles.empty() || x0 >= x1 || y0 >= y1) return {};
  return {static_cast<uint32_t>(y0) << 16 | x0, static_cast<uint32_t>(y1 - y0) << 16 | (x1 - x0)};
}

// The macro tiles that the bounding box of a footprint meets; some of them the footprint itself may miss.
template <class S> __device__ MacroRect macro_rect(const ProjectedGaussian<S>& gaussian, MacroGrid grid) {
  if (!(gaussian.squared_reach >= S(0))) return {};
  const EllipseBand<S> ellipse(gaussian.conic, gaussian.squared_reach);
  const S size = S(kMacroSize), last = S(kMacroSize - 1);
  const Interval<S> u = ellipse.over({-gaussian.mean.y, S(grid.rows) * size - gaussian.mean.y});
  if (u.empty()) return {};
  const auto first = [&](S low, int count) { return ceil_to_int((low - last) / size, 0, count); };
  const auto behind = [&](S high, int count) { return floor_to_int(high / size + S(1), 0, count); };
  const S extent = ellipse.v_extent();
  const int x0 = first(gaussian.mean.x + u.low, grid.columns), x1 = behind(gaussian.mean.x + u.high, grid.columns);
  const int y0 = first(gaussian.mean.y - extent, grid.rows), y1 = behind(gaussian.mean.y + extent, grid.rows);
  if (x0 >= x1 || y0 >= y1) return {};
  return {static_cast<uint32_t>(y0) << 16 | x0, static_cast<uint32_t>(y1 - y0) << 16 | (x1 - x0)};
}

template <class S>
__device__ MacroRect macro_rect_of(const MacroBounds<S>& bounds, const SavedForward<S>& saved, int32_t gaussian) {
  const ProjectedGaussian<S> projected = saved.projected[gaussian];
  const MacroRect rect = macro_rect(in_band(projected, saved.band, bounds.tail_reach), bounds.grid);
  if (bounds.radii == nullptr) return rect;
  const TileRect square = radius_rect(projected.mean, S(bounds.radii[gaussian]), bounds.image);
  return cut(rect, rows_in_band(square, saved.band, bounds.grid.rows * kMacroTiles));
}

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
    // Registers are no arrays to a loop that is not unrolled.
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

// The lists of macro tiles, cut into chunks. Chunk c of a macro tile has the number floor(begin / kChunk) + m + c, with
// m the macro tile and `begin` its first entry. No two chunks share a number; some numbers have no chunk.
struct Chunks {
  const int64_t* offsets;  // [macros + 1] first entry of each macro tile
  int macros;
  uint32_t* counts;  // [chunks, kTilesPerMacro] entries that each tile gets

  __device__ int64_t first_chunk(int macro) const { return offsets[macro] / kChunk + macro; }
  __device__ int64_t end() const { return offsets[macros] / kChunk + macros; }

  // The last macro tile whose first chunk is not behind this one. A warp searches, as above.
  __device__ int macro_of(int64_t chunk, int lane) const {
    int low = 0, high = macros - 1;
    while (low < high) {
      const int part = (high - low + kWarp - 1) / kWarp;
      const bool before = first_chunk(min(low + (lane + 1) * part, high)) <= chunk;
      const int parts = __popc(__ballot_sync(kAllLanes, before));
      const int next = min(low + (parts + 1) * part, high);
      low = min(low + parts * part, high);
      high = parts == kWarp ? low : max(low, next - 1);
    }
    return low;
  }
};

// A block's share of the chunks: neighbouring ones, so that it seldom searches for their macro tile.
class ChunkWalk {
 public:
  __device__ ChunkWalk(const Chunks& chunks, int lane) : chunks_(chunks) {
    const int64_t all = chunks.end(), share = (all + gridDim.x - 1) / gridDim.x;
    number = share * blockIdx.x;
    last_ = min(number + share, all);
    if (number < last_) begin_chunk(chunks.macro_of(number, lane));
  }

  __device__ bool is_done() const { return number >= last_; }
  __device__ void next() {
    if (++number >= last_) return;
    // Each macro tile has a number at least, so that the next one is at most one macro tile ahead.
    begin_chunk(macro + (macro + 1 < chunks_.macros && chunks_.first_chunk(macro + 1) <= number));
  }

  int64_t number;      // of the chunk
  int macro;           // tile
  int64_t begin, end;  // its entries; none where the number has no chunk

 private:
  __device__ void begin_chunk(int of_macro) {
    macro = of_macro;
    begin = chunks_.offsets[macro] + (number - chunks_.first_chunk(macro)) * kChunk;
    end = min(begin + kChunk, chunks_.offsets[macro + 1]);
  }

  const Chunks& chunks_;
  int64_t last_;  // behind the block's last number
};

// Bits of the tiles that have squares, each at its tile's first square.
__device__ uint64_t tiles_of(uint64_t squares) {
  const uint64_t rows = squares | squares >> 8;
  return (rows | rows >> 1) & 0x0055005500550055ull;
}
// Where tile t of a macro tile has its first square.
__device__ constexpr int first_square(int tile) { return tile / kMacroTiles * 16 + tile % kMacroTiles * 2; }
// The four squares of tile t, row by row.
__device__ uint32_t squares_of(uint64_t squares, int tile) {
  const auto from = static_cast<uint32_t>(squares >> first_square(tile));
  return (from & 3) | (from >> 6 & 12);
}

template <class S> struct TestArguments {
  Chunks chunks;
  const int32_t* gaussians;  // [entries] of each entry
  SavedForward<S> saved;     // projected is read
  const int32_t* radii;      // [N] pixels
  BlendMode mode;            // decides the bounds of footprints
  TileGrid image, tiles;     // all tiles, and those of the band
  int macro_columns;
  S tail_reach;           // of BlendRules
  bool near_first;        // squares are those that near pairs meet
  uint64_t* squares;      // [entries] written: which squares the footprint meets
  uint64_t* listed;       // [entries] written: squares with any pair or tail, also if only wide pixels have it; null
                          // if these are the same
  uint32_t* tile_counts;  // [tiles] entries of each tile; zero before
};

// The squares of a macro tile that a footprint meets, inside bounds.
template <class S>
__device__ uint64_t met_squares(const ProjectedGaussian<S>& gaussian, TileRect bounds, int macro_x, int macro_y) {
  if (!(gaussian.squared_reach >= S(0))) return 0;
  const EllipseBand<S> ellipse(gaussian.conic, gaussian.squared_reach);
  const S x0 = gaussian.mean.x - S(macro_x * kMacroSize), y0 = gaussian.mean.y - S(macro_y * kMacroSize);
  const S size = S(kWarpTile), last = S(kWarpTile - 1);
  const auto in_macro = [](int tile, int macro) { return 2 * max(0, min(tile - macro * kMacroTiles, kMacroTiles)); };
  const int left = in_macro(bounds.x0, macro_x), right = in_macro(bounds.x1, macro_x);
  int row = floor_to_int((y0 - ellipse.v_extent()) / size, in_macro(bounds.y0, macro_y), kSquares);
  const int end = floor_to_int((y0 + ellipse.v_extent()) / size + S(1), 0, in_macro(bounds.y1, macro_y));
  uint64_t squares = 0;
  for (; row < end; ++row) {
    const S top = S(row) * size - y0;
    const Interval<S> u = ellipse.over({top, top + last});
    if (u.empty()) continue;
    const int from = ceil_to_int((x0 + u.low - last) / size, 0, kSquares);
    const int to = floor_to_int((x0 + u.high) / size + S(1), 0, kSquares);
    const int first = max(from, left), behind = min(to, right);
    if (first < behind) squares |= uint64_t((1u << behind) - (1u << first)) << (8 * row);
  }
  return squares;
}

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

    // Where this chunk's instances of each tile begin: behind those of the macro tile's earlier chunks.
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

// Number of blocks for a kernel whose blocks take piece after piece, at most `pieces`.
unsigned resident_blocks(int64_t pieces) {
  return static_cast<unsigned>(min(pieces, int64_t(kResidentBlocks) * num_multiprocessors()));
}

template <class Key, class S> void bin_by(const Frame<S>& frame, const Work& work) {
  const SavedForward<S>& saved = frame.saved;
  const cudaStream_t stream = work.stream;
  Scratch& scratch = *work.scratch;
  const TileGrid image(frame.camera.width, frame.camera.height), tiles = band_grid(frame);
  const MacroGrid grid(tiles);
  const int64_t num_tiles = int64_t(tiles.columns) * tiles.rows, macros = grid.count();
  // For each kind of list. Seldom are those of macro tiles longer, by macro tiles that long Gaussians only pass by.
  const int64_t capacity = max<int64_t>(1, min<int64_t>(saved.capacity, std::numeric_limits<uint32_t>::max()));
  const int64_t list_blocks = max<int64_t>(1, blocks_for(frame.inputs.num_gaussians, kListBlock * kListedPerLane));
  const int64_t offset_blocks = blocks_for(num_tiles + 1, kSortBlock);
  int passes = 1;
  while (int64_t(1) << (passes * kMacroDigit<Key>) < macros) ++passes;

  // What must be zero, in one piece: the states of the look-backs, each with its counter behind, and the counts.
  const int64_t of_groups = num_groups(capacity) * kMacroBins<Key>;
  const int64_t longs = (list_blocks + 1) + (offset_blocks + 1);
  const int64_t words = 2 * longs + passes * of_groups + num_tiles + kLengthClasses;
  auto* zeros = reinterpret_cast<uint32_t*>(allocate<unsigned long long>(scratch, (words + 1) / 2));
  check(cudaMemsetAsync(zeros, 0, words * sizeof(*zeros), stream), "listing instances");
  auto* list_states = reinterpret_cast<unsigned long long*>(zeros);
  auto* offset_states = list_states + list_blocks + 1;
  uint32_t* groups = zeros + 2 * longs;
  uint32_t* tile_counts = groups + passes * of_groups;
  uint32_t* longer = tile_counts + num_tiles;

  int64_t* num_entries = allocate<int64_t>(scratch, 1);
  ListArguments<S, Key> list = {};
  list.saved = saved;
  list.bounds = MacroBounds<S>(frame);
  list.look_back = {list_states, reinterpret_cast<unsigned*>(list_states + list_blocks)};
  list.capacity = capacity;
  list.num_entries = num_entries;
  list.keys = allocate<Key>(scratch, capacity);
  list.values = allocate<int32_t>(scratch, capacity);
  list_macro_tiles_kernel<<<static_cast<unsigned>(list_blocks), kListBlock, 0, stream>>>(list);
  DSMOE_CHECK_LAUNCH("list_macro_tiles");

  Key* keys[2] = {allocate<Key>(scratch, capacity), list.keys};
  int32_t* values[2] = {allocate<int32_t>(scratch, capacity), list.values};
  RadixPass<Key> pass = {};
  pass.capacity = capacity;
  pass.count = num_entries;
  pass.strips = allocate<uint32_t>(scratch, num_strips(capacity) * kMacroBins<Key>);
  pass.keys = list.keys;
  pass.values = list.values;
  for (int p = 0; p < passes; ++p) {
    pass.sorted_keys = keys[p % 2];
    pass.sorted_values = values[p % 2];
    pass.groups = groups + p * of_groups;
    pass.shift = p * kMacroDigit<Key>;
    launch_radix_pass<kMacroDigit<Key>>(pass, stream);
    pass.keys = pass.sorted_keys;
    pass.values = pass.sorted_values;
  }

  const EntryCount entries = {num_entries, capacity};
  MacroOffsetArguments<Key> offsets = {};
  offsets.entries = entries;
  offsets.keys = pass.keys;
  offsets.macros = macros;
  offsets.offsets = allocate<int64_t>(scratch, macros + 1);
  macro_offsets_kernel<<<blocks_for((macros + 1) * kWarp, kListBlock), kListBlock, 0, stream>>>(offsets);
  DSMOE_CHECK_LAUNCH("macro_offsets");

  const int64_t most_chunks = capacity / kChunk + macros;
  const Chunks chunks = {offsets.offsets, grid.count(), allocate<uint32_t>(scratch, most_chunks * kTilesPerMacro)};
  TestArguments<S> test = {};
  test.chunks = chunks;
  test.gaussians = pass.values;
  test.saved = saved;
  test.radii = frame.images.radii;
  test.mode = frame.config.blend.mode;
  test.image = image;
  test.tiles = tiles;
  test.macro_columns = grid.columns;
  test.tail_reach = list.bounds.tail_reach;
  test.squares = allocate<uint64_t>(scratch, capacity);
  test.near_first = frame.config.blend.blends_near_first();
  // Whether marks are by some of the pairs for which tiles are listed.
  const bool marks_some = has_tails(test.mode) || test.near_first;
  test.listed = marks_some ? allocate<uint64_t>(scratch, capacity) : nullptr;
  test.tile_counts = tile_counts;
  test_squares_kernel<<<resident_blocks(most_chunks), kChunk, 0, stream>>>(test);
  DSMOE_CHECK_LAUNCH("test_squares");

  TileOffsetArguments add = {};
  add.tiles = num_tiles;
  add.counts = tile_counts;
  add.look_back = {offset_states, reinterpret_cast<unsigned*>(offset_states + offset_blocks)};
  add.entries = entries;
  add.offsets = saved.tile_offsets;
  add.num_instances = saved.num_instances;
  add.longer = longer;
  add.segment_queue = saved.segment_queue;
  add_up_tiles_kernel<<<static_cast<unsigned>(offset_blocks), kSortBlock, 0, stream>>>(add);
  DSMOE_CHECK_LAUNCH("add_up_tiles");

  GiveArguments give = {};
  give.chunks = chunks;
  give.gaussians = pass.values;
  give.squares = test.squares;
  give.listed = test.listed != nullptr ? test.listed : test.squares;
  give.tiles = tiles;
  give.macro_columns = grid.columns;
  give.tile_offsets = saved.tile_offsets;
  give.num_instances = saved.num_instances;
  give.capacity = saved.capacity;
  give.marked = marks_quarters(frame.inputs.num_gaussians);
  give.instances = saved.instances;
  give.next_of_class = longer;
  give.tile_order = saved.tile_order;
  give_to_tiles_kernel<<<resident_blocks(most_chunks), kChunk, 0, stream>>>(give);
  DSMOE_CHECK_LAUNCH("give_to_tiles");
}

}  // namespace

template <class S> void count_macro_entries(const Frame<S>& frame, int64_t* num_entries, const Work& work) {
  const unsigned blocks = blocks_for(frame.inputs.num_gaussians, kListBlock);
  if (blocks == 0) return;
  count_macro_entries_kernel<S><<<blocks, kListBlock, 0, work.stream>>>(
      frame.saved, MacroBounds<S>(frame), reinterpret_cast<unsigned long long*>(num_entries));
  DSMOE_CHECK_LAUNCH("count_macro_entries");
}

template <class S> void bin_by_macro_tiles(const Frame<S>& frame, const Work& work) {
  const MacroGrid grid(band_grid(frame));
  grid.count() <= std::numeric_limits<uint16_t>::max() ? bin_by<uint16_t>(frame, work) : bin_by<uint32_t>(frame, work);
}

#define DSMOE_INSTANTIATE(S)                                                 \
  template void count_macro_entries(const Frame<S>&, int64_t*, const Work&); \
  template void bin_by_macro_tiles(const Frame<S>&, const Work&);
DSMOE_INSTANTIATE(float)
DSMOE_INSTANTIATE(double)
#undef DSMOE_INSTANTIATE

}  // namespace cuda
}  // namespace dsmoe

// The geometry of the tile lists: macro tiles of 64x64 pixels, their 8x8 squares of 8x8 pixels, and the chunks into
// which the lists of macro tiles are cut. macro_lists.cu has the kernels.
#pragma once

#include <cstdint>

#include "bands.h"
#include "tile_rows.cuh"
#include "tuning.cuh"

namespace dsmoe {
namespace cuda {

constexpr int kMacroSize = 64;                       // pixels, each way
constexpr int kMacroTiles = kMacroSize / kTileSize;  // tiles, each way
constexpr int kTilesPerMacro = kMacroTiles * kMacroTiles;
constexpr int kSquares = kMacroSize / kWarpTile;  // squares of warps, each way
static_assert(kMostImageSide <= 0xffff * kMacroSize, "a MacroRect has 16 bits for each of its numbers");
static_assert(kSquares == 8 && kTileSize == 2 * kWarpTile, "a macro tile's squares are 64 bits, a tile's are four");

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
  const int32_t* radii;  // [N] pixels; null if footprints have no other bounds than their ellipse
  S tail_reach;          // of BlendRules

  MacroBounds() = default;
  explicit MacroBounds(const Frame<S>& frame)
      : grid(band_grid(frame)),
        image(frame.camera.width, frame.camera.height),
        radii(has_tails(frame.config.blend.mode) ? frame.images.radii : nullptr),
        tail_reach(frame.config.blend.tail_reach()) {}
};

// Neighbouring macro tiles, two 16-bit numbers in one.
struct MacroRect {
  uint32_t corner, size;  // columns and rows, the columns in the lower half
  __device__ unsigned count() const { return (size & 0xffff) * (size >> 16); }
};

// Tiles of the image as tiles of a band.
inline __device__ TileRect rows_in_band(TileRect tiles, TileBand band, int rows) {
  tiles.y0 = max(tiles.y0 - band.begin, 0), tiles.y1 = min(tiles.y1 - band.begin, rows);
  return tiles;
}

// The macro tiles of both.
inline __device__ MacroRect cut(MacroRect rect, TileRect tiles) {
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
  int64_t begin, end;  // its entries; none if the number has no chunk

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
inline __device__ uint64_t tiles_of(uint64_t squares) {
  const uint64_t rows = squares | squares >> 8;
  return (rows | rows >> 1) & 0x0055005500550055ull;
}
// Where tile t of a macro tile has its first square.
__device__ constexpr int first_square(int tile) { return tile / kMacroTiles * 16 + tile % kMacroTiles * 2; }
// The four squares of tile t, row by row.
inline __device__ uint32_t squares_of(uint64_t squares, int tile) {
  const auto from = static_cast<uint32_t>(squares >> first_square(tile));
  return (from & 3) | (from >> 6 & 12);
}

}  // namespace cuda
}  // namespace dsmoe

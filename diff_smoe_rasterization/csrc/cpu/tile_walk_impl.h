// The walk over a tile: Gaussians in list order, then strips of pixels (one SIMD pack wide) and the rows of each strip.
// Forward, backward and contributions are visitors of it. Included once per instruction set, after pack.h.
#pragma once

#include "../dispatch.h"
#include "dsmoe/features.h"
#include "dsmoe/tiles.h"
#include "pack.h"
#include "tile_kernels.h"

namespace dsmoe {
namespace cpu {
namespace DSMOE_SIMD {

template <class S> using Pack = ::dsmoe::DSMOE_SIMD::Pack<S>;

// One number per pixel of the tile, strip by strip, each strip's rows one below the other.
template <class S> struct PixelArray {
  S* values;

  DSMOE_HD S* at(int strip, int row) const { return values + (strip * kTileSize + row) * Pack<S>::kLanes; }
  DSMOE_HD Pack<S> load(int strip, int row) const { return Pack<S>::load(at(strip, row)); }
  DSMOE_HD void store(int strip, int row, Pack<S> value) const { value.store(at(strip, row)); }
  DSMOE_HD S& pixel(int x, int y) const { return at(x / Pack<S>::kLanes, y)[x % Pack<S>::kLanes]; }
};

template <class S> constexpr int kStrips = kTileSize / Pack<S>::kLanes;

// A Gaussian's rows are found for the tile's whole width: where that is one strip, each of them holds pixels.
template <class S> constexpr bool kRowsAreExact = kStrips<S> == 1;

// Hands out PixelArrays one after the other.
template <class S> struct Scratch {
  S* next;
  DSMOE_HD PixelArray<S> pixels() {
    S* values = next;
    next += kTilePixels;
    return {values};
  }
};

// The part of the tile that lies on the image.
struct TileExtent {
  int x0, y0, columns, rows;
  template <class S>
  DSMOE_HD explicit TileExtent(const Tile<S>& tile)
      : x0(tile.x * kTileSize),
        y0(tile.y * kTileSize),
        columns(min(kTileSize, tile.width - x0)),
        rows(min(kTileSize, tile.height - y0)) {}

  // Calls body(x, y, index into an [H, W] image).
  template <class Body> DSMOE_HD void for_each_pixel(int width, Body body) const {
    for (int y = 0; y < rows; ++y) {
      for (int x = 0; x < columns; ++x) body(x, y, static_cast<int64_t>(y0 + y) * width + x0 + x);
    }
  }
};

// The rows of the tile that a Gaussian's footprint meets.
struct RowRange {
  int begin, end;
};

template <class S> DSMOE_HD RowRange rows_of(const ProjectedGaussian<S>& gaussian, const TileExtent& extent) {
  // EllipseBand gives u over a band of v; with x and y exchanged, y over the tile's columns.
  const Sym2<S> exchanged = {gaussian.conic.yy, gaussian.conic.xy, gaussian.conic.xx};
  const S left = S(extent.x0) - gaussian.mean.x, top = gaussian.mean.y - S(extent.y0);
  const auto y = EllipseBand<S>(exchanged, gaussian.squared_reach).over({left, left + S(extent.columns - 1)});
  if (y.empty()) return {0, 0};
  return {ceil_to_int(top + y.low, 0, extent.rows), floor_to_int(top + y.high + S(1), 0, extent.rows)};
}

// No pair of the Gaussian has an exponent below this.
template <class S> DSMOE_HD S least_power(const ProjectedGaussian<S>& gaussian) {
  return S(-0.5) * (gaussian.squared_reach * S(1 + kFootprintSlack) + S(kFootprintSlack));
}

constexpr int64_t kPrefetchDistance = 8;  // instances; the Gaussians of a list lie anywhere in memory

template <class S>
DSMOE_HD void prefetch_gaussian(const SavedForward<S>& saved, const TileInstance& instance, int num_features) {
  __builtin_prefetch(saved.projected + instance.gaussian);
  __builtin_prefetch(saved.features + static_cast<int64_t>(instance.gaussian) * num_features);
}

// A Gaussian of the list.
template <class S> struct ListedGaussian {
  const ProjectedGaussian<S>& projected;
  const S* features;  // [F]
  uint32_t slot;
  S position;  // in the list, from 0
};

// Visits the pairs of the instances [begin, end), and returns how many pairs had their exponent evaluated. A visitor
// has:
//   kMode, kBackToFront   how pairs are cut, and the direction
//   done()                whether no more Gaussians are wanted
//   begin(gaussian)       then, for each strip and the rows of it that the footprint meets:
//     begin_strip()
//     wants(strip, row)   whether pairs of these pixels are wanted
//     take(strip, row, gate, dx, dy)   a pack of pairs; (dx, dy): pixel - mean
//     end_strip(dx)
//   end(gaussian)
template <class S, class Visitor>
DSMOE_HD int64_t walk_tile(const Tile<S>& tile, int64_t begin, int64_t end, int num_features, Visitor& visitor) {
  using P = Pack<S>;
  const TileExtent extent(tile);
  const AlphaCut<S> cut = tile.config.alpha_cut();
  int64_t pairs = 0;
  for (int64_t k = 0; k < end - begin && !visitor.done(); ++k) {
    const int64_t i = Visitor::kBackToFront ? end - 1 - k : begin + k;
    const int64_t ahead =
        Visitor::kBackToFront ? max(i - kPrefetchDistance, begin) : min(i + kPrefetchDistance, end - 1);
    prefetch_gaussian(tile.saved, tile.saved.instances[ahead], num_features);
    const TileInstance& instance = tile.saved.instances[i];
    const ListedGaussian<S> listed = {tile.saved.projected[instance.gaussian],
                                      tile.saved.features + static_cast<int64_t>(instance.gaussian) * num_features,
                                      instance.slot, S(i - tile.begin)};
    const ProjectedGaussian<S>& gaussian = listed.projected;
    const RowRange rows = rows_of(gaussian, extent);
    const S faintest = least_power(gaussian), least_alpha = cut.of(gaussian.opacity);
    visitor.begin(listed);
    for (int strip = 0; strip < kStrips<S>; ++strip) {
      const P dx = P::iota() + P(S(extent.x0 + strip * P::kLanes) - gaussian.mean.x);
      const ColumnExponent<P, S> exponent(gaussian.conic, dx);
      visitor.begin_strip();
      for (int row = rows.begin; row < rows.end; ++row) {
        if (!visitor.wants(strip, row)) continue;
        pairs += P::kLanes;
        const S dy = S(extent.y0 + row) - gaussian.mean.y;
        const P power = exponent.at(dy);
        if (!kRowsAreExact<S> && !any(power >= P(faintest))) continue;
        visitor.take(strip, row, evaluate_gate<Visitor::kMode>(power, gaussian.opacity, least_alpha), dx, dy);
      }
      visitor.end_strip(dx);
    }
    visitor.end(listed);
  }
  return pairs;
}

}  // namespace DSMOE_SIMD
}  // namespace cpu
}  // namespace dsmoe

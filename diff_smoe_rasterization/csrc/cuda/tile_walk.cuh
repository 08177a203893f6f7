// The tile walk: how a warp goes through the list of a tile. Every pass over pixels is a visitor of it.
//
// A warp owns a square of pixels, a quarter of a tile; each lane owns two of them, one below the other, so that they
// share a Gaussian's terms in x. (HiGS, arXiv:2606.00352, also has small squares for warps inside larger tiles.)
// The warp takes 32 entries of the list at a time, one a lane:
//
//   prefetch  each lane loads its entry of the next chunk, while the current one is visited
//   ballot    each lane tests the footprint of its entry against the warp's pixels
//   stage     the entries that meet them go to shared memory
//   visit     all lanes read the staged entries one after the other, and the visitor does the work of its pass
//
// Warps do not wait for each other.
#pragma once

#include "device.cuh"
#include "dsmoe/features.h"
#include "tile_rows.cuh"
#include "tuning.cuh"

namespace dsmoe {
namespace cuda {

// What every walk needs to know of a rendering.
template <class S> struct BlendArguments {
  int64_t num_gaussians;      // N
  int width, height;          // of the image, pixels
  int tile_columns;           // tiles side by side
  RasterConfig<S> config;     // mode, features, background
  SavedForward<S> saved;      // what the forward pass leaves, and reads itself
  ImageOutputs<S> images;     // [features, H, W], and the radii [N]
  unsigned long long* pairs;  // [1] (Gaussian, pixel) pairs that were evaluated are added to it, or null
};

template <class S> BlendArguments<S> blend_arguments(const Frame<S>& frame, const Work& work) {
  BlendArguments<S> arguments = {};
  arguments.num_gaussians = frame.inputs.num_gaussians;
  arguments.width = frame.camera.width;
  arguments.height = frame.camera.height;
  arguments.tile_columns = TileGrid(frame.camera.width, frame.camera.height).columns;
  arguments.config = frame.config;
  arguments.saved = frame.saved;
  arguments.images = frame.images;
  arguments.pairs = work.pairs;
  return arguments;
}

// Where a tile's walk gets its entries: from the list of the tile, or, where the instances outgrew their memory, from
// the depth order of all Gaussians. Both lead front to back.
template <class S> class EntrySource {
 public:
  EntrySource() = default;
  __device__ EntrySource(const BlendArguments<S>& arguments, int tile) {
    const SavedForward<S>& saved = arguments.saved;
    listed = !overflows(saved);
    begin = listed ? saved.tile_offsets[tile] : 0;
    length = static_cast<int32_t>(listed ? saved.tile_offsets[tile + 1] - begin : arguments.num_gaussians);
    entries_ = listed ? saved.instances + begin : saved.order;
  }

  // The Gaussian of an entry. Below 0 for a culled one, which only the depth order has.
  __device__ int32_t gaussian(int32_t position) const { return entries_[position]; }

  bool listed;     // the entries are the tile's list; else the depth order, which knows nothing of tiles
  int64_t begin;   // the list's first instance
  int32_t length;  // entries

 private:
  const int32_t* entries_;  // [length]
};

// The pixels of a warp, and the entries that may meet them.
template <class S> class WarpTile {
 public:
  __device__ explicit WarpTile(const BlendArguments<S>& arguments)
      : WarpTile(arguments, blockIdx.x, threadIdx.x / kWarp) {}

  __device__ WarpTile(const BlendArguments<S>& arguments, int tile, int quarter) : quarter(quarter) {
    lane = threadIdx.x % kWarp;
    index = tile;
    tile_x = tile % arguments.tile_columns, tile_y = arguments.saved.band.begin + tile / arguments.tile_columns;
    constexpr int kAcross = kTileSize / kWarpTile;
    const int x0 = tile_x * kTileSize + quarter % kAcross * kWarpTile;
    const int y0 = tile_y * kTileSize + quarter / kAcross * kWarpTile;
    x = x0 + lane % kWarpTile, y = y0 + lane / kWarpTile;
    empty = x0 >= arguments.width || y0 >= arguments.height;
    rect = {S(x0), S(y0), S(min(x0 + kWarpTile, arguments.width) - 1), S(min(y0 + kWarpTile, arguments.height) - 1)};
    source = EntrySource<S>(arguments, tile);
  }

  __device__ bool inside(const BlendArguments<S>& arguments, int k) const {
    return x < arguments.width && y + k * kLaneStep < arguments.height;
  }
  __device__ int64_t pixel_index(const BlendArguments<S>& arguments, int k) const {
    return int64_t(y + k * kLaneStep) * arguments.width + x;
  }

  int quarter;  // of the tile, row by row
  int lane;
  int index;           // of the tile in the band
  int tile_x, tile_y;  // of the tile, in tiles
  int x, y;            // of the lane's first pixel
  bool empty;          // no pixel of the warp lies in the image
  PixelRect<S> rect;   // the warp's pixels in the image
  EntrySource<S> source;
};

// A Gaussian that meets the warp's pixels.
template <class S, bool kWithFeatures> struct alignas(16) StagedGaussian {
  ProjectedGaussian<S> gaussian;
  S features[kFeatureChunk];
};
template <class S> struct alignas(16) StagedGaussian<S, false> { ProjectedGaussian<S> gaussian; };

// Where a warp stages what it visits, in shared memory.
template <class S, class Visitor> struct WarpStage {
  StagedGaussian<S, Visitor::kReadsFeatures>* gaussians;  // [32]
  int32_t* indices;                                       // [32] of the Gaussians; null where the visitor reads none
};

// The part of a list that a warp walks.
struct WalkRange {
  int32_t begin, end;     // entries of the list, half-open
  int first_feature = 0;  // the kFeatureChunk features from here on come along, where the visitor reads features
};

// One entry of a list, as its lane loads it.
template <class S, bool kWithFeatures> struct ListEntry {
  StagedGaussian<S, kWithFeatures> staged;
  int32_t gaussian;
  bool valid;
};

// Positions behind the end of the walk give an entry that is not valid.
template <class Visitor, class S>
__device__ auto load_entry(const Visitor& visitor, int32_t position, const WalkRange& range) {
  const BlendArguments<S>& arguments = visitor.arguments;
  const WarpTile<S>& tile = visitor.tile;
  const SavedForward<S>& saved = arguments.saved;
  ListEntry<S, Visitor::kReadsFeatures> entry;
  entry.valid = Visitor::kBackToFront ? position >= range.begin : position < range.end;
  if (!entry.valid) return entry;
  entry.gaussian = tile.source.gaussian(position);
  entry.valid = entry.gaussian >= 0;
  if (!entry.valid) return entry;
  entry.staged.gaussian = saved.projected[entry.gaussian];
  if constexpr (Visitor::kReadsFeatures) {
    const S* features = saved.features + int64_t(entry.gaussian) * feature_stride(arguments.config.num_features());
    struct alignas(16) Chunk {
      S values[kFeatureChunk];
    };
    *reinterpret_cast<Chunk*>(entry.staged.features) = *reinterpret_cast<const Chunk*>(features + range.first_feature);
  }
  if (!tile.source.listed) {
    const BlendMode mode = arguments.config.mode;
    const TileRect bounds = tile_bounds(mode, TileGrid(arguments.width, arguments.height), entry.staged.gaussian.mean,
                                        bounding_radius<S>(mode, arguments.images.radii, entry.gaussian));
    entry.valid =
        bounds.x0 <= tile.tile_x && tile.tile_x < bounds.x1 && bounds.y0 <= tile.tile_y && tile.tile_y < bounds.y1;
  }
  return entry;
}

template <class S, bool kWithFeatures>
__device__ bool meets_pixels(const ListEntry<S, kWithFeatures>& entry, const WarpTile<S>& tile) {
  const auto& gaussian = entry.staged.gaussian;
  return entry.valid && may_meet(gaussian.conic, gaussian.mean, gaussian.squared_reach, tile.rect);
}

// The walk itself. Returns how many entries met the warp's pixels. A visitor has
//
//   kBackToFront, kStopsEarly, kReadsFeatures, kReadsIndices   what it wants of the walk, static
//   arguments, tile                                   the rendering, and the warp's place in it
//   begin_chunk(position)                             called before the chunk whose first entry is at `position`
//   visit(stage, j, position)                         entry j of the stage, at `position` of the list, for all lanes
//   is_done()                                         the walk may end; called behind each chunk
template <class S, class Visitor>
__device__ __forceinline__ unsigned walk_tile(const WarpStage<S, Visitor>& stage, const WalkRange& range,
                                              Visitor& visitor) {
  const auto at = [](int32_t chunk, int j) { return Visitor::kBackToFront ? chunk - j : chunk + j; };
  const auto load = [&](int32_t position) { return load_entry<Visitor, S>(visitor, position, range); };
  const int lane = visitor.tile.lane;
  unsigned met = 0;
  int32_t chunk = Visitor::kBackToFront ? range.end - 1 : range.begin;
  auto next = load(at(chunk, lane));
  for (; Visitor::kBackToFront ? chunk >= range.begin : chunk < range.end; chunk = at(chunk, kWarp)) {
    visitor.begin_chunk(chunk);
    const bool meets = meets_pixels(next, visitor.tile);
    if (meets) {
      stage.gaussians[lane] = next.staged;
      if constexpr (Visitor::kReadsIndices) stage.indices[lane] = next.gaussian;
    }
    unsigned left = __ballot_sync(kAllLanes, meets);
    __syncwarp();
    next = load(at(at(chunk, kWarp), lane));
    met += __popc(left);
    for (; left != 0; left &= left - 1) {
      const int j = __ffs(left) - 1;
      visitor.visit(stage, j, at(chunk, j));
    }
    __syncwarp();
    if constexpr (Visitor::kStopsEarly) {
      if (visitor.is_done()) break;
    }
  }
  return met;
}

// Adds the pairs of the entries that a warp has met to the count of the rendering.
template <class S> __device__ void count_pairs(const BlendArguments<S>& arguments, int lane, unsigned met) {
  if (arguments.pairs != nullptr && lane == 0) {
    atomicAdd(arguments.pairs, static_cast<unsigned long long>(met) * (kWarpTile * kWarpTile));
  }
}

}  // namespace cuda
}  // namespace dsmoe

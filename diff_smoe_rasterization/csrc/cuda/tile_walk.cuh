// How a warp walks a tile's list. A warp owns 8x8 pixels, a quarter of a tile: each lane two of them, one below the
// other, so that a Gaussian's terms in x are shared. It takes 32 instances at a time, one a lane, tests each footprint
// against its pixels, and stages those that meet them in shared memory, for all lanes to read. Warps do not wait for
// each other.
#pragma once

#include "device.cuh"
#include "dsmoe/features.h"
#include "tile_rows.cuh"

namespace dsmoe {
namespace cuda {

constexpr int kWarpTile = 8;  // pixels, each way
constexpr int kWarpsPerTile = (kTileSize / kWarpTile) * (kTileSize / kWarpTile);
constexpr int kLanePixels = kWarpTile * kWarpTile / kWarp;  // one below the other
constexpr int kLaneStep = kWarpTile / kLanePixels;          // rows between them
constexpr int kFeatureChunk = 4;                            // features that load as one vector
static_assert(kWarpsPerTile == kSlotsPerInstance, "each quarter of a tile has its slot");

template <class S> struct BlendArguments {
  int64_t num_gaussians;
  int width, height;
  int tile_columns;
  RasterConfig<S> config;
  SavedForward<S> saved;
  ImageOutputs<S> images;
  unsigned long long* pairs;
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

// A Gaussian that meets the warp's pixels.
template <class S> struct alignas(16) StagedGaussian {
  ProjectedGaussian<S> gaussian;
  S features[kFeatureChunk];
};

template <class S> class WarpTile {
 public:
  __device__ explicit WarpTile(const BlendArguments<S>& arguments)
      : WarpTile(arguments, blockIdx.x, threadIdx.x / kWarp) {}

  __device__ WarpTile(const BlendArguments<S>& arguments, int tile, int quarter) : quarter(quarter) {
    lane = threadIdx.x % kWarp;
    tile_x = tile % arguments.tile_columns, tile_y = tile / arguments.tile_columns;
    constexpr int kAcross = kTileSize / kWarpTile;
    const int x0 = tile_x * kTileSize + quarter % kAcross * kWarpTile;
    const int y0 = tile_y * kTileSize + quarter / kAcross * kWarpTile;
    x = x0 + lane % kWarpTile, y = y0 + lane / kWarpTile;
    empty = x0 >= arguments.width || y0 >= arguments.height;
    rect = {S(x0), S(y0), S(min(x0 + kWarpTile, arguments.width) - 1), S(min(y0 + kWarpTile, arguments.height) - 1)};
    const SavedForward<S>& saved = arguments.saved;
    listed = !overflows(saved);
    begin = listed ? saved.tile_offsets[tile] : 0;
    length = static_cast<int32_t>(listed ? saved.tile_offsets[tile + 1] - begin : arguments.num_gaussians);
    list = listed ? saved.instances + begin * saved.instance_width : saved.order;
    stride = listed ? saved.instance_width : 1;
  }

  __device__ bool inside(const BlendArguments<S>& arguments, int k) const {
    return x < arguments.width && y + k * kLaneStep < arguments.height;
  }
  __device__ int64_t pixel_index(const BlendArguments<S>& arguments, int k) const {
    return int64_t(y + k * kLaneStep) * arguments.width + x;
  }

  int quarter;
  int lane, tile_x, tile_y;
  int x, y;  // of the lane's first pixel
  bool empty;
  PixelRect<S> rect;    // the warp's pixels
  bool listed;          // the tile has a list; else the depth order serves
  int64_t begin;        // the list's first instance
  const int32_t* list;  // Gaussians, front to back
  int stride;           // numbers an entry
  int32_t length;
};

// One entry of a list, as its lane loads it.
template <class S> struct ListEntry {
  StagedGaussian<S> staged;
  int32_t gaussian;
  bool valid;
};

// Four features from `first_feature` on come along, where the kernel has a use for them. Entries in front of `first`
// are not wanted.
template <bool kWithFeatures = true, class S>
__device__ ListEntry<S> load_entry(const BlendArguments<S>& arguments, const WarpTile<S>& tile, int32_t position,
                                   int first_feature, int32_t first = 0) {
  const SavedForward<S>& saved = arguments.saved;
  ListEntry<S> entry;
  entry.valid = first <= position && position < tile.length;
  if (!entry.valid) return entry;
  entry.gaussian = tile.list[int64_t(position) * tile.stride];
  entry.valid = entry.gaussian >= 0;  // the depth order has culled Gaussians too, below 0
  if (!entry.valid) return entry;
  entry.staged.gaussian = saved.projected[entry.gaussian];
  if constexpr (kWithFeatures) {
    const S* features = saved.features + int64_t(entry.gaussian) * feature_stride(arguments.config.num_features());
    struct alignas(16) Chunk {
      S values[kFeatureChunk];
    };
    *reinterpret_cast<Chunk*>(entry.staged.features) = *reinterpret_cast<const Chunk*>(features + first_feature);
  }
  if (!tile.listed) {  // the entries of the depth order know nothing of tiles
    const TileRect bounds = footprint_bounds(arguments.config.mode, arguments.width, arguments.height,
                                             entry.staged.gaussian.mean, arguments.images.radii, entry.gaussian);
    entry.valid =
        bounds.x0 <= tile.tile_x && tile.tile_x < bounds.x1 && bounds.y0 <= tile.tile_y && tile.tile_y < bounds.y1;
  }
  return entry;
}

template <class S> __device__ bool meets_pixels(const ListEntry<S>& entry, const WarpTile<S>& tile) {
  const auto& gaussian = entry.staged.gaussian;
  return entry.valid && may_meet(gaussian.conic, gaussian.mean, gaussian.squared_reach, tile.rect);
}

}  // namespace cuda
}  // namespace dsmoe

// Long lists in segments. The forward pass notes each pixel's state where a segment begins, so that a later pass can
// give every segment to a warp of its own. Otherwise the warp with the longest list would decide how long the pass
// takes. (Taming 3DGS, arXiv:2406.15643, notes such states every 32 Gaussians, and gives those to a warp.)
//
// Segment s of a tile holds entries [s L, (s + 1) L) of its list, where L is kSegmentLength. A tile's first segment
// needs no state. The state of any other lies in row floor(begin / L) + s, with `begin` the tile's first instance. No
// two segments share a row: a tile's last row is at most floor(end / L), and the next tile's first row is above that.
#pragma once

#include "tile_walk.cuh"

namespace dsmoe {
namespace cuda {

static_assert(kSegmentLength % kWarp == 0, "a segment is a number of whole chunks");

// The state of one pixel where a segment begins.
template <class S> struct alignas(4 * sizeof(S)) SegmentPixel {
  S transmittance;        // in front of the segment
  S sums[kFastFeatures];  // sum w c behind there; until the walk has reached the list's end, sum w c in front of it
};

// The state of the lane's pixel k in segment 1, 2, ... of its tile.
template <class S>
__device__ SegmentPixel<S>& segment_pixel(const SavedForward<S>& saved, const WarpTile<S>& tile, int segment, int k) {
  const int64_t row = tile.source.begin / kSegmentLength + segment;
  const int pixel = (tile.quarter * kLanePixels + k) * kWarp + tile.lane;
  return reinterpret_cast<SegmentPixel<S>*>(saved.segments)[row * (kTileSize * kTileSize) + pixel];
}

// Which kernels can walk segments.
template <class S, BlendMode kMode, int kFeatures>
constexpr bool kWalksSegments = sizeof(S) == sizeof(float) && (kFeatures == kFastFeatures) && kResumes<kMode>;

template <class S> __device__ bool has_segments(const SavedForward<S>& saved, const WarpTile<S>& tile) {
  return saved.segments != nullptr && tile.source.listed && tile.source.length > kSegmentLength;
}

// The segments that some pixel of a square has reached, in any order. Entry 0 holds their number.
struct SegmentQueue {
  int2* entries;  // (tile and quarter, segment)

  __device__ void push(int tile, int quarter, int segment) const {
    entries[1 + atomicAdd(&entries[0].x, 1)] = make_int2(tile * kWarpsPerTile + quarter, segment);
  }
};
template <class S> __device__ SegmentQueue segment_queue(const SavedForward<S>& saved) {
  return {reinterpret_cast<int2*>(saved.segment_queue)};
}

// What a warp of such a pass walks: a quarter of a tile, in one segment.
struct WarpSegment {
  int tile, quarter, segment;
};

// The first blocks take the queue, one entry a warp, because nearly all of its segments are full. The later blocks take
// the first segment of one tile each, the longest lists first.
template <class S> __device__ int queue_blocks(const SavedForward<S>& saved) {
  return saved.segments != nullptr ? (segment_queue(saved).entries[0].x + kWarpsPerTile - 1) / kWarpsPerTile : 0;
}

// Whether no warp of the block has work.
template <class S> __device__ bool is_idle_block(const SavedForward<S>& saved, int tiles) {
  return int(blockIdx.x) >= queue_blocks(saved) + tiles;
}

// For a block that is not idle. Tile -1: the queue has no entry for the warp.
template <class S> __device__ WarpSegment segment_of_warp(const SavedForward<S>& saved) {
  const int block = blockIdx.x, warp = threadIdx.x / kWarp, behind = block - queue_blocks(saved);
  if (behind >= 0) return {saved.tile_order[behind], warp, 0};
  const int2* entries = segment_queue(saved).entries;
  const int i = block * kWarpsPerTile + warp;
  if (i >= entries[0].x) return {-1, 0, 0};
  const int2 entry = entries[1 + i];
  return {entry.x / kWarpsPerTile, entry.x % kWarpsPerTile, entry.y};
}

}  // namespace cuda
}  // namespace dsmoe

// The rows of tiles that the Gaussians of a warp meet, dealt out evenly to its lanes, however many each Gaussian has.
#pragma once

#include <cstring>

#include "device.cuh"
#include "dsmoe/params.h"
#include "dsmoe/project.h"

namespace dsmoe {
namespace cuda {

// The tiles that may hold pairs of a Gaussian; radii: [N].
template <class S>
__device__ TileRect footprint_bounds(BlendMode mode, int width, int height, Vec2<S> mean, const int32_t* radii,
                                     int32_t gaussian) {
  Camera<S> camera;
  camera.width = width, camera.height = height;
  return tile_bounds(mode, camera, mean, is_smoe(mode) ? S(0) : S(radii[gaussian]));
}

// What `lane` has, word by word.
template <class T> __device__ T from_lane(const T& value, int lane) {
  constexpr int kWords = sizeof(T) / sizeof(unsigned);
  static_assert(sizeof(T) == kWords * sizeof(unsigned), "whole words");
  unsigned words[kWords];
  memcpy(words, &value, sizeof(T));
#pragma unroll
  for (int k = 0; k < kWords; ++k) words[k] = __shfl_sync(kAllLanes, words[k], lane);
  T result = value;
  memcpy(&result, words, sizeof(T));
  return result;
}

// Items of all lanes in one line, lane by lane: where each lane's items begin, and how many there are.
class WarpLine {
 public:
  __device__ WarpLine(unsigned items, int lane) {
    unsigned sum = items;
#pragma unroll
    for (int step = 1; step < kWarp; step *= 2) {
      const unsigned before = __shfl_up_sync(kAllLanes, sum, step);
      if (lane >= step) sum += before;
    }
    begin = sum - items;
    total = __shfl_sync(kAllLanes, sum, kWarp - 1);
  }

  // The lane that has item k: the last one that begins at k or before. Any lane where k is beyond the items.
  __device__ int owner(unsigned k) const {
    int lane = 0;
#pragma unroll
    for (int step = kWarp / 2; step > 0; step /= 2) {
      if (__shfl_sync(kAllLanes, begin, lane + step) <= k) lane += step;
    }
    return lane;
  }

  unsigned begin, total;
};

// Tiles side by side that one Gaussian meets.
struct alignas(16) TileRow {
  uint32_t tile;  // the first
  int32_t width;  // how many
  int32_t gaussian;
  int32_t ends;  // of the Gaussian's rows: kFirstRow, kLastRow, both or none
};
constexpr int32_t kFirstRow = 1, kLastRow = 2;

template <class S> class WarpTileRows {
 public:
  // The lane's own Gaussian; no rows where its reach is negative.
  __device__ WarpTileRows(int32_t gaussian, const ProjectedGaussian<S>& projected, TileRect bounds, int columns,
                          int lane)
      : tiles_(projected.conic, projected.mean, projected.squared_reach, bounds),
        gaussian_(gaussian),
        columns_(columns),
        line_(max(0, tiles_.end() - tiles_.begin()), lane) {}

  __device__ unsigned total() const { return line_.total; }
  __device__ bool lane_has_none() const { return tiles_.end() <= tiles_.begin(); }

  // Row k of all; all lanes take part.
  __device__ TileRow at(unsigned k) const {
    const int owner = line_.owner(k);
    const unsigned row = k - from_lane(line_.begin, owner);
    const int32_t gaussian = from_lane(gaussian_, owner);
    const FootprintTiles<S> tiles = from_lane(tiles_, owner);
    if (k >= line_.total) return {};
    const int y = tiles.begin() + static_cast<int>(row);
    const auto span = tiles.row(y);
    const int32_t ends = (row == 0 ? kFirstRow : 0) | (y + 1 == tiles.end() ? kLastRow : 0);
    return {static_cast<uint32_t>(y) * columns_ + span.x0, max(0, span.x1 - span.x0), gaussian, ends};
  }

 private:
  FootprintTiles<S> tiles_;
  int32_t gaussian_;
  int columns_;
  WarpLine line_;
};

}  // namespace cuda
}  // namespace dsmoe

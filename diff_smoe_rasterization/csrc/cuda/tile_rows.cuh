// The rows of tiles that the Gaussians of a warp meet. The lanes share all rows evenly, however many each Gaussian has.
// The tiles of a row are exact: they lie between the points where the ellipse enters and leaves the row (Speedy-Splat's
// AccuTile, arXiv:2412.00578).
#pragma once

#include <cstring>

#include "device.cuh"
#include "dsmoe/params.h"
#include "dsmoe/project.h"

namespace dsmoe {
namespace cuda {

// What tile_bounds wants of a Gaussian: its radius, which is only read if the mode needs it. radii: [N].
template <class S> __device__ S bounding_radius(BlendMode mode, const int32_t* radii, int32_t gaussian) {
  return within_radius(mode) ? S(radii[gaussian]) : S(0);
}

template <class T> __device__ T from_lane(T value, int lane) { return __shfl_sync(kAllLanes, value, lane); }

// Numbers the items of all lanes, lane by lane: where each lane's items begin, and how many there are.
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

  // Returns the lane that has item k: the last one that begins at k or before. If k is beyond the items, the result
  // is some lane.
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

template <class S> class WarpTileRows {
 public:
  // A lane's tiles in shared memory, for all lanes to read. The padding spreads the lanes over the banks.
  struct alignas(16) Shared {
    unsigned char tiles[sizeof(FootprintTiles<S>) + 16];
  };

  // tiles: of the lane. shared: [32] of the warp.
  __device__ WarpTileRows(const FootprintTiles<S>& tiles, Shared* shared, int lane)
      : shared_(shared), line_(max(0, tiles.end() - tiles.begin()), lane) {
    memcpy(shared[lane].tiles, &tiles, sizeof(tiles));
    __syncwarp();
  }

  __device__ unsigned total() const { return line_.total; }

  // How many tiles row k of all rows has. All lanes must call it together.
  __device__ unsigned width(unsigned k) const {
    const int owner = line_.owner(k);
    const unsigned row = k - from_lane(line_.begin, owner);
    if (k >= line_.total) return 0;
    FootprintTiles<S> tiles;
    memcpy(&tiles, shared_[owner].tiles, sizeof(tiles));
    const auto span = tiles.row(tiles.begin() + static_cast<int>(row));
    return static_cast<unsigned>(max(0, span.x1 - span.x0));
  }

 private:
  const Shared* shared_;
  WarpLine line_;
};

}  // namespace cuda
}  // namespace dsmoe

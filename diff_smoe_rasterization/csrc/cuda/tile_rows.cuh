// The tiles of a Gaussian: counted in one kernel, listed in another. Both must find the same ones, so they share
// functions that are never inlined: inlined twice, their products and sums could be fused in two ways.
#pragma once

#include "dsmoe/params.h"
#include "dsmoe/project.h"

namespace dsmoe {
namespace cuda {

template <class S>
__device__ __noinline__ FootprintTiles<S> tiles_of(const ProjectedGaussian<S>& gaussian, TileRect bounds) {
  return FootprintTiles<S>(gaussian.conic, gaussian.mean, gaussian.squared_reach, bounds);
}

template <class S>
__device__ __noinline__ typename FootprintTiles<S>::Span row_of(const FootprintTiles<S>& tiles, int y) {
  return tiles.row(y);
}

template <class S> __device__ int32_t count_tiles(const ProjectedGaussian<S>& gaussian, TileRect bounds) {
  const auto tiles = tiles_of(gaussian, bounds);
  int32_t count = 0;
  for (int y = tiles.begin(); y < tiles.end(); ++y) {
    const auto span = row_of(tiles, y);
    count += max(0, span.x1 - span.x0);
  }
  return count;
}

// tile_bounds needs of the camera only its image.
template <class S> __device__ TileRect bounds_of(BlendMode mode, int width, int height, Vec2<S> mean, int32_t radius) {
  Camera<S> camera;
  camera.width = width, camera.height = height;
  return tile_bounds(mode, camera, mean, S(radius));
}

}  // namespace cuda
}  // namespace dsmoe

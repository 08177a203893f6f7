// The tiles of a large Gaussian: counted in one place, listed in another. Both must find the same ones, so they share
// functions that are never inlined: inlined twice, their products and sums could be fused in two ways.
#pragma once

#include "dsmoe/params.h"
#include "dsmoe/project.h"

namespace dsmoe {
namespace cuda {

template <class S>
__device__ __noinline__ FootprintTiles<S> shared_tiles(const ProjectedGaussian<S>& gaussian, TileRect bounds) {
  return {gaussian.conic, gaussian.mean, gaussian.squared_reach, bounds};
}

template <class S>
__device__ __noinline__ typename FootprintTiles<S>::Span row_of(const FootprintTiles<S>& tiles, int y) {
  return tiles.row(y);
}

template <class S> __device__ unsigned long long count_tiles(const FootprintTiles<S>& tiles) {
  unsigned long long count = 0;
  for (int y = tiles.begin(); y < tiles.end(); ++y) {
    const auto span = row_of(tiles, y);
    count += max(0, span.x1 - span.x0);
  }
  return count;
}

// The tiles that may hold pairs of a Gaussian; radii: [N].
template <class S>
__device__ TileRect footprint_bounds(BlendMode mode, int width, int height, Vec2<S> mean, const int32_t* radii,
                                     int32_t gaussian) {
  Camera<S> camera;
  camera.width = width, camera.height = height;
  return tile_bounds(mode, camera, mean, is_smoe(mode) ? S(0) : S(radii[gaussian]));
}

}  // namespace cuda
}  // namespace dsmoe

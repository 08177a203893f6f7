// Runs a tile kernel over all tiles, each thread with its own scratch memory.
#pragma once

#include <algorithm>
#include <atomic>
#include <cstdint>
#include <memory>

#include "dsmoe/tiles.h"
#include "parallel.h"
#include "tile_kernels.h"

namespace dsmoe {
namespace cpu {

// Calls body(tile, scratch) for every tile of the band that has its lists in `saved`. Returns the sum of what body
// returns. num_features: how many features `scratch` has room for.
template <class S, class Body>
int64_t for_each_tile(const RasterConfig<S>& config, const SavedForward<S>& saved, int width, int height,
                      int num_features, Body body) {
  constexpr size_t kAlignment = 64;
  const TileGrid grid(width, height);
  const int64_t first = static_cast<int64_t>(grid.columns) * saved.band.begin, tiles = band_tiles(grid, saved.band);
  std::atomic<int64_t> next{0}, total{0};
  run_threads(static_cast<int>(std::min<int64_t>(config.num_threads, tiles)), [&](int) {
    size_t bytes = tile_scratch_size(num_features) * sizeof(S) + kAlignment;
    const std::unique_ptr<char[]> memory(new char[bytes]);
    void* aligned = memory.get();
    std::align(kAlignment, bytes - kAlignment, aligned, bytes);
    int64_t sum = 0;
    for (int64_t i = next++; i < tiles; i = next++) {
      const Tile<S> tile = {config,
                            saved,
                            width,
                            height,
                            static_cast<int>(i % grid.columns),
                            static_cast<int>(i / grid.columns) + saved.band.begin,
                            first + i,
                            saved.tile_offsets[i],
                            saved.tile_offsets[i + 1]};
      sum += body(tile, static_cast<S*>(aligned));
    }
    total += sum;
  });
  return total;
}

}  // namespace cpu
}  // namespace dsmoe

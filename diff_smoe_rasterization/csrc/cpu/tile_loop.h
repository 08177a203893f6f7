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

// Calls body(tile index, tile x, tile y, scratch) for every tile; returns the sum of what body returns.
template <class S, class Body>
int64_t for_each_tile(int num_threads, int width, int height, int num_features, Body body) {
  constexpr size_t kAlignment = 64;
  const TileGrid grid(width, height);
  const int64_t tiles = static_cast<int64_t>(grid.columns) * grid.rows;
  std::atomic<int64_t> next{0}, total{0};
  run_threads(static_cast<int>(std::min<int64_t>(num_threads, tiles)), [&](int) {
    size_t bytes = tile_scratch_size(num_features) * sizeof(S) + kAlignment;
    const std::unique_ptr<char[]> memory(new char[bytes]);
    void* aligned = memory.get();
    std::align(kAlignment, bytes - kAlignment, aligned, bytes);
    int64_t sum = 0;
    for (int64_t tile = next++; tile < tiles; tile = next++) {
      sum += body(tile, static_cast<int>(tile % grid.columns), static_cast<int>(tile / grid.columns),
                  static_cast<S*>(aligned));
    }
    total += sum;
  });
  return total;
}

}  // namespace cpu
}  // namespace dsmoe

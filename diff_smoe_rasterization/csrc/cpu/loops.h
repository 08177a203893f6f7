// The loops of a stage over bands and tiles, and its clock.
#pragma once

#include <algorithm>
#include <atomic>
#include <chrono>
#include <cstdint>
#include <memory>
#include <mutex>
#include <vector>

#include "dsmoe/rasterize.h"
#include "dsmoe/tiles.h"
#include "parallel.h"
#include "tile_kernels.h"

namespace dsmoe {
namespace cpu {

// Adds the seconds between its construction and its destruction to a stage. Does nothing if no times are asked for.
class Stopwatch {
 public:
  Stopwatch(StageTimes* times, double StageTimes::*stage)
      : seconds_(times != nullptr ? &(times->*stage) : nullptr), start_(Clock::now()) {}
  ~Stopwatch() {
    if (seconds_ != nullptr) *seconds_ += std::chrono::duration<double>(Clock::now() - start_).count();
  }
  Stopwatch(const Stopwatch&) = delete;
  Stopwatch& operator=(const Stopwatch&) = delete;

 private:
  using Clock = std::chrono::steady_clock;
  double* seconds_;
  Clock::time_point start_;
};

// Renderings with more tile instances than are listed at once are made in bands: rows of tiles whose instances fit. A
// pass over such a rendering lists one band after the other, and walks each.

// The tiles that may hold pairs of Gaussian i, in the rows that the frame's lists are of.
template <class S> TileRect bounds_in(const Frame<S>& frame, int64_t i) {
  const TileGrid grid(frame.camera.width, frame.camera.height);
  TileRect bounds = tile_bounds(frame.config.blend.mode, grid, frame.saved.projected[i].mean, S(frame.images.radii[i]));
  bounds.y0 = max(bounds.y0, frame.saved.band.begin), bounds.y1 = min(bounds.y1, frame.saved.band.end);
  return bounds;
}

// Calls visit(tile_x0, tile_x1, tile_y) for each row of tiles that list Gaussian i.
template <class S, class Visit> void for_each_tile_row(const Frame<S>& frame, int64_t i, Visit visit) {
  const ProjectedGaussian<S>& gaussian = frame.saved.projected[i];
  const S reach = gaussian.squared_reach + frame.config.blend.tail_reach();
  for_each_tile_row(gaussian.conic, gaussian.mean, reach, bounds_in(frame, i), visit);
}

// The tiles that may hold near pairs of Gaussian i.
template <class S> FootprintTiles<S> near_tiles(const Frame<S>& frame, int64_t i) {
  const ProjectedGaussian<S>& gaussian = frame.saved.projected[i];
  return {gaussian.conic, gaussian.mean, near_reach(gaussian.opacity, gaussian.squared_reach), bounds_in(frame, i)};
}

// Whether the frame has no lists.
template <class S> bool is_banded(const Frame<S>& frame) {
  return frame.saved.instances == nullptr && frame.saved.instance_offsets[frame.inputs.num_gaussians] > 0;
}

// How many instances each row of tiles has.
template <class S> std::vector<int64_t> count_rows(const Frame<S>& frame) {
  constexpr int64_t kChunk = 4096;  // Gaussians
  std::vector<int64_t> rows(TileGrid(frame.camera.width, frame.camera.height).rows);
  std::mutex mutex;
  parallel_for(frame.config.num_threads, frame.inputs.num_gaussians, kChunk, [&](int64_t begin, int64_t end) {
    std::vector<int64_t> own(rows.size());
    for (int64_t i = begin; i < end; ++i) {
      if (frame.images.radii[i] == 0) continue;
      for_each_tile_row(frame, i, [&](int x0, int x1, int y) { own[y] += x1 - x0; });
    }
    const std::lock_guard<std::mutex> lock(mutex);
    for (size_t y = 0; y < rows.size(); ++y) rows[y] += own[y];
  });
  return rows;
}

// Cuts the image into bands of at most `most` instances; a single row may have more.
inline std::vector<TileBand> cut_into_bands(const std::vector<int64_t>& rows, int64_t most) {
  std::vector<TileBand> bands;
  int64_t sum = 0;
  for (int y = 0; y < static_cast<int>(rows.size()); ++y) {
    if (bands.empty() || sum + rows[y] > most) bands.push_back({y, y}), sum = 0;
    bands.back().end = y + 1;
    sum += rows[y];
  }
  return bands;
}

// Calls visit(frame) if the frame has lists. Else it makes the lists of one band after the other, and calls visit
// with a frame for each, from top to bottom.
template <class S, class Visit> void for_each_band(const Frame<S>& frame, StageTimes* times, Visit visit) {
  if (!is_banded(frame)) return visit(frame);
  for (const TileBand& band : cut_into_bands(count_rows(frame), frame.config.most_instances)) {
    std::vector<int64_t> offsets(frame.inputs.num_gaussians + 1);
    std::vector<int64_t> tile_offsets(band_tiles(TileGrid(frame.camera.width, frame.camera.height), band) + 1);
    Frame<S> part = frame;
    part.saved.band = band;
    part.saved.instance_offsets = offsets.data();
    part.saved.tile_offsets = tile_offsets.data();
    const std::unique_ptr<TileInstance[]> instances(new TileInstance[count_instances(part, times)]);
    part.saved.instances = instances.get();
    bin(part, times);
    visit(part);
  }
}

// Runs a tile kernel over all tiles, each thread with its own scratch memory.

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

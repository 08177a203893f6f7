// Renderings with more tile instances than are listed at once are made in bands: rows of tiles whose instances fit. A
// pass over such a rendering lists one band after the other, and walks each.
#pragma once

#include <algorithm>
#include <memory>
#include <mutex>
#include <vector>

#include "dsmoe/rasterize.h"
#include "parallel.h"

namespace dsmoe {
namespace cpu {

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

// Calls visit(frame) where the frame has lists. Else it makes the lists of one band after the other, and calls visit
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

}  // namespace cpu
}  // namespace dsmoe

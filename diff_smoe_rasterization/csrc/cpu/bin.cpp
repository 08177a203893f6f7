// Stage 2: a depth sort of the visible Gaussians, then a list of instances for each tile, front to back.
#include <algorithm>
#include <limits>
#include <memory>
#include <stdexcept>
#include <string>
#include <vector>

#include "../dispatch.h"
#include "dsmoe/blend.h"
#include "dsmoe/depth_bits.h"
#include "dsmoe/project.h"
#include "dsmoe/rasterize.h"
#include "loops.h"
#include "parallel.h"
#include "radix_sort.h"

namespace dsmoe {
namespace cpu {
namespace {

// The Gaussians that have instances, nearest first if the mode needs it, else in the order of their indices.
template <class S>
std::vector<KeyedIndex<DepthBits<S>>> depth_order(int64_t num_gaussians, const RasterConfig<S>& config,
                                                  const SavedForward<S>& saved) {
  std::vector<KeyedIndex<DepthBits<S>>> order;
  order.reserve(num_gaussians);
  for (int64_t i = 0; i < num_gaussians; ++i) {
    if (saved.instance_offsets[i + 1] == saved.instance_offsets[i]) continue;
    order.push_back({depth_bits(saved.projected[i].depth), static_cast<int32_t>(i)});
  }
  dispatch_blend(config.blend.mode, kAnyFeatures, [&](auto mode, auto) {
    if (Blend<decltype(mode)::value>::kNeedsDepthOrder) radix_sort(order);
  });
  return order;
}

}  // namespace

template <class S> void bin(const Frame<S>& frame, StageTimes* times) {
  const int64_t num_gaussians = frame.inputs.num_gaussians;
  const Camera<S>& camera = frame.camera;
  const RasterConfig<S>& config = frame.config;
  const SavedForward<S>& saved = frame.saved;
  if (saved.instance_offsets[num_gaussians] > std::numeric_limits<uint32_t>::max()) {
    throw std::overflow_error("rasterize: " + std::to_string(saved.instance_offsets[num_gaussians]) +
                              " tile instances are to be listed at once; the CPU backend lists at most 4294967295, and "
                              "no less than a row of tiles. Are the scales right?");
  }
  std::vector<KeyedIndex<DepthBits<S>>> order;
  {
    const Stopwatch stopwatch(times, &StageTimes::sort);
    order = depth_order(num_gaussians, config, saved);
  }
  const Stopwatch stopwatch(times, &StageTimes::bin);
  const TileGrid grid(camera.width, camera.height);
  const TileBand& band = saved.band;
  const int64_t tiles = band_tiles(grid, band);
  const int64_t num_visible = static_cast<int64_t>(order.size());

  // A counting sort by tile. Each thread has a run of the depth order and counters of its own. So the lists are in
  // depth order, whatever the number of threads. The tile of each instance is found once, and kept by slot, with
  // kWideOnly if near pairs are blended first and none of them may lie there.
  constexpr uint32_t kWideOnly = uint32_t(1) << 31;
  const bool near_first = config.blend.blends_near_first();
  const int num_runs = static_cast<int>(std::clamp<int64_t>(num_visible / 256, 1, std::max(1, config.num_threads)));
  const std::unique_ptr<uint32_t[]> tile_of_slot(new uint32_t[saved.instance_offsets[num_gaussians]]);
  std::vector<std::vector<int64_t>> cursors(num_runs, std::vector<int64_t>(tiles));
  auto for_each_gaussian = [&](int run, auto visit) {
    for (int64_t k = num_visible * run / num_runs; k < num_visible * (run + 1) / num_runs; ++k) visit(order[k].index);
  };
  run_threads(num_runs, [&](int run) {
    for_each_gaussian(run, [&](int32_t i) {
      uint32_t* next = &tile_of_slot[saved.instance_offsets[i]];
      FootprintTiles<S> near;
      if (near_first) near = near_tiles(frame, i);
      for_each_tile_row(frame, i, [&](int x0, int x1, int y) {
        typename FootprintTiles<S>::Span span = {x0, x1};
        if (near_first) span = near.begin() <= y && y < near.end() ? near.row(y) : typename FootprintTiles<S>::Span();
        for (int x = x0; x < x1; ++x) {
          const uint32_t tile = static_cast<uint32_t>(y - band.begin) * grid.columns + x;
          ++cursors[run][tile];
          *next++ = span.x0 <= x && x < span.x1 ? tile : tile | kWideOnly;
        }
      });
    });
  });
  int64_t total = 0;
  for (int64_t tile = 0; tile < tiles; ++tile) {
    saved.tile_offsets[tile] = total;
    for (auto& cursor : cursors) {
      const int64_t count = cursor[tile];
      cursor[tile] = total;
      total += count;
    }
    // The blend keeps positions in a list as numbers of the scalar type, which must hold them exactly.
    if (total - saved.tile_offsets[tile] >= int64_t(1) << std::numeric_limits<S>::digits) {
      throw std::overflow_error("rasterize: one tile holds " + std::to_string(total - saved.tile_offsets[tile]) +
                                " Gaussians, more than this scalar type can count");
    }
  }
  saved.tile_offsets[tiles] = total;
  run_threads(num_runs, [&](int run) {
    for_each_gaussian(run, [&](int32_t i) {
      for (int64_t slot = saved.instance_offsets[i]; slot < saved.instance_offsets[i + 1]; ++slot) {
        const uint32_t tile = tile_of_slot[slot];
        saved.instances[cursors[run][tile & ~kWideOnly]++] = {tile < kWideOnly ? i : ~i, static_cast<uint32_t>(slot)};
      }
    });
  });
}

#define DSMOE_INSTANTIATE(S) template void bin(const Frame<S>&, StageTimes*);
DSMOE_INSTANTIATE(float)
DSMOE_INSTANTIATE(double)
#undef DSMOE_INSTANTIATE

}  // namespace cpu
}  // namespace dsmoe

// What each Gaussian is worth to an image: tiles write one record per instance, then each Gaussian sums its own, which
// lie side by side. No atomics, so the result does not depend on the threads.
#include <memory>
#include <vector>

#include "bands.h"
#include "dsmoe/rasterize.h"
#include "dsmoe/removal.h"
#include "parallel.h"
#include "tile_kernels.h"
#include "tile_loop.h"

namespace dsmoe {
namespace cpu {
namespace {

constexpr int64_t kChunk = 4096;  // Gaussians: a few additions each

}  // namespace

template <class S> void importance(const Frame<S>& frame, const ImportanceMap<S>& map) {
  const int64_t num_gaussians = frame.inputs.num_gaussians;
  const RasterConfig<S>& config = frame.config;
  const ImportanceSums<S>& sums = map.sums;
  const auto& kernels = tile_kernels<S>();
  // In double: a large Gaussian has thousands of instances.
  std::vector<Importance<double>> totals(num_gaussians, no_importance<double>());
  for_each_band(frame, nullptr, [&](const Frame<S>& band) {
    const SavedForward<S>& saved = band.saved;
    const std::unique_ptr<Importance<S>[]> instances(new Importance<S>[saved.instance_offsets[num_gaussians]]);
    const TileImportances<S> out = {map, instances.get()};
    for_each_tile(config, saved, frame.camera.width, frame.camera.height, kImportanceArrays + 2 * config.num_channels,
                  [&](const Tile<S>& tile, S* scratch) { return kernels.importance(tile, out, scratch); });
    parallel_for(config.num_threads, num_gaussians, kChunk, [&](int64_t begin, int64_t end) {
      for (int64_t i = begin; i < end; ++i) {
        Importance<double>& sum = totals[i];
        for (int64_t slot = saved.instance_offsets[i]; slot < saved.instance_offsets[i + 1]; ++slot) {
          const Importance<S>& part = instances[slot];
          sum.share += part.share, sum.squared_share += part.squared_share, sum.removal_cost += part.removal_cost;
        }
      }
    });
  });
  for (int64_t i = 0; i < num_gaussians; ++i) {
    const Importance<double>& sum = totals[i];
    sums.shares[i] = static_cast<S>(sum.share), sums.squared_shares[i] = static_cast<S>(sum.squared_share);
    sums.removal_costs[i] = static_cast<S>(sum.removal_cost);
  }
}

#define DSMOE_INSTANTIATE(S) template void importance(const Frame<S>&, const ImportanceMap<S>&);
DSMOE_INSTANTIATE(float)
DSMOE_INSTANTIATE(double)
#undef DSMOE_INSTANTIATE

}  // namespace cpu
}  // namespace dsmoe

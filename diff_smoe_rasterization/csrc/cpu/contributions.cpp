// Sums over the pixels of each Gaussian. Each tile writes one record per instance. Then each Gaussian sums its own
// records, which lie side by side. There are no atomics, so the result does not depend on the threads.
#include <memory>
#include <vector>

#include "bands.h"
#include "dsmoe/contribution.h"
#include "dsmoe/rasterize.h"
#include "parallel.h"
#include "tile_kernels.h"
#include "tile_loop.h"

namespace dsmoe {
namespace cpu {
namespace {

constexpr int64_t kChunk = 4096;  // Gaussians: a few additions each

}  // namespace

template <class S> void contributions(const Frame<S>& frame, const ContributionMap<S>& map) {
  const int64_t num_gaussians = frame.inputs.num_gaussians;
  const int width = frame.camera.width, height = frame.camera.height;
  const RasterConfig<S>& config = frame.config;
  const S* pixel_weights = map.pixel_weights;
  const ContributionSums<S>& sums = map.sums;
  const auto& kernels = tile_kernels<S>();
  // In double: a large Gaussian has thousands of instances.
  std::vector<Contribution<double>> totals(num_gaussians, no_contribution<double>());
  for_each_band(frame, nullptr, [&](const Frame<S>& band) {
    const SavedForward<S>& saved = band.saved;
    const std::unique_ptr<Contribution<S>[]> instances(new Contribution<S>[saved.instance_offsets[num_gaussians]]);
    const TileContributions<S> out = {pixel_weights, instances.get()};
    for_each_tile(config, saved, width, height, 0,
                  [&](const Tile<S>& tile, S* scratch) { return kernels.contributions(tile, out, scratch); });
    parallel_for(config.num_threads, num_gaussians, kChunk, [&](int64_t begin, int64_t end) {
      for (int64_t i = begin; i < end; ++i) {
        Contribution<double>& sum = totals[i];
        for (int64_t slot = saved.instance_offsets[i]; slot < saved.instance_offsets[i + 1]; ++slot) {
          const Contribution<S>& part = instances[slot];
          sum.pixel_weight += part.pixel_weight, sum.pixels += part.pixels;
          sum.blend_weight += part.blend_weight, sum.distance += part.distance;
        }
      }
    });
  });
  for (int64_t i = 0; i < num_gaussians; ++i) {
    const Contribution<double>& sum = totals[i];
    sums.pixel_weights[i] = static_cast<S>(sum.pixel_weight), sums.pixels[i] = static_cast<int32_t>(sum.pixels);
    sums.blend_weights[i] = static_cast<S>(sum.blend_weight), sums.distances[i] = static_cast<S>(sum.distance);
  }
}

#define DSMOE_INSTANTIATE(S) template void contributions(const Frame<S>&, const ContributionMap<S>&);
DSMOE_INSTANTIATE(float)
DSMOE_INSTANTIATE(double)
#undef DSMOE_INSTANTIATE

}  // namespace cpu
}  // namespace dsmoe

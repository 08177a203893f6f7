// What each Gaussian gives to the pixels of an image.
#include "../refuse.h"
#include "dsmoe/contribution.h"
#include "dsmoe/rasterize.h"
#include "instance_sums.h"
#include "tile_kernels.h"

namespace dsmoe {
namespace cpu {

template <class S> void contributions(const Frame<S>& frame, const ContributionMap<S>& map) {
  refuse_contributions("cpu::contributions", frame, map);
  const ContributionSums<S>& sums = map.sums;
  const auto& kernels = tile_kernels<S>();
  const auto totals = sum_instances<Contribution>(
      frame, no_contribution<double>(),
      [&](const SavedForward<S>& saved, Contribution<S>* instances) {
        const TileContributions<S> out = {map.pixel_weights, instances};
        for_each_tile(frame.config, saved, frame.camera.width, frame.camera.height, 0,
                      [&](const Tile<S>& tile, S* scratch) { return kernels.contributions(tile, out, scratch); });
      },
      [](Contribution<double>& sum, const Contribution<S>& part) {
        sum.pixel_weight += part.pixel_weight, sum.pixels += part.pixels;
        sum.blend_weight += part.blend_weight, sum.distance += part.distance;
      });
  for (size_t i = 0; i < totals.size(); ++i) {
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

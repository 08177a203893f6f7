// What each Gaussian is worth to an image.
#include "../refuse.h"
#include "dsmoe/rasterize.h"
#include "dsmoe/removal.h"
#include "instance_sums.h"
#include "tile_kernels.h"

namespace dsmoe {
namespace cpu {

template <class S> void importance(const Frame<S>& frame, const ImportanceMap<S>& map) {
  refuse_importance("cpu::importance", frame, map);
  const ImportanceSums<S>& sums = map.sums;
  const auto& kernels = tile_kernels<S>();
  const auto totals = sum_instances<Importance>(
      frame, no_importance<double>(),
      [&](const SavedForward<S>& saved, Importance<S>* instances) {
        const TileImportances<S> out = {map, instances};
        for_each_tile(frame.config, saved, frame.camera.width, frame.camera.height,
                      kImportanceArrays + 2 * frame.config.num_channels,
                      [&](const Tile<S>& tile, S* scratch) { return kernels.importance(tile, out, scratch); });
      },
      [](Importance<double>& sum, const Importance<S>& part) {
        sum.share += part.share, sum.squared_share += part.squared_share, sum.removal_cost += part.removal_cost;
      });
  for (size_t i = 0; i < totals.size(); ++i) {
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

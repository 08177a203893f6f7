// Stage 3: the images.
#include "dsmoe/rasterize.h"
#include "stopwatch.h"
#include "tile_kernels.h"
#include "tile_loop.h"

namespace dsmoe {
namespace cpu {

template <class S>
void blend(const Camera<S>& camera, const RasterConfig<S>& config, const SavedForward<S>& saved,
           const ImageOutputs<S>& images, StageTimes* times) {
  const Stopwatch stopwatch(times, &StageTimes::blend);
  const auto& kernels = tile_kernels<S>();
  const int64_t pairs =
      for_each_tile(config, saved, camera.width, camera.height, config.num_features(),
                    [&](const Tile<S>& tile, S* scratch) { return kernels.forward(tile, images, scratch); });
  if (times != nullptr) times->forward_pairs += pairs;
}

#define DSMOE_INSTANTIATE(S)                                                                                    \
  template void blend(const Camera<S>&, const RasterConfig<S>&, const SavedForward<S>&, const ImageOutputs<S>&, \
                      StageTimes*);
DSMOE_INSTANTIATE(float)
DSMOE_INSTANTIATE(double)
#undef DSMOE_INSTANTIATE

}  // namespace cpu
}  // namespace dsmoe

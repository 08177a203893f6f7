// Stage 3: the images.
#include "dsmoe/rasterize.h"
#include "loops.h"
#include "tile_kernels.h"

namespace dsmoe {
namespace cpu {

template <class S> void blend(const Frame<S>& frame, StageTimes* times) {
  const Camera<S>& camera = frame.camera;
  const RasterConfig<S>& config = frame.config;
  const ImageOutputs<S>& images = frame.images;
  const auto& kernels = tile_kernels<S>();
  for_each_band(frame, times, [&](const Frame<S>& band) {
    const Stopwatch stopwatch(times, &StageTimes::blend);
    const int64_t pairs =
        for_each_tile(config, band.saved, camera.width, camera.height, config.num_features(),
                      [&](const Tile<S>& tile, S* scratch) { return kernels.forward(tile, images, scratch); });
    if (times != nullptr) times->forward_pairs += pairs;
  });
}

#define DSMOE_INSTANTIATE(S) template void blend(const Frame<S>&, StageTimes*);
DSMOE_INSTANTIATE(float)
DSMOE_INSTANTIATE(double)
#undef DSMOE_INSTANTIATE

}  // namespace cpu
}  // namespace dsmoe

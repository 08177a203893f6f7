// From image gradients to the gradients of every input. Each tile writes one record per instance. Then each Gaussian
// sums its own records, which lie side by side. There are no atomics, so the result does not depend on the threads.
#include <algorithm>
#include <memory>
#include <vector>

#include "bands.h"
#include "dsmoe/arrays.h"
#include "dsmoe/rasterize.h"
#include "parallel.h"
#include "stopwatch.h"
#include "tile_kernels.h"
#include "tile_loop.h"

namespace dsmoe {
namespace cpu {
namespace {

constexpr int64_t kChunk = 512;  // Gaussians; also fixes the order in which the camera's gradient is summed

// Adds the records of one Gaussian to its sum, in double: a large Gaussian has thousands.
template <class S> void add_records(const S* records, int64_t count, int size, double* sum) {
  for (int64_t n = 0; n < count; ++n) {
    for (int k = 0; k < size; ++k) sum[k] += records[n * size + k];
  }
}

}  // namespace

template <class S> void backward(const Frame<S>& frame, const Gradients<S>& wanted, StageTimes* times) {
  const GaussianInputs<S>& inputs = frame.inputs;
  const Camera<S>& camera = frame.camera;
  const RasterConfig<S>& config = frame.config;
  const SavedForward<S>& saved = frame.saved;
  const ImageOutputs<S>& images = frame.images;
  const ImageGradients<S>& image_gradients = wanted.images;
  const GaussianGradients<S>& gradients = wanted.inputs;
  const int record = kNumGateMoments + config.num_features();
  const int64_t tiles = num_tiles(camera.width, camera.height);
  const int background = config.num_channels + 1;  // numbers: its colour and its gate
  const bool banded = is_banded(frame);
  std::unique_ptr<S[]> dL_dinstances;
  std::vector<double> totals(banded ? inputs.num_gaussians * record : 0);  // the sums of the bands so far
  std::vector<S> dL_dbackground(gradients.background != nullptr ? tiles * background : 0);
  for_each_band(frame, times, [&](const Frame<S>& band) {
    const Stopwatch stopwatch(times, &StageTimes::blend_backward);
    const auto& kernels = tile_kernels<S>();
    const int64_t* offsets = band.saved.instance_offsets;
    dL_dinstances.reset(new S[offsets[inputs.num_gaussians] * record]);
    const TileGradients<S> tile_gradients = {images, image_gradients, dL_dinstances.get(),
                                             dL_dbackground.empty() ? nullptr : dL_dbackground.data()};
    const int64_t pairs =
        for_each_tile(config, band.saved, camera.width, camera.height, config.num_features(),
                      [&](const Tile<S>& tile, S* scratch) { return kernels.backward(tile, tile_gradients, scratch); });
    if (times != nullptr) times->backward_pairs += pairs;
    if (!banded) return;
    parallel_for(config.num_threads, inputs.num_gaussians, kChunk, [&](int64_t begin, int64_t end) {
      for (int64_t i = begin; i < end; ++i) {
        add_records(dL_dinstances.get() + offsets[i] * record, offsets[i + 1] - offsets[i], record,
                    &totals[i * record]);
      }
    });
  });
  if (gradients.background != nullptr) {
    std::vector<double> wide(background);
    add_records(dL_dbackground.data(), tiles, background, wide.data());
    for (int k = 0; k < background; ++k) gradients.background[k] = static_cast<S>(wide[k]);
  }

  const Stopwatch stopwatch(times, &StageTimes::project_backward);
  const int64_t num_chunks = (inputs.num_gaussians + kChunk - 1) / kChunk;
  std::vector<CameraGradient<S>> camera_shares(gradients.camera != nullptr ? num_chunks : 0);
  parallel_for(config.num_threads, inputs.num_gaussians, kChunk, [&](int64_t begin, int64_t end) {
    std::vector<S> sum(record);
    std::vector<double> wide(record);
    CameraGradient<S>* share = camera_shares.empty() ? nullptr : &camera_shares[begin / kChunk];
    for (int64_t i = begin; i < end; ++i) {
      store_zeros(gradients, config.num_channels, inputs.num_sh, i);
      const int64_t first = saved.instance_offsets[i], count = saved.instance_offsets[i + 1] - first;
      if (count == 0) continue;
      const double* total = banded ? &totals[i * record] : wide.data();
      if (!banded) {
        std::fill(wide.begin(), wide.end(), 0);
        add_records(dL_dinstances.get() + first * record, count, record, wide.data());
      }
      for (int k = 0; k < record; ++k) sum[k] = static_cast<S>(total[k]);
      const ProjectedGaussian<S>& gaussian = saved.projected[i];
      const GateMoments<S> moments = {sum[0], sum[1], sum[2], sum[3], sum[4], sum[5]};
      PixelSums<S> sums;
      sums.gate = moments_backward(gaussian.conic, gaussian.opacity, moments);
      sums.features.values = saved.features + i * config.num_features();
      sums.features.dL_dvalues = sum.data() + kNumGateMoments;
      const auto to_camera = project_gaussian_backward({inputs, camera, config, i}, sums, gradients);
      if (share != nullptr) share->add(to_camera);
    }
  });
  if (gradients.camera == nullptr) return;
  *gradients.camera = {};
  for (const auto& share : camera_shares) gradients.camera->add(share);
}

#define DSMOE_INSTANTIATE(S) template void backward(const Frame<S>&, const Gradients<S>&, StageTimes*);
DSMOE_INSTANTIATE(float)
DSMOE_INSTANTIATE(double)
#undef DSMOE_INSTANTIATE

}  // namespace cpu
}  // namespace dsmoe

// From image gradients to the gradients of every input. Each tile writes one record per instance. Then each Gaussian
// sums its own records, which lie side by side. There are no atomics, so the result does not depend on the threads.
#include <algorithm>
#include <memory>
#include <vector>

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

// Sums the records of one Gaussian in double: a large Gaussian has thousands.
template <class S> void sum_records(const S* records, int64_t count, int size, double* wide, S* sum) {
  for (int k = 0; k < size; ++k) wide[k] = 0;
  for (int64_t n = 0; n < count; ++n) {
    for (int k = 0; k < size; ++k) wide[k] += records[n * size + k];
  }
  for (int k = 0; k < size; ++k) sum[k] = static_cast<S>(wide[k]);
}

// One record for each instance, as the tiles write them; where means2D_abs is wanted, it ends with those sums. Also
// writes the gradient by the background.
template <class S>
std::unique_ptr<S[]> instance_records(const Frame<S>& frame, const Gradients<S>& wanted, StageTimes* times) {
  const Stopwatch stopwatch(times, &StageTimes::blend_backward);
  const Camera<S>& camera = frame.camera;
  const RasterConfig<S>& config = frame.config;
  S* dL_dbackground = wanted.inputs.background;
  const bool absolute = wanted.inputs.means2D_abs != nullptr;
  const int record = record_size(config.num_features(), absolute);
  std::unique_ptr<S[]> dL_dinstances(new S[frame.saved.instance_offsets[frame.inputs.num_gaussians] * record]);
  const auto& kernels = tile_kernels<S>();
  const int64_t tiles = num_tiles(camera.width, camera.height);
  const int background = config.num_channels + 1;  // numbers: its colour and its gate
  std::vector<S> dL_dbackgrounds(dL_dbackground != nullptr ? tiles * background : 0);
  const TileGradients<S> tile_gradients = {frame.images, wanted.images, dL_dinstances.get(),
                                           dL_dbackgrounds.empty() ? nullptr : dL_dbackgrounds.data(), absolute};
  const int64_t pairs =
      for_each_tile(config, frame.saved, camera.width, camera.height, config.num_features(),
                    [&](const Tile<S>& tile, S* scratch) { return kernels.backward(tile, tile_gradients, scratch); });
  if (times != nullptr) times->backward_pairs += pairs;
  if (dL_dbackground != nullptr) {
    std::vector<double> wide(background);
    sum_records(dL_dbackgrounds.data(), tiles, background, wide.data(), dL_dbackground);
  }
  return dL_dinstances;
}

// Sums what the instances of a Gaussian say, one Gaussian at a time.
template <class S> class InstanceSums {
 public:
  InstanceSums(const Frame<S>& frame, const S* dL_dinstances, S* means2D_abs)
      : frame_(frame),
        dL_dinstances_(dL_dinstances),
        means2D_abs_(means2D_abs),
        sum_(record_size(frame.config.num_features(), means2D_abs != nullptr)),
        wide_(sum_.size()) {}

  // Fills `sums`, which last until the next call, with those of Gaussian i, and stores its absolute ones where they are
  // wanted. Returns false where it has no instances.
  bool operator()(int64_t i, PixelSums<S>& sums) {
    const SavedForward<S>& saved = frame_.saved;
    const int record = static_cast<int>(sum_.size());
    const int64_t first = saved.instance_offsets[i], count = saved.instance_offsets[i + 1] - first;
    if (count == 0) return false;
    sum_records(dL_dinstances_ + first * record, count, record, wide_.data(), sum_.data());
    const ProjectedGaussian<S>& gaussian = saved.projected[i];
    const GateMoments<S> moments = {sum_[0], sum_[1], sum_[2], sum_[3], sum_[4], sum_[5]};
    sums.gate = moments_backward(gaussian.conic, gaussian.opacity, moments);
    sums.features.values = saved.features + i * frame_.config.num_features();
    sums.features.dL_dvalues = sum_.data() + kNumGateMoments;
    if (means2D_abs_ != nullptr) {
      store_absolute(sum_.data() + record - kNumAbsoluteSums, frame_.camera, means2D_abs_, i);
    }
    return true;
  }

 private:
  const Frame<S>& frame_;
  const S* dL_dinstances_;
  S* means2D_abs_;  // null where it is not wanted
  std::vector<S> sum_;
  std::vector<double> wide_;
};

// Writes the gradients of every input but the background. new_sums() returns what InstanceSums is.
template <class S, class NewSums>
void project_all_backward(const Frame<S>& frame, const GaussianGradients<S>& gradients, StageTimes* times,
                          NewSums new_sums) {
  const Stopwatch stopwatch(times, &StageTimes::project_backward);
  const GaussianInputs<S>& inputs = frame.inputs;
  const RasterConfig<S>& config = frame.config;
  const int64_t num_chunks = (inputs.num_gaussians + kChunk - 1) / kChunk;
  std::vector<CameraGradient<S>> camera_shares(gradients.camera != nullptr ? num_chunks : 0);
  parallel_for(config.num_threads, inputs.num_gaussians, kChunk, [&](int64_t begin, int64_t end) {
    auto sums_of = new_sums();
    CameraGradient<S>* share = camera_shares.empty() ? nullptr : &camera_shares[begin / kChunk];
    for (int64_t i = begin; i < end; ++i) {
      if (gradients.seen_only && frame.images.radii[i] <= 0) continue;
      store_zeros(gradients, config.num_channels, inputs.num_sh, i);
      PixelSums<S> sums;
      if (!sums_of(i, sums)) continue;
      const auto to_camera = project_gaussian_backward({inputs, frame.camera, config, i}, sums, gradients);
      if (share != nullptr) share->add(to_camera);
    }
  });
  if (gradients.camera == nullptr) return;
  *gradients.camera = {};
  for (const auto& share : camera_shares) gradients.camera->add(share);
}

}  // namespace

template <class S> void backward(const Frame<S>& frame, const Gradients<S>& wanted, StageTimes* times) {
  const auto records = instance_records(frame, wanted, times);
  project_all_backward(frame, wanted.inputs, times,
                       [&] { return InstanceSums<S>(frame, records.get(), wanted.inputs.means2D_abs); });
}

template <class S>
void blend_footprints_backward(const Frame<S>& frame, const Gradients<S>& gradients,
                               const FootprintGradients<S>& footprints, StageTimes* times) {
  const auto records = instance_records(frame, gradients, times);
  const Stopwatch stopwatch(times, &StageTimes::blend_backward);
  const int num_features = frame.config.num_features(), size = kNumGateGradients + num_features;
  parallel_for(frame.config.num_threads, frame.inputs.num_gaussians, kChunk, [&](int64_t begin, int64_t end) {
    InstanceSums<S> sums_of(frame, records.get(), gradients.inputs.means2D_abs);
    for (int64_t i = begin; i < end; ++i) {
      S* record = footprints.records + i * size;
      PixelSums<S> sums;
      if (sums_of(i, sums)) {
        store_gate_gradient(sums.gate, record);
        std::copy_n(sums.features.dL_dvalues, num_features, record + kNumGateGradients);
      } else {
        std::fill_n(record, size, S(0));
      }
    }
  });
}

template <class S>
void project_backward(const Frame<S>& frame, const FootprintGradients<S>& footprints,
                      const GaussianGradients<S>& gradients, StageTimes* times) {
  const int num_features = frame.config.num_features();
  project_all_backward(frame, gradients, times, [&] {
    return [&](int64_t i, PixelSums<S>& sums) {
      if (frame.images.radii[i] == 0) return false;
      sums = pixel_sums(footprints, i, num_features, frame.saved.features + i * num_features);
      return true;
    };
  });
}

#define DSMOE_INSTANTIATE(S)                                                                                  \
  template void backward(const Frame<S>&, const Gradients<S>&, StageTimes*);                                  \
  template void blend_footprints_backward(const Frame<S>&, const Gradients<S>&, const FootprintGradients<S>&, \
                                          StageTimes*);                                                       \
  template void project_backward(const Frame<S>&, const FootprintGradients<S>&, const GaussianGradients<S>&,  \
                                 StageTimes*);
DSMOE_INSTANTIATE(float)
DSMOE_INSTANTIATE(double)
#undef DSMOE_INSTANTIATE

}  // namespace cpu
}  // namespace dsmoe

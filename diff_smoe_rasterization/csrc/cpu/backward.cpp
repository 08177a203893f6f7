// From image gradients to the gradients of every input. Each tile writes one record per instance. Then each Gaussian
// sums its own records, which lie side by side. There are no atomics, so the result does not depend on the threads.
#include <algorithm>
#include <memory>
#include <vector>

#include "../refuse.h"
#include "dsmoe/arrays.h"
#include "dsmoe/rasterize.h"
#include "loops.h"
#include "parallel.h"
#include "tile_kernels.h"

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

// The tiles' contributions to each Gaussian's gradient. If means2D_abs is wanted, records end with its sums.
template <class S> struct Records {
  int size;                           // numbers a record
  std::unique_ptr<S[]> of_instances;  // one for each instance, a Gaussian's side by side
  std::vector<double> of_gaussians;   // their sums, if the tile lists were made band by band; else empty
};

// Also writes the gradient by the background.
template <class S> Records<S> walk_tiles(const Frame<S>& frame, const Gradients<S>& wanted, StageTimes* times) {
  const Camera<S>& camera = frame.camera;
  const RasterConfig<S>& config = frame.config;
  const int64_t num_gaussians = frame.inputs.num_gaussians;
  S* dL_dbackground = wanted.inputs.background;
  const bool absolute = wanted.inputs.means2D_abs != nullptr, banded = is_banded(frame);
  Records<S> records;
  records.size = record_size(config.num_features(), absolute);
  const int size = records.size;
  if (banded) records.of_gaussians.resize(num_gaussians * size);
  const int64_t tiles = num_tiles(camera.width, camera.height);
  const int background = config.num_channels + 1;  // numbers: its colour and its gate
  std::vector<S> dL_dbackgrounds(dL_dbackground != nullptr ? tiles * background : 0);
  for_each_band(frame, times, [&](const Frame<S>& band) {
    const Stopwatch stopwatch(times, &StageTimes::blend_backward);
    const auto& kernels = tile_kernels<S>();
    const int64_t* offsets = band.saved.instance_offsets;
    records.of_instances.reset(new S[offsets[num_gaussians] * size]);
    const TileGradients<S> tile_gradients = {frame.images, wanted.images, records.of_instances.get(),
                                             dL_dbackgrounds.empty() ? nullptr : dL_dbackgrounds.data(), absolute};
    const int64_t pairs =
        for_each_tile(config, band.saved, camera.width, camera.height, config.num_features(),
                      [&](const Tile<S>& tile, S* scratch) { return kernels.backward(tile, tile_gradients, scratch); });
    if (times != nullptr) times->backward_pairs += pairs;
    if (!banded) return;
    parallel_for(config.num_threads, num_gaussians, kChunk, [&](int64_t begin, int64_t end) {
      for (int64_t i = begin; i < end; ++i) {
        add_records(records.of_instances.get() + offsets[i] * size, offsets[i + 1] - offsets[i], size,
                    &records.of_gaussians[i * size]);
      }
    });
  });
  if (dL_dbackground != nullptr) {
    std::vector<double> wide(background);
    add_records(dL_dbackgrounds.data(), tiles, background, wide.data());
    for (int k = 0; k < background; ++k) dL_dbackground[k] = static_cast<S>(wide[k]);
  }
  return records;
}

// Sums the records of a Gaussian, one Gaussian at a time.
template <class S> class RecordSums {
 public:
  RecordSums(const Frame<S>& frame, const Records<S>& records, S* means2D_abs)
      : frame_(frame), records_(records), means2D_abs_(means2D_abs), sum_(records.size), wide_(records.size) {}

  // Points `sums` at the sums of Gaussian i, which last until the next call, and stores its absolute sums if wanted.
  // Returns false if it has no instances.
  bool operator()(int64_t i, PixelSums<S>& sums) {
    const SavedForward<S>& saved = frame_.saved;
    const int size = records_.size;
    const int64_t first = saved.instance_offsets[i], count = saved.instance_offsets[i + 1] - first;
    if (count == 0) return false;
    const double* total = wide_.data();
    if (!records_.of_gaussians.empty()) {
      total = &records_.of_gaussians[i * size];
    } else {
      std::fill(wide_.begin(), wide_.end(), 0);
      add_records(records_.of_instances.get() + first * size, count, size, wide_.data());
    }
    for (int k = 0; k < size; ++k) sum_[k] = static_cast<S>(total[k]);
    const ProjectedGaussian<S>& gaussian = saved.projected[i];
    const GateMoments<S> moments = {sum_[0], sum_[1], sum_[2], sum_[3], sum_[4], sum_[5]};
    sums.gate = moments_backward(gaussian.conic, gaussian.opacity, moments);
    sums.features.values = saved.features + i * frame_.config.num_features();
    sums.features.dL_dvalues = sum_.data() + kNumGateMoments;
    if (means2D_abs_ != nullptr) {
      store_absolute(sum_.data() + size - kNumAbsoluteSums, frame_.camera, means2D_abs_, i);
    }
    return true;
  }

 private:
  const Frame<S>& frame_;
  const Records<S>& records_;
  S* means2D_abs_;  // null if it is not wanted
  std::vector<S> sum_;
  std::vector<double> wide_;
};

// Writes the gradients of every input but the background. new_sums() returns what RecordSums is.
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
  refuse_backward("cpu::backward", frame, wanted.images, saved_sizes(frame));
  const auto records = walk_tiles(frame, wanted, times);
  project_all_backward(frame, wanted.inputs, times,
                       [&] { return RecordSums<S>(frame, records, wanted.inputs.means2D_abs); });
}

template <class S>
void blend_footprints_backward(const Frame<S>& frame, const Gradients<S>& gradients,
                               const FootprintGradients<S>& footprints, StageTimes* times) {
  refuse_blend_backward("cpu::blend_footprints_backward", frame, gradients.images, footprints, saved_sizes(frame));
  const auto records = walk_tiles(frame, gradients, times);
  const Stopwatch stopwatch(times, &StageTimes::blend_backward);
  const int num_features = frame.config.num_features(), size = kNumGateGradients + num_features;
  parallel_for(frame.config.num_threads, frame.inputs.num_gaussians, kChunk, [&](int64_t begin, int64_t end) {
    RecordSums<S> sums_of(frame, records, nullptr);
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
  refuse_project_backward("cpu::project_backward", frame, footprints);
  const int num_features = frame.config.num_features();
  project_all_backward(frame, gradients, times, [&] {
    return [&](int64_t i, PixelSums<S>& sums) {
      if (frame.images.radii[i] == 0) return false;
      sums = pixel_sums<S>(footprints.records + i * (kNumGateGradients + num_features),
                           frame.saved.features + i * num_features);
      if (footprints.depths != nullptr) sums.depth = footprints.depths[i];
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

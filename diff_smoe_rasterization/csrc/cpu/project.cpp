// Stage 1: every Gaussian to the image plane, and how many tiles each meets.
#include <algorithm>

#include "../refuse.h"
#include "dsmoe/arrays.h"
#include "dsmoe/rasterize.h"
#include "loops.h"
#include "parallel.h"

namespace dsmoe {
namespace cpu {
namespace {

constexpr int64_t kChunk = 1024;  // Gaussians: enough to hide the hand-out, few enough to balance

// How many tiles the footprint of Gaussian i meets.
template <class S> int64_t count_tiles(const Frame<S>& frame, int64_t i) {
  int64_t count = 0;
  for_each_tile_row(frame, i, [&](int x0, int x1, int) { count += x1 - x0; });
  return count;
}

// Makes offsets of the counts that lie one place behind them. Returns how many instances there are.
int64_t sum_counts(int64_t* instance_offsets, int64_t num_gaussians) {
  instance_offsets[0] = 0;
  for (int64_t i = 0; i < num_gaussians; ++i) instance_offsets[i + 1] += instance_offsets[i];
  return instance_offsets[num_gaussians];
}

}  // namespace

template <class S> int64_t project(const Frame<S>& frame, StageTimes* times) {
  refuse_project("cpu::project", frame);
  const GaussianInputs<S>& inputs = frame.inputs;
  const Camera<S>& camera = frame.camera;
  const RasterConfig<S>& config = frame.config;
  const SavedForward<S>& saved = frame.saved;
  const ImageOutputs<S>& images = frame.images;
  const Stopwatch stopwatch(times, &StageTimes::project);
  const int num_features = config.num_features();
  int64_t* counts = saved.instance_offsets == nullptr ? nullptr : saved.instance_offsets + 1;
  parallel_for(config.num_threads, inputs.num_gaussians, kChunk, [&](int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i) {
      S* features = saved.features + i * num_features;
      const auto [radius, gaussian] = project_gaussian<S>({inputs, camera, config, i}, features);
      images.radii[i] = radius;
      if (counts != nullptr) counts[i] = 0;
      if (radius == 0) {
        saved.projected[i] = {};
        std::fill_n(features, num_features, S(0));
        continue;
      }
      saved.projected[i] = gaussian;
      if (counts != nullptr) counts[i] = count_tiles(frame, i);
    }
  });
  return counts == nullptr ? 0 : sum_counts(saved.instance_offsets, inputs.num_gaussians);
}

template <class S> int64_t count_instances(const Frame<S>& frame, StageTimes* times) {
  const SavedForward<S>& saved = frame.saved;
  const Stopwatch stopwatch(times, &StageTimes::bin);
  const int64_t count = frame.inputs.num_gaussians;
  parallel_for(frame.config.num_threads, count, kChunk, [&](int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i) {
      saved.instance_offsets[i + 1] = frame.images.radii[i] == 0 ? 0 : count_tiles(frame, i);
    }
  });
  return sum_counts(saved.instance_offsets, count);
}

template <class S> void mark_visible(const Frame<S>& frame, bool* visible) {
  refuse_mark_visible("cpu::mark_visible", frame, visible);
  for (int64_t i = 0; i < frame.inputs.num_gaussians; ++i) {
    const Camera<S>& camera = frame.camera;
    const auto beyond = [&](const S* view) {
      const Vec3<S> point = transform_point(view, load3(frame.inputs.means3D + 3 * i));
      return view_depth(camera.lens.model, point) > camera.near;
    };
    visible[i] = beyond(camera.view) || (camera.shutter != Shutter::kGlobal && beyond(camera.view_end));
  }
}

#define DSMOE_INSTANTIATE(S)                                      \
  template int64_t project(const Frame<S>&, StageTimes*);         \
  template int64_t count_instances(const Frame<S>&, StageTimes*); \
  template void mark_visible(const Frame<S>&, bool*);
DSMOE_INSTANTIATE(float)
DSMOE_INSTANTIATE(double)
#undef DSMOE_INSTANTIATE

}  // namespace cpu
}  // namespace dsmoe

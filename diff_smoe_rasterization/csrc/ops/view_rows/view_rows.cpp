// The first half of a rendering for the views of a batch, and back: a thread takes a block of Gaussians through all
// views.
#include <algorithm>
#include <cstring>

#include "cpu/parallel.h"
#include "dsmoe/arrays.h"
#include "dsmoe/rasterize.h"
#include "refuse.h"

namespace dsmoe {
namespace cpu {
namespace {

using View = BatchView<Camera<float>>;

// Calls body(block, begin, end) for each block of Gaussians.
template <class Body> void for_each_block(const ViewBatch& batch, const Body& body) {
  parallel_for(batch.config.num_threads, batch.inputs.num_gaussians, kViewBlock,
               [&](int64_t begin, int64_t end) { body(begin / kViewBlock, begin, end); });
}

void project_block(const ViewBatch& batch, const View& view, int64_t row, int64_t begin, int64_t end) {
  for (int64_t i = begin; i < end; ++i) {
    if (view.radii[i] == 0) continue;
    float* features = view.features + row * kRowFeatures;
    Projection<float> projection = project_gaussian<float>({batch.inputs, view.camera, batch.config, i}, features);
    if (projection.radius == 0) {
      projection = {};
      std::fill_n(features, kRowFeatures, 0.0f);
      view.radii[i] = kCulledInRow;
    }
    std::memcpy(features + kRowFeatures - 1, &projection.radius, sizeof(float));
    std::memcpy(view.gates + row * kProjectedGaussianSize, &projection.gaussian, sizeof(projection.gaussian));
    ++row;
  }
}

}  // namespace

void count_rows(const ViewBatch& batch) {
  refuse_batch<Frame<float>>("cpu::count_rows", batch, [](const View&) {});
  for (const View& view : batch.views) view.offsets[0] = 0;
  for_each_block(batch, [&](int64_t block, int64_t begin, int64_t end) {
    for (const View& view : batch.views) {
      int32_t count = 0;
      for (int64_t i = begin; i < end; ++i) {
        const auto gaussian = load_gaussian(batch.inputs, i);
        view.radii[i] = project(gaussian, view.camera, batch.config.projection_rules()).radius;
        count += view.radii[i] > 0;
      }
      view.offsets[block + 1] = count;
    }
  });
  const int64_t blocks = num_view_blocks(batch.inputs.num_gaussians);
  for (const View& view : batch.views) {
    for (int64_t block = 0; block < blocks; ++block) view.offsets[block + 1] += view.offsets[block];
  }
}

void project_rows(const ViewBatch& batch) {
  refuse_rows<Frame<float>>("cpu::project_rows", batch, false);
  for_each_block(batch, [&](int64_t block, int64_t begin, int64_t end) {
    for (const View& view : batch.views) project_block(batch, view, view.offsets[block], begin, end);
  });
}

void project_rows_backward(const ViewBatch& batch, const GaussianGradients<float>& gradients) {
  refuse_rows<Frame<float>>("cpu::project_rows_backward", batch, true);
  const GaussianInputs<float>& inputs = batch.inputs;
  const int num_views = static_cast<int>(batch.views.size());
  for_each_block(batch, [&](int64_t block, int64_t begin, int64_t end) {
    int64_t rows[kMostViews];
    for (int v = 0; v < num_views; ++v) rows[v] = batch.views[v].offsets[block];
    for (int64_t i = begin; i < end; ++i) {
      const Gaussian<float> gaussian = load_gaussian(inputs, i);
      const Colors<float> colors = colors_of(inputs, batch.config.num_channels, i);
      ViewSum<3 * kMaxShCoefficients> sum;
      for (int v = 0; v < num_views; ++v) {
        const View& view = batch.views[v];
        if (view.radii[i] == 0) continue;
        const int64_t row = rows[v]++;
        if (view.radii[i] < 0) continue;
        const auto own = sum.add(gaussian, {colors, gaussian.mean, view.camera, batch.config}, view.camera,
                                 view.features + row * kRowFeatures, view.records + row * (kNumGateGradients + 3));
        if (view.means2D != nullptr) store3<float>(view.means2D + 3 * i, {own.mean2D.x, own.mean2D.y, 0});
      }
      store_gradient(sum.gaussian, gradients, i);
      if (gradients.dc != nullptr) std::copy_n(sum.dc, 3, gradients.dc + 3 * i);
      if (gradients.shs != nullptr) std::copy_n(sum.shs, 3 * inputs.num_sh, gradients.shs + 3 * inputs.num_sh * i);
    }
  });
}

}  // namespace cpu
}  // namespace dsmoe

// dsmoe::core at work: a Frame is filled with pointers to the caller's arrays, and `forward` renders it.
#include <numeric>

#include "dsmoe/gate.h"
#include "dsmoe/rasterize.h"
#include "renderer.h"

namespace dsmoe::tools {
namespace {

/// What a panorama shows of a frame's Gaussians: the footprints that cross its seam lie on both sides of it.
struct AroundTheSeam {
  std::vector<ProjectedGaussian<float>> projected;
  std::vector<float> features;
  std::vector<int32_t> radii, gaussians;  // the Gaussian that a footprint is of

  explicit AroundTheSeam(cpu::Frame<float> frame)
      : projected(static_cast<std::size_t>(frame.inputs.num_gaussians)),
        features(projected.size() * static_cast<std::size_t>(frame.config.num_features())),
        radii(projected.size()),
        gaussians(projected.size()) {
    std::iota(gaussians.begin(), gaussians.end(), 0);
    frame.saved = {};
    frame.saved.projected = projected.data(), frame.saved.features = features.data();
    frame.images.radii = radii.data();
    cpu::project(frame);
    const auto width = static_cast<float>(frame.camera.width);
    const std::size_t count = projected.size();
    for (const float step : {width, -width}) {
      for (std::size_t i = 0; i < count; ++i) {
        const ProjectedGaussian<float>& of = projected[i];
        const float column = of.mean.x;
        const float border = pixel_reach(static_cast<float>(radii[i]), of.opacity, of.squared_reach);
        if (radii[i] > 0 && (step > 0 ? column < border : column > width - 1 - border)) copy(i, step);
      }
    }
  }

 private:
  void copy(std::size_t i, float step) {
    const std::size_t row = features.size() / projected.size();
    ProjectedGaussian<float> moved = projected[i];
    moved.mean.x += step;
    projected.push_back(moved);
    for (std::size_t k = 0; k < row; ++k) features.push_back(features[i * row + k]);
    radii.push_back(radii[i]);
    gaussians.push_back(static_cast<int32_t>(i));
  }
};

class CpuRenderer final : public Renderer {
 public:
  CpuRenderer(const Model& model, const RenderOptions& options)
      : options_(options), radii_(static_cast<std::size_t>(model.count)) {
    frame_.inputs.num_gaussians = model.count;
    frame_.inputs.means3D = model.means3D.data();
    frame_.inputs.opacities = model.opacities.data();
    frame_.inputs.scales = model.scales.data();
    frame_.inputs.rotations = model.rotations.data();
    frame_.inputs.dc = model.dc.data();
    frame_.inputs.shs = model.shs.data();
    frame_.inputs.num_sh = model.num_rest();
    frame_.inputs.sh_degree = model.sh_degree;
    frame_.config = raster_config<float>(options_);
    frame_.config.background = options_.background.data();
    frame_.images.radii = radii_.data();
  }

  Images render(const View& view) override {
    const auto pixels = static_cast<std::size_t>(view.width) * view.height;
    Images out;
    out.width = view.width, out.height = view.height;
    out.color.resize(3 * pixels);
    out.alpha.resize(pixels);
    if (options_.depth) out.depth.resize(pixels);

    frame_.camera = camera_of(view);
    frame_.images.color = out.color.data();
    frame_.images.gate_sum = out.alpha.data();
    frame_.images.depth = options_.depth ? out.depth.data() : nullptr;
    cpu::Heap memory;
    if (view.model != LensModel::kEquirectangular) {
      cpu::forward(frame_, memory);
      find_gates(frame_, out);
      return out;
    }
    AroundTheSeam around(frame_);
    cpu::Frame<float> frame = frame_;
    frame.inputs = {};
    frame.inputs.num_gaussians = static_cast<int64_t>(around.projected.size());
    frame.saved.projected = around.projected.data(), frame.saved.features = around.features.data();
    frame.images.radii = around.radii.data();
    cpu::blend_footprints(frame, memory);
    find_gates(frame, out);
    for (int32_t& gaussian : out.gaussians) {
      if (gaussian >= 0) gaussian = around.gaussians[static_cast<std::size_t>(gaussian)];
    }
    return out;
  }

 private:
  void find_gates(const cpu::Frame<float>& frame, Images& out) const {
    if (!options_.gate_map) return;
    out.gaussians.resize(out.alpha.size());
    out.counts.resize(out.alpha.size());
    cpu::gate_map(frame, {out.gaussians.data(), out.counts.data()});
  }

  const RenderOptions options_;
  std::vector<int32_t> radii_;
  cpu::Frame<float> frame_;
};

}  // namespace

std::unique_ptr<Renderer> make_cpu_renderer(const Model& model, const RenderOptions& options) {
  return std::make_unique<CpuRenderer>(model, options);
}

}  // namespace dsmoe::tools

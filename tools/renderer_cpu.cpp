// dsmoe::core at work: a Frame is filled with pointers to the caller's arrays, and `forward` renders it.
#include "dsmoe/rasterize.h"
#include "renderer.h"

namespace dsmoe::tools {
namespace {

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
    cpu::forward(frame_, memory);

    if (options_.gate_map) {
      out.gaussians.resize(pixels);
      out.counts.resize(pixels);
      cpu::gate_map(frame_, {out.gaussians.data(), out.counts.data()});
    }
    return out;
  }

 private:
  const RenderOptions options_;
  std::vector<int32_t> radii_;
  cpu::Frame<float> frame_;
};

}  // namespace

std::unique_ptr<Renderer> make_cpu_renderer(const Model& model, const RenderOptions& options) {
  return std::make_unique<CpuRenderer>(model, options);
}

}  // namespace dsmoe::tools

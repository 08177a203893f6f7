// A model seen from a view, on the CPU or on a GPU: the two implementations show how the core is used.
#pragma once

#include <array>
#include <cstdint>
#include <memory>
#include <vector>

#include "model.h"
#include "views.h"

namespace dsmoe::tools {

struct RenderOptions {
  BlendRules<double> blend;
  std::array<float, 3> background = {0, 0, 0};
  bool antialiasing = false;
  bool depth = false;     // is wanted
  bool gate_map = false;  // is wanted
  int num_threads = 1;    // CPU
};

/// What one view shows; what was not wanted is empty.
struct Images {
  int width = 0, height = 0;
  std::vector<float> color;        // [3, H, W]
  std::vector<float> alpha;        // [H, W] the gate sum
  std::vector<float> depth;        // [H, W] world; 0 if there is no Gaussian
  std::vector<int32_t> gaussians;  // [H, W] the one of the greatest gate, or -1
  std::vector<int32_t> counts;     // [H, W] Gaussians that were blended
};

class Renderer {
 public:
  virtual ~Renderer() = default;
  virtual Images render(const View& view) = 0;
};

/// `model` must outlive the renderer.
std::unique_ptr<Renderer> make_cpu_renderer(const Model& model, const RenderOptions& options);

/// On the current GPU. Throws std::runtime_error if there is none, and if this build has no CUDA.
std::unique_ptr<Renderer> make_cuda_renderer(const Model& model, const RenderOptions& options);
bool has_cuda_renderer();

/// What both implementations fill in the same way.
template <class S> RasterConfig<S> raster_config(const RenderOptions& options) {
  RasterConfig<S> config;
  config.blend = options.blend.as<S>();
  config.antialiasing = options.antialiasing;
  config.depth = options.depth;
  config.num_threads = options.num_threads;
  return config;
}

}  // namespace dsmoe::tools

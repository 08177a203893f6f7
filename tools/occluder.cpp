#include "occluder.h"

#include <cmath>

#include "dsmoe/sh.h"

namespace dsmoe::tools {
namespace {

constexpr float kOpaque = 0.99f;

/// Adds round, flat Gaussians on a grid over a rectangle at depth z, so dense that two such sheets hide what is behind.
void add_sheet(Model& model, double x0, double x1, double y0, double y1, double z, const Color& color) {
  const double spacing = 0.03 * z, radius = 0.6 * spacing;
  for (double y = y0; y <= y1; y += spacing) {
    for (double x = x0; x <= x1; x += spacing) {
      for (const double value : {x, y, z}) model.means3D.push_back(static_cast<float>(value));
      for (const double value : {radius, radius, 0.01}) model.scales.push_back(static_cast<float>(value));
      for (const float value : {1.0f, 0.0f, 0.0f, 0.0f}) model.rotations.push_back(value);
      for (const float value : color) model.dc.push_back(static_cast<float>((value - 0.5) / kSh0));
      model.opacities.push_back(kOpaque);
      ++model.count;
    }
  }
}

}  // namespace

Model occluder_scene(const OccluderParts& parts) {
  Model model;
  if (parts.panel) {
    add_sheet(model, -0.6, 0.6, -0.6, 0.6, 2.0, {0.1f, 0.2f, 0.8f});
    add_sheet(model, -0.6, 0.6, -0.6, 0.6, 2.1, {0.1f, 0.2f, 0.8f});
  }
  for (const double x : {-0.75, 0.0, 0.75}) {
    if (parts.bars) add_sheet(model, x - 0.15, x + 0.15, -1.7, 1.7, 4, {1, 0, 0});
  }
  if (parts.backdrop) add_sheet(model, -4, 4, -4, 4, 6, {0.9f, 0.9f, 0.8f});
  return model;
}

View occluder_view(int size) {
  View view;  // at the origin, along z
  view.name = "occluder";
  view.width = view.height = size;
  view.fx = view.fy = size;
  view.cx = view.cy = size / 2.0;
  view.rotation = {1, 0, 0, 0, 1, 0, 0, 0, 1};
  return view;
}

OccluderRendering render_occluder(BlendMode mode, int size, int num_threads) {
  const View view = occluder_view(size);
  const auto render = [&](const OccluderParts& parts, BlendMode in_mode) {
    const Model model = occluder_scene(parts);
    RenderOptions options;
    options.blend.mode = in_mode;
    options.num_threads = num_threads;
    return make_cpu_renderer(model, options)->render(view);
  };
  const std::vector<float> panel = render({true, false, false}, BlendMode::kAlpha).alpha;
  const std::vector<float> bars = render({false, true, false}, BlendMode::kAlpha).alpha;
  const Images without = render({true, false, true}, mode);
  OccluderRendering out = {render({true, true, true}, mode), {}};
  for (std::size_t pixel = 0; pixel < panel.size(); ++pixel) {
    // The panel lets less than a level of 255 through, and the bars would be seen there.
    if (panel[pixel] < 1 - 1 / 255.0 || bars[pixel] < 0.5) continue;
    ++out.ghost.pixels;
    for (int c = 0; c < 3; ++c) {
      const double change = out.images.color[c * panel.size() + pixel] - without.color[c * panel.size() + pixel];
      out.ghost.change += std::abs(change) / 3;
      if (c == 0) out.ghost.leak += change;
    }
  }
  out.ghost.leak /= out.ghost.pixels;
  out.ghost.change /= out.ghost.pixels;
  return out;
}

}  // namespace dsmoe::tools

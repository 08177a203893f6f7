// The two renderers of the tools: the same pictures, on the CPU and, if there is one, on a GPU.
#include "renderer.h"

#include <gtest/gtest.h>

#include <cmath>
#include <stdexcept>

#include "finite_difference.h"

namespace dsmoe::tools {
namespace {

Model make_model(int count) {
  Random random(3);
  Model model;
  model.count = count;
  model.sh_degree = 1;
  const auto add = [&](std::vector<float>& values, int size, double low, double high) {
    for (int k = 0; k < size; ++k) values.push_back(static_cast<float>(random.uniform(low, high)));
  };
  for (int i = 0; i < count; ++i) {
    add(model.means3D, 3, -1, 1);
    add(model.dc, 3, -1, 1);
    add(model.shs, 9, -0.3, 0.3);
    add(model.opacities, 1, 0.05, 0.95);
    add(model.scales, 3, 0.02, 0.15);
    add(model.rotations, 4, -1, 1);
  }
  return model;
}

View make_view() {
  Orbit orbit;
  orbit.distance = 4;
  orbit.width = 131, orbit.height = 83;
  return orbit_views(orbit)[10];
}

RenderOptions options_of(BlendMode mode) {
  RenderOptions options;
  options.blend.mode = mode;
  if (mode == BlendMode::kSmoe) options.blend.background_gate = 0.05;
  options.background = {0.1f, 0.5f, 0.9f};
  options.depth = options.gate_map = true;
  return options;
}

TEST(Renderer, OnAGpuDrawsWhatTheCpuDraws) {
  if (!has_cuda_renderer()) GTEST_SKIP() << "built without CUDA";
  const Model model = make_model(800);
  const View view = make_view();
  for (int mode = 0; mode < BlendModes::kSize; ++mode) {
    const RenderOptions options = options_of(static_cast<BlendMode>(mode));
    std::unique_ptr<Renderer> on_gpu;
    try {
      on_gpu = make_cuda_renderer(model, options);
    } catch (const std::runtime_error& error) {
      GTEST_SKIP() << error.what();
    }
    const Images expected = make_cpu_renderer(model, options)->render(view);
    for (int time = 0; time < 2; ++time) {  // the second time the number of instances is known
      const Images actual = on_gpu->render(view);
      ASSERT_EQ(actual.color.size(), expected.color.size());
      // A pair within rounding of a threshold may count on one side only: up to 1/255 of a pixel, and one in its count.
      // If two gates are equal but for rounding, either is the greatest.
      const std::size_t pixels = expected.alpha.size();
      std::size_t num_different = 0;
      for (std::size_t i = 0; i < pixels; ++i) {
        bool equal = actual.gaussians[i] == expected.gaussians[i] && actual.counts[i] == expected.counts[i];
        for (int c = 0; c < 3; ++c) {
          const float difference = std::abs(actual.color[c * pixels + i] - expected.color[c * pixels + i]);
          EXPECT_LT(difference, 2 / 255.0);
          equal = equal && difference < 1e-4f;
        }
        equal = equal && std::abs(actual.alpha[i] - expected.alpha[i]) < 1e-4f * std::max(1.0f, expected.alpha[i]);
        equal = equal && std::abs(actual.depth[i] - expected.depth[i]) < 1e-3f;
        num_different += !equal;
      }
      EXPECT_LT(num_different, pixels / 200) << "mode " << mode;
    }
  }
}

TEST(Renderer, MapsGatesOnlyWhereTheyAreWanted) {
  const Model model = make_model(50);
  RenderOptions options;
  options.blend.mode = BlendMode::kSmoe;
  Images images = make_cpu_renderer(model, options)->render(make_view());
  EXPECT_TRUE(images.depth.empty());
  EXPECT_TRUE(images.gaussians.empty());
  options.depth = options.gate_map = true;
  images = make_cpu_renderer(model, options)->render(make_view());
  for (std::size_t i = 0; i < images.alpha.size(); ++i) {
    EXPECT_EQ(images.counts[i] > 0, images.alpha[i] > 0);
    EXPECT_EQ(images.gaussians[i] >= 0, images.alpha[i] > 0);
    EXPECT_EQ(images.depth[i] > 0, images.alpha[i] > 0);
  }
}

TEST(Renderer, NamesTheGaussiansOnBothSidesOfAPanoramasSeam) {
  Model model = make_model(1);
  Orbit orbit;
  orbit.distance = 4, orbit.elevation = 0;
  orbit.width = 64, orbit.height = 32;
  View view = orbit_views(orbit)[0];
  set_panorama(view);
  const Camera<float> camera = camera_of(view);
  // Twice as far away from the orbit's middle as the camera is: straight behind it.
  for (int k = 0; k < 3; ++k) model.means3D[k] = 2 * camera.position[k];
  model.scales = {0.5f, 0.5f, 0.5f}, model.rotations = {1, 0, 0, 0}, model.opacities = {0.9f};
  const Images images = make_cpu_renderer(model, options_of(BlendMode::kAlpha))->render(view);
  const int row = 16 * images.width;
  for (const int column : {0, 1, images.width - 2, images.width - 1}) {
    EXPECT_EQ(images.gaussians[row + column], 0);
    EXPECT_EQ(images.counts[row + column], 1);
    EXPECT_NEAR(images.depth[row + column], 4, 1e-4);
    EXPECT_NEAR(images.alpha[row + column], images.alpha[row + images.width - 1 - column], 1e-5);
  }
  EXPECT_EQ(images.gaussians[row + images.width / 2], -1);
}

}  // namespace
}  // namespace dsmoe::tools

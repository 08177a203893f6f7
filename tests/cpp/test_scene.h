// Small scenes, and the CPU backend run on them with all its buffers.
#pragma once

#include <algorithm>
#include <cmath>
#include <limits>
#include <memory>
#include <vector>

#include "cpu/tile_kernels.h"
#include "dsmoe/rasterize.h"
#include "finite_difference.h"

namespace dsmoe {

// Owns what GaussianInputs, Camera and RasterConfig point to; an absent input is an empty vector.
template <class S> struct Scene {
  int64_t count = 0;
  Camera<S> camera;
  RasterConfig<S> config;                                      // but for the background
  std::vector<S> background = {S(0.2), S(0.5), S(0.8), S(0)};  // [C + 1] its colour, and its gate
  std::vector<S> means3D, opacities, scales, rotations, cov3D_precomp, colors_precomp, dc, shs;
  int sh_degree = 0;

  GaussianInputs<S> inputs() const {
    GaussianInputs<S> in;
    auto pointer = [](const std::vector<S>& v) { return v.empty() ? nullptr : v.data(); };
    in.num_gaussians = count;
    in.means3D = pointer(means3D);
    in.opacities = pointer(opacities);
    in.scales = pointer(scales);
    in.rotations = pointer(rotations);
    in.cov3D_precomp = pointer(cov3D_precomp);
    in.colors_precomp = pointer(colors_precomp);
    in.dc = pointer(dc);
    in.shs = pointer(shs);
    in.num_sh = count > 0 ? static_cast<int>(shs.size() / (3 * count)) : 0;
    in.sh_degree = sh_degree;
    return in;
  }

  RasterConfig<S> raster_config() const {
    RasterConfig<S> out = config;
    out.background = background.data();
    out.blend.background_gate_at = out.background + out.num_channels;
    return out;
  }

  int64_t pixels() const { return static_cast<int64_t>(camera.width) * camera.height; }

  // Every array of numbers, in a fixed order: what gradients are taken by.
  template <class Visit> void for_each_array(Visit visit) {
    for (auto* v :
         {&means3D, &opacities, &scales, &rotations, &cov3D_precomp, &colors_precomp, &dc, &shs, &background}) {
      visit(v->data(), v->size());
    }
    visit(camera.view, size_t(16));
    visit(camera.projection, size_t(16));
    visit(camera.position, size_t(3));
    visit(camera.view_end, size_t(16));
  }

  std::vector<S> flat() {
    std::vector<S> out;
    for_each_array([&](const S* values, size_t size) { out.insert(out.end(), values, values + size); });
    return out;
  }

  void set_flat(const std::vector<S>& values) {
    auto next = values.begin();
    for_each_array([&](S* array, size_t size) {
      std::copy(next, next + size, array);
      next += size;
    });
  }
};

// A camera off the axes, with an off-centre principal point, 3 in front of the origin.
inline Camera<double> make_camera(int width, int height) {
  Camera<double> camera;
  camera.width = width;
  camera.height = height;
  camera.tan_fov_x = 0.6;
  camera.tan_fov_y = 0.6 * height / width;
  const double a = 0.3, b = -0.2;  // turns around y, then x
  const double ca = std::cos(a), sa = std::sin(a), cb = std::cos(b), sb = std::sin(b);
  const double r[3][3] = {{ca, 0, sa}, {sb * sa, cb, -sb * ca}, {-cb * sa, sb, cb * ca}};
  const double t[3] = {0.1, -0.05, 3};
  const double p[4][4] = {
      {1 / camera.tan_fov_x, 0, 0.05, 0}, {0, 1 / camera.tan_fov_y, -0.03, 0}, {0, 0, 1, -0.01}, {0, 0, 1, 0}};
  for (int row = 0; row < 3; ++row) {
    for (int column = 0; column < 3; ++column) camera.view[4 * column + row] = r[row][column];
    camera.view[12 + row] = t[row];
  }
  camera.view[15] = 1;
  for (int row = 0; row < 4; ++row) {
    for (int column = 0; column < 4; ++column) {
      for (int k = 0; k < 4; ++k) camera.projection[4 * column + row] += p[row][k] * camera.view[4 * column + k];
    }
  }
  for (int k = 0; k < 3; ++k) camera.position[k] = -(r[0][k] * t[0] + r[1][k] * t[1] + r[2][k] * t[2]);
  return camera;
}

// Of the same image: one of every kind, of coefficients that bend it well.
inline std::vector<Lens<double>> make_lenses(int width, int height) {
  const auto lens = [&](LensModel model, double focal, std::vector<double> distortion) {
    return lens_of({model, width, height, focal * width, focal * width, 0.53 * width, 0.48 * height, distortion});
  };
  return {lens(LensModel::kOrthographic, 0.3, {}),
          lens(LensModel::kOpencv, 0.8, {-0.2, 0.05, 0.01, -0.02, 0.03, 0.01, 0.02, -0.01, 0.01, -0.005, 0.004, 0.003}),
          lens(LensModel::kFisheye, 0.4, {0.02, -0.01, 0.003, -0.0002}),
          lens(LensModel::kThinPrismFisheye, 0.4, {0.02, -0.01, 0.003, -0.002, 0.01, 0.001, 0.02, -0.01}),
          lens(LensModel::kEquirectangular, 0, {})};
}

// Turns and shifts the camera by some pixels while the image is read out.
template <class S> void set_shutter(Camera<S>& camera, Shutter shutter) {
  camera.shutter = shutter;
  std::copy_n(camera.view, 16, camera.view_end);
  const S turn[3] = {S(0.03), S(-0.05), S(0.04)}, shift[3] = {S(0.1), S(-0.12), S(0.08)};
  for (int row = 0; row < 4; ++row) {
    const S *from = camera.view + 4 * row, x = from[0], y = from[1], z = from[2];
    S* to = camera.view_end + 4 * row;
    to[0] += turn[1] * z - turn[2] * y, to[1] += turn[2] * x - turn[0] * z, to[2] += turn[0] * y - turn[1] * x;
    for (int k = 0; row == 3 && k < 3; ++k) to[k] += shift[k];
  }
}
constexpr Shutter kRolling[] = {Shutter::kTopToBottom, Shutter::kLeftToRight, Shutter::kBottomToTop,
                                Shutter::kRightToLeft};

// Odd seeds have a gate for the background. Gaussians around the origin: some off the image or behind the camera, some
// more than opaque, some not there at all.
inline Scene<double> make_scene(unsigned seed, int count, int width, int height) {
  Random random(seed);
  Scene<double> scene;
  scene.count = count;
  scene.camera = make_camera(width, height);
  scene.sh_degree = 1;
  if (seed % 2 == 1) scene.background[3] = 0.15;
  for (int i = 0; i < count; ++i) {
    for (int k = 0; k < 3; ++k) scene.means3D.push_back(random.uniform(-2, 2) * (i % 7 == 0 ? 3 : 1));
    scene.opacities.push_back(i % 13 == 12 ? -0.1
                              : i % 5 == 4 ? random.uniform(0.9, 2)
                                           : random.log_uniform(1e-3, 0.9));
    for (int k = 0; k < 3; ++k) scene.scales.push_back(random.log_uniform(0.01, 0.4));
    for (int k = 0; k < 4; ++k) scene.rotations.push_back(random.uniform(-1, 1));
    for (int k = 0; k < 12; ++k) scene.shs.push_back(random.uniform(-0.8, 0.8));
  }
  return scene;
}

template <class To, class From> Scene<To> convert(const Scene<From>& from) {
  Scene<To> to;
  to.count = from.count;
  to.sh_degree = from.sh_degree;
  to.camera.width = from.camera.width, to.camera.height = from.camera.height;
  to.camera.tan_fov_x = To(from.camera.tan_fov_x), to.camera.tan_fov_y = To(from.camera.tan_fov_y);
  to.camera.near = To(from.camera.near);
  to.camera.lens = from.camera.lens.template as<To>();
  to.camera.shutter = from.camera.shutter;
  to.config.blend = from.config.blend.template as<To>();
  to.config.num_channels = from.config.num_channels;
  to.config.scale_modifier = To(from.config.scale_modifier);
  to.config.antialiasing = from.config.antialiasing;
  to.config.clamp_color = from.config.clamp_color;
  to.config.depth = from.config.depth;
  to.config.inverse_depth = from.config.inverse_depth;
  to.config.num_threads = from.config.num_threads;
  auto copy = [](const std::vector<From>& v) { return std::vector<To>(v.begin(), v.end()); };
  to.background = copy(from.background);
  to.means3D = copy(from.means3D), to.opacities = copy(from.opacities);
  to.scales = copy(from.scales), to.rotations = copy(from.rotations);
  to.cov3D_precomp = copy(from.cov3D_precomp), to.colors_precomp = copy(from.colors_precomp);
  to.dc = copy(from.dc), to.shs = copy(from.shs);
  std::copy(from.camera.view, from.camera.view + 16, to.camera.view);
  std::copy(from.camera.projection, from.camera.projection + 16, to.camera.projection);
  std::copy(from.camera.position, from.camera.position + 3, to.camera.position);
  std::copy(from.camera.view_end, from.camera.view_end + 16, to.camera.view_end);
  return to;
}

// The buffers of a forward pass. Filled with numbers that no result is, so that what was not written shows.
template <class S> struct Rendering {
  std::vector<ProjectedGaussian<S>> projected;
  std::vector<S> features;
  std::vector<int64_t> instance_offsets, tile_offsets;
  std::vector<TileInstance> instances;
  std::vector<S> final_transmittance, gate_sum, sums, color, depth, inverse_depth;
  std::vector<int32_t> last_contributor, radii;

  explicit Rendering(const Scene<S>& scene) {
    const S unwritten = S(-12345);
    projected.resize(scene.count);
    features.resize(scene.count * scene.config.num_features(), unwritten);
    instance_offsets.resize(scene.count + 1, -1);
    tile_offsets.resize(num_tiles(scene.camera.width, scene.camera.height) + 1, -1);
    for (auto* image : {&final_transmittance, &gate_sum}) image->resize(scene.pixels(), unwritten);
    if (has_tails(scene.config.blend.mode)) sums.resize(2 * scene.pixels(), unwritten);
    color.resize(scene.pixels() * scene.config.num_channels, unwritten);
    if (scene.config.depth) depth.resize(scene.pixels(), unwritten);
    if (scene.config.inverse_depth) inverse_depth.resize(scene.pixels(), unwritten);
    last_contributor.resize(scene.pixels(), -1);
    radii.resize(scene.count, -1);
  }

  SavedForward<S> saved() {
    SavedForward<S> out;
    out.projected = projected.data(), out.features = features.data();
    out.instance_offsets = instance_offsets.data(), out.tile_offsets = tile_offsets.data();
    out.instances = instances.data();
    out.final_transmittance = final_transmittance.data(), out.last_contributor = last_contributor.data();
    out.sums = sums.data();
    SavedSizes sizes;
    sizes.pixels = static_cast<int64_t>(gate_sum.size()), sizes.tails = !sums.empty();
    set_sums(out, sizes, gate_sum.data());
    return out;
  }
  ImageOutputs<S> images() {
    return {color.data(), depth.empty() ? nullptr : depth.data(),
            inverse_depth.empty() ? nullptr : inverse_depth.data(), radii.data(), gate_sum.data()};
  }
};

template <class S> cpu::Frame<S> frame_of(const Scene<S>& scene, Rendering<S>& rendering) {
  return {scene.inputs(), scene.camera, scene.raster_config(), rendering.images(), rendering.saved()};
}

template <class S> Rendering<S> project_and_bin(const Scene<S>& scene) {
  Rendering<S> out(scene);
  out.instances.resize(cpu::project(frame_of(scene, out)));
  cpu::bin(frame_of(scene, out));
  return out;
}

template <class S> Rendering<S> render(const Scene<S>& scene) {
  Rendering<S> out = project_and_bin(scene);
  cpu::blend(frame_of(scene, out));
  return out;
}

// Gradients on the images, one number a pixel and output.
template <class S> struct ImageWeights {
  std::vector<S> color, gate_sum, depth, inverse_depth;

  ImageWeights(const Scene<S>& scene, unsigned seed) {
    Random random(seed);
    auto fill = [&](std::vector<S>& out, int64_t size) {
      for (int64_t i = 0; i < size; ++i) out.push_back(S(random.uniform(-1, 1)));
    };
    fill(color, scene.pixels() * scene.config.num_channels);
    fill(gate_sum, scene.pixels());
    if (scene.config.depth) fill(depth, scene.pixels());
    if (scene.config.inverse_depth) fill(inverse_depth, scene.pixels());
  }

  ImageGradients<S> gradients() const {
    auto pointer = [](const std::vector<S>& v) { return v.empty() ? nullptr : v.data(); };
    return {pointer(color), pointer(gate_sum), pointer(depth), pointer(inverse_depth)};
  }

  double loss(const Rendering<S>& r) const {
    double sum = 0;
    for (size_t i = 0; i < color.size(); ++i) sum += double(color[i]) * r.color[i];
    for (size_t i = 0; i < gate_sum.size(); ++i) sum += double(gate_sum[i]) * r.gate_sum[i];
    for (size_t i = 0; i < depth.size(); ++i) sum += double(depth[i]) * r.depth[i];
    for (size_t i = 0; i < inverse_depth.size(); ++i) sum += double(inverse_depth[i]) * r.inverse_depth[i];
    return sum;
  }
};

// The gradient of every array of a scene, in a scene of the same shape.
template <class S> struct SceneGradient {
  Scene<S> by;
  std::vector<S> means2D;
  CameraGradient<S> camera;

  // All NaN, so that what is not written shows.
  explicit SceneGradient(const Scene<S>& scene) : by(scene), means2D(3 * scene.count) {
    const S nan = std::numeric_limits<S>::quiet_NaN();
    by.for_each_array([&](S* values, size_t size) { std::fill(values, values + size, nan); });
    std::fill(means2D.begin(), means2D.end(), nan);
    camera.view[0] = nan;
  }

  GaussianGradients<S> gradients() {
    auto pointer = [](std::vector<S>& v) { return v.empty() ? nullptr : v.data(); };
    return {pointer(by.means3D),
            pointer(means2D),
            pointer(by.opacities),
            pointer(by.scales),
            pointer(by.rotations),
            pointer(by.cov3D_precomp),
            pointer(by.colors_precomp),
            pointer(by.dc),
            pointer(by.shs),
            pointer(by.background),
            &camera};
  }

  std::vector<S> flat() {
    std::copy(camera.view, camera.view + 16, by.camera.view);
    std::copy(camera.projection, camera.projection + 16, by.camera.projection);
    std::copy(camera.position, camera.position + 3, by.camera.position);
    std::copy(camera.view_end, camera.view_end + 16, by.camera.view_end);
    return by.flat();
  }
};

template <class S>
SceneGradient<S> render_backward(const Scene<S>& scene, Rendering<S>& rendering, const ImageGradients<S>& weights) {
  SceneGradient<S> out(scene);
  cpu::backward(frame_of(scene, rendering), {weights, out.gradients()});
  return out;
}

}  // namespace dsmoe

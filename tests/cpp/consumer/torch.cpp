// The rasterizer for LibTorch, through the installed library: against the core, finite differences and formulas.
#include "dsmoe/torch.h"

#include <c10/core/GradMode.h>
#include <gtest/gtest.h>

#include <cmath>
#include <functional>

#include "dsmoe/rasterize.h"
#include "dsmoe/torch_training.h"
#include "scene.h"

namespace {

using dsmoe::GaussianRasterizationSettings;
using dsmoe::RasterizeArguments;

constexpr int64_t kGaussians = 40, kSize = 24;

at::Tensor random(at::IntArrayRef shape, double low, double high) {
  return low + (high - low) * at::rand(shape, at::kDouble);
}

// Gaussians in front of a camera that sees all of them, with every kind of gradient.
struct Scene {
  at::Tensor means3D = at::cat({random({kGaussians, 2}, -1, 1), random({kGaussians, 1}, 2, 4)}, 1);
  at::Tensor opacities = random({kGaussians, 1}, 0.1, 0.9);
  GaussianRasterizationSettings settings;
  RasterizeArguments arguments;

  explicit Scene(const std::string& mode) {
    settings.image_width = settings.image_height = kSize;
    settings.tanfovx = settings.tanfovy = 0.7;
    settings.bg = random({3}, 0, 1);
    settings.viewmatrix = at::eye(4, at::kDouble);
    settings.projmatrix = at::zeros({4, 4}, at::kDouble);
    settings.projmatrix[0][0] = settings.projmatrix[1][1] = 1 / 0.7;
    settings.projmatrix[2][2] = settings.projmatrix[2][3] = 1;
    settings.campos = at::zeros({3}, at::kDouble);
    settings.sh_degree = 2;
    settings.blend_mode = mode;
    if (mode == "smoe" || mode == "smoe_eq7") settings.background_gate = random({1}, 0.2, 0.5);
    arguments.means2D = at::zeros({kGaussians, 3}, at::kDouble);
    arguments.dc = random({kGaussians, 1, 3}, 0.5, 1);
    arguments.shs = random({kGaussians, 8, 3}, -0.1, 0.1);
    arguments.scales = random({kGaussians, 3}, 0.05, 0.2);
    arguments.rotations = at::randn({kGaussians, 4}, at::kDouble);
    arguments.outputs = {"alpha", "depth", "inverse_depth"};
  }

  // Every tensor that gets a gradient.
  std::vector<at::Tensor*> tensors() {
    std::vector<at::Tensor*> all = {
        &means3D,          &opacities,           &arguments.means2D, &arguments.dc,        &arguments.shs,
        &arguments.scales, &arguments.rotations, &settings.bg,       &settings.viewmatrix, &settings.projmatrix,
        &settings.campos};
    if (settings.background_gate) all.push_back(&settings.background_gate->tensor);
    if (settings.viewmatrix_end.defined()) all.push_back(&settings.viewmatrix_end);
    return all;
  }

  void roll() {
    settings.rolling_shutter = "left_to_right";
    settings.principal_point = {kSize / 2 + 1.0, kSize / 2 - 0.5};
    settings.viewmatrix_end = settings.viewmatrix + 0.05 * at::randn({4, 4}, at::kDouble);
  }

  dsmoe::Rendering render() const { return dsmoe::rasterize(means3D, opacities, settings, arguments); }
};

std::vector<at::Tensor> weights() {
  std::vector<at::Tensor> all;
  for (int64_t channels : {3, 1, 1, 1}) all.push_back(random({channels, kSize, kSize}, -1, 1));
  return all;
}

at::Tensor loss(const dsmoe::Rendering& rendering, const std::vector<at::Tensor>& w) {
  return (rendering.color * w[0]).sum() + (rendering.alpha * w[1]).sum() + (rendering.depth * w[2]).sum() +
         (rendering.inverse_depth * w[3]).sum();
}

class Modes : public testing::TestWithParam<const char*> {
 protected:
  void SetUp() override { at::manual_seed(7); }
};

INSTANTIATE_TEST_SUITE_P(All, Modes, testing::Values("alpha", "smoe", "smoe_eq7", "smoe_tn", "smoe_std"),
                         [](const auto& info) { return std::string(info.param); });

// The same arithmetic in the same order: equal bit for bit.
TEST_P(Modes, GradientsAreTheCores) {
  Scene scene(GetParam());
  const auto w = weights();
  for (at::Tensor* tensor : scene.tensors()) tensor->requires_grad_();
  const dsmoe::Rendering rendering = scene.render();
  loss(rendering, w).backward();

  const auto data = [](const at::Tensor& tensor) { return tensor.data_ptr<double>(); };
  dsmoe::cpu::Frame<double> frame;
  auto& inputs = frame.inputs;
  inputs.num_gaussians = kGaussians;
  inputs.means3D = data(scene.means3D), inputs.opacities = data(scene.opacities);
  inputs.scales = data(scene.arguments.scales), inputs.rotations = data(scene.arguments.rotations);
  inputs.dc = data(scene.arguments.dc), inputs.shs = data(scene.arguments.shs);
  inputs.num_sh = 8, inputs.sh_degree = 2;
  auto& camera = frame.camera;
  camera.width = camera.height = kSize;
  camera.tan_fov_x = camera.tan_fov_y = 0.7;
  camera.near = 0.2f;
  std::copy_n(data(scene.settings.viewmatrix), 16, camera.view);
  std::copy_n(data(scene.settings.projmatrix), 16, camera.projection);
  std::copy_n(data(scene.settings.campos), 3, camera.position);
  auto& config = frame.config;
  dsmoe::BlendModes::for_each([&](auto mode) {
    if (std::string(GetParam()) == dsmoe::Blend<decltype(mode)::value>::kName) config.blend.mode = mode();
  });
  config.background = data(scene.settings.bg);
  config.blend.background_gate = config.blend.mode == dsmoe::BlendMode::kAlpha ? 1 : 0;
  if (scene.settings.background_gate) config.blend.background_gate_at = data(scene.settings.background_gate->tensor);
  config.depth = config.inverse_depth = true;
  const at::Tensor color = at::zeros({3, kSize, kSize}, at::kDouble), alpha = at::zeros({kSize, kSize}, at::kDouble);
  const at::Tensor depth = at::zeros_like(alpha), inverse_depth = at::zeros_like(alpha);
  const at::Tensor radii = at::zeros({kGaussians}, at::kInt);
  frame.images = {data(color), data(depth), data(inverse_depth), radii.data_ptr<int32_t>(), data(alpha)};
  dsmoe::cpu::Heap heap;
  dsmoe::cpu::forward(frame, heap);
  EXPECT_TRUE(at::equal(color, rendering.color) && at::equal(radii, rendering.radii));
  EXPECT_TRUE(at::equal(alpha[0], rendering.alpha[0][0]) && at::equal(depth, rendering.depth[0]));
  EXPECT_TRUE(at::equal(inverse_depth, rendering.inverse_depth[0]));
  EXPECT_GT(rendering.radii.count_nonzero().item<int64_t>(), kGaussians / 2);

  // The scores too, without and with a gradient.
  const at::Tensor e = random({kSize, kSize}, 0, 1), f = random({kSize, kSize}, 0, 1);
  const auto sum = [] { return at::zeros({kGaussians}, at::kDouble); };
  const at::Tensor pixels = at::zeros({kGaussians}, at::kInt);
  const std::vector<at::Tensor> sums = {sum(), sum(), sum(), sum(), sum(), sum()};
  dsmoe::cpu::contributions(frame,
                            {data(e), {data(sums[0]), pixels.data_ptr<int32_t>(), data(sums[1]), data(sums[2])}});
  dsmoe::cpu::importance(frame, {data(color), data(e), data(f), {data(sums[3]), data(sums[4]), data(sums[5])}});
  const auto map = [] { return at::zeros({kSize, kSize}, at::kInt); };
  const at::Tensor greatest = map(), counts = map(), medians = map();
  dsmoe::cpu::gate_map(frame, {greatest.data_ptr<int32_t>(), counts.data_ptr<int32_t>(), medians.data_ptr<int32_t>()});
  EXPECT_EQ(counts.sum().item<int64_t>(), pixels.sum().item<int64_t>());
  for (const bool differentiable : {true, false}) {
    const c10::AutoGradMode mode(differentiable);
    const auto splats =
        dsmoe::rasterize_with_splats(scene.means3D, scene.opacities, scene.settings, scene.arguments).second;
    const auto contributions = splats.contributions(e);
    const auto importance = splats.importance(e, f);
    const std::vector<at::Tensor> actual = {contributions.pixel_weights, contributions.blend_weights,
                                            contributions.distances,     importance.shares,
                                            importance.squared_shares,   importance.removal_costs};
    for (size_t i = 0; i < sums.size(); ++i) EXPECT_TRUE(at::equal(actual[i], sums[i])) << "sums " << i;
    EXPECT_TRUE(at::equal(contributions.pixels, pixels));
    const auto [gaussians, in_pixels, halfway] = splats.gate_map();
    EXPECT_TRUE(at::equal(gaussians, greatest) && at::equal(in_pixels, counts) && at::equal(halfway, medians));
    EXPECT_GT(pixels.sum().item<int64_t>(), 0);
    const at::Tensor ones = at::ones({kSize, kSize}, at::kDouble);
    EXPECT_TRUE(at::equal(splats.importance().shares, splats.importance(ones, ones).shares));
  }
  EXPECT_THROW(dsmoe::Splats().contributions(e), c10::ValueError);
  EXPECT_THROW(dsmoe::Splats().importance(), c10::ValueError);

  dsmoe::cpu::Gradients<double> gradients;
  gradients.images = {data(w[0]), data(w[1]), data(w[2]), data(w[3])};
  std::vector<at::Tensor> own;
  for (at::Tensor* tensor : scene.tensors()) own.push_back(at::zeros(tensor->sizes(), at::kDouble));
  const at::Tensor camera_gradient = at::zeros({51}, at::kDouble), background = at::zeros({4}, at::kDouble);
  auto& by = gradients.inputs;
  by.means3D = data(own[0]), by.opacities = data(own[1]), by.means2D = data(own[2]), by.dc = data(own[3]);
  by.shs = data(own[4]), by.scales = data(own[5]), by.rotations = data(own[6]);
  by.camera = reinterpret_cast<dsmoe::CameraGradient<double>*>(data(camera_gradient));
  by.background = data(background);
  dsmoe::cpu::backward(frame, gradients);
  own[7] = background.slice(0, 0, 3), own[8] = camera_gradient.slice(0, 0, 16).view({4, 4});
  own[9] = camera_gradient.slice(0, 16, 32).view({4, 4}), own[10] = camera_gradient.slice(0, 32, 35);
  if (own.size() > 11) own[11] = background.slice(0, 3);
  const auto tensors = scene.tensors();
  constexpr size_t kBackground = 7;
  // The ablations see it only if no gate is open, and here one is everywhere.
  const bool sees_background =
      config.blend.mode != dsmoe::BlendMode::kSmoeTn && config.blend.mode != dsmoe::BlendMode::kSmoeStd;
  for (size_t i = 0; i < tensors.size(); ++i) {
    ASSERT_TRUE(tensors[i]->grad().defined()) << "tensor " << i;
    EXPECT_TRUE(at::equal(tensors[i]->grad(), own[i])) << "tensor " << i;
    if (i == kBackground && !sees_background) continue;
    EXPECT_GT(own[i].count_nonzero().item<int64_t>(), 0) << "tensor " << i;
  }
}

// In a random direction of all tensors but means2D, whose value is ignored. A step of 1e-6 leaves an error of 1e-6^2
// times a third derivative, and 1e-16 / 1e-6 of rounding, both relative to the loss's size. Gradients leave out how
// tails move, so no tails count here.
void expect_gradients_of_finite_differences(Scene scene) {
  scene.settings.faint_below = 0;
  const auto w = weights();
  double predicted = 0;
  std::vector<at::Tensor> directions;
  for (at::Tensor* tensor : scene.tensors()) tensor->requires_grad_();
  loss(scene.render(), w).backward();
  for (at::Tensor* tensor : scene.tensors()) {
    directions.push_back(at::randn(tensor->sizes(), at::kDouble) * (tensor == &scene.arguments.means2D ? 0 : 1e-2));
    predicted += (tensor->grad() * directions.back()).sum().item<double>();
  }
  const auto loss_at = [&](double step) {
    Scene moved = scene;
    const auto tensors = moved.tensors();
    for (size_t i = 0; i < tensors.size(); ++i) *tensors[i] = tensors[i]->detach() + step * directions[i];
    return loss(moved.render(), w).item<double>();
  };
  const double step = 1e-6, measured = (loss_at(step) - loss_at(-step)) / (2 * step);
  EXPECT_NEAR(predicted, measured, 1e-6 * std::abs(measured) + 1e-7);
}

TEST_P(Modes, GradientsAreThoseOfFiniteDifferences) { expect_gradients_of_finite_differences(Scene(GetParam())); }

TEST_P(Modes, GradientsOfARollingShutterAreThoseOfFiniteDifferences) {
  Scene scene(GetParam());
  const at::Tensor still = scene.render().color;
  scene.roll();
  EXPECT_FALSE(at::allclose(scene.render().color, still, 0, 1e-3));
  expect_gradients_of_finite_differences(scene);
}

TEST(Torch, OneGaussianIsWhatTheConsumersExpect) {
  const auto tensor = [](const float* values, at::IntArrayRef shape) {
    return at::from_blob(const_cast<float*>(values), shape, at::kFloat).clone();
  };
  GaussianRasterizationSettings settings;
  settings.image_width = settings.image_height = scene::kSize;
  settings.tanfovx = settings.tanfovy = scene::kTanFov;
  settings.bg = tensor(scene::kBackground, {3});
  settings.viewmatrix = tensor(scene::kView, {4, 4});
  settings.projmatrix = tensor(scene::kProjection, {4, 4});
  settings.campos = tensor(scene::kPosition, {3});
  settings.blend_mode = "smoe";
  RasterizeArguments arguments;
  arguments.colors_precomp = tensor(scene::kExpert, {1, 3}).requires_grad_();
  arguments.scales = tensor(scene::kScale, {1, 3});
  arguments.rotations = tensor(scene::kRotation, {1, 4});
  const auto rendering =
      dsmoe::rasterize(tensor(scene::kMean, {1, 3}), tensor(scene::kOpacity, {1}), settings, arguments);
  EXPECT_FALSE(rendering.alpha.defined() || rendering.depth.defined() || rendering.inverse_depth.defined());
  rendering.color.flatten(1).select(1, scene::kCentre).sum().backward();
  const at::Tensor color = rendering.color.detach(), gradient = arguments.colors_precomp.grad();
  EXPECT_TRUE(scene::is_right(color.data_ptr<float>(), rendering.radii.item<int>(), gradient.data_ptr<float>()));
}

TEST(Torch, AGateOfOneIsAlpha) {
  Scene scene("alpha");
  const at::Tensor alpha = scene.render().color;
  scene.settings.blend_mode = "smoe_eq7";
  scene.settings.background_gate = 1;
  EXPECT_TRUE(at::equal(scene.render().color, alpha));
  scene.settings.background_gate = 0.5;
  EXPECT_FALSE(at::equal(scene.render().color, alpha));
}

template <class Error> void expect_error(const std::function<void()>& function, const std::string& text) {
  try {
    function();
    ADD_FAILURE() << "no error; expected: " << text;
  } catch (const Error& error) {
    EXPECT_NE(std::string(error.what_without_backtrace()).find(text), std::string::npos)
        << error.what_without_backtrace();
  }
}

TEST(Torch, WhatDoesNotFitIsRefused) {
  const Scene good("smoe");
  const auto refused = [&](const std::function<void(Scene&)>& edit, const std::string& text) {
    Scene bad = good;
    edit(bad);
    expect_error<c10::ValueError>([&] { bad.render(); }, text);
  };
  refused([](Scene& s) { s.settings.blend_mode = "mean"; },
          "blend_mode is 'mean'; it must be one of alpha, smoe, smoe_eq7, smoe_tn, smoe_std");
  refused([](Scene& s) { s.settings.blend_mode = "smoe_tn"; }, "only 'smoe' and 'smoe_eq7' know it");
  refused([](Scene& s) { s.settings.background_gate = -0.1; }, "background_gate is -0.1; it must be 0 to 1e+30");
  refused([](Scene& s) { s.arguments.outputs = {"color"}; }, "outputs holds 'color'; it may hold alpha");
  refused([](Scene& s) { s.means3D.reset(); }, "rasterize: means3D is absent; it must be given");
  refused([](Scene& s) { s.settings.bg.reset(); }, "rasterize: bg is absent; it must be given");
  refused([](Scene& s) { s.arguments.scales.reset(); }, "rotations is given without scales");
  refused(
      [](Scene& s) { s.settings.rolling_shutter = "up"; },
      "rolling_shutter is 'up'; it must be one of global, top_to_bottom, left_to_right, bottom_to_top, right_to_left");
  refused([](Scene& s) { s.settings.viewmatrix_end = s.settings.viewmatrix; },
          "viewmatrix_end is given, but rolling_shutter is 0; it must be absent");
  refused([](Scene& s) { s.roll(), s.settings.viewmatrix_end.reset(); },
          "viewmatrix_end is absent, but rolling_shutter is 2; it must be given");
  refused([](Scene& s) { s.roll(), s.settings.principal_point.reset(); },
          "principal_point is absent, but rolling_shutter is 'left_to_right', with which projmatrix is not read");
  refused([](Scene& s) { s.settings.image_width = 0; }, "image_width x image_height is 0 x 24");
  expect_error<c10::TypeError>([&] { dsmoe::rasterize(good.means3D.to(at::kHalf), good.opacities, good.settings); },
                               "means3D is float16");
}

TEST(Torch, WhatHasNoDerivativeSaysSo) {
  Scene scene("smoe");
  scene.opacities.requires_grad_();
  dsmoe::Rendering rendering = scene.render();
  expect_error<c10::Error>([&] { rendering.color.sum().backward({}, /*keep_graph=*/true, /*create_graph=*/true); },
                           "second derivatives are not implemented");
  const at::Tensor sum = (rendering.color * 2).sum();
  rendering.color.detach().add_(1);  // shares the numbers and their version
  expect_error<c10::Error>([&] { sum.backward(); }, "modified by an inplace operation");
}

// Where the camera's own formula says: fx X / Z + cx, in COLMAP's pixels.
TEST(Torch, SettingsOfACameraPutAGaussianWhereItIs) {
  const at::Tensor K = at::zeros({3, 3}, at::kDouble), t = at::zeros({3}, at::kDouble);
  K[0][0].fill_(40), K[1][1].fill_(50), K[0][2].fill_(20.5), K[1][2].fill_(12.5), K[2][2].fill_(1);
  t[2].fill_(1);
  const auto settings = dsmoe::settings_from_camera(K, at::eye(3, at::kDouble), t, 48, 32, at::zeros({3}), 0);
  EXPECT_EQ(settings.image_width, 48);
  EXPECT_EQ(settings.image_height, 32);
  at::Tensor mean = at::zeros({1, 3});
  mean[0][0].fill_(0.25), mean[0][1].fill_(0.2), mean[0][2].fill_(1);  // at depth 2: column 25.5, row 17.5
  RasterizeArguments arguments;
  arguments.colors_precomp = at::ones({1, 3});
  arguments.scales = at::full({1, 3}, 0.01);
  arguments.rotations = at::eye(1, 4);
  const at::Tensor image = dsmoe::rasterize(mean, at::full({1}, 0.9), settings, arguments).color;
  EXPECT_EQ(image[0].flatten().argmax().item<int64_t>(), 17 * 48 + 25);
  expect_error<c10::ValueError>(
      [&] { dsmoe::settings_from_camera(K, 2 * at::eye(3, at::kDouble), t, 48, 32, at::zeros({3})); }, "R must be a");
}

// fx theta + cx with theta = atan(1 / 2): column 39.05, where a pinhole has 40.5.
TEST(Torch, ALensPutsAGaussianWhereItIs) {
  const at::Tensor K = at::eye(3, at::kDouble);
  K[0][0].fill_(40), K[1][1].fill_(50);
  auto settings =
      dsmoe::settings_from_camera(K, at::eye(3, at::kDouble), at::zeros({3}, at::kDouble), 48, 32, at::zeros({3}), 0);
  settings.camera_model = "fisheye";
  settings.principal_point = {20.5, 12.5};
  const at::Tensor mean = at::zeros({1, 3});
  mean[0][0].fill_(1), mean[0][2].fill_(2);
  RasterizeArguments arguments;
  arguments.colors_precomp = at::ones({1, 3});
  arguments.scales = at::full({1, 3}, 0.01);
  arguments.rotations = at::eye(1, 4);
  const auto render = [&] { return dsmoe::rasterize(mean, at::full({1}, 0.9), settings, arguments).color; };
  EXPECT_EQ(render()[0].flatten().argmax().item<int64_t>(), 12 * 48 + 39);
  settings.distortion = {0.1, 0.2, 0.3};
  expect_error<c10::ValueError>(render, "rasterize: distortion has 3 numbers; it must have 0, 1, 2 or 4");
  settings.camera_model = "fish";
  expect_error<c10::ValueError>(render, "rasterize: camera_model is 'fish'; it must be one of pinhole");
  settings.camera_model = "pinhole";
  expect_error<c10::ValueError>(render, "rasterize: distortion is given, but camera_model is 'pinhole'");
}

TEST(Torch, SettingsOfACameraHaveTheCoresMatrices) {
  const at::Tensor K = at::zeros({3, 3}, at::kDouble), R = at::zeros({3, 3}, at::kDouble);
  K[0][0].fill_(40), K[1][1].fill_(50), K[0][2].fill_(20.5), K[1][2].fill_(12.5), K[2][2].fill_(1);
  R[0][1].fill_(1), R[1][2].fill_(1), R[2][0].fill_(1);
  const at::Tensor t = at::arange(1, 4, at::kDouble);
  const auto settings = dsmoe::settings_from_camera(K, R, t, 48, 32, at::zeros({3}, at::kDouble), 0);
  dsmoe::Pinhole pinhole;
  pinhole.width = 48, pinhole.height = 32;
  pinhole.fx = 40, pinhole.fy = 50, pinhole.cx = 20.5, pinhole.cy = 12.5;
  pinhole.rotation = {0, 1, 0, 0, 0, 1, 1, 0, 0};
  pinhole.translation = {1, 2, 3};
  const auto camera = dsmoe::pinhole_camera<double>(pinhole);
  EXPECT_EQ(settings.tanfovx, camera.tan_fov_x);
  EXPECT_EQ(settings.tanfovy, camera.tan_fov_y);
  for (int i = 0; i < 16; ++i) {
    EXPECT_EQ(settings.viewmatrix.flatten()[i].item<double>(), camera.view[i]) << i;
    EXPECT_NEAR(settings.projmatrix.flatten()[i].item<double>(), camera.projection[i], 1e-14) << i;  // below 8
  }
  for (int i = 0; i < 3; ++i) EXPECT_EQ(settings.campos[i].item<double>(), camera.position[i]) << i;
}

TEST(Training, ActivationsAreTorchs) {
  const at::Tensor raw[] = {at::randn({9, 1}, at::kDouble), at::randn({9, 3}, at::kDouble),
                            at::randn({9, 4}, at::kDouble)};
  const auto gradients = [&](bool own) {
    std::vector<at::Tensor> leaves;
    for (const at::Tensor& tensor : raw) leaves.push_back(tensor.clone().requires_grad_());
    const dsmoe::Activated values =
        own ? dsmoe::activate(leaves[0], leaves[1], leaves[2])
            : dsmoe::Activated{leaves[0].sigmoid(), leaves[1].exp(), leaves[2] / leaves[2].norm(2, 1, true)};
    (values.opacities.sum() + values.scales.square().sum() + values.rotations.pow(3).sum()).backward();
    return at::cat({leaves[0].grad(), leaves[1].grad(), leaves[2].grad(), values.opacities.detach(),
                    values.scales.detach(), values.rotations.detach()},
                   1);
  };
  EXPECT_TRUE(at::allclose(gradients(true), gradients(false), 1e-12, 1e-12));  // a few roundings of numbers near 1
}

TEST(Training, LossIsItsFormulaAndDifferentiable) {
  const at::Tensor image = random({3, 20, 20}, 0, 1).requires_grad_(), target = random({3, 20, 20}, 0, 1);
  EXPECT_NEAR(dsmoe::fused_ssim(target, target).item<double>(), 1, 1e-12);
  const at::Tensor loss = dsmoe::l1_ssim_loss(image, target, 0.2);
  const double ssim = dsmoe::fused_ssim(image.detach(), target).item<double>();
  const double l1 = (image.detach() - target).abs().mean().item<double>();
  EXPECT_NEAR(loss.item<double>(), 0.8 * l1 + 0.2 * (1 - ssim), 1e-12);
  loss.backward();
  const at::Tensor direction = at::randn({3, 20, 20}, at::kDouble) * 1e-7;  // crosses hardly any |x| = 0
  const double measured = (dsmoe::l1_ssim_loss(image.detach() + direction, target) -
                           dsmoe::l1_ssim_loss(image.detach() - direction, target))
                              .item<double>() /
                          2;
  EXPECT_NEAR((image.grad() * direction).sum().item<double>(), measured, 1e-4 * std::abs(measured));
  expect_error<c10::ValueError>([&] { dsmoe::l1_ssim_loss(target, image); }, "only the first gets");
}

TEST(Training, AdamIsItsFormula) {
  std::vector<dsmoe::AdamParameter> parameters(2);
  parameters[0] = {at::randn({5, 2}, at::kDouble).requires_grad_(), 0.1};
  parameters[1] = {at::ones({3}, at::kDouble).requires_grad_(), 0.1};  // without a gradient: stays
  at::Tensor expected = parameters[0].value.detach().clone(), m = at::zeros({5, 2}, at::kDouble), v = m.clone();
  for (int step = 1; step <= 3; ++step) {
    const at::Tensor gradient = at::randn({5, 2}, at::kDouble);
    parameters[0].value.mutable_grad() = gradient;
    dsmoe::adam_step(parameters, 1e-8, 0.9, 0.99);
    m = 0.9 * m + 0.1 * gradient;
    v = 0.99 * v + 0.01 * gradient.square();
    expected = expected - 0.1 * (m / (1 - std::pow(0.9, step))) / ((v / (1 - std::pow(0.99, step))).sqrt() + 1e-8);
  }
  EXPECT_TRUE(at::allclose(parameters[0].value.detach(), expected, 1e-12, 1e-12));  // a few roundings a step
  parameters[0].value.mutable_grad().reset();
  dsmoe::adam_step(parameters);  // nothing has a gradient
  EXPECT_EQ(parameters[0].step, 3);
  EXPECT_EQ(parameters[1].step, 0);
  EXPECT_TRUE(at::equal(parameters[1].value.detach(), at::ones({3}, at::kDouble)));
}

TEST(Training, NeighboursAndViewsAreCounted) {
  const at::Tensor axis = 2 * at::arange(6, at::kFloat);  // a lattice: each point has three neighbours at distance 2
  const at::Tensor lattice = at::stack(at::meshgrid({axis, axis, axis}, "ij"), 3).reshape({-1, 3});
  EXPECT_TRUE(at::equal(dsmoe::distCUDA2(lattice), at::full({216}, 4.f)));
  const at::Tensor gradients = at::zeros({2, 3}), radii = at::zeros({2}, at::kInt), sum = at::zeros({2}),
                   views = at::zeros({2});
  gradients[0][0].fill_(3), gradients[0][1].fill_(4), gradients[1][0].fill_(9), radii[0].fill_(1);
  dsmoe::add_view(gradients, radii, sum, views);
  EXPECT_EQ(sum[0].item<float>(), 5);
  EXPECT_EQ(views[0].item<float>(), 1);
  EXPECT_EQ(sum[1].item<float>() + views[1].item<float>(), 0);
  axis[2].fill_(INFINITY);
  expect_error<c10::ValueError>([&] { dsmoe::distCUDA2(axis.view({2, 3})); }, "distCUDA2: points[0] is not finite");
}

// Sums in another order, in double: relative differences of roundings, times the number of terms.
TEST(Torch, ACudaRenderingIsTheCpus) {
  if (!at::hasCUDA()) GTEST_SKIP() << "there is no GPU";
  const auto run = [](const Scene& scene, at::Device device) {
    Scene copy = scene;
    for (at::Tensor* tensor : copy.tensors()) *tensor = tensor->detach().to(device).requires_grad_();
    loss(copy.render(), {at::ones({1}, device), at::ones({1}, device), at::ones({1}, device), at::ones({1}, device)})
        .backward();
    std::vector<at::Tensor> results = {copy.render().color.detach().cpu().to(at::kDouble)};
    for (at::Tensor* tensor : copy.tensors()) results.push_back(tensor->grad().cpu());
    return results;
  };
  for (const char* mode : {"alpha", "smoe", "smoe_eq7", "smoe_tn", "smoe_std"}) {
    const Scene scene(mode);
    const auto cpu = run(scene, at::kCPU), cuda = run(scene, at::kCUDA);
    for (size_t i = 0; i < cpu.size(); ++i) {
      EXPECT_LT((cpu[i] - cuda[i]).norm().item<double>(), 1e-9 * (1 + cpu[i].norm().item<double>()))
          << mode << " " << i;
    }
  }
}

}  // namespace

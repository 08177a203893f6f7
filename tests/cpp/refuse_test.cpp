// What the passes refuse, and what their messages say.
#include "refuse.h"

#include <gtest/gtest.h>

#include <cmath>
#include <functional>
#include <string>
#include <vector>

#include "dsmoe/rasterize_cuda.h"
#include "refusal.h"
#include "test_scene.h"

namespace dsmoe {
namespace {

Scene<float> scene_with_depths() {
  Scene<float> scene = convert<float>(make_scene(1, 20, 37, 29));
  scene.config.depth = scene.config.inverse_depth = true;
  return scene;
}

template <class Frame> struct Case {
  std::function<void(Frame&)> spoil;
  std::string problem;
};

// What is wrong with a rendering before it begins; pointers of both backends.
template <class Frame> std::vector<Case<Frame>> cases_of_forward() {
  static const float number = 1;
  const std::string last_mode = std::to_string(BlendModes::kSize - 1);
  return {
      {[](auto& f) { f.inputs.num_gaussians = -1; }, "num_gaussians is -1; it must be 0 to 2147483647"},
      {[](auto& f) { f.camera.width = 0; }, "image_width x image_height is 0 x 29; both must be 1 to 4194240"},
      {[](auto& f) { f.camera.width = 4194241; },
       "image_width x image_height is 4194241 x 29; both must be 1 to 4194240"},
      {[](auto& f) { f.camera.height = 1 << 22; },
       "image_width x image_height is 37 x 4194304; both must be 1 to 4194240"},
      {[](auto& f) { f.camera.height = -4; }, "image_width x image_height is 37 x -4; both must be 1 to 4194240"},
      {[](auto& f) { f.config.blend.mode = static_cast<BlendMode>(99); },
       "blend_mode is 99; it must be 0 to " + last_mode},
      {[](auto& f) { f.config.blend.mode = static_cast<BlendMode>(-1); },
       "blend_mode is -1; it must be 0 to " + last_mode},
      {[](auto& f) { f.config.num_channels = 0; }, "num_channels is 0; it must be 1 or more"},
      {[](auto& f) { f.config.blend.alpha_min = -0.5f; }, "alpha_min is -0.5; it must be 0 or more and finite"},
      {[](auto& f) { f.config.blend.faint_below = -0.5f; }, "faint_below is -0.5; it must be 0 or more and finite"},
      {[](auto& f) { f.config.blend.background_gate_at = nullptr, f.config.blend.background_gate = -0.1f; },
       "background_gate is -0.1; it must be 0 to 1e+30"},
      {[](auto& f) { f.config.most_instances = 0; }, "most_instances is 0; it must be 1 or more"},
      {[](auto& f) { f.inputs.means3D = nullptr; }, "means3D is null; it must point to an array [N, 3]"},
      {[](auto& f) { f.inputs.opacities = nullptr; }, "opacities is null; it must point to an array [N]"},
      {[](auto& f) { f.inputs.shs = nullptr; },
       "neither of shs (or dc) and colors_precomp is given; exactly one of the two must be"},
      {[](auto& f) { f.inputs.colors_precomp = &number; },
       "both of shs (or dc) and colors_precomp are given; exactly one of the two must be"},
      {[](auto& f) { f.inputs.scales = f.inputs.rotations = nullptr; },
       "neither of scales with rotations, and cov3D_precomp, is given; exactly one of the two must be"},
      {[](auto& f) { f.inputs.cov3D_precomp = &number; },
       "both of scales with rotations, and cov3D_precomp, are given; exactly one of the two must be"},
      {[](auto& f) { f.inputs.rotations = nullptr; }, "scales is given without rotations; the covariance needs both"},
      {[](auto& f) { f.inputs.scales = nullptr; }, "rotations is given without scales; the covariance needs both"},
      {[](auto& f) { f.config.num_channels = 4; }, "num_channels is 4; colours from shs have 3"},
      {[](auto& f) { f.inputs.sh_degree = 4; }, "sh_degree is 4; it must be 0 to 3"},
      {[](auto& f) { f.inputs.sh_degree = -1; }, "sh_degree is -1; it must be 0 to 3"},
      {[](auto& f) { f.inputs.sh_degree = 2; },
       "shs has shape [20, 4, 3]; sh_degree 2 needs 9 coefficients a Gaussian, not 4"},
      {[](auto& f) { f.inputs.dc = &number, f.inputs.num_sh = 2; },
       "shs has shape [20, 2, 3] besides dc; sh_degree 1 needs 4 coefficients a Gaussian, not 3"},
      {[](auto& f) { f.camera.tan_fov_y = 0; }, "tan_fov_y (tanfovy) is 0; it must be positive and finite"},
      {[](auto& f) { f.camera.tan_fov_x = HUGE_VALF; }, "tan_fov_x (tanfovx) is inf; it must be positive and finite"},
      {[](auto& f) { f.camera.near = NAN; }, "near is nan; it must be 0 or more and finite"},
      {[](auto& f) { f.camera.shutter = static_cast<Shutter>(7); },
       "camera.shutter (rolling_shutter) is 7; it must be 0 to 4"},
      {[](auto& f) { f.camera.shutter = Shutter::kTopToBottom; },
       "camera.shutter is top_to_bottom, but camera.lens is a pinhole; it must be another lens, such as opencv without "
       "distortion"},
      {[](auto& f) { f.config.scale_modifier = -2; }, "scale_modifier is -2; it must be 0 or more and finite"},
      {[](auto& f) { f.config.low_pass = HUGE_VALF; }, "low_pass is inf; it must be 0 or more and finite"},
      {[](auto& f) { f.config.background = nullptr; }, "background is null; it must point to an array [C]"},
      {[](auto& f) { f.images.color = nullptr; }, "images.color is null; it must point to an array [C, H, W]"},
      {[](auto& f) { f.images.gate_sum = nullptr; }, "images.gate_sum is null; it must point to an array [H, W]"},
      {[](auto& f) { f.images.depth = nullptr; },
       "images.depth is null; it must point to an array [H, W], as config.depth is set"},
      {[](auto& f) { f.images.inverse_depth = nullptr; },
       "images.inverse_depth is null; it must point to an array [H, W], as config.inverse_depth is set"},
      {[](auto& f) { f.images.radii = nullptr; }, "images.radii is null; it must point to an array [N]"}};
}

template <class AnyCamera> void roll(AnyCamera& camera) {
  camera.shutter = Shutter::kTopToBottom;
  camera.lens.model = LensModel::kOpencv, camera.lens.focal = {1, 1};
}

TEST(Refuse, AForwardPassOnTheCpuNamesWhatIsWrong) {
  using Frame = cpu::Frame<float>;
  const Scene<float> scene = scene_with_depths();
  Rendering<float> rendering(scene);
  auto cases = cases_of_forward<Frame>();
  const float negative = -1;
  cases.push_back({[&](Frame& f) { f.config.blend.background_gate_at = &negative; },
                   "background_gate is -1; it must be 0 to 1e+30"});
  const float background[] = {0, 0, NAN};
  cases.push_back(
      {[&](Frame& f) { f.config.background = background; }, "background (bg)[2] is nan; it must be finite"});
  cases.push_back({[](Frame& f) { f.camera.view[6] = NAN; }, "camera.view (viewmatrix)[6] is nan; it must be finite"});
  cases.push_back({[](Frame& f) { f.camera.projection[15] = HUGE_VALF; },
                   "camera.projection (projmatrix)[15] is inf; it must be finite"});
  cases.push_back(
      {[](Frame& f) { f.camera.position[1] = NAN; }, "camera.position (campos)[1] is nan; it must be finite"});
  cases.push_back({[](Frame& f) { roll(f.camera), f.camera.view_end[2] = NAN; },
                   "camera.view_end (viewmatrix_end)[2] is nan; it must be finite"});
  for (const auto& c : cases) {
    Frame frame = frame_of(scene, rendering);
    c.spoil(frame);
    cpu::Heap heap;
    expect_refusal([&] { cpu::forward(frame, heap); }, "cpu::forward: " + c.problem);
  }
}

TEST(Refuse, AFrameOfDevicePointersIsHeldToTheSame) {
  using Frame = cuda::Frame<float>;
  const Scene<float> scene = scene_with_depths();
  Rendering<float> rendering(scene);
  auto cases = cases_of_forward<Frame>();
  cases.push_back({[](Frame& f) { f.camera.view = nullptr; }, "camera.view is null; it must point to an array [4, 4]"});
  cases.push_back(
      {[](Frame& f) { f.camera.projection = nullptr; }, "camera.projection is null; it must point to an array [4, 4]"});
  cases.push_back(
      {[](Frame& f) { f.camera.position = nullptr; }, "camera.position is null; it must point to an array [3]"});
  cases.push_back({[](Frame& f) { roll(f.camera); }, "camera.view_end is null; it must point to an array [4, 4]"});
  Frame good;
  good.inputs = scene.inputs(), good.config = scene.raster_config(), good.images = rendering.images();
  good.config.blend.background_gate_at = reinterpret_cast<const float*>(8);  // of the device: the host must not read it
  good.camera.width = 37, good.camera.height = 29;
  good.camera.tan_fov_x = good.camera.tan_fov_y = 0.6f;
  good.camera.view = scene.camera.view, good.camera.projection = scene.camera.projection;
  good.camera.position = scene.camera.position;
  EXPECT_NO_THROW(refuse_forward("cuda::forward", good));
  for (const auto& c : cases) {
    Frame frame = good;
    c.spoil(frame);
    expect_refusal([&] { refuse_forward("cuda::forward", frame); }, "cuda::forward: " + c.problem);
  }
  expect_refusal([&] { refuse_project("cuda::project_footprints", good); },
                 "cuda::project_footprints: saved.projected is null; it must point to an array [N]");
  good.saved.projected = reinterpret_cast<ProjectedGaussian<float>*>(16);
  expect_refusal([&] { refuse_project("cuda::project_footprints", good); },
                 "cuda::project_footprints: saved.features is null; it must point to an array [N, feature_stride(F)]");
}

TEST(Refuse, EveryOtherPassNamesWhatItLacks) {
  using Frame = cpu::Frame<float>;
  const Scene<float> scene = scene_with_depths();
  Rendering<float> rendering = render(scene);
  const ImageWeights<float> weights(scene, 2);
  std::vector<float> records(scene.count * (kNumGateGradients + 5)), numbers(scene.pixels() * 3 + scene.count);
  std::vector<int32_t> integers(scene.pixels() + scene.count);
  const FootprintGradients<float> given = {records.data(), nullptr};
  const ContributionMap<float> sums = {numbers.data(),
                                       {numbers.data(), integers.data(), numbers.data(), numbers.data()}};
  const ImportanceMap<float> worth = {
      numbers.data(), numbers.data(), numbers.data(), {numbers.data(), numbers.data(), numbers.data()}};
  const GateMap gates = {integers.data(), integers.data(), integers.data()};
  bool visible[20];
  cpu::Heap heap;
  const auto forget = [](auto value, auto member) {
    value.*member = nullptr;
    return value;
  };
  const auto backward = [&](Frame& f) { cpu::backward(f, {weights.gradients(), {}}); };
  struct {
    std::function<void(Frame&)> call;
    const char* message;
  } const cases[] = {
      {[&](Frame& f) { f.saved.features = nullptr, cpu::project(f); },
       "cpu::project: saved.features is null; it must point to an array [N, F]"},
      {[&](Frame& f) { f.images.radii = nullptr, cpu::radii(f, heap); },
       "cpu::radii: images.radii is null; it must point to an array [N]"},
      {[&](Frame& f) { f.saved.projected = nullptr, cpu::blend_footprints(f, heap); },
       "cpu::blend_footprints: saved.projected is null; it must point to an array [N]"},
      {[&](Frame& f) { f.saved.tile_offsets = nullptr, backward(f); },
       "cpu::backward: saved.tile_offsets is null; the frame must be as the forward pass left it"},
      {[&](Frame& f) { f.saved.gate_sum = nullptr, backward(f); },
       "cpu::backward: saved.gate_sum is null; the frame must be as the forward pass left it"},
      {[&](Frame& f) { f.images.color = nullptr, backward(f); },
       "cpu::backward: images.color is null; it must point to an array [C, H, W], as its gradient is given"},
      {[&](Frame& f) { f.images.depth = nullptr, backward(f); },
       "cpu::backward: images.depth is null; it must point to an array [H, W], as its gradient is given"},
      {[&](Frame& f) {
         cpu::blend_footprints_backward(f, {weights.gradients(), {}}, {});
       },
       "cpu::blend_footprints_backward: records is null; it must point to an array [N, 6 + F]"},
      {[&](Frame& f) { cpu::project_backward(f, {}, {}); },
       "cpu::project_backward: records is null; it must point to an array [N, 6 + F]"},
      {[&](Frame& f) { f.saved.features = nullptr, cpu::project_backward(f, given, {}); },
       "cpu::project_backward: saved.features is null; it must point to an array [N, F]"},
      {[&](Frame& f) { cpu::contributions(f, forget(sums, &ContributionMap<float>::pixel_weights)); },
       "cpu::contributions: pixel_weights is null; it must point to an array [H, W]"},
      {[&](Frame& f) { f.saved.last_contributor = nullptr, cpu::contributions(f, sums); },
       "cpu::contributions: saved.last_contributor is null; it must point to an array [H, W]"},
      {[&](Frame& f) { f.saved.final_transmittance = nullptr, cpu::contributions(f, sums); },
       "cpu::contributions: saved.final_transmittance is null; it must point to an array [H, W]"},
      {[&](Frame& f) { f.saved.final_transmittance = nullptr, cpu::gate_map(f, gates); },
       "cpu::gate_map: saved.final_transmittance is null; it must point to an array [H, W]"},
      {[&](Frame& f) { f.saved.instance_offsets = nullptr, cpu::contributions(f, sums); },
       "cpu::contributions: saved.instance_offsets is null; it must point to an array [N + 1]"},
      {[&](Frame& f) { cpu::importance(f, forget(worth, &ImportanceMap<float>::color)); },
       "cpu::importance: color is null; it must point to an array [C, H, W]"},
      {[&](Frame& f) { cpu::gate_map(f, forget(gates, &GateMap::counts)); },
       "cpu::gate_map: counts is null; it must point to an array [H, W]"},
      {[&](Frame& f) { f.saved.gate_sum = nullptr, cpu::gate_map(f, gates); },
       "cpu::gate_map: saved.gate_sum is null; it must point to an array [H, W]"},
      {[&](Frame& f) { f.inputs.means3D = nullptr, cpu::mark_visible(f, visible); },
       "cpu::mark_visible: means3D is null; it must point to an array [N, 3]"}};
  for (const auto& c : cases) {
    Frame frame = frame_of(scene, rendering);
    expect_refusal([&] { c.call(frame); }, c.message);
  }
}

TEST(Refuse, RowsOfABatchFitWhatWasCounted) {
  const Scene<float> scene = convert<float>(make_scene(1, 20, 37, 29));
  std::vector<int32_t> radii(scene.count), offsets(2);
  cpu::ViewBatch batch;
  batch.inputs = scene.inputs(), batch.config = scene.raster_config();
  auto& view = batch.views.emplace_back();
  view.camera = scene.camera, view.radii = radii.data(), view.offsets = offsets.data();
  cpu::count_rows(batch);
  ASSERT_GT(offsets[1], 1);
  alignas(16) float gates[20 * kProjectedGaussianSize], features[20 * kRowFeatures + 1];
  view.gates = gates, view.features = features, view.num_rows = offsets[1] - 1;
  const std::string message = "num_rows is " + std::to_string(view.num_rows) + "; it must be " +
                              std::to_string(offsets[1]) + ", the last of offsets";
  expect_refusal([&] { cpu::project_rows(batch); }, "cpu::project_rows: " + message);
  expect_refusal([&] { cpu::project_rows_backward(batch, {}); }, "cpu::project_rows_backward: " + message);

  cuda::ViewBatch on_device;
  on_device.inputs = batch.inputs, on_device.config = batch.config;
  auto& rows = on_device.views.emplace_back();
  rows.camera = {37, 29, 0.6f, 0.6f, 0.2f, scene.camera.view, scene.camera.projection, scene.camera.position, {}};
  rows.radii = radii.data(), rows.offsets = offsets.data(), rows.num_rows = 7;  // the host does not read offsets there
  rows.gates = gates, rows.features = features;
  EXPECT_NO_THROW(refuse_rows<cuda::Frame<float>>("cuda::project_rows", on_device, false));
  rows.features = features + 1;
  expect_refusal([&] { refuse_rows<cuda::Frame<float>>("cuda::project_rows", on_device, false); },
                 "cuda::project_rows: features is not aligned; it must begin at a multiple of 16 bytes");
}

TEST(Refuse, WhatMayBeNullIsNotRefused) {
  Scene<float> scene = convert<float>(make_scene(2, 20, 37, 29));
  Rendering<float> rendering(scene);
  cpu::Frame<float> frame = frame_of(scene, rendering);
  cpu::Heap heap;
  EXPECT_NO_THROW(cpu::forward(frame, heap));
  EXPECT_NO_THROW(cpu::backward(frame, {}));
  frame.camera.view[15] = frame.camera.projection[14] = NAN;  // which nothing reads
  EXPECT_NO_THROW(cpu::forward(frame, heap));
  frame.images.color = nullptr;  // no gradient by the colour is given
  EXPECT_NO_THROW(cpu::backward(frame, {}));

  Scene<float> nothing = scene;
  nothing.count = 0;
  for (auto* values : {&nothing.means3D, &nothing.opacities, &nothing.scales, &nothing.rotations, &nothing.shs}) {
    values->clear();
  }
  Rendering<float> empty(nothing);
  frame = frame_of(nothing, empty);
  frame.images.radii = nullptr;
  EXPECT_NO_THROW(cpu::forward(frame, heap));
  EXPECT_NO_THROW(cpu::backward(frame, {}));
}

}  // namespace
}  // namespace dsmoe

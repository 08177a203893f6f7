// The CUDA kernels, run on the CPU by the emulator, against the CPU backend in double.
#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <string>
#include <utility>
#include <vector>

#include "all_modes.h"
#include "brute_force.h"
#include "dsmoe/rasterize.h"
#include "dsmoe/rasterize_cuda.h"
#include "order.h"
#include "test_scene.h"

namespace dsmoe {
namespace {

// What a rendering and its backward pass leave.
template <class S> struct Results {
  explicit Results(const Scene<S>& scene)
      : mode(scene.config.blend.mode),
        rendering(scene),
        weights(scene, 7),
        gradient(scene),
        means2D_abs(2 * scene.count, S(NAN)) {}

  Gradients<S> gradients() {
    Gradients<S> out = {weights.gradients(), gradient.gradients()};
    out.inputs.means2D_abs = means2D_abs.data();
    return out;
  }

  // Every gradient, one behind the other.
  std::vector<S> all_gradients() {
    std::vector<S> all = gradient.flat();
    for (const auto* more : {&gradient.means2D, &means2D_abs}) all.insert(all.end(), more->begin(), more->end());
    return all;
  }

  // Calls walk(contribution map, importance map, gate map), for sums over the pixels that count.
  template <class Walk> void weigh(const std::vector<bool>& unsure, Walk walk) {
    const size_t count = rendering.radii.size();
    std::vector<S> pixel_weights, unused(2 * count);
    for (const bool left_out : unsure) pixel_weights.push_back(S(!left_out));
    std::vector<int32_t> pixels(count);
    for (auto* map : {&greatest, &counts, &medians}) map->assign(unsure.size(), -2);
    worth.assign(4 * count, is_removable(mode) ? S(NAN) : S(0));
    const auto sums = [&](int k) { return worth.data() + k * count; };
    walk(ContributionMap<S>{pixel_weights.data(), {sums(0), pixels.data(), unused.data(), unused.data() + count}},
         ImportanceMap<S>{
             rendering.color.data(), pixel_weights.data(), pixel_weights.data(), {sums(1), sums(2), sums(3)}},
         GateMap{greatest.data(), counts.data(), medians.data()});
  }

  BlendMode mode;
  Rendering<S> rendering;
  ImageWeights<S> weights;
  SceneGradient<S> gradient;
  std::vector<S> means2D_abs, worth;
  std::vector<int32_t> greatest, counts, medians;
};

// Pixels where rounding may turn a decision over show nothing: they get no weight.
template <class S> void leave_out(ImageWeights<S>& weights, const std::vector<bool>& unsure) {
  for (auto* image : {&weights.color, &weights.gate_sum, &weights.depth, &weights.inverse_depth}) {
    for (size_t i = 0; i < image->size(); ++i) (*image)[i] *= S(!unsure[i % unsure.size()]);
  }
}

Results<double> on_cpu(const Scene<double>& scene, const std::vector<bool>& unsure) {
  Results<double> out(scene);
  leave_out(out.weights, unsure);
  cpu::Frame<double> frame = {scene.inputs(), scene.camera, scene.raster_config(), out.rendering.images(), {}};
  cpu::Heap heap;
  cpu::forward(frame, heap);
  out.weigh(unsure, [&](const auto& contributions, const auto& importance, const GateMap& gates) {
    cpu::contributions(frame, contributions);
    cpu::gate_map(frame, gates);
    if (is_removable(frame.config.blend.mode)) cpu::importance(frame, importance);
  });
  cpu::backward(frame, out.gradients());
  return out;
}

// Each tile once, the longest lists first, by classes of 64 instances.
void expect_longest_first(const cuda::SavedForward<float>& saved, int64_t tiles) {
  std::vector<int> seen(tiles);
  int64_t before = std::numeric_limits<int64_t>::max();
  for (int64_t i = 0; i < tiles; ++i) {
    const int32_t tile = saved.tile_order[i];
    ASSERT_TRUE(0 <= tile && tile < tiles) << i;
    const int64_t of_length = (saved.tile_offsets[tile + 1] - saved.tile_offsets[tile]) / 64;
    EXPECT_LE(of_length, before) << i;
    before = of_length, ++seen[tile];
  }
  EXPECT_EQ(seen, std::vector<int>(tiles, 1));
}

struct How {
  bool deterministic = false;
  int64_t most_instances = kMostInstances;
  bool overflows = false;  // the lists do not fit their memory
  StageTimes* times = nullptr;
  bool weighs = true;  // contributions and importance too
  // Removal costs are compared. Where nearly all of a pixel is one Gaussian's, they are sums of rounded remains.
  bool removes = true;
};

Results<float> by_kernels(const Scene<float>& scene, const std::vector<bool>& unsure, const How& how) {
  Results<float> out(scene);
  leave_out(out.weights, unsure);
  const Camera<float>& camera = scene.camera;
  cuda::Frame<float> frame = {
      scene.inputs(),
      {camera.width, camera.height, camera.tan_fov_x, camera.tan_fov_y, camera.near, camera.view, camera.projection,
       camera.position, camera.lens, camera.shutter, camera.view_end},
      scene.raster_config(),
      out.rendering.images(),
      {}};
  frame.config.most_instances = how.most_instances;
  cuda::Run run;
  run.deterministic = how.deterministic;
  run.times = how.times;
  cuda::StreamMemory memory(nullptr);
  cuda::forward(frame, run, memory);
  if (how.overflows) {
    frame.saved.capacity = 1;
    cuda::bin(frame, {nullptr, &memory});
    cuda::blend(frame, {nullptr, &memory});
  }
  const TileGrid grid(camera.width, camera.height);
  if (frame.saved.capacity > 0) expect_longest_first(frame.saved, int64_t(grid.columns) * grid.rows);
  const cuda::Work work = {nullptr, &memory, nullptr, how.deterministic};
  if (how.weighs) {
    out.weigh(unsure, [&](const auto& contributions, const auto& importance, const GateMap& gates) {
      cuda::contributions(frame, contributions, work);
      cuda::gate_map(frame, gates, work);
      if (is_removable(frame.config.blend.mode)) cuda::importance(frame, importance, work);
    });
  }
  cuda::backward(frame, out.gradients(), run, memory);
  return out;
}

// The tolerances of the tests on a GPU (tests/python/cuda/against_cpu.py): a position of some hundred pixels is rounded
// by 3e-5, which changes the alpha of the smallest splats by 2e-4 of itself, a part of a pixel; in a gradient, sums
// that cancel multiply 6e-8 by 1e3.
constexpr double kTolerance = 1e-4;

void expect_close(const std::vector<float>& actual, const std::vector<double>& expected,
                  const std::vector<bool>& unsure, const std::string& name) {
  double largest = 0, worst = 0;
  for (size_t i = 0; i < expected.size(); ++i) {
    largest = std::max(largest, std::abs(expected[i]));
    if (unsure[i % unsure.size()]) continue;
    ASSERT_TRUE(std::isfinite(actual[i])) << name << " " << i;
    worst = std::max(worst, std::abs(actual[i] - expected[i]));
  }
  EXPECT_LE(worst, kTolerance * largest) << name;
}

// In the 2-norm.
void expect_near(const std::vector<float>& actual, const std::vector<double>& expected, const char* name) {
  ASSERT_EQ(actual.size(), expected.size()) << name;
  double error = 0, norm = 0;
  for (size_t i = 0; i < actual.size(); ++i) {
    error += std::pow(actual[i] - expected[i], 2), norm += std::pow(expected[i], 2);
  }
  EXPECT_LE(error, kTolerance * kTolerance * norm) << name;
}

void expect_cpu(const Scene<double>& of, const How& how = {}) {
  const Scene<float> scene = convert<float>(of);
  const Scene<double> same = convert<double>(scene);
  const BruteForce<double> truth = brute_force(same);
  std::vector<bool> unsure;
  for (const double margin : truth.margin) unsure.push_back(margin < 3e-5);
  Results<float> actual = by_kernels(scene, unsure, how);
  Results<double> expected = on_cpu(same, unsure);
  EXPECT_EQ(actual.rendering.radii, expected.rendering.radii);
  expect_close(actual.rendering.color, expected.rendering.color, unsure, "color");
  expect_close(actual.rendering.gate_sum, expected.rendering.gate_sum, unsure, "gate sum");
  expect_close(actual.rendering.depth, expected.rendering.depth, unsure, "depth");
  expect_near(actual.all_gradients(), expected.all_gradients(), "gradients");
  for (size_t pixel = 0; pixel < unsure.size(); ++pixel) {
    if (unsure[pixel]) continue;
    ASSERT_EQ(actual.counts[pixel], expected.counts[pixel]) << pixel;
    // Alphas are rounded by up to 2e-4 of themselves, which moves T too, a sum of weights and its denominator.
    if (truth.median_margin[pixel] > 1e-3) ASSERT_EQ(actual.medians[pixel], expected.medians[pixel]) << pixel;
    if (truth.lead[pixel] < 4e-4) continue;  // two alphas, each rounded by up to 2e-4 of itself
    ASSERT_EQ(actual.greatest[pixel], expected.greatest[pixel]) << pixel;
  }
  for (size_t k = 0; k < (how.removes ? 4 : 3); ++k) {
    const auto part = [&](const auto& worth) {
      const auto begin = worth.begin() + k * of.count;
      return std::vector<typename std::decay_t<decltype(worth)>::value_type>(begin, begin + of.count);
    };
    constexpr const char* kNames[] = {"contributions", "shares", "squared shares", "removal costs"};
    expect_near(part(actual.worth), part(expected.worth), kNames[k]);
  }
}

// A scene in all its modes, with and without a gate of the background if the mode has one, and with the rule for
// faint pairs that is not usual in the mode.
template <BlendMode kMode> std::vector<Scene<double>> in_mode(Scene<double> scene) {
  scene.config.blend.mode = kMode;
  scene.background.back() = 0;
  std::vector<Scene<double>> scenes = {scene};
  if (Blend<kMode>::kLearnsGate) scene.background.back() = 0.03, scenes.push_back(scene);
  if (Blend<kMode>::kNearFirst) {
    scene.config.blend.faint_below = Blend<kMode>::kFaintBelow < 1 ? kFaintEverywhere : kFaintBelow;
    scenes.push_back(scene);
  }
  return scenes;
}

// More Gaussians than a warp or a block takes, and an image of several tiles that ends within one.
Scene<double> crowd() { return make_scene(3, 150, 41, 23); }

Scene<double> with_degree_3(Scene<double> scene, bool dc_apart) {
  Random random(5);
  scene.sh_degree = 3;
  scene.shs = random.uniforms(scene.count * (dc_apart ? 45 : 48));
  if (dc_apart) scene.dc = random.uniforms(scene.count * 3);
  return scene;
}

// Four tiles whose lists have two or three segments, or other numbers.
Scene<double> long_lists(int count = 1300, int width = 19, int height = 18) {
  Random random(6);
  Scene<double> scene = make_scene(6, count, width, height);
  for (double& x : scene.means3D) x = random.uniform(-0.6, 0.6);
  for (double& scale : scene.scales) scale = random.uniform(0.2, 0.4);
  for (double& opacity : scene.opacities) opacity = random.uniform(0.004, 0.02);
  return scene;
}

// Moves a Gaussian to a place that the camera sees.
void put(Scene<double>& scene, int64_t i, double x, double y, double z) {
  const double* view = scene.camera.view;
  const double from_camera[] = {x - view[12], y - view[13], z - view[14]};
  for (int axis = 0; axis < 3; ++axis) {
    double& mean = scene.means3D[3 * i + axis] = 0;
    for (int k = 0; k < 3; ++k) mean += view[4 * axis + k] * from_camera[k];
  }
}

// One list of five segments and two squares of pixels. All pixels of a half of a square leave in the first segment: of
// one square the upper half, of the other one the lower half. Some of each other half stay until the third or fourth;
// where its Gaussians are faint, all do to the end.
Scene<double> list_of_unlike_halves(double opacity = 0.05) {
  Random random(7);
  Scene<double> scene = make_scene(7, 2300, 16, 8);
  for (int64_t i = 0; i < scene.count; ++i) {
    const double x = random.uniform(-2.2, 2.2), y = random.uniform(-1.3, 1.3), z = random.uniform(2.7, 3.3);
    put(scene, i, x, y, z);
    for (int axis = 0; axis < 3; ++axis) scene.scales[3 * i + axis] = random.uniform(0.2, 0.3);
    scene.opacities[i] = random.uniform(0.5, 1) * ((x < 0) == (y < 0) ? 0.6 : opacity);
  }
  return scene;
}

// A wall behind a list's first segment, in which W stays small.
Scene<double> wall_behind_a_veil() {
  Scene<double> scene = long_lists();
  Random random(9);
  for (double& opacity : scene.opacities) opacity = random.uniform(1e-4, 2e-4);
  const int64_t wall = scene.count - 1;
  scene.means3D[3 * wall + 2] += 5;
  for (int axis = 0; axis < 3; ++axis) scene.scales[3 * wall + axis] = 2;
  scene.opacities[wall] = 0.9;
  return scene;
}

template <class Mode> struct KernelsIn : testing::Test {
  static void expect(const Scene<double>& scene, const How& how = {}) {
    for (const Scene<double>& own : in_mode<Mode::value>(scene)) expect_cpu(own, how);
  }
};
TYPED_TEST_SUITE(KernelsIn, AllModes);

TYPED_TEST(KernelsIn, EqualTheCpuWithColoursOfDegree3) {
  this->expect(with_degree_3(crowd(), false));
  this->expect(with_degree_3(crowd(), true));
}

TYPED_TEST(KernelsIn, EqualTheCpuWithOtherColoursAndDepth) {
  Scene<double> scene = crowd();
  this->expect(scene);
  scene.config.depth = true;
  this->expect(scene);
}

TYPED_TEST(KernelsIn, EqualTheCpuThroughEveryLens) {
  for (const Lens<double>& lens : make_lenses(41, 23)) {
    for (Scene<double> scene : {crowd(), with_degree_3(crowd(), false)}) {
      scene.camera.lens = lens;
      scene.config.depth = lens.model == LensModel::kFisheye;
      How how;
      how.removes = false;
      this->expect(scene, how);
    }
  }
}

TYPED_TEST(KernelsIn, EqualTheCpuWithARollingShutter) {
  const std::vector<Lens<double>> lenses = make_lenses(41, 23);
  int next = 1;
  for (const Shutter shutter : kRolling) {
    for (Scene<double> scene : {crowd(), with_degree_3(crowd(), false)}) {
      scene.camera.lens = lenses[next++ % lenses.size()];
      set_shutter(scene.camera, shutter);
      How how;
      how.removes = false;
      this->expect(scene, how);
    }
  }
}

TYPED_TEST(KernelsIn, EqualTheCpuOnLongLists) { this->expect(long_lists()); }

TYPED_TEST(KernelsIn, EqualTheCpuWhereTheHalvesOfASquareLeaveAListApart) {
  if (!Blend<TypeParam::value>::kStopsEarly) return;
  this->expect(list_of_unlike_halves());
  this->expect(list_of_unlike_halves(), {false, kMostInstances, true});
  this->expect(list_of_unlike_halves(0.002));
}

TYPED_TEST(KernelsIn, EqualTheCpuBehindAVeil) { this->expect(wall_behind_a_veil()); }

TYPED_TEST(KernelsIn, EqualTheCpuInBands) { this->expect(crowd(), {false, 60}); }

TYPED_TEST(KernelsIn, EqualTheCpuWhereListsDoNotFit) { this->expect(crowd(), {false, kMostInstances, true}); }

TYPED_TEST(KernelsIn, EqualTheCpuDeterministically) { this->expect(crowd(), {true}); }

TYPED_TEST(KernelsIn, GiveTheSameBitsDeterministicallyWhetherListsFitOrNot) {
  const Scene<float> scene = convert<float>(in_mode<TypeParam::value>(long_lists(700, 16, 8)).back());
  const std::vector<bool> all_sure(scene.pixels(), false);
  Results<float> fit = by_kernels(scene, all_sure, {true});
  Results<float> overflow = by_kernels(scene, all_sure, {true, kMostInstances, true});
  EXPECT_EQ(overflow.rendering.color, fit.rendering.color);
  EXPECT_EQ(overflow.all_gradients(), fit.all_gradients());
  EXPECT_EQ(overflow.worth, fit.worth);
}

TYPED_TEST(KernelsIn, EqualTheCpuWhereLittleIsSeen) {
  this->expect(make_scene(8, 3, 1, 1));
  Scene<double> unseen = make_scene(8, 5, 33, 17);  // tiles of one row and one column of pixels, and no list
  for (int64_t i = 0; i < unseen.count; ++i) unseen.means3D[3 * i + 2] = -9;
  this->expect(unseen);
  this->expect(make_scene(8, 0, 33, 17));
}

// A needle along the diagonal passes by macro tiles whose tiles it does not meet.
TEST(Kernels, CountTheRoomThatListsOfMacroTilesNeed) {
  ProjectedGaussian<float> needle = {};
  const double length = 500, width = 2;  // standard deviations, pixels
  const auto along = static_cast<float>(1 / (length * length)), across = static_cast<float>(1 / (width * width));
  needle.mean = {512, 512};
  needle.conic = {(along + across) / 2, (along - across) / 2, (along + across) / 2};
  needle.opacity = 0.5f, needle.squared_reach = 4;
  int32_t order = 0, radius = 1000;
  const int64_t tiles = 64 * 64;
  std::vector<int64_t> tile_offsets(tiles + 3);
  std::vector<int32_t> tile_order(tiles), instances(1000);
  cuda::Frame<float> frame = {};
  frame.inputs.num_gaussians = 1;
  frame.camera.width = frame.camera.height = 1024;
  frame.images.radii = &radius;
  frame.saved.projected = &needle, frame.saved.order = &order;
  frame.saved.tile_offsets = tile_offsets.data(), frame.saved.tile_order = tile_order.data();
  frame.saved.instances = instances.data();
  cuda::SavedSizes sizes;
  sizes.tiles = tiles, sizes.capacity = static_cast<int64_t>(instances.size());
  cuda::complete(frame.saved, sizes);
  *frame.saved.num_ordered = 1;
  cuda::StreamMemory memory(nullptr);
  cuda::count_instances(frame, {nullptr, &memory});
  const int64_t room = *frame.saved.num_instances;
  EXPECT_EQ(room, 16 * 16) << "macro tiles";
  cuda::bin(frame, {nullptr, &memory});
  EXPECT_EQ(*frame.saved.num_instances, room);
  EXPECT_LT(tile_offsets[tiles], room) << "else this is no such needle";
  frame.saved.capacity = room;
  cuda::bin(frame, {nullptr, &memory});
  EXPECT_GT(tile_offsets[tiles], 0) << "the lists fit";
}

TEST(Kernels, OrderFootprintsByTheirDepthsAlsoNegativeOnes) {
  std::vector<ProjectedGaussian<float>> projected;
  for (const float depth : {2.0f, -4.0f, 0.0f, 5.0f, -0.0f, -4.5f, 1e-40f, 2.0f}) {
    projected.push_back({}), projected.back().depth = depth;
  }
  const auto count = static_cast<int64_t>(projected.size());
  std::vector<int32_t> radii(count, 1), order(count, -1);
  std::vector<DepthBits<float>> keys(count);
  int64_t ordered = -1;
  radii[3] = 0;  // culled
  cuda::Frame<float> frame = {};
  frame.inputs.num_gaussians = count;
  frame.saved.projected = projected.data(), frame.saved.order = order.data(), frame.saved.num_ordered = &ordered;
  frame.images.radii = radii.data();
  cuda::StreamMemory memory(nullptr);
  cuda::key_footprints(frame, keys.data(), {nullptr, &memory});
  cuda::sort_by_depth(frame, keys.data(), {nullptr, &memory});
  ASSERT_EQ(ordered, count - 1);
  order.resize(ordered);
  EXPECT_EQ(order, (std::vector<int32_t>{5, 1, 2, 4, 6, 0, 7}));
}

// What the views of a batch see, and the gradients by the Gaussians; for three cameras, side by side.
struct BatchResults {
  // lenses: of the first views. Of two the first one rolls.
  BatchResults(const Scene<float>& scene, const std::vector<Lens<double>>& lenses) : gradient(scene) {
    for (int v = 0; v < 3; ++v) {
      Camera<float> camera = scene.camera;
      for (int row = 0; row < 2; ++row) camera.view[12 + row] += 0.7f * static_cast<float>(v);
      for (int row = 0; row < 4; ++row) {
        camera.projection[12 + row] +=
            0.4f * static_cast<float>(v) * (camera.projection[row] + camera.projection[4 + row]);
      }
      if (v < static_cast<int>(lenses.size())) camera.lens = lenses[v].as<float>();
      if (v == 0 && lenses.size() == 2) set_shutter(camera, Shutter::kBottomToTop);
      cameras.push_back(camera);
      radii.emplace_back(scene.count, -5), offsets.emplace_back(num_view_blocks(scene.count) + 1, -5);
    }
  }

  // fewer: rows that are left out of those that were counted.
  template <class Batch, class Count, class Project, class Backward>
  void run(const Scene<float>& scene, Batch batch, int fewer, Count count, Project project, Backward backward) {
    batch.inputs = scene.inputs(), batch.config = scene.raster_config();
    for (size_t v = 0; v < batch.views.size(); ++v) {
      batch.views[v].radii = radii[v].data(), batch.views[v].offsets = offsets[v].data();
    }
    count(batch);
    for (size_t v = 0; v < batch.views.size(); ++v) {
      auto& view = batch.views[v];
      view.num_rows = offsets[v].back() - fewer;
      Random random(11);  // of each view: what differs between the views is the cameras
      for (auto* rows : {&gates, &features}) rows->emplace_back(view.num_rows * 8 + 1, 7.0f);
      const std::vector<double> numbers = random.uniforms(9 * offsets[v].back());
      records.emplace_back(numbers.begin(), numbers.end());
      means2D.emplace_back(3 * scene.count, 7.0f);
      view.gates = gates[v].data(), view.features = features[v].data();
      view.records = records[v].data(), view.means2D = means2D[v].data();
    }
    project(batch);
    backward(batch, gradient.gradients());
  }

  std::vector<Camera<float>> cameras;
  std::vector<std::vector<int32_t>> radii, offsets;
  std::vector<std::vector<float>> gates, features, records, means2D;
  SceneGradient<float> gradient;
};

BatchResults batch_on_cpu(const Scene<float>& scene, const std::vector<Lens<double>>& lenses = {}) {
  BatchResults out(scene, lenses);
  cpu::ViewBatch batch;
  for (const Camera<float>& camera : out.cameras) batch.views.emplace_back().camera = camera;
  out.run(scene, batch, 0, cpu::count_rows, cpu::project_rows, cpu::project_rows_backward);
  return out;
}

BatchResults batch_by_kernels(const Scene<float>& scene, int fewer = 0, const std::vector<Lens<double>>& lenses = {}) {
  BatchResults out(scene, lenses);
  cuda::ViewBatch batch;
  for (const Camera<float>& camera : out.cameras) {
    batch.views.emplace_back().camera = {camera.width, camera.height,  camera.tan_fov_x,  camera.tan_fov_y,
                                         camera.near,  camera.view,    camera.projection, camera.position,
                                         camera.lens,  camera.shutter, camera.view_end};
  }
  out.run(
      scene, batch, fewer, [](const auto& batch) { cuda::count_rows(batch, {}); },
      [](const auto& batch) { cuda::project_rows(batch, {}); },
      [](const auto& batch, const auto& gradients) { cuda::project_rows_backward(batch, gradients, {}); });
  return out;
}

std::vector<double> widened(const std::vector<float>& numbers) { return {numbers.begin(), numbers.end()}; }

TEST(Kernels, TakeTheViewsOfABatchAsTheCpu) {
  Scene<double> no_shs = make_scene(4, 300, 41, 23);
  no_shs.sh_degree = 0, no_shs.dc = no_shs.shs, no_shs.dc.resize(3 * no_shs.count), no_shs.shs.clear();
  const std::vector<Lens<double>> lenses = make_lenses(41, 23), mixed = {lenses[2], {}, lenses[1]},
                                  rolling = {lenses[1], lenses[2]};  // the first of two
  const Scene<double> known = with_degree_3(make_scene(3, 300, 41, 23), false), staged = make_scene(3, 129, 41, 23);
  for (auto [of, through] : std::vector<std::pair<Scene<double>, std::vector<Lens<double>>>>{
           {known, {}},
           {known, mixed},
           {staged, {}},
           {staged, mixed},
           {known, rolling},
           {staged, rolling},
           {no_shs, {}},
           {with_degree_3(make_scene(3, 300, 41, 23), true), {}},
           {make_scene(3, 0, 41, 23), {}}}) {
    if (of.count > 0) (of.dc.empty() ? of.shs : of.dc)[3 * 40] = NAN;  // that Gaussian has a row, and is culled
    const Scene<float> scene = convert<float>(of);
    const BatchResults expected = batch_on_cpu(scene, through), actual = batch_by_kernels(scene, 0, through);
    for (const auto order : {emulator::Order::kBackward, emulator::Order::kShuffled}) {
      emulator::run_in(order);
      const BatchResults other = batch_by_kernels(scene, 0, through);
      EXPECT_EQ(other.offsets, actual.offsets);
      EXPECT_EQ(other.features, actual.features);
      EXPECT_EQ(other.gates, actual.gates);
      EXPECT_EQ(other.gradient.by.shs, actual.gradient.by.shs);
      EXPECT_EQ(other.gradient.by.means3D, actual.gradient.by.means3D);
    }
    emulator::run_in(emulator::Order::kForward);
    for (size_t v = 0; v < actual.cameras.size(); ++v) {
      EXPECT_EQ(actual.radii[v], expected.radii[v]);
      EXPECT_EQ(actual.offsets[v], expected.offsets[v]);
      EXPECT_TRUE(of.count == 0 || actual.offsets[v].back() > 20);
      expect_near(actual.features[v], widened(expected.features[v]), "features");
      expect_near(actual.gates[v], widened(expected.gates[v]), "gates");
      for (int64_t i = 0; i < of.count; ++i) {
        EXPECT_NEAR(actual.means2D[v][3 * i], expected.means2D[v][3 * i], 1e-5) << i;
      }
    }
    for (const auto array : {&Scene<float>::means3D, &Scene<float>::opacities, &Scene<float>::scales,
                             &Scene<float>::rotations, &Scene<float>::dc, &Scene<float>::shs}) {
      expect_near(actual.gradient.by.*array, widened(expected.gradient.by.*array), "gradients");
    }
  }
}

// A caller that has read another number of rows than there are gets no numbers from behind its memory.
TEST(Kernels, TouchNoRowsBehindThoseOfABatch) {
  const BatchResults out = batch_by_kernels(convert<float>(with_degree_3(make_scene(3, 150, 41, 23), true)), 5);
  for (const auto& gates : out.gates) EXPECT_EQ(gates.back(), 7.0f);
}

// If pixels do not stop, both passes evaluate all pairs of the entries that meet a square.
TEST(Kernels, CountThePairsOfBothPasses) {
  Scene<double> scene = long_lists();
  scene.config.blend.mode = BlendMode::kSmoeTn;
  StageTimes times;
  by_kernels(convert<float>(scene), std::vector<bool>(scene.pixels(), false), {false, kMostInstances, false, &times});
  EXPECT_GT(times.backward_pairs, 0);
  EXPECT_EQ(times.forward_pairs, times.backward_pairs);
}

TEST(Kernels, GiveTheSameBitsInEveryOrder) {
  for (const Scene<double>& of : {make_scene(4, 70, 17, 17), list_of_unlike_halves()}) {
    const Scene<float> scene = convert<float>(in_mode<BlendMode::kSmoeEq7>(of).back());
    const std::vector<bool> all_sure(scene.pixels(), false);
    Results<float> first = by_kernels(scene, all_sure, {true});
    for (const auto order : {emulator::Order::kBackward, emulator::Order::kShuffled}) {
      emulator::run_in(order);
      Results<float> other = by_kernels(scene, all_sure, {true});
      EXPECT_EQ(other.rendering.color, first.rendering.color);
      EXPECT_EQ(other.all_gradients(), first.all_gradients());
      EXPECT_EQ(other.worth, first.worth);
    }
    emulator::run_in(emulator::Order::kForward);
  }
}

// Faint Gaussians that cover the image: more instances than a view of small ones leaves room for. Walls hide them but
// in the tiles on the right, which saves time.
Scene<double> view_of_large_ones() {
  Random random(10);
  Scene<double> scene = make_scene(10, 3000, 96, 64);
  for (int64_t i = 0; i < scene.count; ++i) {
    const bool wall = i < 10;
    put(scene, i, wall ? -0.7 * (i % 2) : random.uniform(-0.5, 0.5), random.uniform(-0.5, 0.5), wall ? 1.5 : 3);
    for (int axis = 0; axis < 3; ++axis) scene.scales[3 * i + axis] = wall ? 0.3 : random.uniform(0.8, 1.2);
    scene.opacities[i] = wall ? 0.95 : random.uniform(0.01, 0.02);
  }
  return scene;
}

TEST(Kernels, GiveTheSameBitsWhateverWasRenderedBefore) {
  const Scene<float> large = convert<float>(in_mode<BlendMode::kSmoe>(view_of_large_ones()).back());
  Scene<float> small = large;
  for (float& scale : small.scales) scale *= 0.01f;
  const std::vector<bool> all_sure(large.pixels(), false);
  How deterministic = {true};
  deterministic.weighs = false;
  for (int i = 0; i < 2; ++i) by_kernels(small, all_sure, deterministic);
  Results<float> first = by_kernels(large, all_sure, deterministic);  // its lists do not fit
  for (int i = 0; i < 2; ++i) {
    Results<float> later = by_kernels(large, all_sure, deterministic);
    EXPECT_EQ(later.rendering.color, first.rendering.color);
    EXPECT_EQ(later.all_gradients(), first.all_gradients());
  }
}

}  // namespace
}  // namespace dsmoe

// The instruction sets: the same images and gradients from each, called directly, and the choice by DSMOE_SIMD.
#include <gtest/gtest.h>

#include <cstdlib>
#include <iostream>
#include <limits>
#include <memory>
#include <stdexcept>
#include <string>
#include <vector>

#include "all_modes.h"
#include "brute_force.h"
#include "cpu/loops.h"
#include "simd_levels.h"
#include "test_scene.h"

namespace dsmoe {
namespace cpu {
namespace {

std::vector<const SimdLevel*> available_levels() {
  std::vector<const SimdLevel*> out = {&kBaselineLevel};
#if defined(__x86_64__)
  if (processor_has_avx2()) out.push_back(&kAvx2Level);
  if (processor_has_avx512()) out.push_back(&kAvx512Level);
#endif
  return out;
}

template <class S> const TileKernels<S>& kernels_of(const SimdLevel& level);
template <> const TileKernels<float>& kernels_of(const SimdLevel& level) { return level.float_kernels; }
template <> const TileKernels<double>& kernels_of(const SimdLevel& level) { return level.double_kernels; }

template <class S> Rendering<S> render_at(const SimdLevel& level, const Scene<S>& scene) {
  Rendering<S> out = project_and_bin(scene);
  const auto config = scene.raster_config();
  const auto saved = out.saved();
  const auto images = out.images();
  for_each_tile(config, saved, scene.camera.width, scene.camera.height, config.num_features(),
                [&](const Tile<S>& tile, S* scratch) { return kernels_of<S>(level).forward(tile, images, scratch); });
  return out;
}

// The gradients of all instances.
template <class S>
std::vector<S> backward_at(const SimdLevel& level, const Scene<S>& scene, Rendering<S>& r,
                           const ImageWeights<S>& weights) {
  const auto config = scene.raster_config();
  const auto saved = r.saved();
  const auto images = r.images();
  const auto dL_dimages = weights.gradients();
  const auto& camera = scene.camera;
  std::vector<S> out(r.instances.size() * (kNumGateMoments + config.num_features()), S(-12345));
  std::vector<S> background(num_tiles(camera.width, camera.height) * (config.num_channels + 1));
  const TileGradients<S> gradients = {images, dL_dimages, out.data(), background.data()};
  for_each_tile(
      config, saved, camera.width, camera.height, config.num_features(),
      [&](const Tile<S>& tile, S* scratch) { return kernels_of<S>(level).backward(tile, gradients, scratch); });
  out.insert(out.end(), background.begin(), background.end());
  return out;
}

// What each instance's pixels say of its Gaussian, four numbers each.
template <class S> std::vector<S> contributions_at(const SimdLevel& level, const Scene<S>& scene, Rendering<S>& r) {
  const auto config = scene.raster_config();
  const auto saved = r.saved();
  const auto& camera = scene.camera;
  std::vector<S> pixel_weights;
  for (int64_t pixel = 0; pixel < scene.pixels(); ++pixel) pixel_weights.push_back(brute_force_pixel_weight<S>(pixel));
  std::vector<Contribution<S>> out(r.instances.size(), Contribution<S>{-1, -1, -1, -1});
  const ContributionPass<S> pass = {{pixel_weights.data(), {}}};
  for_each_tile(config, saved, camera.width, camera.height, 0, [&](const Tile<S>& tile, S* scratch) {
    return kernels_of<S>(level).template of_pass<ContributionPass<S>>()(tile, pass, out.data(), scratch);
  });
  std::vector<S> flat;
  for (const auto& c : out) flat.insert(flat.end(), {c.pixel_weight, c.pixels, c.blend_weight, c.distance});
  return flat;
}

// What each instance's Gaussian is worth to its tile, three numbers each.
template <class S> std::vector<S> importance_at(const SimdLevel& level, const Scene<S>& scene, Rendering<S>& r) {
  const auto config = scene.raster_config();
  const auto saved = r.saved();
  std::vector<S> weights;
  for (int64_t pixel = 0; pixel < scene.pixels(); ++pixel) weights.push_back(brute_force_pixel_weight<S>(pixel));
  ImportanceMap<S> map;
  map.color = r.color.data();
  map.pixel_weights = map.share_weights = weights.data();
  std::vector<Importance<S>> out(r.instances.size(), Importance<S>{-1, -1, -1});
  for_each_tile(config, saved, scene.camera.width, scene.camera.height, kImportanceArrays + 2 * config.num_channels,
                [&](const Tile<S>& tile, S* scratch) {
                  return kernels_of<S>(level).template of_pass<ImportancePass<S>>()(tile, {map}, out.data(), scratch);
                });
  std::vector<S> flat;
  for (const auto& i : out) flat.insert(flat.end(), {i.share, i.squared_share, i.removal_cost});
  return flat;
}

template <class S>
void expect_close(const std::vector<S>& a, const std::vector<S>& b, double tolerance, const char* name) {
  expect_near_all(std::vector<double>(a.begin(), a.end()), std::vector<double>(b.begin(), b.end()), tolerance);
  EXPECT_FALSE(testing::Test::HasFailure()) << name;
}

template <class S> void expect_levels_agree(BlendMode mode, bool depths) {
  Scene<double> wide = make_scene(41, 40, 37, 29);
  wide.config.blend.mode = mode;
  wide.config.depth = wide.config.inverse_depth = depths;
  const Scene<S> scene = convert<S>(wide);
  const ImageWeights<S> weights(scene, 2);
  const double epsilon = std::numeric_limits<S>::epsilon();
  // No decision may be near enough to its threshold for the levels to disagree on it.
  ASSERT_GT(brute_force(scene).smallest_margin(), 20 * epsilon);
  Rendering<S> expected = render_at(kBaselineLevel, scene);
  const auto expected_gradient = backward_at(kBaselineLevel, scene, expected, weights);
  const auto expected_contributions = contributions_at(kBaselineLevel, scene, expected);
  const auto expected_importance = importance_at(kBaselineLevel, scene, expected);
  for (const SimdLevel* level : available_levels()) {
    Rendering<S> actual = render_at(*level, scene);
    // With and without fused multiply-add: an ulp here and there in some dozens of terms.
    expect_close(actual.color, expected.color, 50 * epsilon, level->name);
    expect_close(actual.gate_sum, expected.gate_sum, 50 * epsilon, level->name);
    if (depths) {
      expect_close(actual.depth, expected.depth, 50 * epsilon, level->name);
      expect_close(actual.inverse_depth, expected.inverse_depth, 50 * epsilon, level->name);
    }
    EXPECT_EQ(actual.last_contributor, expected.last_contributor) << level->name;
    // Sums over a tile's 256 pixels.
    expect_close(backward_at(*level, scene, expected, weights), expected_gradient, 256 * epsilon, level->name);
    expect_close(contributions_at(*level, scene, expected), expected_contributions, 256 * epsilon, level->name);
    // Of the level's own rendering: a pixel's only owner is known by equal sums. Roundings in front of a pair grow by
    // 1 / (1 - alpha) <= 100.
    expect_close(importance_at(*level, scene, actual), expected_importance, 100 * 256 * epsilon, level->name);
  }
}

template <class Mode> struct SimdLevelIn : testing::Test {};
TYPED_TEST_SUITE(SimdLevelIn, AllModes);

TYPED_TEST(SimdLevelIn, EveryLevelDrawsTheSameImageAndGradients) {
  for (const bool depths : {false, true}) {
    expect_levels_agree<float>(TypeParam::value, depths);
    expect_levels_agree<double>(TypeParam::value, depths);
  }
}

// In processes of their own, because the choice is made once.
class SimdLevelDeathTest : public testing::Test {
 protected:
  void SetUp() override { GTEST_FLAG_SET(death_test_style, "threadsafe"); }
};

[[noreturn]] void print_level_and_exit(const char* wanted) {
  setenv("DSMOE_SIMD", wanted, 1);
  try {
    std::cerr << "level " << simd_level() << "\n";
  } catch (const std::invalid_argument& error) {
    std::cerr << error.what() << "\n";
  }
  std::exit(0);
}

TEST_F(SimdLevelDeathTest, TheEnvironmentChoosesAmongTheLevelsOfThisProcessor) {
  for (const SimdLevel* level : available_levels()) {
    EXPECT_EXIT(print_level_and_exit(level->name), testing::ExitedWithCode(0), std::string("level ") + level->name);
  }
}

TEST_F(SimdLevelDeathTest, TheBestLevelIsTheDefault) {
  EXPECT_EXIT(print_level_and_exit(""), testing::ExitedWithCode(0),
              std::string("level ") + available_levels().back()->name);
}

TEST_F(SimdLevelDeathTest, AnUnknownLevelIsAnErrorThatNamesTheKnownOnes) {
  EXPECT_EXIT(print_level_and_exit("mmx"), testing::ExitedWithCode(0), "DSMOE_SIMD is \"mmx\".*baseline");
}

}  // namespace
}  // namespace cpu
}  // namespace dsmoe

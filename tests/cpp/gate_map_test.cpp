// The Gaussian of the greatest gate in each pixel, the median one, and the number of Gaussians there.
#include <gtest/gtest.h>

#include <limits>
#include <vector>

#include "all_modes.h"
#include "brute_force.h"
#include "test_scene.h"

namespace dsmoe {
namespace {

struct Map {
  std::vector<int32_t> gaussians, counts, medians;
};

// Unwritten numbers are none that a map holds.
template <class S> Map map_of(const Scene<S>& scene, int num_threads = 1) {
  Rendering<S> rendering = render(scene);
  cpu::Frame<S> frame = frame_of(scene, rendering);
  frame.config.num_threads = num_threads;
  const std::vector<int32_t> unwritten(scene.pixels(), -2);
  Map map = {unwritten, unwritten, unwritten};
  cpu::gate_map(frame, {map.gaussians.data(), map.counts.data(), map.medians.data()});
  return map;
}

// A pixel is left out if rounding may turn a decision over, or exchange the two greatest gates; of the medians also one
// in which a sum of weights is half up to rounding.
template <class S> void expect_brute_force(const Scene<S>& scene) {
  const double least = 100 * std::numeric_limits<S>::epsilon();  // of weights: products of up to 80 rounded factors
  const BruteForce<S> expected = brute_force(scene);
  const Map actual = map_of(scene);
  int64_t left_out = 0, num_pairs = 0, num_empty = 0, num_medians = 0, no_medians = 0;
  for (int64_t pixel = 0; pixel < scene.pixels(); ++pixel) {
    if (expected.margin[pixel] < least || expected.lead[pixel] < least) {
      ++left_out;
      continue;
    }
    ASSERT_EQ(actual.gaussians[pixel], expected.greatest[pixel]) << pixel;
    ASSERT_EQ(actual.counts[pixel], expected.num_contributing[pixel]) << pixel;
    num_pairs += actual.counts[pixel];
    num_empty += actual.gaussians[pixel] < 0;
    if (expected.median_margin[pixel] < least) continue;
    ASSERT_EQ(actual.medians[pixel], expected.medians[pixel]) << pixel;
    num_medians += actual.medians[pixel] >= 0;
    no_medians += actual.medians[pixel] < 0 && actual.counts[pixel] > 0;
  }
  EXPECT_LE(left_out, scene.pixels() / 50);
  EXPECT_GT(num_pairs, 500);
  EXPECT_GT(num_empty, 0);
  EXPECT_GT(num_medians, 50);
  if (scene.config.blend.mode == BlendMode::kAlpha) EXPECT_GT(no_medians, 0);
}

template <class Mode> struct GateMapIn : testing::Test {};
TYPED_TEST_SUITE(GateMapIn, AllModes);

TYPED_TEST(GateMapIn, EqualsBruteForce) {
  for (const unsigned seed : {41, 44}) {  // with a gate for the background, and without
    Scene<double> scene = make_scene(seed, 150, 61, 47);
    scene.config.blend.mode = TypeParam::value;
    for (double& scale : scene.scales) scale /= 4;  // so that some pixels are empty
    expect_brute_force(scene);
    expect_brute_force(convert<float>(scene));
  }
}

TYPED_TEST(GateMapIn, TakesTheNearestOfEqualGates) {
  // Both faint and in one place. In modes with transmittance the nearer one's gate is greater, else they are equal and
  // the first in the list counts.
  Scene<double> scene = make_scene(45, 2, 16, 16);
  scene.config.blend.mode = TypeParam::value;
  scene.means3D = {0, 0, 0, 0, 0, 0};
  scene.scales = {0.5, 0.5, 0.5, 0.5, 0.5, 0.5};
  scene.opacities = {0.25, 0.25};
  const Map map = map_of(scene);
  const int centre = 8 * 16 + 8;
  EXPECT_EQ(map.gaussians[centre], 0);
  EXPECT_EQ(map.counts[centre], 2);
}

TYPED_TEST(GateMapIn, DoesNotDependOnThreads) {
  Scene<double> wide = make_scene(42, 300, 131, 83);
  wide.config.blend.mode = TypeParam::value;
  const Scene<float> scene = convert<float>(wide);
  const Map expected = map_of(scene);
  for (const int threads : {2, 7}) {
    const Map actual = map_of(scene, threads);
    EXPECT_EQ(actual.gaussians, expected.gaussians);
    EXPECT_EQ(actual.counts, expected.counts);
    EXPECT_EQ(actual.medians, expected.medians);
  }
}

TYPED_TEST(GateMapIn, IsEmptyWithoutGaussians) {
  Scene<double> scene = make_scene(43, 0, 37, 29);
  scene.config.blend.mode = TypeParam::value;
  const Map map = map_of(scene, 2);
  EXPECT_EQ(map.gaussians, std::vector<int32_t>(scene.pixels(), -1));
  EXPECT_EQ(map.counts, std::vector<int32_t>(scene.pixels(), 0));
  EXPECT_EQ(map.medians, map.gaussians);
}

}  // namespace
}  // namespace dsmoe

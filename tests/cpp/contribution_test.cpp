// What pixels say of a Gaussian: the pair's numbers by hand, and the CPU backend's sums over whole images.
#include <gtest/gtest.h>

#include <limits>
#include <vector>

#include "all_modes.h"
#include "brute_force.h"
#include "dsmoe/passes/contributions.h"
#include "test_scene.h"

namespace dsmoe {
namespace {

template <class S> class AddPair : public testing::Test {};
using Scalars = testing::Types<float, double>;
TYPED_TEST_SUITE(AddPair, Scalars);

TYPED_TEST(AddPair, AddsFourNumbersOfAPairThatContributes) {
  using S = TypeParam;
  Contribution<S> sum = {};
  add_pair(sum, true, S(-2), S(0.25), S(3), S(-4));
  add_pair(sum, true, S(7), S(0.5), S(0), S(2));
  EXPECT_EQ(sum.pixel_weight, S(5));
  EXPECT_EQ(sum.pixels, S(2));
  EXPECT_EQ(sum.blend_weight, S(0.75));
  EXPECT_EQ(sum.distance, S(7));
}

TYPED_TEST(AddPair, AddsNothingOfOthersWhateverTheyHold) {
  using S = TypeParam;
  const S nan = std::numeric_limits<S>::quiet_NaN();
  Contribution<S> sum = {};
  add_pair(sum, false, nan, nan, nan, nan);
  EXPECT_EQ(sum.pixel_weight, S(0));
  EXPECT_EQ(sum.pixels, S(0));
  EXPECT_EQ(sum.blend_weight, S(0));
  EXPECT_EQ(sum.distance, S(0));
}

template <class S> struct Sums {
  std::vector<S> pixel_weights, blend_weights, distances;
  std::vector<int32_t> pixels;
};

// Unwritten numbers are none that a sum is.
template <class S> Sums<S> sums_of(const Scene<S>& scene, int num_threads) {
  Rendering<S> rendering = render(scene);
  cpu::Frame<S> frame = frame_of(scene, rendering);
  frame.config.num_threads = num_threads;
  std::vector<S> pixel_weights;
  for (int64_t pixel = 0; pixel < scene.pixels(); ++pixel) pixel_weights.push_back(brute_force_pixel_weight<S>(pixel));
  const S unwritten = S(-12345);
  Sums<S> out;
  for (auto* sum : {&out.pixel_weights, &out.blend_weights, &out.distances}) sum->resize(scene.count, unwritten);
  out.pixels.resize(scene.count, -1);
  cpu::contributions(frame,
                     {pixel_weights.data(),
                      {out.pixel_weights.data(), out.pixels.data(), out.blend_weights.data(), out.distances.data()}});
  return out;
}

template <class S> void expect_brute_force(const Scene<S>& scene) {
  const double epsilon = std::numeric_limits<S>::epsilon();
  const BruteForce<S> expected = brute_force(scene);
  // No decision is near enough to its threshold to be another one here.
  ASSERT_GT(expected.smallest_margin(), 20 * epsilon);
  const Sums<S> actual = sums_of(scene, 1);
  int64_t num_pairs = 0;
  for (int64_t i = 0; i < scene.count; ++i) {
    const Contribution<double>& sum = expected.contributions[i];
    // Sums of thousands of positive numbers, each rounded some times.
    const double tolerance = 100 * epsilon;
    EXPECT_EQ(actual.pixels[i], sum.pixels) << i;
    EXPECT_NEAR(actual.pixel_weights[i], sum.pixel_weight, tolerance * sum.pixel_weight) << i;
    EXPECT_NEAR(actual.blend_weights[i], sum.blend_weight, tolerance * sum.blend_weight) << i;
    EXPECT_NEAR(actual.distances[i], sum.distance, tolerance * sum.distance) << i;
    num_pairs += actual.pixels[i];
  }
  EXPECT_GT(num_pairs, 500);
}

template <class Mode> struct ContributionsIn : testing::Test {};
TYPED_TEST_SUITE(ContributionsIn, AllModes);

TYPED_TEST(ContributionsIn, EqualBruteForce) {
  for (const bool antialiasing : {false, true}) {
    Scene<double> scene = make_scene(41, 40, 37, 29);
    scene.config.blend.mode = TypeParam::value;
    scene.config.antialiasing = antialiasing;
    expect_brute_force(scene);
    if (!antialiasing) expect_brute_force(convert<float>(scene));
  }
}

TYPED_TEST(ContributionsIn, DoNotDependOnThreads) {
  Scene<double> wide = make_scene(42, 300, 131, 83);
  wide.config.blend.mode = TypeParam::value;
  const Scene<float> scene = convert<float>(wide);
  const Sums<float> expected = sums_of(scene, 1);
  for (const int threads : {2, 3, 7}) {
    const Sums<float> actual = sums_of(scene, threads);
    EXPECT_EQ(actual.pixel_weights, expected.pixel_weights);
    EXPECT_EQ(actual.pixels, expected.pixels);
    EXPECT_EQ(actual.blend_weights, expected.blend_weights);
    EXPECT_EQ(actual.distances, expected.distances);
  }
}

TYPED_TEST(ContributionsIn, AreZeroWhereThereAreNoGaussians) {
  Scene<double> scene = make_scene(43, 0, 37, 29);
  scene.config.blend.mode = TypeParam::value;
  EXPECT_TRUE(sums_of(scene, 2).pixels.empty());
}

}  // namespace
}  // namespace dsmoe

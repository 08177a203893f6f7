// The CPU backend from Gaussians to images and back.
#include "dsmoe/rasterize.h"

#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <memory>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

#include "all_modes.h"
#include "brute_force.h"
#include "dsmoe/arrays.h"
#include "test_scene.h"

namespace dsmoe {
namespace {

using Vector = std::vector<double>;

template <class S> Scene<S> in_mode(Scene<S> scene, BlendMode mode) {
  scene.config.blend.mode = mode;
  return scene;
}

// ---- Images against the brute-force renderer ----

// Pixels where rounding may turn a decision over are left out, and counted.
template <class S> void expect_brute_force(const Scene<S>& scene, double tolerance, double smallest_margin) {
  const Rendering<S> actual = render(scene);
  const BruteForce<S> expected = brute_force(scene);
  EXPECT_EQ(actual.radii, expected.radii);
  const int64_t pixels = scene.pixels();
  const auto left_out = std::count_if(expected.margin.begin(), expected.margin.end(),
                                      [&](double margin) { return margin < smallest_margin; });
  EXPECT_LE(left_out, pixels / 50);
  auto compare = [&](const std::vector<S>& a, const std::vector<S>& b, const char* name) {
    ASSERT_EQ(a.size(), b.size()) << name;
    for (size_t k = 0; k < a.size(); ++k) {
      if (expected.margin[k % pixels] < smallest_margin) continue;
      ASSERT_NEAR(a[k], b[k], tolerance * std::max<double>(1, std::abs(b[k])))
          << name << " of pixel " << k % pixels % scene.camera.width << ", " << k % pixels / scene.camera.width;
    }
  };
  compare(actual.color, expected.color, "color");
  compare(actual.gate_sum, expected.gate_sum, "gate sum");
  compare(actual.depth, expected.depth, "depth");
  compare(actual.inverse_depth, expected.inverse_depth, "inverse depth");
}

// Sums of a hundred terms near 1, each off by the exponential's 2 ulps and a few roundings more; a pair's exponent
// of up to 11 adds its own rounding. A decision within ten times that of its threshold is left out.
template <class S> void expect_brute_force(const Scene<S>& scene) {
  const double epsilon = std::numeric_limits<S>::epsilon();
  expect_brute_force(scene, 100 * epsilon, 100 * epsilon);
}

template <class Mode> struct RasterizeIn : testing::Test {};
TYPED_TEST_SUITE(RasterizeIn, AllModes);

TYPED_TEST(RasterizeIn, EqualsBruteForceOnOddSizes) {
  const std::pair<int, int> sizes[] = {{1, 1}, {16, 16}, {17, 3}, {5, 33}, {61, 47}};
  for (const auto& [width, height] : sizes) {
    const Scene<double> scene = in_mode(make_scene(1, 80, width, height), TypeParam::value);
    expect_brute_force(scene);
    expect_brute_force(convert<float>(scene));
  }
}

TYPED_TEST(RasterizeIn, EqualsBruteForceWithDepths) {
  for (const bool depth : {false, true}) {
    for (const bool inverse_depth : {false, true}) {
      Scene<double> scene = in_mode(make_scene(2, 60, 37, 29), TypeParam::value);
      scene.config.depth = depth;
      scene.config.inverse_depth = inverse_depth;
      expect_brute_force(scene);
      expect_brute_force(convert<float>(scene));
    }
  }
}

TYPED_TEST(RasterizeIn, EqualsBruteForceWithAnyNumberOfChannels) {
  for (const int channels : {1, 2, 4, 19}) {
    Scene<double> scene = in_mode(make_scene(3, 60, 37, 29), TypeParam::value);
    scene.shs.clear();
    scene.colors_precomp = Random(4).uniforms(60 * channels);
    scene.background = Random(5).uniforms(channels);
    scene.background.push_back(0.15);
    scene.config.num_channels = channels;
    scene.config.depth = channels == 2;  // three features: two colours and the depth
    expect_brute_force(scene);
    expect_brute_force(convert<float>(scene));
  }
}

TYPED_TEST(RasterizeIn, EqualsBruteForceWithAlphaMinAndAntialiasing) {
  Scene<double> scene = in_mode(make_scene(6, 80, 37, 29), TypeParam::value);
  scene.config.blend.alpha_min = 0.01;
  scene.config.antialiasing = true;
  expect_brute_force(scene);
  expect_brute_force(convert<float>(scene));
}

TYPED_TEST(RasterizeIn, EqualsBruteForceOnNeedlesAndGiants) {
  Scene<double> scene = in_mode(make_scene(7, 60, 61, 47), TypeParam::value);
  Random random(8);
  for (int64_t i = 0; i < scene.count; ++i) {
    scene.scales[3 * i] = random.log_uniform(0.5, 20);
    scene.scales[3 * i + 1] = scene.scales[3 * i + 2] = random.log_uniform(1e-4, 1e-2);
    if (i % 3 == 0) scene.scales[3 * i + 1] = random.log_uniform(1, 20);
  }
  // A needle's exponent is a difference of terms up to 1e7 times as large: in double six digits are left over.
  expect_brute_force(scene, 1e-8, 1e-8);
}

// ---- Gradients against finite differences of the whole rasterizer ----

// Wide gates, so that every pair counts at every pixel and no step turns a decision over.
Scene<double> smooth_scene(unsigned seed, double smallest_opacity, double largest_opacity) {
  Random random(seed);
  Scene<double> scene = make_scene(seed, 6, 21, 18);
  scene.background[3] = 0.15;
  for (int64_t i = 0; i < scene.count; ++i) {
    for (int k = 0; k < 3; ++k) {
      scene.means3D[3 * i + k] = random.uniform(-0.6, 0.6);
      scene.scales[3 * i + k] = random.uniform(1.5, 2.5);
    }
    scene.opacities[i] = random.uniform(smallest_opacity, largest_opacity);
    Vector q = random.uniforms(4);  // near length 1, or the gates would be narrower or wider by its square
    const double length = std::sqrt(weighted_sum(q, q)) / random.uniform(0.9, 1.1);
    for (int k = 0; k < 4; ++k) scene.rotations[4 * i + k] = q[k] / length;
  }
  scene.config.depth = scene.config.inverse_depth = true;
  scene.config.blend.faint_below = 0;  // gradients hold the sum of tails constant
  return scene;
}

constexpr double kStep = 1e-5;

void expect_backward_is_the_derivative(Scene<double> scene) {
  // Parameters of size 1 move by two steps; that moves exponents and alphas by a few times as much.
  const BruteForce<double> forward = brute_force(scene);
  ASSERT_GT(forward.smallest_margin(), 20 * kStep) << "a step could turn a decision over";
  ASSERT_GT(forward.num_pairs, 3 * scene.pixels());
  const ImageWeights<double> weights(scene, 9);
  const Vector x = scene.flat();
  auto loss = [&](const Vector& v) {
    scene.set_flat(v);
    return weights.loss(render(scene));
  };
  const Vector expected = finite_differences(loss, x, kStep);
  scene.set_flat(x);
  Rendering<double> rendering = render(scene);
  // A loss of about 100, the sum of 2000 outputs, rounds at 1e-13: divided by the step, 1e-8 of gradients near 10.
  expect_near_all(render_backward(scene, rendering, weights.gradients()).flat(), expected, 1e-7);
}

TYPED_TEST(RasterizeIn, BackwardIsTheDerivativeByEveryInput) {
  expect_backward_is_the_derivative(in_mode(smooth_scene(10, 0.2, 0.6), TypeParam::value));
}

TYPED_TEST(RasterizeIn, BackwardIsTheDerivativeWherePixelsFillUp) {
  const Scene<double> scene = in_mode(smooth_scene(11, 0.96, 0.985), TypeParam::value);
  const Rendering<double> rendering = render(scene);
  const auto full = std::count_if(rendering.last_contributor.begin(), rendering.last_contributor.end(),
                                  [](int32_t last) { return last < 6; });
  EXPECT_EQ(full > 10, Blend<TypeParam::value>::kNeedsDepthOrder);
  expect_backward_is_the_derivative(scene);
}

TYPED_TEST(RasterizeIn, BackwardIsTheDerivativeWithAntialiasing) {
  Scene<double> scene = in_mode(smooth_scene(12, 0.2, 0.6), TypeParam::value);
  scene.config.antialiasing = true;
  expect_backward_is_the_derivative(scene);
}

// means2D is in normalised device coordinates: moving the whole image by a small step there moves every mean.
TYPED_TEST(RasterizeIn, Means2DGradientIsByNormalisedDeviceCoordinates) {
  Scene<double> scene = in_mode(smooth_scene(13, 0.2, 0.6), TypeParam::value);
  const ImageWeights<double> weights(scene, 14);
  const Scene<double> original = scene;
  for (int axis = 0; axis < 2; ++axis) {
    auto loss = [&](const Vector& shift) {
      for (int i = 0; i < 4; ++i) {
        scene.camera.projection[4 * i + axis] =
            original.camera.projection[4 * i + axis] + shift[0] * original.camera.projection[4 * i + 3];
      }
      return weights.loss(render(scene));
    };
    const Vector expected = finite_differences(loss, {0.0}, kStep);
    scene = original;
    Rendering<double> rendering = render(scene);
    const auto gradient = render_backward(scene, rendering, weights.gradients());
    double sum = 0;
    for (int64_t i = 0; i < scene.count; ++i) {
      sum += gradient.means2D[3 * i + axis];
      EXPECT_EQ(gradient.means2D[3 * i + 2], 0);
    }
    // 1e-7 is added to w, which is 2 to 4.
    EXPECT_NEAR(sum, expected[0], 1e-6 * std::abs(expected[0]));
  }
}

TYPED_TEST(RasterizeIn, FloatGradientsAgreeWithDoubleOnes) {
  Scene<double> wide = in_mode(smooth_scene(15, 0.2, 0.6), TypeParam::value);
  Scene<float> narrow = convert<float>(wide);
  wide = convert<double>(narrow);
  const ImageWeights<double> weights(wide, 16);
  const ImageWeights<float> narrow_weights(narrow, 16);
  Rendering<double> wide_rendering = render(wide);
  Rendering<float> narrow_rendering = render(narrow);
  const Vector expected = render_backward(wide, wide_rendering, weights.gradients()).flat();
  const auto actual = render_backward(narrow, narrow_rendering, narrow_weights.gradients()).flat();
  // Sums of 378 pixels that partly cancel, of terms with a few roundings of 6e-8 each.
  expect_near_all(Vector(actual.begin(), actual.end()), expected, 1e-4);
}

TYPED_TEST(RasterizeIn, GradientsMayBeAskedForOneByOne) {
  const Scene<float> scene = in_mode(convert<float>(make_scene(17, 40, 37, 29)), TypeParam::value);
  Rendering<float> rendering = render(scene);
  const ImageWeights<float> weights(scene, 18);
  SceneGradient<float> all = render_backward(scene, rendering, weights.gradients());
  SceneGradient<float> single(scene);
  const GaussianGradients<float> everything = single.gradients();
  auto ask_for = [&](auto... members) {
    GaussianGradients<float> wanted;
    ((wanted.*members = everything.*members), ...);
    cpu::backward(frame_of(scene, rendering), {weights.gradients(), wanted});
  };
  using G = GaussianGradients<float>;
  ask_for(&G::means3D), ask_for(&G::means2D), ask_for(&G::opacities), ask_for(&G::scales), ask_for(&G::rotations);
  ask_for(&G::shs), ask_for(&G::background), ask_for(&G::camera);
  EXPECT_EQ(single.flat(), all.flat());
  EXPECT_EQ(single.means2D, all.means2D);
}

TYPED_TEST(RasterizeIn, AnAbsentImageGradientIsZero) {
  Scene<float> scene = in_mode(convert<float>(make_scene(19, 40, 37, 29)), TypeParam::value);
  scene.config.depth = scene.config.inverse_depth = true;
  Rendering<float> rendering = render(scene);
  using I = ImageGradients<float>;
  using Member = const float* I::*;
  const std::vector<float> zeros(3 * scene.pixels());
  const ImageWeights<float> weights(scene, 20);
  for (const Member kept : {&I::color, &I::gate_sum, &I::depth, &I::inverse_depth}) {
    I absent, zero = {zeros.data(), zeros.data(), zeros.data(), zeros.data()};
    absent.*kept = zero.*kept = weights.gradients().*kept;
    EXPECT_EQ(render_backward(scene, rendering, absent).flat(), render_backward(scene, rendering, zero).flat());
  }
}

TEST(Rasterize, TheBackgroundsGateMayBeANumberOrLieInMemory) {
  const Scene<float> scene = in_mode(convert<float>(make_scene(31, 60, 37, 29)), BlendMode::kSmoeEq7);
  Rendering<float> in_memory = render(scene);
  Rendering<float> number = render(scene);
  cpu::Frame<float> frame = frame_of(scene, number);
  frame.config.blend.background_gate = *frame.config.blend.background_gate_at;
  ASSERT_GT(frame.config.blend.background_gate, 0);
  frame.config.blend.background_gate_at = nullptr;
  std::fill(number.color.begin(), number.color.end(), -1);
  cpu::blend(frame);
  EXPECT_EQ(number.color, in_memory.color);
}

// ---- Threads, lists, memory ----

TYPED_TEST(RasterizeIn, ResultsDoNotDependOnTheNumberOfThreadsBitForBit) {
  Scene<float> scene = in_mode(convert<float>(make_scene(21, 3000, 70, 50)), TypeParam::value);
  const ImageWeights<float> weights(scene, 22);
  Rendering<float> expected = render(scene);
  SceneGradient<float> expected_gradient = render_backward(scene, expected, weights.gradients());
  ASSERT_GT(expected.instances.size(), 3000u);
  for (const int threads : {2, 3, 7}) {
    scene.config.num_threads = threads;
    Rendering<float> actual = render(scene);
    SceneGradient<float> gradient = render_backward(scene, actual, weights.gradients());
    EXPECT_EQ(actual.color, expected.color);
    EXPECT_EQ(actual.gate_sum, expected.gate_sum);
    EXPECT_EQ(actual.final_transmittance, expected.final_transmittance);
    EXPECT_EQ(actual.last_contributor, expected.last_contributor);
    EXPECT_EQ(actual.radii, expected.radii);
    EXPECT_EQ(gradient.flat(), expected_gradient.flat());
    EXPECT_EQ(gradient.means2D, expected_gradient.means2D);
  }
}

TYPED_TEST(RasterizeIn, EveryInstanceHasItsOwnSlotAmongItsGaussians) {
  const Scene<float> scene = in_mode(convert<float>(make_scene(23, 500, 70, 50)), TypeParam::value);
  const Rendering<float> r = render(scene);
  std::vector<int> used(r.instances.size());
  for (const TileInstance& instance : r.instances) {
    EXPECT_GE(instance.slot, r.instance_offsets[instance.index()]);
    EXPECT_LT(instance.slot, r.instance_offsets[instance.index() + 1]);
    ++used.at(instance.slot);
  }
  for (const int times : used) EXPECT_EQ(times, 1);
  EXPECT_EQ(r.tile_offsets.back(), static_cast<int64_t>(r.instances.size()));
}

// Where no pixel of a tile is wide, walks skip such instances. With all of them walked no bit changes.
TYPED_TEST(RasterizeIn, InstancesWithoutNearPairsMatterToWidePixelsOnly) {
  if (!Blend<TypeParam::value>::kNearFirst) return;
  Scene<float> scene = in_mode(convert<float>(make_scene(28, 1500, 90, 70)), TypeParam::value);
  const ImageWeights<float> weights(scene, 29);
  for (const float below : {0.0f, kFaintBelow, 0.6f}) {
    scene.config.blend.faint_below = below;
    Rendering<float> marked = render(scene), all = render(scene);
    const auto skipped = std::count_if(all.instances.begin(), all.instances.end(),
                                       [](const TileInstance& instance) { return !instance.has_near_pairs(); });
    EXPECT_GT(skipped, 500);
    for (TileInstance& instance : all.instances) instance.gaussian = instance.index();
    for (auto* image : {&all.color, &all.gate_sum, &all.final_transmittance}) {
      std::fill(image->begin(), image->end(), -1.0f);
    }
    cpu::blend(frame_of(scene, all));
    EXPECT_EQ(marked.color, all.color);
    EXPECT_EQ(marked.gate_sum, all.gate_sum);
    EXPECT_EQ(marked.final_transmittance, all.final_transmittance);
    EXPECT_EQ(render_backward(scene, marked, weights.gradients()).flat(),
              render_backward(scene, all, weights.gradients()).flat());
  }
}

TEST(Rasterize, InstancesAreMarkedOnlyIfNearPairsAreBlendedFirst) {
  Scene<float> scene = convert<float>(make_scene(28, 300, 70, 50));
  BlendModes::for_each([&](auto mode) {
    scene.config.blend.mode = mode();
    scene.config.blend.faint_below = kFaintEverywhere;
    for (const TileInstance& instance : render(scene).instances) ASSERT_TRUE(instance.has_near_pairs());
  });
}

void expect_depth_order(BlendMode mode) {
  Scene<float> scene = in_mode(convert<float>(make_scene(24, 500, 70, 50)), mode);
  for (int64_t i = 1; i < scene.count; i += 2) {  // pairs at the same place
    for (int k = 0; k < 3; ++k) scene.means3D[3 * i + k] = scene.means3D[3 * (i - 1) + k];
  }
  const Rendering<float> r = render(scene);
  int ties = 0;
  for (size_t tile = 0; tile + 1 < r.tile_offsets.size(); ++tile) {
    for (int64_t k = r.tile_offsets[tile] + 1; k < r.tile_offsets[tile + 1]; ++k) {
      const int32_t before = r.instances[k - 1].index(), here = r.instances[k].index();
      const float front = r.projected[before].depth, back = r.projected[here].depth;
      ASSERT_LE(front, back);
      if (front == back) {
        ++ties;
        ASSERT_LT(before, here);
      }
    }
  }
  EXPECT_GT(ties, 100);
}

TEST(Rasterize, EveryTilesListIsInDepthOrderAndTiesInIndexOrder) {
  BlendModes::for_each([](auto mode) {
    if (Blend<mode()>::kNeedsDepthOrder) expect_depth_order(mode());
  });
}

// ---- Edges ----

TYPED_TEST(RasterizeIn, NoGaussiansGiveTheBackgroundAndItsGradient) {
  Scene<float> nothing = in_mode(convert<float>(make_scene(25, 0, 19, 17)), TypeParam::value);
  Scene<float> unseen = in_mode(convert<float>(make_scene(26, 5, 19, 17)), TypeParam::value);
  for (float& coordinate : unseen.means3D) coordinate = -100;  // behind the camera
  for (Scene<float>& scene : std::vector<Scene<float>>{nothing, unseen}) {
    Rendering<float> r = render(scene);
    EXPECT_TRUE(r.instances.empty());
    for (int64_t k = 0; k < 3 * scene.pixels(); ++k) ASSERT_EQ(r.color[k], scene.background[k / scene.pixels()]);
    for (const float sum : r.gate_sum) ASSERT_EQ(sum, 0);
    for (const int32_t radius : r.radii) EXPECT_EQ(radius, 0);
    const ImageWeights<float> weights(scene, 27);
    SceneGradient<float> gradient = render_backward(scene, r, weights.gradients());
    for (int c = 0; c < 3; ++c) {
      double expected = 0;
      for (int64_t k = 0; k < scene.pixels(); ++k) expected += weights.color[c * scene.pixels() + k];
      EXPECT_NEAR(gradient.by.background[c], expected, 1e-4);  // 323 additions of numbers below 1
      gradient.by.background[c] = 0;
    }
    for (const float g : gradient.flat()) EXPECT_EQ(g, 0);
    for (const float g : gradient.means2D) EXPECT_EQ(g, 0);
  }
}

TYPED_TEST(RasterizeIn, CulledGaussiansGetZeroGradientsAndTheOthersAsIfAlone) {
  Scene<double> scene = in_mode(make_scene(28, 40, 37, 29), TypeParam::value);
  scene.means3D[3 * 4] = std::nan("");
  scene.opacities[9] = HUGE_VAL;
  scene.shs[12 * 11 + 7] = std::nan("");
  scene.opacities[14] = -0.5;
  Rendering<double> r = render(scene);
  const ImageWeights<double> weights(scene, 29);
  SceneGradient<double> gradient = render_backward(scene, r, weights.gradients());
  int culled = 0, kept = 0;
  for (int64_t i = 0; i < scene.count; ++i) {
    const bool no_pairs = r.instance_offsets[i] == r.instance_offsets[i + 1];
    if (r.radii[i] == 0) {
      EXPECT_TRUE(no_pairs);
    }
    ++(no_pairs ? culled : kept);
    auto expect_zero = [&](const Vector& values, int stride) {
      for (int k = 0; k < stride; ++k) {
        if (no_pairs) {
          EXPECT_EQ(values[i * stride + k], 0) << "Gaussian " << i;
        } else {
          EXPECT_TRUE(std::isfinite(values[i * stride + k])) << "Gaussian " << i;
        }
      }
    };
    expect_zero(gradient.by.means3D, 3), expect_zero(gradient.means2D, 3), expect_zero(gradient.by.opacities, 1);
    expect_zero(gradient.by.scales, 3), expect_zero(gradient.by.rotations, 4), expect_zero(gradient.by.shs, 12);
  }
  for (const int64_t i : {4, 9, 11}) EXPECT_EQ(r.radii[i], 0);
  EXPECT_GT(culled, 4);
  EXPECT_GT(kept, 10);

  Scene<double> without = scene;
  without.means3D.clear(), without.opacities.clear(), without.scales.clear(), without.rotations.clear();
  without.shs.clear();
  without.count = 0;
  auto copy = [&](const Vector& from, Vector& to, int stride, int64_t i) {
    to.insert(to.end(), from.begin() + stride * i, from.begin() + stride * (i + 1));
  };
  for (int64_t i = 0; i < scene.count; ++i) {
    if (r.instance_offsets[i] == r.instance_offsets[i + 1]) continue;
    ++without.count;
    copy(scene.means3D, without.means3D, 3, i), copy(scene.opacities, without.opacities, 1, i);
    copy(scene.scales, without.scales, 3, i), copy(scene.rotations, without.rotations, 4, i);
    copy(scene.shs, without.shs, 12, i);
  }
  EXPECT_EQ(render(without).color, r.color);
}

// cov3D_precomp is the caller's and may not be a covariance at all. A determinant above 0 does not exclude negative
// definite ones, whose exponents grow without bound away from the centre.
TYPED_TEST(RasterizeIn, GivenCovariancesOfAnyKindLeaveGradientsFinite) {
  Scene<float> scene = in_mode(convert<float>(make_scene(30, 1000, 37, 29)), TypeParam::value);
  scene.scales.clear(), scene.rotations.clear();
  scene.cov3D_precomp.resize(6 * scene.count);
  Random random(31);
  for (int64_t i = 0; i < scene.count; ++i) {
    float* cov = &scene.cov3D_precomp[6 * i];
    const float z = transform_point(scene.camera.view, load3(&scene.means3D[3 * i])).z;
    const float pixel = z * 2 * scene.camera.tan_fov_x / scene.camera.width;  // at this depth
    if (i % 2 == 0) {  // a few hundredths of -1 px^2 after the low-pass filter
      cov[0] = cov[3] = cov[5] = -float(random.uniform(0.31, 0.4)) * pixel * pixel;
    } else {
      for (int k = 0; k < 6; ++k) cov[k] = float(random.uniform(-5, 5)) * pixel * pixel;
    }
  }
  Rendering<float> r = render(scene);
  for (int64_t i = 0; i < scene.count; i += 2) ASSERT_EQ(r.radii[i], 0) << "negative definite";
  EXPECT_GT(r.instances.size(), 50u);
  for (const float value : r.color) ASSERT_TRUE(std::isfinite(value));
  const ImageWeights<float> weights(scene, 32);
  for (const float g : render_backward(scene, r, weights.gradients()).flat()) ASSERT_TRUE(std::isfinite(g));
}

// 4096 x 4096 tiles times 260 Gaussians: bands would make it, but this caller asks for one list.
TEST(Rasterize, SaysHowManyInstancesAreTooMany) {
  Scene<float> scene = convert<float>(make_scene(33, 260, 65536, 65536));
  scene.config.blend.mode = BlendMode::kSmoeEq7;
  std::fill(scene.means3D.begin(), scene.means3D.end(), 0.0f);
  std::fill(scene.scales.begin(), scene.scales.end(), 100.0f);
  std::fill(scene.opacities.begin(), scene.opacities.end(), 0.5f);
  std::vector<ProjectedGaussian<float>> projected(scene.count);
  std::vector<float> features(3 * scene.count);
  std::vector<int64_t> offsets(scene.count + 1);
  std::vector<int32_t> radii(scene.count);
  cpu::Frame<float> frame;
  frame.inputs = scene.inputs(), frame.camera = scene.camera, frame.config = scene.raster_config();
  frame.saved.projected = projected.data(), frame.saved.features = features.data();
  frame.saved.instance_offsets = offsets.data();
  frame.images.radii = radii.data();
  EXPECT_EQ(cpu::project(frame), 4362076160);
  try {
    cpu::bin(frame);
    FAIL() << "nothing was thrown";
  } catch (const std::overflow_error& error) {
    EXPECT_NE(std::string(error.what()).find("4362076160 tile instances"), std::string::npos) << error.what();
  }
}

TYPED_TEST(RasterizeIn, ThePipelineDoesWhatItsStagesDo) {
  const Scene<float> scene = in_mode(convert<float>(make_scene(37, 80, 37, 29)), TypeParam::value);
  Rendering<float> stages = render(scene), whole(scene);
  cpu::Frame<float> frame = frame_of(scene, whole);
  cpu::Heap heap;
  cpu::forward(frame, heap);
  EXPECT_EQ(whole.color, stages.color);
  EXPECT_EQ(whole.gate_sum, stages.gate_sum);
  EXPECT_EQ(whole.radii, stages.radii);

  const ImageWeights<float> weights(scene, 38);
  SceneGradient<float> expected = render_backward(scene, stages, weights.gradients()), actual(scene);
  cpu::backward(frame, {weights.gradients(), actual.gradients()});
  EXPECT_EQ(actual.flat(), expected.flat());

  std::fill(whole.radii.begin(), whole.radii.end(), -1);
  cpu::radii(frame, heap);
  EXPECT_EQ(whole.radii, stages.radii);
}

TYPED_TEST(RasterizeIn, TheHalvesDoWhatTheWholeDoes) {
  Scene<float> scene = in_mode(convert<float>(make_scene(39, 80, 37, 29)), TypeParam::value);
  scene.config.depth = scene.config.inverse_depth = true;
  Rendering<float> whole = render(scene), halves(scene);
  cpu::Frame<float> projecting = frame_of(scene, halves);
  projecting.saved.instance_offsets = nullptr;
  EXPECT_EQ(cpu::project(projecting), 0);
  EXPECT_EQ(halves.radii, whole.radii);

  cpu::Frame<float> blending = frame_of(scene, halves);
  blending.inputs = {};  // the blend knows no Gaussians
  blending.inputs.num_gaussians = scene.count;
  cpu::Heap heap;
  cpu::blend_footprints(blending, heap);
  EXPECT_EQ(halves.color, whole.color);
  EXPECT_EQ(halves.gate_sum, whole.gate_sum);
  EXPECT_EQ(halves.depth, whole.depth);
  EXPECT_EQ(halves.inverse_depth, whole.inverse_depth);

  const ImageWeights<float> weights(scene, 40);
  SceneGradient<float> expected = render_backward(scene, whole, weights.gradients()), actual(scene);
  std::vector<float> records(scene.count * (kNumGateGradients + scene.config.num_features()));
  cpu::Gradients<float> gradients = {weights.gradients(), {}};
  gradients.inputs.background = actual.gradients().background;
  cpu::blend_footprints_backward(blending, gradients, {records.data(), nullptr});
  GaussianGradients<float> wanted = actual.gradients();
  wanted.background = nullptr;
  cpu::project_backward(projecting, {records.data(), nullptr}, wanted);
  EXPECT_EQ(actual.flat(), expected.flat());
}

TEST(MarkVisible, WithARollingShutterTakesTheNearPlaneOfEitherPose) {
  const Scene<double> scene = make_scene(34, 200, 37, 29);
  const auto marked = [&](const Camera<double>& camera) {
    const std::unique_ptr<bool[]> visible(new bool[scene.count]);
    cpu::Frame<double> frame;
    frame.inputs = scene.inputs(), frame.camera = camera;
    cpu::mark_visible(frame, visible.get());
    return std::vector<bool>(visible.get(), visible.get() + scene.count);
  };
  for (const double step : {-0.7, 0.7}) {  // towards the points, and away from them
    Camera<double> rolling = scene.camera, last = scene.camera;
    set_shutter(rolling, Shutter::kTopToBottom);
    rolling.view_end[14] += step;
    std::copy_n(rolling.view_end, 16, last.view);
    const std::vector<bool> first = marked(scene.camera), second = marked(last), either = marked(rolling);
    EXPECT_NE(first, second);
    for (int64_t i = 0; i < scene.count; ++i) EXPECT_EQ(either[i], first[i] || second[i]);
  }
}

TEST(MarkVisible, IsTheNearPlaneTest) {
  const Scene<double> scene = make_scene(34, 200, 37, 29);
  const std::unique_ptr<bool[]> visible(new bool[scene.count]);
  cpu::Frame<double> frame;
  frame.inputs = scene.inputs(), frame.camera = scene.camera;
  cpu::mark_visible(frame, visible.get());
  int behind = 0;
  for (int64_t i = 0; i < scene.count; ++i) {
    double z = scene.camera.view[14];
    for (int k = 0; k < 3; ++k) z += scene.camera.view[4 * k + 2] * scene.means3D[3 * i + k];
    EXPECT_EQ(visible[i], z > 0.2);
    behind += !visible[i];
  }
  EXPECT_GT(behind, 3);
  EXPECT_LT(behind, 190);
}

TEST(StageTimes, CountThePairsThatWereEvaluated) {
  Scene<float> scene = convert<float>(make_scene(36, 60, 37, 29));
  Rendering<float> r = project_and_bin(scene);
  StageTimes times;
  cpu::blend(frame_of(scene, r), &times);
  // Whole packs of the rows that a footprint meets: at least the pairs that count before a pixel is full.
  int64_t seen = 0;
  for (const int32_t last : r.last_contributor) seen += last > 0;
  EXPECT_GE(times.forward_pairs, seen);
  EXPECT_LE(times.forward_pairs, static_cast<int64_t>(r.instances.size()) * kTileSize * kTileSize);
  EXPECT_GT(times.blend, 0);
}

}  // namespace
}  // namespace dsmoe

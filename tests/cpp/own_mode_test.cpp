// A blend mode of the test's own, for what a new mode needs: nothing but its policy. It is written as in blend.h.
#include <gtest/gtest.h>

#include <vector>

#include "cpu/loops.h"
#include "dsmoe/removal.h"
#include "refusal.h"
#include "refuse.h"
#include "test_scene.h"

#define DSMOE_SIMD own_mode  // any machine's packs, and symbols of their own
#define DSMOE_SIMD_BYTES 16
#include "cpu/tile_backward_impl.h"
#include "cpu/tile_forward_impl.h"

namespace dsmoe {

// A pixel is the plain mean of the colours of all pairs that count: C = sum c_i / n.
constexpr auto kMean = static_cast<BlendMode>(BlendModes::kSize);

template <> struct Blend<kMean> : GateBlend<false, false> {
  static constexpr const char* kName = "mean";
  static constexpr Law kLaw = Law::kOther;

  template <class Real> static DSMOE_HD PairWeight<Real> accumulate(PixelState<Real>& state, const Gate<Real>& gate) {
    const Real weight = select(gate.counts, Real(Scalar<Real>(1)), Real(Scalar<Real>(0)));
    state.gate_sum = state.gate_sum + weight;
    return {weight, gate.counts};
  }

  // No weight depends on a gate, so dL/dpower is 0.
  template <class Real, class AnyGate>
  static DSMOE_HD PairGradient<Real> backward(PixelBackward<Real>&, const AnyGate&, Real, Mask<Real> contributes) {
    const Real zero = Scalar<Real>(0), one = Scalar<Real>(1);
    return {zero, select(contributes, one, zero)};
  }
};

namespace {

// What the gates' law says of sums does not hold here, and nothing builds on it.
static_assert(!kResumes<kMean> && !kRemovable<kMean>);
TEST(OwnMode, HasNoImportance) {
  EXPECT_NO_THROW(refuse_unremovable("importance", BlendMode::kSmoe));
  expect_refusal([] { refuse_unremovable<ModeList<kMean>>("importance", kMean); },
                 "importance: blend_mode is mean; it must be one whose law dsmoe/removal.h knows");
}

TEST(OwnMode, IsDrawnAndDifferentiatedByTheWalk) {
  Scene<double> scene = make_scene(1, 60, 37, 29);
  scene.config.blend.mode = BlendMode::kSmoeStd;  // the same cut and order
  Rendering<double> r = project_and_bin(scene);
  const auto config = scene.raster_config();
  const auto saved = r.saved();
  const auto images = r.images();
  const ImageWeights<double> weights(scene, 2);
  const auto dL_dimages = weights.gradients();
  constexpr int kRecord = kNumGateMoments + 3;
  std::vector<double> dL_dinstances(r.instances.size() * kRecord, -12345);
  const cpu::TileGradients<double> gradients = {images, dL_dimages, dL_dinstances.data(), nullptr};
  cpu::for_each_tile(config, saved, 37, 29, 3, [&](const cpu::Tile<double>& tile, double* scratch) {
    cpu::own_mode::blend_tile<double, kMean, 3>(tile, images, scratch);
    return cpu::own_mode::blend_tile_backward<double, kMean, 3>(tile, gradients, scratch);
  });

  std::vector<double> dL_dfeatures(3 * scene.count), expected_dL_dfeatures(3 * scene.count);
  for (const TileInstance& instance : r.instances) {
    for (int c = 0; c < 3; ++c) {
      dL_dfeatures[3 * instance.gaussian + c] += dL_dinstances[instance.slot * kRecord + kNumGateMoments + c];
    }
  }
  int drawn = 0;
  for (int64_t pixel = 0; pixel < scene.pixels(); ++pixel) {
    std::vector<int64_t> counting;
    for (int64_t i = 0; i < scene.count; ++i) {
      const auto& g = r.projected[i];
      const double dx = pixel % 37 - g.mean.x, dy = pixel / 37 - g.mean.y;
      const double distance = g.conic.xx * dx * dx + 2 * g.conic.xy * dx * dy + g.conic.yy * dy * dy;
      // The scene has a gate for the background: fainter pairs than lambda / 255 do not count outside 3 sigma.
      if (r.radii[i] > 0 && g.opacity > 0 && distance <= g.squared_reach) counting.push_back(i);
    }
    drawn += !counting.empty();
    for (int c = 0; c < 3; ++c) {
      double mean = counting.empty() ? scene.background[c] : 0;
      for (const int64_t i : counting) {
        mean += r.features[3 * i + c] / counting.size();
        expected_dL_dfeatures[3 * i + c] += weights.color[c * scene.pixels() + pixel] / counting.size();
      }
      ASSERT_NEAR(r.color[c * scene.pixels() + pixel], mean, 1e-14);  // means of at most 60 numbers near 1
    }
  }
  EXPECT_GT(drawn, scene.pixels() / 2);
  expect_near_all(dL_dfeatures, expected_dL_dfeatures, 1e-13);  // sums over at most 1073 pixels of numbers below 1
}

}  // namespace
}  // namespace dsmoe

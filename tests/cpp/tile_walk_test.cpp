// The cells that a Gaussian meets, and the pairs of smooth cells, against the formula at every pixel.
#include <gtest/gtest.h>

#include <algorithm>
#include <cmath>
#include <limits>

#include "finite_difference.h"

#define DSMOE_SIMD walked  // any machine's packs, and symbols of their own
#define DSMOE_SIMD_BYTES 16
#include "cpu/tile_walk_impl.h"

namespace dsmoe {
namespace {

constexpr int kSide = 48;
constexpr double kGate = 0.03;  // of the background

template <class S> ProjectedGaussian<S> random_gaussian(Random& random) {
  const double a = random.log_uniform(0.55, 100), b = std::max(0.55, a / random.log_uniform(1, 30));
  const double angle = random.uniform(0, 3.2), c = std::cos(angle), s = std::sin(angle);
  const double xx = c * c / (a * a) + s * s / (b * b), yy = s * s / (a * a) + c * c / (b * b);
  const S opacity = S(random.log_uniform(1e-3, 0.99));
  const S least_alpha = AlphaCut<S>(0, S(kGate)).of(opacity);
  return {{S(kSide * random.uniform(-1, 2)), S(kSide * random.uniform(-1, 2))},
          {S(xx), S((1 / (a * a) - 1 / (b * b)) * c * s), S(yy)},
          opacity,
          squared_reach(Cut::kKernel, opacity, least_alpha),
          S(1)};
}

template <class S> void expect_the_cells_of_random_gaussians() {
  using namespace cpu;
  using namespace cpu::walked;
  constexpr int kLanes = cpu::walked::Pack<S>::kLanes;
  const double epsilon = std::numeric_limits<S>::epsilon();
  Random random(5);
  int counted = 0, smooth_pairs = 0;
  for (int n = 0; n < 3000; ++n) {
    const ProjectedGaussian<S> gaussian = random_gaussian<S>(random);
    const S features[3] = {};
    const TileInstance instance = {0, 0};
    SavedForward<S> saved;
    saved.projected = const_cast<ProjectedGaussian<S>*>(&gaussian);
    saved.features = const_cast<S*>(features);
    saved.instances = const_cast<TileInstance*>(&instance);
    RasterConfig<S> config;
    config.mode = BlendMode::kSmoeEq7;
    config.background_gate = S(kGate);
    if (n % 2 > 0) config.faint_below = S(kFaintBelow);
    const auto pairs = n % 4 < 2 ? Pairs::kNarrow : Pairs::kWide;
    const Tile<S> tile = {config, saved, kSide, kSide, n % 3, n / 3 % 3, 0, 0, 1};
    const TileExtent extent(tile);
    const PixelCenters<S> pixels(extent);
    ListedGaussian<S> listed;
    GaussianList<S>(tile, extent, 3, pairs).load(0, 0, listed);
    for (int at = 0; at < kTilePixels; at += kLanes) {
      const CellBits cell = CellBits(1) << (at / kCellPixels);
      const bool smooth = (listed.smooth & cell) != 0;
      const PackPairs<BlendMode::kSmoeEq7, S, true> quick(listed, pixels, at);
      for (int lane = 0; lane < kLanes; ++lane) {
        const S dx = pixels.x[at + lane] - gaussian.mean.x, dy = pixels.y[at + lane] - gaussian.mean.y;
        const S power = ColumnExponent<S, S>(gaussian.conic, dx).at(dy);
        const auto gate = evaluate_gate<BlendMode::kSmoeEq7>(power, gaussian.opacity, listed.least_alpha);
        counted += gate.counts;
        if (gate.counts) {
          ASSERT_NE(listed.met & cell, 0u) << "Gaussian " << n << " pixel " << at + lane;
        }
        if (!smooth) continue;
        ++smooth_pairs;
        ASSERT_TRUE(gate.counts) << "Gaussian " << n << " pixel " << at + lane;
        if (config.blends_near_first()) {
          ASSERT_GE(gate.logit, listed.near_alpha) << "Gaussian " << n << " pixel " << at + lane;
        }
        // The exponent's terms round at half an ulp each, in both ways of summing them; the exponentials at some ulps.
        const double terms = std::abs(gaussian.conic.xx * dx * dx) + 2 * std::abs(gaussian.conic.xy * dx * dy) +
                             std::abs(gaussian.conic.yy * dy * dy);
        ASSERT_NEAR(quick.gate.alpha.v[lane] / gate.alpha, 1, epsilon * (10 + 4 * terms));
        ASSERT_LE(quick.gate.alpha.v[lane], S(kAlphaMax));
      }
    }
  }
  EXPECT_GT(counted, 100000);
  EXPECT_GT(smooth_pairs, 50000);
  EXPECT_LT(smooth_pairs, counted);
}

TEST(TileWalk, MeetsTheCellsOfAllPairsThatCountAndKnowsTheSmoothOnes) {
  expect_the_cells_of_random_gaussians<float>();
  expect_the_cells_of_random_gaussians<double>();
}

}  // namespace
}  // namespace dsmoe

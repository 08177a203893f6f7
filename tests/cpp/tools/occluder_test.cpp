// Ghosts behind an occluder: what each blend mode's own equation says of them.
#include "occluder.h"

#include <gtest/gtest.h>

#include <cmath>

namespace dsmoe::tools {
namespace {

constexpr int kSize = 64;

Images render(const OccluderParts& parts, BlendMode mode) {
  const Model model = occluder_scene(parts);
  RenderOptions options;
  options.blend.mode = mode;
  return make_cpu_renderer(model, options)->render(occluder_view(kSize));
}

TEST(Occluder, HidesTheBarsWhereGatesKnowTransmittance) {
  for (const BlendMode mode : {BlendMode::kAlpha, BlendMode::kSmoe}) {
    const Ghost ghost = render_occluder(mode, kSize, 1).ghost;
    EXPECT_GT(ghost.pixels, 200);
    // In the pixels that count the panel lets less than 1/255 through.
    EXPECT_LT(std::abs(ghost.leak), 1 / 255.0);
    EXPECT_LT(ghost.change, 1 / 255.0);
  }
}

TEST(Occluder, MixesTheBarsInWithoutTransmittance) {
  const Ghost ghost = render_occluder(BlendMode::kSmoeStd, kSize, 1).ghost;
  EXPECT_GT(ghost.leak, 0.1);
  // Eq. 6: the colour of all is the mean of those of the parts, by the parts' sums of alpha.
  const Images all = render({true, true, true}, BlendMode::kSmoeStd);
  const Images others = render({true, false, true}, BlendMode::kSmoeStd);
  const Images bars = render({false, true, false}, BlendMode::kSmoeStd);
  for (std::size_t pixel = 0; pixel < all.alpha.size(); ++pixel) {
    const double a = others.alpha[pixel], b = bars.alpha[pixel];
    for (int c = 0; c < 3; ++c) {
      const std::size_t i = c * all.alpha.size() + pixel;
      // Sums of a hundred rounded numbers.
      EXPECT_NEAR(all.color[i], (a * others.color[i] + b * bars.color[i]) / (a + b), 1e-5);
    }
  }
}

TEST(Occluder, DarkensThePanelWithTransmittanceInTheNumeratorOnly) {
  const OccluderRendering rendering = render_occluder(BlendMode::kSmoeTn, kSize, 1);
  EXPECT_LT(rendering.ghost.leak, 0);  // no red is added: what was there is divided by more
  EXPECT_GT(rendering.ghost.change, 1 / 255.0);
  // Eq. 8 in the middle: the numerator is the panel's, the denominator has the alphas of all.
  const std::size_t middle = kSize / 2 * kSize + kSize / 2, blue = 2 * kSize * kSize + middle;
  const Images panel = render({true, false, false}, BlendMode::kSmoeTn);
  const double expected = panel.color[blue] * panel.alpha[middle] / rendering.images.alpha[middle];
  EXPECT_LT(expected, 0.8 * panel.color[blue]);
  // What the panel lets through of 1e-3 at most is not in the numerator here.
  EXPECT_NEAR(rendering.images.color[blue], expected, 1e-3);
}

}  // namespace
}  // namespace dsmoe::tools

// One Gaussian in the middle of an image, seen along z. Its image is known: gated blending of a single expert
// gives its colour, exactly, where the Gaussian is, and the background elsewhere.
#pragma once

#include <cstdio>

namespace scene {

constexpr int kSize = 33, kPixels = kSize * kSize, kCentre = kPixels / 2;  // pixels
constexpr float kMean[3] = {0, 0, 2};                                      // world
constexpr float kOpacity[1] = {0.5f};
constexpr float kScale[3] = {0.2f, 0.2f, 0.2f};  // world
constexpr float kRotation[4] = {1, 0, 0, 0};     // (w, x, y, z)
constexpr float kExpert[3] = {0.25f, 0.5f, 0.75f};
constexpr float kBackground[3] = {0, 0, 0};
constexpr float kView[16] = {1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1};
constexpr float kProjection[16] = {1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 1, 0, 0, 0, 0};
constexpr float kPosition[3] = {0, 0, 0};
constexpr float kTanFov = 1;

// color: [3, kSize, kSize]. radius: pixels. dL_dexpert: [3], where the loss is the sum of the middle pixel's channels.
// Prints what differs, and returns whether nothing does.
inline bool is_right(const float* color, int radius, const float* dL_dexpert) {
  // One rounding of the product with the weight and one of the quotient: two units in the last place at most.
  const auto equal = [](float actual, float expected) {
    return actual >= expected * (1 - 2.4e-7f) && actual <= expected * (1 + 2.4e-7f);
  };
  bool right = radius > 0;
  std::printf("radius %d\n", radius);
  for (int channel = 0; channel < 3; ++channel) {
    const float centre = color[channel * kPixels + kCentre], corner = color[channel * kPixels];
    std::printf("channel %d: centre %g, expert %g, corner %g, dL/dexpert %g\n", channel, centre, kExpert[channel],
                corner, dL_dexpert[channel]);
    // The corner lies 13 standard deviations away: background. The pixel's colour is the expert: the derivative is 1.
    right = right && equal(centre, kExpert[channel]) && corner == 0 && equal(dL_dexpert[channel], 1);
  }
  return right;
}

}  // namespace scene

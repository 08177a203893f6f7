// The features of a rendering by number: colour channels, then z and 1 / z if they are asked for.
#pragma once

#include "dsmoe/params.h"
#include "dsmoe/pixel.h"

namespace dsmoe {

// How many features have code of their own, in float: the colours of a usual rendering. Any other number takes the
// general code.
constexpr int kFastFeatures = 3;

template <class S> DSMOE_HD FeatureRule feature_rule(const RasterConfig<S>& config, int feature) {
  return config.depth && feature == config.num_channels ? FeatureRule::kAveraged : FeatureRule::kBlended;
}

template <class S> DSMOE_HD S feature_background(const RasterConfig<S>& config, int feature) {
  return feature < config.num_channels ? config.background[feature] : S(0);
}

// Where feature f of an image lies; ImageOutputs and ImageGradients have the same fields.
template <class S, class Images>
DSMOE_HD auto feature_image(const RasterConfig<S>& config, const Images& images, int feature, int64_t pixels)
    -> decltype(images.color) {
  if (feature < config.num_channels) return images.color == nullptr ? nullptr : images.color + feature * pixels;
  return config.depth && feature == config.num_channels ? images.depth : images.inverse_depth;
}

}  // namespace dsmoe

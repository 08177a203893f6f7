// From the image gradients of one tile to a record per instance. Included once per instruction set.
#pragma once

#include "tile_walk_impl.h"

namespace dsmoe {
namespace cpu {
namespace DSMOE_SIMD {

template <class S, BlendMode kBlendMode, int kFeatures> class BackwardVisitor {
 public:
  using P = Pack<S>;
  static constexpr BlendMode kMode = kBlendMode;
  static constexpr bool kBackToFront = true;

  DSMOE_HD BackwardVisitor(int num_features, Scratch<S> scratch, const TileGradients<S>& gradients)
      : num_features_(num_features),
        absolute_(kFeatures == kAnyFeatures && gradients.absolute),
        transmittance_(scratch.pixels()),
        suffix_(scratch.pixels()),
        base_(scratch.pixels()),
        last_(scratch.pixels()),
        scaled_{scratch.next},
        dL_dinstances_(gradients.dL_dinstances) {
    for (int i = 0; i < kTilePixels * (4 + num_features); ++i) transmittance_.values[i] = S(0);
    for (int i = 0; i < kTilePixels; ++i) transmittance_.values[i] = S(1);
  }

  // Starts every pixel. Returns how many entries of the list some numerator has seen.
  DSMOE_HD int64_t read(const Tile<S>& tile, const TileExtent& extent, const TileGradients<S>& gradients) const {
    const int64_t pixels = static_cast<int64_t>(tile.width) * tile.height;
    const S background_gate = tile.config.gate_of_background();
    const int num_channels = tile.config.num_channels;
    S* dL_dbackground =
        gradients.dL_dbackground != nullptr ? gradients.dL_dbackground + tile.index * (num_channels + 1) : nullptr;
    int64_t num_seen = 0;
    extent.for_each_pixel(tile.width, [&](int x, int y, int64_t index) {
      const PixelEnd<S> end = {tile.saved.final_transmittance[index], tile.saved.gate_sum[index], background_gate};
      const S* dL_dgate_sum = gradients.dL_dimages.gate_sum;
      auto pixel = begin_backward(end, dL_dgate_sum != nullptr ? dL_dgate_sum[index] : S(0));
      for (int f = 0; f < num_features_; ++f) {
        const S* gradient = feature_image(tile.config, gradients.dL_dimages, f, pixels);
        if (gradient == nullptr) continue;
        const S value = feature_image(tile.config, gradients.images, f, pixels)[index];
        const auto share = add_feature<kMode>(feature_rule(tile.config, f), pixel, end, gradient[index], value,
                                              feature_background(tile.config, f));
        scaled_of(f).pixel(x, y) = share.scaled;
        if (dL_dbackground == nullptr) continue;
        if (f < num_channels) dL_dbackground[f] += share.background;
        dL_dbackground[num_channels] += share.background_gate;
      }
      transmittance_.pixel(x, y) = pixel.transmittance;
      suffix_.pixel(x, y) = pixel.suffix;
      base_.pixel(x, y) = pixel.base;
      last_.pixel(x, y) = S(tile.saved.last_contributor[index]);
      num_seen = max<int64_t>(num_seen, tile.saved.last_contributor[index]);
    });
    return num_seen;
  }

  DSMOE_HD void expect(uint32_t slot) const { __builtin_prefetch(record(slot), 1); }
  DSMOE_HD void begin(const ListedGaussian<S>& gaussian) {
    features_ = gaussian.features;
    position_ = P(gaussian.position);
    exponent_ = gaussian.exponent;
    absolute_x_ = absolute_y_ = P(S(0));
    one_ = x_ = y_ = xx_ = xy_ = yy_ = P(S(0));
    for (int f = 0; f < num_features_; ++f) dL_dfeatures()[f] = P(S(0));
  }
  DSMOE_HD bool wants(int at) {
    not_past_ = position_ < last_.load(at);
    return !Blend<kMode>::kStopsEarly || any(not_past_);
  }

  template <class Pairs> DSMOE_HD void take(int at, const Pairs& pairs) {
    const Gate<P>& gate = pairs.gate;
    const auto contributes = gate.counts & not_past_;
    P value = S(0);
    for (int f = 0; f < num_features_; ++f) value = fma(scaled_of(f).load(at), P(features_[f]), value);
    PixelBackward<P> pixel = {transmittance_.load(at), suffix_.load(at), base_.load(at)};
    const auto pair = Blend<kMode>::backward(pixel, gate, value, contributes);
    transmittance_.store(at, pixel.transmittance);
    suffix_.store(at, pixel.suffix);
    for (int f = 0; f < num_features_; ++f) {
      dL_dfeatures()[f] = fma(pair.weight, scaled_of(f).load(at), dL_dfeatures()[f]);
    }
    const P dL_dpower = Pairs::kSmooth ? pair.gamma : gate_backward(gate, pair.gamma);
    const P by_x = dL_dpower * pairs.dx, by_y = dL_dpower * pairs.dy;
    one_ = one_ + dL_dpower;
    x_ = x_ + by_x;
    y_ = y_ + by_y;
    xx_ = fma(by_x, pairs.dx, xx_);
    xy_ = fma(by_x, pairs.dy, xy_);
    yy_ = fma(by_y, pairs.dy, yy_);
    if (!absolute_) return;
    const auto by_mean = power_by_mean(exponent_, pairs.dx, pairs.dy);
    absolute_x_ = absolute_x_ + abs(dL_dpower * by_mean.x);
    absolute_y_ = absolute_y_ + abs(dL_dpower * by_mean.y);
  }

  DSMOE_HD void end(const ListedGaussian<S>& gaussian) {
    S* out = record(gaussian.slot);
    sum_lanes(one_, x_, y_, xx_, out);
    if (kFeatures == 3) {
      sum_lanes(xy_, yy_, dL_dfeatures()[0], dL_dfeatures()[1], out + 4);
      out[8] = sum_lanes(dL_dfeatures()[2]);
    } else {
      out[4] = sum_lanes(xy_);
      out[5] = sum_lanes(yy_);
      for (int f = 0; f < num_features_; ++f) out[kNumGateMoments + f] = sum_lanes(dL_dfeatures()[f]);
    }
    if (!absolute_) return;
    out[kNumGateMoments + num_features_] = sum_lanes(absolute_x_);
    out[kNumGateMoments + num_features_ + 1] = sum_lanes(absolute_y_);
  }

  DSMOE_HD void write_zeros(uint32_t slot) const {
    S* out = record(slot);
    for (int k = 0; k < record_size(num_features_, absolute_); ++k) out[k] = S(0);
  }

 private:
  DSMOE_HD PixelArray<S> scaled_of(int f) const { return {scaled_.values + f * kTilePixels}; }
  DSMOE_HD S* record(uint32_t slot) const {
    return dL_dinstances_ + slot * static_cast<int64_t>(record_size(num_features_, absolute_));
  }
  // dL/dfeature of the current Gaussian; in registers where their number is known.
  DSMOE_HD P* dL_dfeatures() {
    if (kFeatures != kAnyFeatures) return dL_dfeatures_in_registers_;
    return reinterpret_cast<P*>(scaled_.values + num_features_ * kTilePixels);
  }

  const int num_features_;
  const bool absolute_;  // false, when compiling, where the number of features is known
  const PixelArray<S> transmittance_, suffix_, base_, last_;
  const PixelArray<S> scaled_;  // g', one array a feature
  S* const dL_dinstances_;
  const S* features_ = nullptr;
  P position_;
  Mask<P> not_past_;
  ExponentFactors<S> exponent_;   // of the current Gaussian
  P absolute_x_, absolute_y_;     // its sums of absolute gradients
  P one_, x_, y_, xx_, xy_, yy_;  // the moments of the current Gaussian
  P dL_dfeatures_in_registers_[kFeatures != kAnyFeatures ? kFeatures : 1];
};

template <class S, BlendMode kMode, int kFeatures>
int64_t blend_tile_backward(const Tile<S>& tile, const TileGradients<S>& gradients, S* memory) {
  const int num_features = kFeatures != kAnyFeatures ? kFeatures : tile.config.num_features();
  BackwardVisitor<S, kMode, kFeatures> visitor(num_features, {memory}, gradients);
  const int64_t num_seen = visitor.read(tile, TileExtent(tile), gradients);
  const int64_t end = Blend<kMode>::kStopsEarly ? tile.begin + num_seen : tile.end;
  for (int64_t i = end; i < tile.end; ++i) visitor.write_zeros(tile.saved.instances[i].slot);
  return walk_tile(tile, tile.begin, end, num_features, visitor);
}

template <class S> int64_t backward(const Tile<S>& tile, const TileGradients<S>& gradients, S* scratch) {
  int64_t pairs = 0;
  const int num_features = gradients.absolute ? kAnyFeatures : tile.config.num_features();
  dispatch_blend(tile.config.mode, num_features, [&](auto mode, auto features) {
    pairs = blend_tile_backward<S, decltype(mode)::value, decltype(features)::value>(tile, gradients, scratch);
  });
  return pairs;
}

}  // namespace DSMOE_SIMD
}  // namespace cpu
}  // namespace dsmoe

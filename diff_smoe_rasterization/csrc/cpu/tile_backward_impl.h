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
        scaled_{scratch.next + kCellPixels},
        dL_dinstances_(gradients.dL_dinstances) {
    for (int i = 0; i < kTilePixels * (4 + num_features) + kCellPixels; ++i) transmittance_.values[i] = S(0);
    for (int i = 0; i < kTilePixels; ++i) transmittance_.values[i] = S(1);
  }

  // Starts every pixel. Returns how many entries of the list some numerator has seen.
  DSMOE_HD int64_t read(const Tile<S>& tile, const TileExtent& extent, const TileGradients<S>& gradients) const {
    const int64_t pixels = static_cast<int64_t>(tile.width) * tile.height;
    const S lambda = tile.config.blend.lambda();
    const int num_channels = tile.config.num_channels;
    S* dL_dbackground =
        gradients.dL_dbackground != nullptr ? gradients.dL_dbackground + tile.index * (num_channels + 1) : nullptr;
    int64_t num_seen = 0;
    extent.for_each_pixel(tile.width, [&](int x, int y, int64_t index) {
      PixelEnd<S> end = {abs(tile.saved.final_transmittance[index]), tile.saved.gate_sum[index], lambda, S(0)};
      if constexpr (Blend<kMode>::kTails) end.tails = tile.saved.tails[index];
      const S* dL_dalpha = gradients.dL_dimages.gate_sum;
      const auto begin = begin_backward<kMode>(end, dL_dalpha != nullptr ? dL_dalpha[index] : S(0));
      auto pixel = begin.pixel;
      if (Blend<kMode>::kTails && dL_dbackground != nullptr) dL_dbackground[num_channels] += begin.lambda;
      for (int f = 0; f < num_features(); ++f) {
        const S* gradient = feature_image(tile.config, gradients.dL_dimages, f, pixels);
        if (gradient == nullptr) continue;
        const S value = feature_image(tile.config, gradients.images, f, pixels)[index];
        const auto share = add_feature<kMode>(feature_rule(tile.config, f), pixel, end, gradient[index], value,
                                              feature_background(tile.config, f));
        scaled_of(f).pixel(x, y) = share.scaled;
        if (dL_dbackground == nullptr) continue;
        if (f < num_channels) dL_dbackground[f] += share.background;
        dL_dbackground[num_channels] += share.lambda;
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
  // Of one Gaussian. Its features' gradients lie here if their number is known, else in scratch memory.
  struct Sums {
    GateMoments<P> moments;
    Vec2<P> absolute;  // of absolute gradients by the mean
    P dL_dfeatures[kFeatures != kAnyFeatures ? kFeatures : 1];
  };
  DSMOE_HD Sums begin(const ListedGaussian<S>& gaussian) {
    features_ = gaussian.features;
    position_ = P(gaussian.position);
    exponent_ = gaussian.exponent;
    const P zero = S(0);
    Sums sums;
    sums.moments = {zero, zero, zero, zero, zero, zero};
    sums.absolute = {zero, zero};
    for (int f = 0; f < num_features(); ++f) dL_dfeature(sums, f) = zero;
    return sums;
  }
  DSMOE_HD bool wanted(int at, Mask<P>& not_past) const {
    not_past = position_ < last_.load(at);
    return !Blend<kMode>::kStopsEarly || any(not_past);
  }

  template <class Pairs> DSMOE_HD void take(int at, const Pairs& pairs, Mask<P> not_past, Sums& sums) const {
    const auto& gate = pairs.gate;
    const auto contributes = gate.counts & not_past;
    P value = S(0);
    for (int f = 0; f < num_features(); ++f) value = fma(scaled_of(f).load(at), P(features_[f]), value);
    PixelBackward<P> pixel = {transmittance_.load(at), suffix_.load(at), base_.load(at)};
    const auto pair = Blend<kMode>::backward(pixel, gate, value, contributes);
    transmittance_.store(at, pixel.transmittance);
    suffix_.store(at, pixel.suffix);
    for (int f = 0; f < num_features(); ++f) {
      dL_dfeature(sums, f) = fma(pair.weight, scaled_of(f).load(at), dL_dfeature(sums, f));
    }
    const P dL_dpower = pair.power;
    const P by_x = dL_dpower * pairs.dx, by_y = dL_dpower * pairs.dy;
    GateMoments<P>& m = sums.moments;
    m.one = m.one + dL_dpower;
    m.x = m.x + by_x;
    m.y = m.y + by_y;
    m.xx = fma(by_x, pairs.dx, m.xx);
    m.xy = fma(by_x, pairs.dy, m.xy);
    m.yy = fma(by_y, pairs.dy, m.yy);
    if (!absolute_) return;
    const auto by_mean = power_by_mean(exponent_, pairs.dx, pairs.dy);
    sums.absolute.x = sums.absolute.x + abs(dL_dpower * by_mean.x);
    sums.absolute.y = sums.absolute.y + abs(dL_dpower * by_mean.y);
  }

  DSMOE_HD void end(const ListedGaussian<S>& gaussian, Sums& sums) const {
    const GateMoments<P>& m = sums.moments;
    S* out = record(gaussian.slot);
    sum_lanes(m.one, m.x, m.y, m.xx, out);
    if constexpr (kFeatures == 3) {
      sum_lanes(m.xy, m.yy, sums.dL_dfeatures[0], sums.dL_dfeatures[1], out + 4);
      out[8] = sum_lanes(sums.dL_dfeatures[2]);
    } else {
      out[4] = sum_lanes(m.xy);
      out[5] = sum_lanes(m.yy);
      for (int f = 0; f < num_features(); ++f) out[kNumGateMoments + f] = sum_lanes(dL_dfeature(sums, f));
    }
    if (!absolute_) return;
    out[kNumGateMoments + num_features_] = sum_lanes(sums.absolute.x);
    out[kNumGateMoments + num_features_ + 1] = sum_lanes(sums.absolute.y);
  }

  DSMOE_HD void skip(uint32_t slot) const {
    S* out = record(slot);
    for (int k = 0; k < record_size(num_features_, absolute_); ++k) out[k] = S(0);
  }

 private:
  DSMOE_HD int num_features() const { return kFeatures != kAnyFeatures ? kFeatures : num_features_; }
  DSMOE_HD PixelArray<S> scaled_of(int f) const { return {scaled_.values + f * kTilePixels}; }
  DSMOE_HD S* record(uint32_t slot) const {
    return dL_dinstances_ + slot * static_cast<int64_t>(record_size(num_features_, absolute_));
  }
  DSMOE_HD P& dL_dfeature(Sums& sums, int f) const {
    if (kFeatures != kAnyFeatures) return sums.dL_dfeatures[f];
    return reinterpret_cast<P*>(scaled_.values + num_features_ * kTilePixels)[f];
  }

  const int num_features_;
  const bool absolute_;  // false, when compiling, if the number of features is known
  const PixelArray<S> transmittance_, suffix_, base_, last_;
  // g', one array a feature, a cell further on: a load may wait for a store just before it that lies 4 KB away.
  const PixelArray<S> scaled_;
  S* const dL_dinstances_;
  const S* features_ = nullptr;
  P position_;
  ExponentFactors<S> exponent_;
};

template <class S, BlendMode kMode, int kFeatures>
int64_t blend_tile_backward(const Tile<S>& tile, const TileGradients<S>& gradients, S* memory) {
  const int num_features = kFeatures != kAnyFeatures ? kFeatures : tile.config.num_features();
  Scratch<S> scratch = {memory};
  const WidePixels<kMode, S> wide(tile, scratch.pixels());
  BackwardVisitor<S, kMode, kFeatures> visitor(num_features, scratch, gradients);
  const int64_t num_seen = visitor.read(tile, TileExtent(tile), gradients);
  const int64_t end = Blend<kMode>::kStopsEarly ? tile.begin + num_seen : tile.end;
  for (int64_t i = end; i < tile.end; ++i) visitor.skip(tile.saved.instances[i].slot);
  return walk_tile(tile, tile.begin, end, num_features, wide, visitor);
}

template <class S> int64_t backward(const Tile<S>& tile, const TileGradients<S>& gradients, S* scratch) {
  int64_t pairs = 0;
  const int num_features = gradients.absolute ? kAnyFeatures : tile.config.num_features();
  dispatch_blend(tile.config.blend.mode, num_features, [&](auto mode, auto features) {
    pairs = blend_tile_backward<S, decltype(mode)::value, decltype(features)::value>(tile, gradients, scratch);
  });
  return pairs;
}

}  // namespace DSMOE_SIMD
}  // namespace cpu
}  // namespace dsmoe

// The images of one tile. Included once per instruction set.
#pragma once

#include "tile_walk_impl.h"

namespace dsmoe {
namespace cpu {
namespace DSMOE_SIMD {

template <class S, BlendMode kBlendMode> class ForwardVisitor {
 public:
  static constexpr BlendMode kMode = kBlendMode;
  static constexpr bool kBackToFront = false;

  DSMOE_HD ForwardVisitor(const TileExtent& extent, int num_features, Scratch<S> scratch)
      : num_features_(num_features),
        transmittance_(scratch.pixels()),
        gate_sum_(scratch.pixels()),
        last_(scratch.pixels()),
        sums_{scratch.next},
        open_strips_(kStrips<S> * extent.rows) {
    for (int i = 0; i < kTilePixels; ++i) transmittance_.values[i] = S(-1);  // outside the image: closed
    for (int i = 0; i < kTilePixels * (2 + num_features); ++i) gate_sum_.values[i] = S(0);
    for (int y = 0; y < extent.rows; ++y) {
      for (int x = 0; x < extent.columns; ++x) transmittance_.pixel(x, y) = S(1);
    }
    for (auto& strip : strip_open_) {
      for (bool& row : strip) row = true;
    }
  }

  DSMOE_HD bool done() const { return open_strips_ == 0; }
  DSMOE_HD void begin(const ListedGaussian<S>& gaussian) {
    features_ = gaussian.features;
    position_ = gaussian.position + S(1);
  }
  DSMOE_HD void begin_strip() {}
  DSMOE_HD bool wants(int strip, int row) const { return !Blend<kMode>::kStopsEarly || strip_open_[strip][row]; }

  DSMOE_HD void take(int strip, int row, const Gate<Pack<S>>& gate, Pack<S>, S) {
    using P = Pack<S>;
    PixelState<P> state = {transmittance_.load(strip, row), gate_sum_.load(strip, row)};
    const auto pair = Blend<kMode>::accumulate(state, gate);
    for (int f = 0; f < num_features_; ++f) {
      sum_of(f).store(strip, row, fma(pair.weight, P(features_[f]), sum_of(f).load(strip, row)));
    }
    transmittance_.store(strip, row, state.transmittance);
    gate_sum_.store(strip, row, state.gate_sum);
    last_.store(strip, row, select(pair.contributes, P(position_), last_.load(strip, row)));
    if (Blend<kMode>::kStopsEarly && !any(state.is_open())) {
      strip_open_[strip][row] = false;
      --open_strips_;
    }
  }

  DSMOE_HD void end_strip(Pack<S>) {}
  DSMOE_HD void end(const ListedGaussian<S>&) {}

  DSMOE_HD void write(const Tile<S>& tile, const TileExtent& extent, const ImageOutputs<S>& images) const {
    const S background_gate = tile.config.gate_of_background();
    const int64_t pixels = static_cast<int64_t>(tile.width) * tile.height;
    extent.for_each_pixel(tile.width, [&](int x, int y, int64_t index) {
      tile.saved.final_transmittance[index] = abs(transmittance_.pixel(x, y));
      tile.saved.gate_sum[index] = gate_sum_.pixel(x, y);
      tile.saved.last_contributor[index] = static_cast<int32_t>(last_.pixel(x, y));
    });
    for (int f = 0; f < num_features_; ++f) {
      S* image = feature_image(tile.config, images, f, pixels);
      const FeatureRule rule = feature_rule(tile.config, f);
      const S background = feature_background(tile.config, f);
      const auto sum = sum_of(f);
      extent.for_each_pixel(tile.width, [&](int x, int y, int64_t index) {
        const PixelState<S> state = {transmittance_.pixel(x, y), gate_sum_.pixel(x, y)};
        image[index] = finish_feature<kMode>(rule, state.end(background_gate), sum.pixel(x, y), background);
      });
    }
  }

 private:
  DSMOE_HD PixelArray<S> sum_of(int f) const { return {sums_.values + f * kTilePixels}; }

  const int num_features_;
  const PixelArray<S> transmittance_, gate_sum_, last_;
  const PixelArray<S> sums_;  // one array a feature
  bool strip_open_[kStrips<S>][kTileSize];
  int open_strips_;
  const S* features_ = nullptr;
  S position_ = 0;
};

template <class S, BlendMode kMode, int kFeatures>
int64_t blend_tile(const Tile<S>& tile, const ImageOutputs<S>& images, S* memory) {
  const int num_features = kFeatures != kAnyFeatures ? kFeatures : tile.config.num_features();
  const TileExtent extent(tile);
  ForwardVisitor<S, kMode> visitor(extent, num_features, {memory});
  const int64_t pairs = walk_tile(tile, tile.begin, tile.end, num_features, visitor);
  visitor.write(tile, extent, images);
  return pairs;
}

template <class S> int64_t forward(const Tile<S>& tile, const ImageOutputs<S>& images, S* scratch) {
  int64_t pairs = 0;
  dispatch_blend(tile.config.mode, tile.config.num_features(), [&](auto mode, auto features) {
    pairs = blend_tile<S, decltype(mode)::value, decltype(features)::value>(tile, images, scratch);
  });
  return pairs;
}

}  // namespace DSMOE_SIMD
}  // namespace cpu
}  // namespace dsmoe

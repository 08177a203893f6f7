// The images of one tile. Included once per instruction set.
#pragma once

#include <algorithm>

#include "tile_walk_impl.h"

namespace dsmoe {
namespace cpu {
namespace DSMOE_SIMD {

// Sums the tails of a tile's pixels: a walk of its own, without features. A pixel that wants none is closed.
template <class S, BlendMode kBlendMode> class TailVisitor {
 public:
  using P = Pack<S>;
  static constexpr BlendMode kMode = kBlendMode;
  static constexpr bool kBackToFront = false, kTails = true;

  DSMOE_HD TailVisitor(PixelArray<S> transmittance, PixelArray<S> tails)
      : transmittance_(transmittance), tails_(tails) {}

  struct Sums {};
  DSMOE_HD void expect(uint32_t) const {}
  DSMOE_HD Sums begin(const ListedGaussian<S>&) const { return {}; }
  DSMOE_HD bool wanted(int at, Mask<P>& pixels) const {
    pixels = transmittance_.load(at) > P(S(0));
    return any(pixels);
  }
  template <class Pairs> DSMOE_HD void take(int at, const Pairs& pairs, Mask<P>, Sums&) const {
    PixelState<P> state = {transmittance_.load(at), P(S(0))};
    P tails = tails_.load(at);
    add_tail(state, tails, static_cast<const Gate<P>&>(pairs.gate), pairs.inside);
    transmittance_.store(at, state.transmittance);
    tails_.store(at, tails);
  }
  DSMOE_HD void end(const ListedGaussian<S>&, Sums&) const {}

 private:
  const PixelArray<S> transmittance_, tails_;
};

// Draws a tile. Its list is taken in batches. For each batch and each pack of pixels, the alphas of the Gaussians that
// meet the pack's cell come first, those of smooth cells apart. Then the pack blends them in order, with its sums in
// registers.
template <class S, BlendMode kMode, int kFeatures> class TilePainter {
 public:
  using P = Pack<S>;

  DSMOE_HD TilePainter(const Tile<S>& tile, const TileExtent& extent, int num_features, Scratch<S> scratch)
      : tile_(tile),
        extent_(extent),
        num_features_(num_features),
        transmittance_(scratch.pixels()),
        gate_sum_(scratch.pixels()),
        last_(scratch.pixels()),
        sums_{scratch.next},
        tails_{scratch.next + num_features * kTilePixels},
        open_(extent.cells()) {
    for (int i = 0; i < kTilePixels; ++i) transmittance_.values[i] = S(-1);  // outside the image: closed
    for (int i = 0; i < kTilePixels * (2 + num_features); ++i) gate_sum_.values[i] = S(0);
    for (int y = 0; y < extent.rows; ++y) {
      for (int x = 0; x < extent.columns; ++x) transmittance_.pixel(x, y) = S(1);
    }
    if (Blend<kMode>::kTails) std::fill_n(tails_.values, kTilePixels, S(0));
  }

  // Sums the tails where the gate sum is small. Returns how many pairs had their exponent evaluated.
  DSMOE_HD int64_t add_tails() const {
    const PixelArray<S> transmittance = {tails_.values + kTilePixels};
    std::fill_n(transmittance.values, kTilePixels, S(-1));
    bool some = false;
    for (int y = 0; y < extent_.rows; ++y) {
      for (int x = 0; x < extent_.columns; ++x) {
        const bool wants = gate_sum_.pixel(x, y) < tile_.config.tails_below;
        if (wants) transmittance.pixel(x, y) = S(1);
        some |= wants;
      }
    }
    if (!some) return 0;
    TailVisitor<S, kMode> visitor(transmittance, tails_);
    return walk_tile(tile_, tile_.begin, tile_.end, num_features_, visitor);
  }

  // Returns how many pairs had their exponent evaluated.
  DSMOE_HD int64_t paint() {
    const PixelCenters<S> pixels(extent_);
    const GaussianList<S> list(tile_, extent_, num_features_);
    int64_t pairs = 0;
    for (int64_t begin = tile_.begin; begin < tile_.end && open_ != 0; begin += kBatch) {
      const int count = static_cast<int>(min<int64_t>(kBatch, tile_.end - begin));
      for (int k = 0; k < count; ++k) {
        list.load(begin + k, min(begin + k + kPrefetchDistance, tile_.end - 1), batch_[k]);
        met_[k] = batch_[k].met;
        smooth_[k] = batch_[k].smooth;
      }
      for (int k = count; k < kBatch; ++k) met_[k] = smooth_[k] = 0;
      for (CellBits cells = open_; cells != 0; cells &= cells - 1) {
        pairs += paint_cell(pixels, __builtin_ctz(cells));
      }
    }
    return pairs;
  }

  // Finishes the pixels, pack by pack, and writes them.
  DSMOE_HD void write(const ImageOutputs<S>& images) const {
    const S background_gate = tile_.config.gate_of_background();
    const int64_t pixels = static_cast<int64_t>(tile_.width) * tile_.height;
    extent_.for_each_pixel(tile_.width, [&](int x, int y, int64_t index) {
      tile_.saved.final_transmittance[index] = abs(transmittance_.pixel(x, y));
      tile_.saved.gate_sum[index] = gate_sum_.pixel(x, y);
      if constexpr (Blend<kMode>::kTails) {
        tile_.saved.tails[index] = tails_.pixel(x, y);
        images.gate_sum[index] = finish_alpha<kMode>(
            PixelEnd<S>{abs(transmittance_.pixel(x, y)), gate_sum_.pixel(x, y), background_gate, tails_.pixel(x, y)});
      }
      tile_.saved.last_contributor[index] = static_cast<int32_t>(last_.pixel(x, y));
    });
    for (int f = 0; f < num_features_; ++f) {
      S* image = feature_image(tile_.config, images, f, pixels);
      const FeatureRule rule = feature_rule(tile_.config, f);
      const P background = feature_background(tile_.config, f);
      const PixelArray<S> sum = sum_of(f);
      for (int at = 0; at < kTilePixels; at += P::kLanes) {
        const PixelState<P> state = {transmittance_.load(at), gate_sum_.load(at)};
        auto end = state.end(background_gate);
        if constexpr (Blend<kMode>::kTails) end.tails = tails_.load(at);
        sum.store(at, finish_feature<kMode>(rule, end, sum.load(at), background));
      }
      extent_.for_each_pixel(tile_.width, [&](int x, int y, int64_t index) { image[index] = sum.pixel(x, y); });
    }
  }

 private:
  using EntryBits = uint32_t;                           // one bit a Gaussian of the batch, the first one's the lowest
  static constexpr int kBatch = 8 * sizeof(EntryBits);  // Gaussians: they stay in the first cache
  static constexpr int kTestEvery = 4;                  // pairs, for whether a pack is full; a full one changes no more

  DSMOE_HD static EntryBits entries_of(const CellBits* cells, int cell) {
    EntryBits out = 0;
    for (int k = 0; k < kBatch; ++k) out |= (cells[k] >> cell & 1) << k;
    return out;
  }

  DSMOE_HD int64_t paint_cell(const PixelCenters<S>& pixels, int cell) {
    const EntryBits met = entries_of(met_, cell), smooth = entries_of(smooth_, cell);
    bool open = false;
    for (int at = cell * kCellPixels; at < (cell + 1) * kCellPixels; at += P::kLanes) {
      for (EntryBits entries = smooth; entries != 0; entries &= entries - 1) {
        const int k = __builtin_ctz(entries);
        PackPairs<kMode, S, true>(batch_[k], pixels, at).gate.alpha.store(alphas_[k]);
      }
      for (EntryBits entries = met & ~smooth; entries != 0; entries &= entries - 1) {
        const int k = __builtin_ctz(entries);
        const Gate<P> gate = PackPairs<kMode, S, false>(batch_[k], pixels, at).gate;
        select(gate.counts, gate.alpha, P(S(0))).store(alphas_[k]);
      }
      open |= paint_pack(met, at);
    }
    if (!open) open_ &= ~(CellBits(1) << cell);
    return static_cast<int64_t>(__builtin_popcount(met)) * kCellPixels;
  }

  // Returns whether the pack's pixels take further pairs.
  DSMOE_HD bool paint_pack(EntryBits entries, int at) {
    PixelState<P> state = {transmittance_.load(at), gate_sum_.load(at)};
    P last = last_.load(at);
    P registers[kFeatures != kAnyFeatures ? kFeatures : 1];
    if (kFeatures != kAnyFeatures) {
      for (int f = 0; f < kFeatures; ++f) registers[f] = sum_of(f).load(at);
    }
    bool open = !Blend<kMode>::kStopsEarly || any(state.is_open());
    for (int n = 0; entries != 0 && open; entries &= entries - 1, ++n) {
      const int k = __builtin_ctz(entries);
      const ListedGaussian<S>& gaussian = batch_[k];
      const P alpha = P::load(alphas_[k]);
      const auto pair = Blend<kMode>::accumulate(state, Gate<P>{alpha, alpha, alpha > P(S(0))});
      for (int f = 0; f < num_features_; ++f) {
        const P feature = gaussian.features[f];
        if (kFeatures != kAnyFeatures) {
          registers[f] = fma(pair.weight, feature, registers[f]);
        } else {
          sum_of(f).store(at, fma(pair.weight, feature, sum_of(f).load(at)));
        }
      }
      last = select(pair.contributes, P(gaussian.position + S(1)), last);
      if (Blend<kMode>::kStopsEarly && n % kTestEvery == 0) open = any(state.is_open());
    }
    if (Blend<kMode>::kStopsEarly) open = any(state.is_open());
    transmittance_.store(at, state.transmittance);
    gate_sum_.store(at, state.gate_sum);
    last_.store(at, last);
    if (kFeatures != kAnyFeatures) {
      for (int f = 0; f < kFeatures; ++f) sum_of(f).store(at, registers[f]);
    }
    return open;
  }

  DSMOE_HD PixelArray<S> sum_of(int f) const { return {sums_.values + f * kTilePixels}; }

  const Tile<S>& tile_;
  const TileExtent& extent_;
  const int num_features_;
  const PixelArray<S> transmittance_, gate_sum_, last_;
  const PixelArray<S> sums_;   // one array a feature
  const PixelArray<S> tails_;  // behind them, with room for one more: where the mode has tails
  CellBits open_;              // cells that take further pairs
  ListedGaussian<S> batch_[kBatch];
  alignas(64) CellBits met_[kBatch], smooth_[kBatch];  // of the batch
  alignas(64) S alphas_[kBatch][P::kLanes];            // of a pack of pixels; 0 where the pair does not count
};

template <class S, BlendMode kMode, int kFeatures>
int64_t blend_tile(const Tile<S>& tile, const ImageOutputs<S>& images, S* memory) {
  const int num_features = kFeatures != kAnyFeatures ? kFeatures : tile.config.num_features();
  const TileExtent extent(tile);
  TilePainter<S, kMode, kFeatures> painter(tile, extent, num_features, {memory});
  int64_t pairs = painter.paint();
  if constexpr (Blend<kMode>::kTails) pairs += painter.add_tails();
  painter.write(images);
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

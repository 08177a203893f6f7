// The images of one tile. Included once per instruction set.
#pragma once

#include <algorithm>

#include "tile_walk_impl.h"

namespace dsmoe {
namespace cpu {
namespace DSMOE_SIMD {

// Draws a tile, its list in batches. For each batch and pack of pixels it first computes the alphas of the Gaussians
// that meet the pack's cell, by a loop of its own if the cell is smooth. Then it blends them in order, with the sums in
// registers.
template <class S, BlendMode kMode, int kFeatures> class TilePainter {
 public:
  using P = Pack<S>;

  DSMOE_HD TilePainter(const Tile<S>& tile, const TileExtent& extent, int num_features, Scratch<S> scratch)
      : tile_(tile),
        extent_(extent),
        num_features_(num_features),
        tail_alpha_(tile.config.blend.tail_alpha()),
        transmittance_(scratch.pixels()),
        gate_sum_(scratch.pixels()),
        last_(scratch.pixels()),
        sums_{scratch.next},
        tails_{scratch.next + num_features * kTilePixels},
        wide_{scratch.next + (num_features + 1) * kTilePixels},
        open_(extent.cells()) {
    for (int i = 0; i < kTilePixels; ++i) transmittance_.values[i] = S(-1);  // outside the image: closed
    for (int i = 0; i < kTilePixels * (2 + num_features); ++i) gate_sum_.values[i] = S(0);
    for (int y = 0; y < extent.rows; ++y) {
      for (int x = 0; x < extent.columns; ++x) transmittance_.pixel(x, y) = S(1);
    }
    if (Blend<kMode>::kNearFirst) std::fill_n(tails_.values, 2 * kTilePixels, S(0));
  }

  // Blends all pixels, by their near pairs if the rendering blends them first, and then the wide ones with all their
  // pairs. Returns how many pairs had their exponent evaluated.
  DSMOE_HD int64_t paint() {
    const bool near_first = tile_.config.blend.blends_near_first();
    int64_t pairs = 0;
    // If near pairs are not blended first, all pixels of a mode with tails are wide.
    if (!Blend<kMode>::kTails || near_first) pairs += paint<Pairs::kNarrow>();
    if constexpr (Blend<kMode>::kNearFirst) {
      constexpr Pairs kPairs = Blend<kMode>::kTails ? Pairs::kWithTails : Pairs::kWide;
      if ((Blend<kMode>::kTails || near_first) && open_wide(near_first)) pairs += paint<kPairs>();
    }
    return pairs;
  }

  // Finishes the pixels, pack by pack, and writes them.
  DSMOE_HD void write(const ImageOutputs<S>& images) const {
    const S lambda = tile_.config.blend.lambda();
    const int64_t pixels = static_cast<int64_t>(tile_.width) * tile_.height;
    extent_.for_each_pixel(tile_.width, [&](int x, int y, int64_t index) {
      const PixelState<S> state = {transmittance_.pixel(x, y), gate_sum_.pixel(x, y)};
      const bool wide = Blend<kMode>::kNearFirst && wide_.pixel(x, y) > S(0);
      tile_.saved.final_transmittance[index] = kept_transmittance(state.end(lambda), wide);
      tile_.saved.gate_sum[index] = gate_sum_.pixel(x, y);
      if constexpr (Blend<kMode>::kTails) {
        tile_.saved.tails[index] = tails_.pixel(x, y);
        images.gate_sum[index] = finish_alpha<kMode>(
            PixelEnd<S>{abs(transmittance_.pixel(x, y)), gate_sum_.pixel(x, y), lambda, tails_.pixel(x, y)});
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
        auto end = state.end(lambda);
        if constexpr (Blend<kMode>::kTails) end.tails = tails_.load(at);
        sum.store(at, finish_feature<kMode>(rule, end, sum.load(at), background));
      }
      extent_.for_each_pixel(tile_.width, [&](int x, int y, int64_t index) { image[index] = sum.pixel(x, y); });
    }
  }

 private:
  // Closes the pixels that their near pairs cover, and opens the others anew, with their cells. Returns whether there
  // is one.
  DSMOE_HD bool open_wide(bool near_first) {
    const S wide_below = tile_.config.blend.wide_below();
    open_ = 0;
    for (int y = 0; y < extent_.rows; ++y) {
      for (int x = 0; x < extent_.columns; ++x) {
        S& transmittance = transmittance_.pixel(x, y);
        if (near_first && !(gate_sum_.pixel(x, y) < wide_below)) {
          transmittance = -abs(transmittance);
          continue;
        }
        transmittance = wide_.pixel(x, y) = S(1);
        gate_sum_.pixel(x, y) = last_.pixel(x, y) = S(0);
        for (int f = 0; f < num_features_; ++f) sum_of(f).pixel(x, y) = S(0);
        open_ |= CellBits(1) << (y / kCellSize * kCellColumns + x / kCellSize);
      }
    }
    return open_ != 0;
  }

  template <Pairs kPairs> DSMOE_HD int64_t paint() {
    const PixelCenters<S> pixels(extent_);
    const GaussianList<S> list(tile_, extent_, num_features_, kPairs);
    int64_t pairs = 0;
    for (int64_t next = tile_.begin; next < tile_.end && open_ != 0;) {
      int count = 0;
      for (; count < kBatch && next < tile_.end; ++next) {
        if (!list.wants(next)) continue;
        list.load(next, min(next + kPrefetchDistance, tile_.end - 1), batch_[count]);
        met_[count] = batch_[count].met;
        smooth_[count] = batch_[count].smooth;
        ++count;
      }
      for (int k = count; k < kBatch; ++k) met_[k] = smooth_[k] = 0;
      for (CellBits cells = open_; cells != 0; cells &= cells - 1) {
        pairs += paint_cell<kPairs == Pairs::kWithTails>(pixels, __builtin_ctz(cells));
      }
    }
    return pairs;
  }

  using EntryBits = uint32_t;                           // one bit a Gaussian of the batch, the first one's the lowest
  static constexpr int kBatch = 8 * sizeof(EntryBits);  // Gaussians: they stay in the first cache
  static constexpr int kTestEvery = 4;                  // pairs between two tests of whether a pack is full

  DSMOE_HD static EntryBits entries_of(const CellBits* cells, int cell) {
    EntryBits out = 0;
    for (int k = 0; k < kBatch; ++k) out |= (cells[k] >> cell & 1) << k;
    return out;
  }

  template <bool kTails> DSMOE_HD int64_t paint_cell(const PixelCenters<S>& pixels, int cell) {
    const EntryBits met = entries_of(met_, cell), smooth = entries_of(smooth_, cell);
    bool open = false;
    for (int at = cell * kCellPixels; at < (cell + 1) * kCellPixels; at += P::kLanes) {
      for (EntryBits entries = smooth; entries != 0; entries &= entries - 1) {
        const int k = __builtin_ctz(entries);
        PackPairs<kMode, S, true>(batch_[k], pixels, at).gate.alpha.store(alphas_[k]);
      }
      for (EntryBits entries = met & ~smooth; entries != 0; entries &= entries - 1) {
        const int k = __builtin_ctz(entries);
        const PackPairs<kMode, S, false> pack(batch_[k], pixels, at);
        const P otherwise = kTails ? -tail_of(pack.gate, pack.inside, tail_alpha_) : P(S(0));
        select(pack.gate.counts, pack.gate.alpha, otherwise).store(alphas_[k]);
      }
      open |= paint_pack<kTails>(met, at);
    }
    if (!open) open_ &= ~(CellBits(1) << cell);
    return static_cast<int64_t>(__builtin_popcount(met)) * kCellPixels;
  }

  // Returns whether the pack's pixels take further pairs.
  template <bool kTails> DSMOE_HD bool paint_pack(EntryBits entries, int at) {
    PixelState<P> state = {transmittance_.load(at), gate_sum_.load(at)};
    P last = last_.load(at), tails = kTails ? tails_.load(at) : P(S(0));
    P registers[kFeatures != kAnyFeatures ? kFeatures : 1];
    if (kFeatures != kAnyFeatures) {
      for (int f = 0; f < kFeatures; ++f) registers[f] = sum_of(f).load(at);
    }
    bool open = !Blend<kMode>::kStopsEarly || any(state.is_open());
    for (int n = 0; entries != 0 && open; entries &= entries - 1, ++n) {
      const int k = __builtin_ctz(entries);
      const ListedGaussian<S>& gaussian = batch_[k];
      const P alpha = P::load(alphas_[k]);
      if (kTails) add_tail(state, tails, max(-alpha, P(S(0))));
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
    if (kTails) tails_.store(at, tails);
    if (kFeatures != kAnyFeatures) {
      for (int f = 0; f < kFeatures; ++f) sum_of(f).store(at, registers[f]);
    }
    return open;
  }

  DSMOE_HD PixelArray<S> sum_of(int f) const { return {sums_.values + f * kTilePixels}; }

  const Tile<S>& tile_;
  const TileExtent& extent_;
  const int num_features_;
  const S tail_alpha_;  // of BlendRules
  const PixelArray<S> transmittance_, gate_sum_, last_;
  const PixelArray<S> sums_;   // one array a feature
  const PixelArray<S> tails_;  // behind them, if the mode has tails
  const PixelArray<S> wide_;   // 1 in wide pixels, else 0: if the mode has any
  CellBits open_;              // cells that take further pairs
  ListedGaussian<S> batch_[kBatch];
  alignas(64) CellBits met_[kBatch], smooth_[kBatch];  // of the batch
  alignas(64) S alphas_[kBatch][P::kLanes];            // of a pack of pixels; 0 if the pair does not count; a tail's
                                                       // alpha is stored negated
};

template <class S, BlendMode kMode, int kFeatures>
int64_t blend_tile(const Tile<S>& tile, const ImageOutputs<S>& images, S* memory) {
  const int num_features = kFeatures != kAnyFeatures ? kFeatures : tile.config.num_features();
  const TileExtent extent(tile);
  TilePainter<S, kMode, kFeatures> painter(tile, extent, num_features, {memory});
  const int64_t pairs = painter.paint();
  painter.write(images);
  return pairs;
}

template <class S> int64_t forward(const Tile<S>& tile, const ImageOutputs<S>& images, S* scratch) {
  int64_t pairs = 0;
  dispatch_blend(tile.config.blend.mode, tile.config.num_features(), [&](auto mode, auto features) {
    pairs = blend_tile<S, decltype(mode)::value, decltype(features)::value>(tile, images, scratch);
  });
  return pairs;
}

}  // namespace DSMOE_SIMD
}  // namespace cpu
}  // namespace dsmoe

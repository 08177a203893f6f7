// The images of one tile. Included once per instruction set.
#pragma once

#include "tile_walk_impl.h"

namespace dsmoe {
namespace cpu {
namespace DSMOE_SIMD {

// Draws a tile. Its list is taken in batches. For each batch every cell has the list of the Gaussians that meet it,
// and each pack of pixels walks that list with its sums in registers.
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
        open_(extent.cells()) {
    for (int i = 0; i < kTilePixels; ++i) transmittance_.values[i] = S(-1);  // outside the image: closed
    for (int i = 0; i < kTilePixels * (2 + num_features); ++i) gate_sum_.values[i] = S(0);
    for (int y = 0; y < extent.rows; ++y) {
      for (int x = 0; x < extent.columns; ++x) transmittance_.pixel(x, y) = S(1);
    }
  }

  // Returns how many pairs had their exponent evaluated.
  DSMOE_HD int64_t paint() {
    const PixelCenters<S> pixels(extent_);
    const GaussianList<S> list(tile_, extent_, num_features_);
    int64_t pairs = 0;
    for (int64_t begin = tile_.begin; begin < tile_.end && open_ != 0; begin += kBatch) {
      for (uint16_t& count : counts_) count = 0;
      const int64_t end = min(begin + kBatch, tile_.end);
      for (int64_t i = begin; i < end; ++i) {
        const auto entry = static_cast<uint16_t>(i - begin);
        list.load(i, min(i + kPrefetchDistance, tile_.end - 1), batch_[entry]);
        for (CellBits cells = batch_[entry].met & open_; cells != 0; cells &= cells - 1) {
          const int cell = __builtin_ctz(cells);
          met_[cell][counts_[cell]++] = entry;
        }
      }
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
      tile_.saved.last_contributor[index] = static_cast<int32_t>(last_.pixel(x, y));
    });
    for (int f = 0; f < num_features_; ++f) {
      S* image = feature_image(tile_.config, images, f, pixels);
      const FeatureRule rule = feature_rule(tile_.config, f);
      const P background = feature_background(tile_.config, f);
      const PixelArray<S> sum = sum_of(f);
      for (int at = 0; at < kTilePixels; at += P::kLanes) {
        const PixelState<P> state = {transmittance_.load(at), gate_sum_.load(at)};
        sum.store(at, finish_feature<kMode>(rule, state.end(background_gate), sum.load(at), background));
      }
      extent_.for_each_pixel(tile_.width, [&](int x, int y, int64_t index) { image[index] = sum.pixel(x, y); });
    }
  }

 private:
  static constexpr int kBatch = 64;     // Gaussians: they and the cells' lists stay in the first cache
  static constexpr int kTestEvery = 4;  // pairs, for whether a pack is full; a full one changes no more

  DSMOE_HD int64_t paint_cell(const PixelCenters<S>& pixels, int cell) {
    int64_t pairs = 0;
    bool open = false;
    for (int part = 0; part < kCellPixels; part += P::kLanes) {
      pairs += paint_pack(pixels, cell, cell * kCellPixels + part, open);
    }
    if (!open) open_ &= ~(CellBits(1) << cell);
    return pairs;
  }

  // stays_open: becomes true if the pack's pixels take further pairs.
  DSMOE_HD int64_t paint_pack(const PixelCenters<S>& pixels, int cell, int at, bool& stays_open) {
    PixelState<P> state = {transmittance_.load(at), gate_sum_.load(at)};
    P last = last_.load(at);
    P registers[kFeatures != kAnyFeatures ? kFeatures : 1];
    if (kFeatures != kAnyFeatures) {
      for (int f = 0; f < kFeatures; ++f) registers[f] = sum_of(f).load(at);
    }
    const uint16_t* const met = met_[cell];
    const int count = counts_[cell];
    bool open = !Blend<kMode>::kStopsEarly || any(state.is_open());
    int k = 0;
    for (; k < count && open; ++k) {
      const ListedGaussian<S>& gaussian = batch_[met[k]];
      PairWeight<P> pair;
      if ((gaussian.smooth >> cell & 1) != 0) {
        pair = Blend<kMode>::accumulate(state, PackPairs<kMode, S, true>(gaussian, pixels, at).gate);
      } else {
        pair = Blend<kMode>::accumulate(state, PackPairs<kMode, S, false>(gaussian, pixels, at).gate);
      }
      for (int f = 0; f < num_features_; ++f) {
        const P feature = gaussian.features[f];
        if (kFeatures != kAnyFeatures) {
          registers[f] = fma(pair.weight, feature, registers[f]);
        } else {
          sum_of(f).store(at, fma(pair.weight, feature, sum_of(f).load(at)));
        }
      }
      last = select(pair.contributes, P(gaussian.position + S(1)), last);
      if (Blend<kMode>::kStopsEarly && k % kTestEvery == 0) open = any(state.is_open());
    }
    if (Blend<kMode>::kStopsEarly) open = any(state.is_open());
    transmittance_.store(at, state.transmittance);
    gate_sum_.store(at, state.gate_sum);
    last_.store(at, last);
    if (kFeatures != kAnyFeatures) {
      for (int f = 0; f < kFeatures; ++f) sum_of(f).store(at, registers[f]);
    }
    stays_open |= open;
    return static_cast<int64_t>(k) * P::kLanes;
  }

  DSMOE_HD PixelArray<S> sum_of(int f) const { return {sums_.values + f * kTilePixels}; }

  const Tile<S>& tile_;
  const TileExtent& extent_;
  const int num_features_;
  const PixelArray<S> transmittance_, gate_sum_, last_;
  const PixelArray<S> sums_;  // one array a feature
  CellBits open_;             // cells that take further pairs
  ListedGaussian<S> batch_[kBatch];
  uint16_t counts_[kCells];
  uint16_t met_[kCells][kBatch];  // entries of the batch
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
  dispatch_blend(tile.config.mode, tile.config.num_features(), [&](auto mode, auto features) {
    pairs = blend_tile<S, decltype(mode)::value, decltype(features)::value>(tile, images, scratch);
  });
  return pairs;
}

}  // namespace DSMOE_SIMD
}  // namespace cpu
}  // namespace dsmoe

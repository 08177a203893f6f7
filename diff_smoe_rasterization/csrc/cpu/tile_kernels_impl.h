// Loops over a tile: Gaussians in list order, then strips of pixels (one SIMD pack wide) and the rows of each strip.
// Included once per instruction set, after pack.h; the formulas are the math headers'.
#pragma once

#include "../dispatch.h"
#include "dsmoe/features.h"
#include "dsmoe/tiles.h"
#include "pack.h"
#include "tile_kernels.h"

namespace dsmoe {
namespace cpu {
namespace DSMOE_SIMD {

template <class S> using Pack = ::dsmoe::DSMOE_SIMD::Pack<S>;

// One number per pixel of the tile, strip by strip, each strip's rows one below the other.
template <class S> struct PixelArray {
  S* values;

  DSMOE_HD S* at(int strip, int row) const { return values + (strip * kTileSize + row) * Pack<S>::kLanes; }
  DSMOE_HD Pack<S> load(int strip, int row) const { return Pack<S>::load(at(strip, row)); }
  DSMOE_HD void store(int strip, int row, Pack<S> value) const { value.store(at(strip, row)); }
  DSMOE_HD S& pixel(int x, int y) const { return at(x / Pack<S>::kLanes, y)[x % Pack<S>::kLanes]; }
};

template <class S> constexpr int kStrips = kTileSize / Pack<S>::kLanes;

// A Gaussian's rows are found for the tile's whole width: where that is one strip, each of them holds pixels.
template <class S> constexpr bool kRowsAreExact = kStrips<S> == 1;

// Hands out PixelArrays one after the other.
template <class S> struct Scratch {
  S* next;
  DSMOE_HD PixelArray<S> pixels() {
    S* values = next;
    next += kTilePixels;
    return {values};
  }
};

// The part of the tile that lies on the image.
struct TileExtent {
  int x0, y0, columns, rows;
  template <class Tile>
  DSMOE_HD explicit TileExtent(const Tile& tile)
      : x0(tile.tile_x * kTileSize),
        y0(tile.tile_y * kTileSize),
        columns(min(kTileSize, tile.width - x0)),
        rows(min(kTileSize, tile.height - y0)) {}

  // Calls body(x, y, index into an [H, W] image).
  template <class Body> DSMOE_HD void for_each_pixel(int width, Body body) const {
    for (int y = 0; y < rows; ++y) {
      for (int x = 0; x < columns; ++x) body(x, y, static_cast<int64_t>(y0 + y) * width + x0 + x);
    }
  }
};

// The rows of the tile that a Gaussian's footprint meets.
struct RowRange {
  int begin, end;
};

template <class S> DSMOE_HD RowRange rows_of(const ProjectedGaussian<S>& gaussian, const TileExtent& extent) {
  // EllipseBand gives u over a band of v; with x and y exchanged, y over the tile's columns.
  const Sym2<S> exchanged = {gaussian.conic.yy, gaussian.conic.xy, gaussian.conic.xx};
  const S left = S(extent.x0) - gaussian.mean.x, top = gaussian.mean.y - S(extent.y0);
  const auto y = EllipseBand<S>(exchanged, gaussian.squared_reach).over({left, left + S(extent.columns - 1)});
  if (y.empty()) return {0, 0};
  return {ceil_to_int(top + y.low, 0, extent.rows), floor_to_int(top + y.high + S(1), 0, extent.rows)};
}

// No pair of the Gaussian has an exponent below this.
template <class S> DSMOE_HD S least_power(const ProjectedGaussian<S>& gaussian) {
  return S(-0.5) * (gaussian.squared_reach * S(1 + kFootprintSlack) + S(kFootprintSlack));
}

constexpr int64_t kPrefetchDistance = 8;  // instances; the Gaussians of a list lie anywhere in memory

template <class S>
DSMOE_HD void prefetch_gaussian(const SavedForward<S>& saved, const TileInstance& instance, int num_features) {
  __builtin_prefetch(saved.projected + instance.gaussian);
  __builtin_prefetch(saved.features + static_cast<int64_t>(instance.gaussian) * num_features);
}

template <class S, BlendMode kMode, int kFeatures> int64_t blend_tile(const ForwardTile<S>& tile, S* memory) {
  using P = Pack<S>;
  const int num_features = kFeatures != kAnyFeatures ? kFeatures : tile.config.num_features();
  const TileExtent extent(tile);
  Scratch<S> scratch{memory};
  const auto transmittance = scratch.pixels(), gate_sum = scratch.pixels(), last = scratch.pixels();
  const PixelArray<S> sums = {scratch.next};  // one array a feature
  const auto sum_of = [&](int f) { return PixelArray<S>{sums.values + f * kTilePixels}; };

  for (int i = 0; i < kTilePixels; ++i) transmittance.values[i] = S(-1);  // outside the image: closed
  for (int i = 0; i < kTilePixels * (2 + num_features); ++i) gate_sum.values[i] = S(0);
  for (int y = 0; y < extent.rows; ++y) {
    for (int x = 0; x < extent.columns; ++x) transmittance.pixel(x, y) = S(1);
  }

  bool strip_open[kStrips<S>][kTileSize];
  int open_strips = kStrips<S> * extent.rows;
  for (auto& strip : strip_open) {
    for (bool& row : strip) row = true;
  }

  const AlphaCut<S> cut = tile.config.alpha_cut();
  int64_t pairs = 0;
  for (int64_t i = tile.begin; i < tile.end && open_strips > 0; ++i) {
    prefetch_gaussian(tile.saved, tile.saved.instances[min(i + kPrefetchDistance, tile.end - 1)], num_features);
    const TileInstance& instance = tile.saved.instances[i];
    const ProjectedGaussian<S>& gaussian = tile.saved.projected[instance.gaussian];
    const S* features = tile.saved.features + static_cast<int64_t>(instance.gaussian) * num_features;
    const RowRange rows = rows_of(gaussian, extent);
    const S faintest = least_power(gaussian), position = S(i - tile.begin + 1);
    const S least_alpha = cut.of(gaussian.opacity);
    for (int strip = 0; strip < kStrips<S>; ++strip) {
      const P dx = P::iota() + P(S(extent.x0 + strip * P::kLanes) - gaussian.mean.x);
      const ColumnExponent<P, S> exponent(gaussian.conic, dx);
      for (int row = rows.begin; row < rows.end; ++row) {
        if (Blend<kMode>::kStopsEarly && !strip_open[strip][row]) continue;
        pairs += P::kLanes;
        const P power = exponent.at(S(extent.y0 + row) - gaussian.mean.y);
        if (!kRowsAreExact<S> && !any(power >= P(faintest))) continue;
        const auto gate = evaluate_gate<kMode>(power, gaussian.opacity, least_alpha);
        PixelState<P> state = {transmittance.load(strip, row), gate_sum.load(strip, row)};
        const auto pair = Blend<kMode>::accumulate(state, gate);
        for (int f = 0; f < num_features; ++f) {
          sum_of(f).store(strip, row, fma(pair.weight, P(features[f]), sum_of(f).load(strip, row)));
        }
        transmittance.store(strip, row, state.transmittance);
        gate_sum.store(strip, row, state.gate_sum);
        last.store(strip, row, select(pair.contributes, P(position), last.load(strip, row)));
        if (Blend<kMode>::kStopsEarly && !any(state.is_open())) {
          strip_open[strip][row] = false;
          --open_strips;
        }
      }
    }
  }

  const S background_gate = tile.config.gate_of_background();
  const int64_t pixels = static_cast<int64_t>(tile.width) * tile.height;
  extent.for_each_pixel(tile.width, [&](int x, int y, int64_t index) {
    tile.saved.final_transmittance[index] = abs(transmittance.pixel(x, y));
    tile.saved.gate_sum[index] = gate_sum.pixel(x, y);
    tile.saved.last_contributor[index] = static_cast<int32_t>(last.pixel(x, y));
  });
  for (int f = 0; f < num_features; ++f) {
    S* image = feature_image(tile.config, tile.images, f, pixels);
    const FeatureRule rule = feature_rule(tile.config, f);
    const S background = feature_background(tile.config, f);
    const auto sum = sum_of(f);
    extent.for_each_pixel(tile.width, [&](int x, int y, int64_t index) {
      const PixelState<S> state = {transmittance.pixel(x, y), gate_sum.pixel(x, y)};
      image[index] = finish_feature<kMode>(rule, state.end(background_gate), sum.pixel(x, y), background);
    });
  }
  return pairs;
}

template <class S, BlendMode kMode, int kFeatures> int64_t blend_tile_backward(const BackwardTile<S>& tile, S* memory) {
  using P = Pack<S>;
  const int num_features = kFeatures != kAnyFeatures ? kFeatures : tile.config.num_features();
  const int record = kNumGateMoments + num_features;
  const TileExtent extent(tile);
  Scratch<S> scratch{memory};
  const auto transmittance = scratch.pixels(), suffix = scratch.pixels(), base = scratch.pixels(),
             last = scratch.pixels();
  const PixelArray<S> scaled = {scratch.next};  // g', one array a feature
  const auto scaled_of = [&](int f) { return PixelArray<S>{scaled.values + f * kTilePixels}; };
  // dL/dfeature of the current Gaussian; in registers where their number is known.
  P dL_dfeatures_in_registers[kFeatures != kAnyFeatures ? kFeatures : 1];
  P* dL_dfeatures = kFeatures != kAnyFeatures ? dL_dfeatures_in_registers
                                              : reinterpret_cast<P*>(scaled.values + num_features * kTilePixels);

  for (int i = 0; i < kTilePixels * (4 + num_features); ++i) transmittance.values[i] = S(0);
  for (int i = 0; i < kTilePixels; ++i) transmittance.values[i] = S(1);
  const int64_t pixels = static_cast<int64_t>(tile.width) * tile.height;
  const S background_gate = tile.config.gate_of_background();
  int64_t num_seen = 0;  // entries of the list that some numerator has seen
  extent.for_each_pixel(tile.width, [&](int x, int y, int64_t index) {
    const PixelEnd<S> pixel_end = {tile.saved.final_transmittance[index], tile.saved.gate_sum[index], background_gate};
    auto pixel =
        begin_backward(pixel_end, tile.dL_dimages.gate_sum != nullptr ? tile.dL_dimages.gate_sum[index] : S(0));
    for (int f = 0; f < num_features; ++f) {
      const S* gradient = feature_image(tile.config, tile.dL_dimages, f, pixels);
      if (gradient == nullptr) continue;
      const S value = feature_image(tile.config, tile.images, f, pixels)[index];
      const auto share = add_feature<kMode>(feature_rule(tile.config, f), pixel, pixel_end, gradient[index], value,
                                            feature_background(tile.config, f));
      scaled_of(f).pixel(x, y) = share.scaled;
      if (tile.dL_dbackground == nullptr) continue;
      if (f < tile.config.num_channels) tile.dL_dbackground[f] += share.background;
      tile.dL_dbackground[tile.config.num_channels] += share.background_gate;
    }
    transmittance.pixel(x, y) = pixel.transmittance;
    suffix.pixel(x, y) = pixel.suffix;
    base.pixel(x, y) = pixel.base;
    last.pixel(x, y) = S(tile.saved.last_contributor[index]);
    num_seen = max<int64_t>(num_seen, tile.saved.last_contributor[index]);
  });

  const int64_t end = Blend<kMode>::kStopsEarly ? tile.begin + num_seen : tile.end;
  for (int64_t i = end; i < tile.end; ++i) {
    S* out = tile.dL_dinstances + tile.saved.instances[i].slot * static_cast<int64_t>(record);
    for (int k = 0; k < record; ++k) out[k] = S(0);
  }

  const AlphaCut<S> cut = tile.config.alpha_cut();
  int64_t pairs = 0;
  for (int64_t i = end - 1; i >= tile.begin; --i) {
    prefetch_gaussian(tile.saved, tile.saved.instances[max(i - kPrefetchDistance, tile.begin)], num_features);
    const TileInstance& instance = tile.saved.instances[i];
    const ProjectedGaussian<S>& gaussian = tile.saved.projected[instance.gaussian];
    const S* features = tile.saved.features + static_cast<int64_t>(instance.gaussian) * num_features;
    const RowRange rows = rows_of(gaussian, extent);
    const S faintest = least_power(gaussian), position = S(i - tile.begin);
    const S least_alpha = cut.of(gaussian.opacity);
    P one = S(0), x = S(0), y = S(0), xx = S(0), xy = S(0), yy = S(0);
    for (int f = 0; f < num_features; ++f) dL_dfeatures[f] = P(S(0));
    for (int strip = 0; strip < kStrips<S>; ++strip) {
      const P dx = P::iota() + P(S(extent.x0 + strip * P::kLanes) - gaussian.mean.x);
      const ColumnExponent<P, S> exponent(gaussian.conic, dx);
      P column_one = S(0), column_y = S(0), column_yy = S(0);  // dx is the same down the column: it joins at the end
      for (int row = rows.begin; row < rows.end; ++row) {
        const auto not_past = P(position) < last.load(strip, row);
        if (Blend<kMode>::kStopsEarly && !any(not_past)) continue;
        pairs += P::kLanes;
        const S dy = S(extent.y0 + row) - gaussian.mean.y;
        const P power = exponent.at(dy);
        if (!kRowsAreExact<S> && !any(power >= P(faintest))) continue;
        const auto gate = evaluate_gate<kMode>(power, gaussian.opacity, least_alpha);
        const auto contributes = gate.counts & not_past;
        P value = S(0);
        for (int f = 0; f < num_features; ++f) value = fma(scaled_of(f).load(strip, row), P(features[f]), value);
        PixelBackward<P> pixel = {transmittance.load(strip, row), suffix.load(strip, row), base.load(strip, row)};
        const auto pair = Blend<kMode>::backward(pixel, gate, value, contributes);
        transmittance.store(strip, row, pixel.transmittance);
        suffix.store(strip, row, pixel.suffix);
        for (int f = 0; f < num_features; ++f) {
          dL_dfeatures[f] = fma(pair.weight, scaled_of(f).load(strip, row), dL_dfeatures[f]);
        }
        const P dL_dpower = gate_backward(gate, pair.gamma);
        column_one = column_one + dL_dpower;
        column_y = fma(dL_dpower, P(dy), column_y);
        column_yy = fma(dL_dpower, P(dy * dy), column_yy);
      }
      one = one + column_one;
      y = y + column_y;
      yy = yy + column_yy;
      x = fma(column_one, dx, x);
      xx = fma(column_one * dx, dx, xx);
      xy = fma(column_y, dx, xy);
    }
    S* out = tile.dL_dinstances + instance.slot * static_cast<int64_t>(record);
    *reinterpret_cast<GateMoments<S>*>(out) = {sum_lanes(one), sum_lanes(x),  sum_lanes(y),
                                               sum_lanes(xx),  sum_lanes(xy), sum_lanes(yy)};
    for (int f = 0; f < num_features; ++f) out[kNumGateMoments + f] = sum_lanes(dL_dfeatures[f]);
  }
  return pairs;
}

template <class S> int64_t forward(const ForwardTile<S>& tile, S* scratch) {
  int64_t pairs = 0;
  dispatch_blend(tile.config.mode, tile.config.num_features(), [&](auto mode, auto features) {
    pairs = blend_tile<S, decltype(mode)::value, decltype(features)::value>(tile, scratch);
  });
  return pairs;
}

template <class S> int64_t backward(const BackwardTile<S>& tile, S* scratch) {
  int64_t pairs = 0;
  dispatch_blend(tile.config.mode, tile.config.num_features(), [&](auto mode, auto features) {
    pairs = blend_tile_backward<S, decltype(mode)::value, decltype(features)::value>(tile, scratch);
  });
  return pairs;
}

}  // namespace DSMOE_SIMD
}  // namespace cpu
}  // namespace dsmoe

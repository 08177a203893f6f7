// One tile's share of what is summed over the pixels of each Gaussian: the forward walk once more, without features.
// Included once per instruction set, as tile_kernels_impl.h is, whose walk this is; the formulas are the math headers'.
#pragma once

#include "dsmoe/contribution.h"
#include "tile_kernels_impl.h"

namespace dsmoe {
namespace cpu {
namespace DSMOE_SIMD {

template <class S, BlendMode kMode> int64_t sum_tile(const ContributionTile<S>& tile, S* memory) {
  using P = Pack<S>;
  const TileExtent extent(tile);
  Scratch<S> scratch{memory};
  const auto transmittance = scratch.pixels(), gate_sum = scratch.pixels(), last = scratch.pixels(),
             pixel_weight = scratch.pixels();
  for (int i = 0; i < kTilePixels; ++i) transmittance.values[i] = S(1);
  for (int i = 0; i < 3 * kTilePixels; ++i) gate_sum.values[i] = S(0);
  int64_t num_seen = 0;  // entries of the list that some numerator has seen
  extent.for_each_pixel(tile.width, [&](int x, int y, int64_t index) {
    last.pixel(x, y) = S(tile.saved.last_contributor[index]);
    pixel_weight.pixel(x, y) = tile.pixel_weights[index];
    num_seen = max<int64_t>(num_seen, tile.saved.last_contributor[index]);
  });

  const int64_t end = tile.begin + num_seen;
  for (int64_t i = end; i < tile.end; ++i) tile.instances[tile.saved.instances[i].slot] = no_contribution<S>();
  const AlphaCut<S> cut = tile.config.alpha_cut();
  int64_t pairs = 0;
  for (int64_t i = tile.begin; i < end; ++i) {
    prefetch_gaussian(tile.saved, tile.saved.instances[min(i + kPrefetchDistance, end - 1)], 0);
    const TileInstance& instance = tile.saved.instances[i];
    const ProjectedGaussian<S>& gaussian = tile.saved.projected[instance.gaussian];
    const RowRange rows = rows_of(gaussian, extent);
    const S faintest = least_power(gaussian), position = S(i - tile.begin);
    const S least_alpha = cut.of(gaussian.opacity);
    auto sum = no_contribution<P>();
    for (int strip = 0; strip < kStrips<S>; ++strip) {
      const P dx = P::iota() + P(S(extent.x0 + strip * P::kLanes) - gaussian.mean.x);
      const ColumnExponent<P, S> exponent(gaussian.conic, dx);
      for (int row = rows.begin; row < rows.end; ++row) {
        const auto not_past = P(position) < last.load(strip, row);
        if (!any(not_past)) continue;
        pairs += P::kLanes;
        const S dy = S(extent.y0 + row) - gaussian.mean.y;
        const P power = exponent.at(dy);
        if (!kRowsAreExact<S> && !any(power >= P(faintest))) continue;
        const auto gate = evaluate_gate<kMode>(power, gaussian.opacity, least_alpha);
        PixelState<P> state = {transmittance.load(strip, row), gate_sum.load(strip, row)};
        const auto pair = Blend<kMode>::accumulate(state, gate);
        transmittance.store(strip, row, state.transmittance);
        gate_sum.store(strip, row, state.gate_sum);
        add_pair(sum, pair.contributes & not_past, pixel_weight.load(strip, row), pair.weight, dx, P(dy));
      }
    }
    tile.instances[instance.slot] = {sum_lanes(sum.pixel_weight), sum_lanes(sum.pixels), sum_lanes(sum.blend_weight),
                                     sum_lanes(sum.distance)};
  }
  return pairs;
}

template <class S> int64_t contributions(const ContributionTile<S>& tile, S* scratch) {
  int64_t pairs = 0;
  dispatch_blend(tile.config.mode, kAnyFeatures,
                 [&](auto mode, auto) { pairs = sum_tile<S, decltype(mode)::value>(tile, scratch); });
  return pairs;
}

}  // namespace DSMOE_SIMD
}  // namespace cpu
}  // namespace dsmoe

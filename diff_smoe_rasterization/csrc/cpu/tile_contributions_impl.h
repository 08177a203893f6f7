// One tile's share of what is summed over the pixels of each Gaussian: the forward walk once more, without features.
// Included once per instruction set.
#pragma once

#include "dsmoe/contribution.h"
#include "tile_walk_impl.h"

namespace dsmoe {
namespace cpu {
namespace DSMOE_SIMD {

template <class S, BlendMode kBlendMode> class ContributionVisitor {
 public:
  using P = Pack<S>;
  static constexpr BlendMode kMode = kBlendMode;
  static constexpr bool kBackToFront = false;

  DSMOE_HD ContributionVisitor(Scratch<S> scratch, const TileContributions<S>& out)
      : transmittance_(scratch.pixels()),
        gate_sum_(scratch.pixels()),
        last_(scratch.pixels()),
        pixel_weight_(scratch.pixels()),
        out_(out) {
    for (int i = 0; i < kTilePixels; ++i) transmittance_.values[i] = S(1);
    for (int i = 0; i < 3 * kTilePixels; ++i) gate_sum_.values[i] = S(0);
  }

  // Returns how many entries of the list some numerator has seen.
  DSMOE_HD int64_t read(const Tile<S>& tile) const {
    int64_t num_seen = 0;
    TileExtent(tile).for_each_pixel(tile.width, [&](int x, int y, int64_t index) {
      last_.pixel(x, y) = S(tile.saved.last_contributor[index]);
      pixel_weight_.pixel(x, y) = out_.pixel_weights[index];
      num_seen = max<int64_t>(num_seen, tile.saved.last_contributor[index]);
    });
    return num_seen;
  }

  DSMOE_HD void expect(uint32_t slot) const { __builtin_prefetch(out_.instances + slot, 1); }
  DSMOE_HD Contribution<P> begin(const ListedGaussian<S>& gaussian) {
    position_ = P(gaussian.position);
    return no_contribution<P>();
  }
  DSMOE_HD bool wanted(int at, Mask<P>& not_past) const {
    not_past = position_ < last_.load(at);
    return any(not_past);
  }

  template <class Pairs> DSMOE_HD void take(int at, const Pairs& pairs, Mask<P> not_past, Contribution<P>& sum) const {
    PixelState<P> state = {transmittance_.load(at), gate_sum_.load(at)};
    const auto pair = Blend<kMode>::accumulate(state, pairs.gate);
    transmittance_.store(at, state.transmittance);
    gate_sum_.store(at, state.gate_sum);
    add_pair(sum, pair.contributes & not_past, pixel_weight_.load(at), pair.weight, pairs.dx, pairs.dy);
  }

  DSMOE_HD void end(const ListedGaussian<S>& gaussian, const Contribution<P>& sum) const {
    out_.instances[gaussian.slot] = {sum_lanes(sum.pixel_weight), sum_lanes(sum.pixels), sum_lanes(sum.blend_weight),
                                     sum_lanes(sum.distance)};
  }

 private:
  const PixelArray<S> transmittance_, gate_sum_, last_, pixel_weight_;
  const TileContributions<S>& out_;
  P position_;
};

template <class S, BlendMode kMode> int64_t sum_tile(const Tile<S>& tile, const TileContributions<S>& out, S* memory) {
  Scratch<S> scratch = {memory};
  const WidePixels<kMode, S> wide(tile, scratch.pixels());
  ContributionVisitor<S, kMode> visitor(scratch, out);
  const int64_t end = tile.begin + visitor.read(tile);
  for (int64_t i = end; i < tile.end; ++i) out.instances[tile.saved.instances[i].slot] = no_contribution<S>();
  return walk_tile(tile, tile.begin, end, 0, wide, visitor);
}

template <class S> int64_t contributions(const Tile<S>& tile, const TileContributions<S>& out, S* scratch) {
  int64_t pairs = 0;
  dispatch_blend(tile.config.mode, kAnyFeatures,
                 [&](auto mode, auto) { pairs = sum_tile<S, decltype(mode)::value>(tile, out, scratch); });
  return pairs;
}

}  // namespace DSMOE_SIMD
}  // namespace cpu
}  // namespace dsmoe

// One tile's share of the gate map: the forward walk once more, without features. Included once per instruction set.
#pragma once

#include "tile_walk_impl.h"

namespace dsmoe {
namespace cpu {
namespace DSMOE_SIMD {

// All gates of a pixel have one denominator, so the greatest weight is the greatest gate.
template <class S, BlendMode kBlendMode> class GateMapVisitor {
 public:
  using P = Pack<S>;
  static constexpr BlendMode kMode = kBlendMode;
  static constexpr bool kBackToFront = false;

  DSMOE_HD explicit GateMapVisitor(Scratch<S> scratch)
      : transmittance_(scratch.pixels()),
        gate_sum_(scratch.pixels()),
        greatest_weight_(scratch.pixels()),
        greatest_position_(scratch.pixels()),
        count_(scratch.pixels()) {
    for (int i = 0; i < kTilePixels; ++i) {
      transmittance_.values[i] = S(1);
      gate_sum_.values[i] = greatest_weight_.values[i] = count_.values[i] = S(0);
      greatest_position_.values[i] = S(-1);
    }
  }

  DSMOE_HD void expect(uint32_t) const {}
  struct NoSums {};
  DSMOE_HD NoSums begin(const ListedGaussian<S>& gaussian) {
    position_ = P(gaussian.position);
    return {};
  }
  DSMOE_HD bool wanted(int, Mask<P>&) const { return true; }

  template <class Pairs> DSMOE_HD void take(int at, const Pairs& pairs, Mask<P>, NoSums) const {
    PixelState<P> state = {transmittance_.load(at), gate_sum_.load(at)};
    const auto pair = Blend<kMode>::accumulate(state, pairs.gate);
    transmittance_.store(at, state.transmittance);
    gate_sum_.store(at, state.gate_sum);
    count_.store(at, count_.load(at) + select(pair.contributes, P(S(1)), P(S(0))));
    const P greatest = greatest_weight_.load(at);
    const Mask<P> greater = pair.contributes & (pair.weight > greatest);
    greatest_weight_.store(at, select(greater, pair.weight, greatest));
    greatest_position_.store(at, select(greater, position_, greatest_position_.load(at)));
  }

  DSMOE_HD void end(const ListedGaussian<S>&, NoSums) const {}

  DSMOE_HD void write(const Tile<S>& tile, const GateMap& map) const {
    TileExtent(tile).for_each_pixel(tile.width, [&](int x, int y, int64_t index) {
      const auto position = static_cast<int64_t>(greatest_position_.pixel(x, y));
      map.gaussians[index] = position < 0 ? -1 : tile.saved.instances[tile.begin + position].gaussian;
      map.counts[index] = static_cast<int32_t>(count_.pixel(x, y));
    });
  }

 private:
  const PixelArray<S> transmittance_, gate_sum_, greatest_weight_, greatest_position_, count_;
  P position_;
};

template <class S, BlendMode kMode> int64_t map_tile(const Tile<S>& tile, const GateMap& map, S* memory) {
  int64_t num_seen = 0;  // entries of the list that some pixel's numerator has seen
  TileExtent(tile).for_each_pixel(tile.width, [&](int, int, int64_t index) {
    num_seen = max<int64_t>(num_seen, tile.saved.last_contributor[index]);
  });
  Scratch<S> scratch = {memory};
  const WidePixels<kMode, S> wide(tile, scratch.pixels());
  GateMapVisitor<S, kMode> visitor(scratch);
  const int64_t pairs = walk_tile(tile, tile.begin, tile.begin + num_seen, 0, wide, visitor);
  visitor.write(tile, map);
  return pairs;
}

template <class S> int64_t gate_map(const Tile<S>& tile, const GateMap& map, S* scratch) {
  int64_t pairs = 0;
  dispatch_blend(tile.config.mode, kAnyFeatures,
                 [&](auto mode, auto) { pairs = map_tile<S, decltype(mode)::value>(tile, map, scratch); });
  return pairs;
}

}  // namespace DSMOE_SIMD
}  // namespace cpu
}  // namespace dsmoe

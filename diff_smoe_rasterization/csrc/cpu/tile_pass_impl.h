// One tile's share of a pass over the pixels of a rendering. Included once per instruction set.
#pragma once

#include "tile_walk_impl.h"

namespace dsmoe {
namespace cpu {
namespace DSMOE_SIMD {

template <class S, BlendMode kBlendMode, class Pass> class PassVisitor {
 public:
  using P = Pack<S>;
  template <class Real> using State = typename Pass::template State<Real>;
  using Sums = typename Pass::template Sums<P>;
  using Record = typename Pass::template Sums<S>;
  static constexpr BlendMode kMode = kBlendMode;
  static constexpr bool kBackToFront = false;
  static constexpr bool kSums = Sums::kNum > 0;

  DSMOE_HD PassVisitor(const Pass& pass, Record* records, Scratch<S> scratch)
      : pass_(pass),
        records_(records),
        transmittance_(scratch.pixels()),
        gate_sum_(scratch.pixels()),
        last_(scratch.pixels()),
        state_(scratch.pixels()) {
    for (int i = 0; i < kTilePixels; ++i) transmittance_.values[i] = S(1);
    for (int i = 0; i < kTilePixels * (2 + State<S>::kNum); ++i) gate_sum_.values[i] = S(0);
  }

  // Starts every pixel. Returns how many entries of the list some numerator has seen.
  DSMOE_HD int64_t begin(const Tile<S>& tile) const {
    int64_t num_seen = 0;
    TileExtent(tile).for_each_pixel(tile.width, [&](int x, int y, int64_t index) {
      num_seen = max<int64_t>(num_seen, tile.saved.last_contributor[index]);
      if constexpr (kSums) {
        last_.pixel(x, y) = S(tile.saved.last_contributor[index]);
      }
      State<S> state = pass_.template begin<kMode>(index);
      each_array([&](PixelArray<S> array, auto number) { array.pixel(x, y) = S(number); }, state);
    });
    return num_seen;
  }

  DSMOE_HD void expect(uint32_t slot) const {
    if (kSums) __builtin_prefetch(records_ + slot, 1);
  }
  DSMOE_HD Sums begin(const ListedGaussian<S>& gaussian) {
    seen_ = P(gaussian.position + S(1));
    return Sums();
  }
  DSMOE_HD bool wanted(int at, Mask<P>& not_past) const {
    not_past = seen_ <= last_.load(at);
    return !kSums || any(not_past);  // to ask costs more than a visit without sums
  }

  template <class Pairs> DSMOE_HD void take(int at, const Pairs& pairs, Mask<P> not_past, Sums& sums) const {
    PixelState<P> walked = {transmittance_.load(at), gate_sum_.load(at)};
    State<P> state;
    each_array([&](PixelArray<S> array, P& number) { number = array.load(at); }, state);
    pass_.template visit<kMode>(walked, state, {pairs.gate, pairs.dx, pairs.dy, seen_, not_past}, sums);
    transmittance_.store(at, walked.transmittance);
    gate_sum_.store(at, walked.gate_sum);
    if (!kSums) each_array([&](PixelArray<S> array, P number) { array.store(at, number); }, state);
  }

  DSMOE_HD void end(const ListedGaussian<S>& gaussian, const Sums& sums) const {
    if constexpr (kSums) {
      Sums::for_each([](S& number, P sum) { number = sum_lanes(sum); }, records_[gaussian.slot], sums);
    }
  }

  DSMOE_HD void skip(uint32_t slot) const {
    if constexpr (kSums) records_[slot] = Record();
  }

  // Ends every pixel.
  DSMOE_HD void end(const Tile<S>& tile) const {
    const auto gaussian_at = [&](int64_t i) { return tile.saved.instances[tile.begin + i].index(); };
    TileExtent(tile).for_each_pixel(tile.width, [&](int x, int y, int64_t index) {
      State<S> state;
      each_array([&](PixelArray<S> array, auto& number) { number = array.pixel(x, y); }, state);
      pass_.end(state, index, gaussian_at);
    });
  }

 private:
  // Calls visit(array, number) for each number of a State.
  template <class Visit, class AnyState> DSMOE_HD void each_array(Visit visit, AnyState& state) const {
    Scratch<S> arrays = {state_.values};
    state.for_each([&](auto& number) { visit(arrays.pixels(), number); });
  }

  const Pass& pass_;
  Record* const records_;  // [I] by slot; the tile's are written whole
  const PixelArray<S> transmittance_, gate_sum_, last_;
  const PixelArray<S> state_;  // one array a number
  P seen_;
};

template <class S, BlendMode kMode, class Pass, class Record>
int64_t pass_of_tile(const Tile<S>& tile, const Pass& pass, Record* records, S* memory) {
  Scratch<S> scratch = {memory};
  const WidePixels<kMode, S> wide(tile, scratch.pixels());
  PassVisitor<S, kMode, Pass> visitor(pass, records, scratch);
  const int64_t end = tile.begin + visitor.begin(tile);
  if constexpr (Record::kNum > 0) {
    for (int64_t i = end; i < tile.end; ++i) visitor.skip(tile.saved.instances[i].slot);
  }
  const int64_t pairs = walk_tile(tile, tile.begin, end, 0, wide, visitor);
  if constexpr (Record::kNum == 0) visitor.end(tile);
  return pairs;
}

template <class S, class Pass>
int64_t pass(const Tile<S>& tile, const Pass& pass, typename Pass::template Sums<S>* records, S* scratch) {
  int64_t pairs = 0;
  dispatch_blend(tile.config.blend.mode, kAnyFeatures, [&](auto mode, auto) {
    pairs = pass_of_tile<S, decltype(mode)::value>(tile, pass, records, scratch);
  });
  return pairs;
}

// One tile's share of what each Gaussian is worth to the image: the forward walk once more, beside its finished pixels.

template <class S, BlendMode kBlendMode, int kFeatures> class ImportanceVisitor {
 public:
  using P = Pack<S>;
  static constexpr BlendMode kMode = kBlendMode;
  static constexpr bool kBackToFront = false;

  DSMOE_HD ImportanceVisitor(const Tile<S>& tile, Scratch<S> scratch, const ImportanceMap<S>& map,
                             Importance<S>* records)
      : num_channels_(kFeatures != kAnyFeatures ? kFeatures : tile.config.num_channels),
        background_(tile.config.background),
        lambda_(tile.config.blend.lambda()),
        transmittance_(scratch.pixels()),
        gate_sum_(scratch.pixels()),
        last_(scratch.pixels()),
        end_transmittance_(scratch.pixels()),
        end_gate_sum_(scratch.pixels()),
        weight_(scratch.pixels()),
        share_weight_(scratch.pixels()),
        alone_(scratch.pixels()),
        channels_{scratch.next},
        map_(map),
        records_(records) {
    for (int i = 0; i < kTilePixels; ++i) transmittance_.values[i] = S(1);
    for (int i = 0; i < kTilePixels * (kImportanceArrays - 1 + 2 * num_channels_); ++i) gate_sum_.values[i] = S(0);
  }

  // Returns how many entries of the list some numerator has seen.
  DSMOE_HD int64_t read(const Tile<S>& tile) const {
    const int64_t pixels = static_cast<int64_t>(tile.width) * tile.height;
    int64_t num_seen = 0;
    TileExtent(tile).for_each_pixel(tile.width, [&](int x, int y, int64_t index) {
      last_.pixel(x, y) = S(tile.saved.last_contributor[index]);
      end_transmittance_.pixel(x, y) = abs(tile.saved.final_transmittance[index]);
      // The tails' sum is held constant. So it stands in front of all pairs, with the background's colour.
      const S tails = Blend<kMode>::kTails ? tile.saved.tails[index] : S(0);
      gate_sum_.pixel(x, y) = tails;
      end_gate_sum_.pixel(x, y) = tile.saved.gate_sum[index] + tails;
      weight_.pixel(x, y) = map_.pixel_weights[index];
      share_weight_.pixel(x, y) = map_.share_weights[index];
      for (int c = 0; c < num_channels_; ++c) {
        const S value = map_.color[c * pixels + index], distance = background_[c] - value;
        value_of(c).pixel(x, y) = value;
        front_of(c).pixel(x, y) = tails > S(0) ? tails * distance : S(0);
        alone_.pixel(x, y) += distance * distance;
      }
      num_seen = max<int64_t>(num_seen, tile.saved.last_contributor[index]);
    });
    return num_seen;
  }

  DSMOE_HD void expect(uint32_t slot) const { __builtin_prefetch(records_ + slot, 1); }
  DSMOE_HD Importance<P> begin(const ListedGaussian<S>& gaussian) {
    features_ = gaussian.features;
    position_ = P(gaussian.position);
    return {};
  }
  DSMOE_HD bool wanted(int at, Mask<P>& not_past) const {
    not_past = position_ < last_.load(at);
    return !Blend<kMode>::kStopsEarly || any(not_past);
  }

  template <class Pairs> DSMOE_HD void take(int at, const Pairs& pairs, Mask<P> not_past, Importance<P>& sum) const {
    PixelState<P> state = {transmittance_.load(at), gate_sum_.load(at)};
    const PixelEnd<P> end = {end_transmittance_.load(at), end_gate_sum_.load(at), lambda_, P(S(0))};
    const auto removal = remove_pair<kMode>(state, end, pairs.gate, not_past);
    transmittance_.store(at, state.transmittance);
    gate_sum_.store(at, state.gate_sum);
    P squared = S(0);
    for (int c = 0; c < num_channels_; ++c) {
      const P value = value_of(c).load(at), distance = P(features_[c]) - value;
      const P front = front_of(c).load(at);
      const P change = channel_change<kMode>(removal, distance, front, value);
      squared = fma(change, change, squared);
      front_of(c).store(at, fma(removal.weight, distance, front));
    }
    add_pair(sum, removal, squared, alone_.load(at), share_weight_.load(at), weight_.load(at));
  }

  DSMOE_HD void end(const ListedGaussian<S>& gaussian, const Importance<P>& sum) const {
    records_[gaussian.slot] = {sum_lanes(sum.share), sum_lanes(sum.squared_share), sum_lanes(sum.removal_cost)};
  }
  DSMOE_HD void skip(uint32_t slot) const { records_[slot] = {}; }

 private:
  DSMOE_HD PixelArray<S> value_of(int c) const { return {channels_.values + 2 * c * kTilePixels}; }
  DSMOE_HD PixelArray<S> front_of(int c) const { return {channels_.values + (2 * c + 1) * kTilePixels}; }

  const int num_channels_;
  const S* const background_;
  const S lambda_;
  const PixelArray<S> transmittance_, gate_sum_, last_, end_transmittance_, end_gate_sum_, weight_, share_weight_;
  const PixelArray<S> alone_;     // |bg - C|^2
  const PixelArray<S> channels_;  // two arrays a channel: C, and A
  const ImportanceMap<S>& map_;
  Importance<S>* const records_;
  const S* features_ = nullptr;
  P position_;
};

template <class S, BlendMode kMode, int kFeatures>
int64_t importance_of_tile(const Tile<S>& tile, const ImportanceMap<S>& map, Importance<S>* records, S* memory) {
  Scratch<S> scratch = {memory};
  const WidePixels<kMode, S> wide(tile, scratch.pixels());
  ImportanceVisitor<S, kMode, kFeatures> visitor(tile, scratch, map, records);
  const int64_t num_seen = visitor.read(tile);
  const int64_t end = Blend<kMode>::kStopsEarly ? tile.begin + num_seen : tile.end;
  for (int64_t i = end; i < tile.end; ++i) visitor.skip(tile.saved.instances[i].slot);
  return walk_tile(tile, tile.begin, end, tile.config.num_features(), wide, visitor);
}

template <class S>
int64_t pass(const Tile<S>& tile, const ImportancePass<S>& pass, Importance<S>* records, S* scratch) {
  int64_t pairs = 0;
  dispatch_blend(tile.config.blend.mode, tile.config.num_channels, [&](auto mode, auto channels) {
    constexpr BlendMode kMode = decltype(mode)::value;
    constexpr int kChannels = decltype(channels)::value;
    if constexpr (kRemovable<kMode>) pairs = importance_of_tile<S, kMode, kChannels>(tile, pass.map, records, scratch);
  });
  return pairs;
}

}  // namespace DSMOE_SIMD
}  // namespace cpu
}  // namespace dsmoe

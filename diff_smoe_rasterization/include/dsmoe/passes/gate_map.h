// Which Gaussian has the greatest gate in each pixel, which one is the median, and how many contribute. All gates of a
// pixel have one denominator, so the greatest weight is the greatest gate.
#pragma once

#include <cmath>

#include "dsmoe/params.h"
#include "dsmoe/passes/pass.h"
#include "dsmoe/pixel.h"

namespace dsmoe {

// Per pixel; all are written whole.
struct GateMap {
  int32_t* gaussians = nullptr;  // [H, W] the one with the greatest gate, the nearest of equal ones; -1 if none is
  int32_t* counts = nullptr;     // [H, W] how many Gaussians the numerator has
  // [H, W] the one with which the weights, in the order of the list, reach half of the denominator; -1 where none does.
  // Or null
  int32_t* medians = nullptr;
};

template <class S> struct GateMapPass {
  template <class Real> struct State {
    Real greatest;       // weight so far
    Whole<Real> seen;    // entries of the list up to its Gaussian; 0: none yet
    Whole<Real> count;   // pairs that contributed
    Real missing;        // weight to half of the pixel's denominator; 0 or less: it is reached
    Whole<Real> median;  // entries up to the Gaussian that reached it; 0: none yet

    static constexpr int kNum = 5;
    template <class Visit> DSMOE_HD void for_each(Visit visit) {
      visit(greatest), visit(seen), visit(count), visit(missing), visit(median);
    }
  };
  template <class Real> using Sums = NoSums;

  template <class Visit> void arrays(Visit visit, int64_t) const {
    visit("gaussians", map.gaussians, "[H, W]", 1);
    visit("counts", map.counts, "[H, W]", 1);
    const bool median = map.medians != nullptr;
    visit("saved.gate_sum", gate_sum, "[H, W]", median);
    visit("saved.tails", saved_tails, "[H, W]", median && has_tails(blend.mode));
  }
  template <BlendMode kMode> DSMOE_HD State<S> begin(int64_t pixel) const {
    State<S> state = {};
    if (map.medians == nullptr) return state;
    const S tails = Blend<kMode>::kTails ? saved_tails[pixel] : S(0);
    const PixelEnd<S> end = {abs(final_transmittance[pixel]), gate_sum[pixel], blend.lambda(), tails};
    const auto by = feature_end<kMode>(FeatureRule::kBlended, end);
    state.missing = by.open ? by.denominator / S(2) : S(INFINITY);
    return state;
  }
  template <BlendMode kMode, class Real>
  DSMOE_HD Mask<Real> visit(PixelState<Real>& walked, State<Real>& state, const WalkedPair<Real>& pair, NoSums&) const {
    const Real zero = Scalar<Real>(0);
    const auto blended = Blend<kMode>::accumulate(walked, pair.gate);
    const Mask<Real> greater = blended.contributes & (blended.weight > state.greatest);
    state.count = state.count + select(blended.contributes, Whole<Real>(1), Whole<Real>(0));
    state.greatest = select(greater, blended.weight, state.greatest);
    state.seen = select(greater, pair.seen, state.seen);
    const Real missing = state.missing - blended.weight;  // whose weight is 0 where it does not contribute
    state.median = select((state.missing > zero) & (missing <= zero), pair.seen, state.median);
    state.missing = missing;
    return greater;
  }
  template <class GaussianAt> DSMOE_HD void end(const State<S>& state, int64_t pixel, GaussianAt gaussian_at) const {
    map.gaussians[pixel] = state.seen > 0 ? gaussian_at(state.seen - 1) : -1;
    map.counts[pixel] = state.count;
    if (map.medians != nullptr) map.medians[pixel] = state.median > 0 ? gaussian_at(state.median - 1) : -1;
  }

  GateMap map;
  // What the rendering kept of its pixels, [H, W] each.
  const S *final_transmittance, *gate_sum, *saved_tails;
  BlendRules<S> blend;
};

template <class S, class Frame> GateMapPass<S> gate_map_pass(const Frame& frame, const GateMap& map) {
  return {map, frame.saved.final_transmittance, frame.saved.gate_sum, frame.saved.tails, frame.config.blend};
}

}  // namespace dsmoe

// Which Gaussian has the greatest gate in each pixel, and how many contribute. All gates of a pixel have one
// denominator, so the greatest weight is the greatest gate.
#pragma once

#include "dsmoe/params.h"
#include "dsmoe/passes/pass.h"

namespace dsmoe {

template <class S> struct GateMapPass {
  template <class Real> struct State {
    Real greatest;      // weight so far
    Whole<Real> seen;   // entries of the list up to its Gaussian; 0: none yet
    Whole<Real> count;  // pairs that contributed

    static constexpr int kNum = 3;
    template <class Visit> DSMOE_HD void for_each(Visit visit) { visit(greatest), visit(seen), visit(count); }
  };
  template <class Real> using Sums = NoSums;

  template <BlendMode kMode, class Real>
  DSMOE_HD Mask<Real> visit(PixelState<Real>& walked, State<Real>& state, const WalkedPair<Real>& pair, NoSums&) const {
    const auto blended = Blend<kMode>::accumulate(walked, pair.gate);
    const Mask<Real> greater = blended.contributes & (blended.weight > state.greatest);
    state.count = state.count + select(blended.contributes, Whole<Real>(1), Whole<Real>(0));
    state.greatest = select(greater, blended.weight, state.greatest);
    state.seen = select(greater, pair.seen, state.seen);
    return greater;
  }
  template <class GaussianAt> DSMOE_HD void end(const State<S>& state, int64_t pixel, GaussianAt gaussian_at) const {
    map.gaussians[pixel] = state.seen > 0 ? gaussian_at(state.seen - 1) : -1;
    map.counts[pixel] = state.count;
  }

  GateMap map;
};

}  // namespace dsmoe

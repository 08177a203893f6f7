// What one (Gaussian, pixel) pair adds to the sums that score its Gaussian. The sums say how much of an image, or of a
// map over it, is due to the Gaussian. Only pairs that the blend took count, with their weight in the numerator of the
// blend mode.
#pragma once

#include "dsmoe/params.h"
#include "dsmoe/passes/pass.h"

namespace dsmoe {

template <class Real> struct Contribution {
  Real pixels;        // 1
  Real pixel_weight;  // of the pixel, in a map of the caller's
  Real blend_weight;  // w: alpha T; alpha in smoe_std
  Real distance;      // from the pixel to the Gaussian's centre, pixels

  static constexpr int kNum = 4;
  template <class Visit, class... Sums> static DSMOE_HD void for_each(Visit visit, Sums&... of) {
    visit(of.pixels...), visit(of.pixel_weight...), visit(of.blend_weight...), visit(of.distance...);
  }
};

// (dx, dy): pixel - centre.
template <class Real>
DSMOE_HD void add_pair(Contribution<Real>& sum, Mask<Real> contributes, Real pixel_weight, Real weight, Real dx,
                       Real dy) {
  const Real zero = Scalar<Real>(0), one = Scalar<Real>(1);
  sum.pixels = sum.pixels + select(contributes, one, zero);
  sum.pixel_weight = sum.pixel_weight + select(contributes, pixel_weight, zero);
  sum.blend_weight = sum.blend_weight + select(contributes, weight, zero);
  sum.distance = sum.distance + select(contributes, sqrt(fma(dx, dx, dy * dy)), zero);
}

// Where the sums go; written whole.
template <class S> struct ContributionSums {
  S* pixel_weights = nullptr;  // [N]
  int32_t* pixels = nullptr;   // [N]
  S* blend_weights = nullptr;  // [N]
  S* distances = nullptr;      // [N] pixels
};

// From a map of the image to sums over the pixels of each Gaussian.
template <class S> struct ContributionMap {
  const S* pixel_weights = nullptr;  // [H, W]
  ContributionSums<S> sums;
};

template <class S> struct ContributionPass {
  template <class Real> struct State {
    Real weight;  // of the pixel, in the caller's map

    static constexpr int kNum = 1;
    template <class Visit> DSMOE_HD void for_each(Visit visit) { visit(weight); }
  };
  template <class Real> using Sums = Contribution<Real>;
  static constexpr bool kCounts = true;

  template <class Visit> void arrays(Visit visit, int64_t count) const {
    visit("pixel_weights", map.pixel_weights, "[H, W]", 1);
    visit("sums.pixel_weights", map.sums.pixel_weights, "[N]", count);
    visit("sums.pixels", map.sums.pixels, "[N]", count);
    visit("sums.blend_weights", map.sums.blend_weights, "[N]", count);
    visit("sums.distances", map.sums.distances, "[N]", count);
  }
  SumTargets<S> targets() const {
    return {{map.sums.pixel_weights, map.sums.blend_weights, map.sums.distances}, 3, map.sums.pixels};
  }
  template <BlendMode kMode> DSMOE_HD State<S> begin(int64_t pixel) const { return {map.pixel_weights[pixel]}; }
  template <BlendMode kMode, class Real>
  DSMOE_HD Mask<Real> visit(PixelState<Real>& walked, const State<Real>& state, const WalkedPair<Real>& pair,
                            Contribution<Real>& sum) const {
    const auto blended = Blend<kMode>::accumulate(walked, pair.gate);
    const Mask<Real> contributes = blended.contributes & pair.blended;
    add_pair(sum, contributes, state.weight, blended.weight, pair.dx, pair.dy);
    return contributes;
  }

  ContributionMap<S> map;
};

}  // namespace dsmoe

// What a Gaussian has in a pixel, and what the pixel would be without it: for each pair, front to back.
//
// Without pair k what lies behind it is seen through no alpha_k: with q_k = alpha_k / (1 - alpha_k), its weights and
// the transmittance T are multiplied by 1 + q_k. With C and D as in blend.h,
//
//   D'_k = sum_{j<k} w_j + (1 + q_k) (sum_{j>k} w_j + lambda T)
//   C'_k - C = (q_k (sum_{j>k} w_j (c_j - C) + lambda T (bg - C)) - w_k (c_k - C)) / D'_k
//
// All w_j (c_j - C) and lambda T (bg - C) together are 0. So one walk front to back knows what lies behind from the sum
// A_k = sum_{j<k} w_j (c_j - C) of what lies in front:
//
//   C'_k - C = -((1 + q_k) w_k (c_k - C) + q_k A_k) / D'_k
//
// In `smoe` the sum B of the tails is held constant. So B (bg - C) and B stand in front of all pairs, in A_k and D'_k.
//
// If the denominator counts weights, (1 + q_k) w_k is q_k T_k with T_k in front of the pair. So all channels share a
// factor, and its reciprocal needs no other one:
//
//   C'_k - C = -alpha_k (T_k (c_k - C) + A_k) / ((1 - alpha_k) D'_k)
//
// The ablations divide by sum alpha, which loses alpha_k. In smoe_std Gaussians do not occlude, so q_k is 0.
// A pixel that no other Gaussian and no background's gate is in shows the background's colour. This is exact but for
// Gaussians behind a pixel's early stop, which are not walked, and for owners behind a pair that have less than
// 1e-6 of W in float: their weights are lost in the rounding of W. In smoe_tn that is 1e-6 of sum alpha, divided by
// 1 - alpha_k. C' - C also errs by the rounding of C, divided by what is left of D: by (1 - alpha_k) D'_k / D.
#pragma once

#include "dsmoe/pixel.h"

namespace dsmoe {

// What is summed over the pixels of each Gaussian, each number times a weight of the pixel's.
template <class Real> struct Importance {
  Real share;          // f = w / D: how the pixel's colour follows the Gaussian's
  Real squared_share;  // f^2
  Real removal_cost;   // |C' - C|^2, summed over the channels

  static constexpr int kNum = 3;
  template <class Visit, class... Sums> static DSMOE_HD void for_each(Visit visit, Sums&... of) {
    visit(of.share...), visit(of.squared_share...), visit(of.removal_cost...);
  }
};

// A pair's removal. C' - C is channel_change if something is left, and else bg - C.
template <class Real> struct Removal {
  Mask<Real> takes;  // the pair has a part in the pixel
  Real weight;       // w
  Real share;        // f
  Real scale;        // of all channels
  Real own;          // of c - C
  Real front;        // of A: in the ablations
  Real value;        // of C: in smoe_tn
  Mask<Real> left;   // something else is in the pixel
};

// total - part. Nothing if that may be the rounding of two sums of equal terms, since a pixel's only owner has to be
// known: two kernels may contract operations otherwise. magnified: how many times that rounding.
template <class Real> DSMOE_HD Real rest_of(Real total, Real part, Real magnified) {
  using S = Scalar<Real>;
  constexpr S kRounding = sizeof(S) == sizeof(float) ? S(0x1p-20) : S(0x1p-49);  // of 8 operations
  const Real rest = total - part;
  return select(rest > total * Real(kRounding) * magnified, rest, Real(S(0)));
}

// Whether the algebra above holds in the mode. If it does not, `importance` refuses the mode.
template <BlendMode kMode> constexpr bool kRemovable = Blend<kMode>::kLaw == Law::kGates;

// Moves `state` past a pair. end: the pixel behind its last pair. wanted: the walk has not passed the pixel's last
// pair.
template <BlendMode kMode, class Real>
DSMOE_HD Removal<Real> remove_pair(PixelState<Real>& state, const PixelEnd<Real>& end, const Gate<Real>& gate,
                                   Mask<Real> wanted) {
  static_assert(kRemovable<kMode>, "another law needs its own C' - C, derived as at the top: ask kRemovable first");
  using S = Scalar<Real>;
  constexpr bool kSeesThrough = Blend<kMode>::kNeedsDepthOrder, kCountsWeights = Blend<kMode>::kStopsEarly;
  const Real zero = S(0), one = S(1);
  const auto by = feature_end<kMode>(FeatureRule::kBlended, end);
  const PixelState<Real> before = state;
  const auto pair = Blend<kMode>::accumulate(state, gate);
  const Mask<Real> blended = pair.contributes & wanted;
  Removal<Real> out;
  out.takes = by.open & (kSeesThrough && !kCountsWeights ? gate.counts : blended);
  out.weight = select(blended, pair.weight, zero);
  out.share = out.weight * reciprocal(select(by.open, by.denominator, one));
  out.front = out.value = zero;
  const Real rest = one - gate.alpha;
  if constexpr (!Blend<kMode>::kDivides) {
    out.left = before.transmittance >= zero;
    out.own = before.transmittance;
    out.scale = -gate.alpha * reciprocal(rest);
    return out;
  }
  // In smoe_tn the sums of the numerator are multiplied by 1 / (1 - alpha), and the one that divides them is not.
  const Real inverse_rest = reciprocal(rest), magnified = kSeesThrough && !kCountsWeights ? inverse_rest : one;
  const Real behind = rest_of(end.gate_sum, state.gate_sum, magnified) + by.weight;
  const Real sum = kCountsWeights ? fma(rest, before.gate_sum, behind) : before.gate_sum + behind;
  out.left = sum >= (kCountsWeights ? Real(S(kGateSumCut)) * rest : Real(S(kGateSumCut)));
  const Real inverse = reciprocal(select(out.left, sum, one));
  // With nothing behind, what is left is what lies in front, and no digit of it is lost to c - C.
  const Mask<Real> hides = behind > zero;
  if constexpr (kCountsWeights) {
    out.own = select(hides, before.transmittance, zero);
    out.scale = select(hides, -gate.alpha, rest) * inverse;
  } else if constexpr (kSeesThrough) {
    const Real odds = select(blended, gate.alpha * inverse_rest, zero), front = before.gate_sum;
    // With nothing behind, C' is A + C sum_{j<k} w_j, divided by F = sum_{j<k} alpha_j. That sum of w is 1 - T, which
    // is in F - F^2 / 2 to F. For a faint F the difference would be the rounding of T.
    const Real by_front = one - abs(before.transmittance) - front;
    out.own = select(hides, -fma(odds, out.weight, out.weight), zero);
    out.front = select(hides, -odds, one);
    out.value =
        select(hides, fma(odds, end.gate_sum - one, gate.alpha), clamp(by_front, Real(S(-0.5)) * front * front, zero));
    out.scale = inverse;
  } else {
    out.own = select(hides, -out.weight, zero);
    out.front = select(hides, zero, one);
    out.scale = inverse;
  }
  return out;
}

// distance: c - C; front: A; value: C; of one channel. The scale joins before anything is squared: it is up to 1e30,
// for a sum that is as small.
template <BlendMode kMode, class Real>
DSMOE_HD Real channel_change(const Removal<Real>& removal, Real distance, Real front, Real value) {
  if constexpr (Blend<kMode>::kStopsEarly) return removal.scale * fma(removal.own, distance, front);
  const Real motion = fma(removal.own, distance, removal.front * front);
  return removal.scale * (Blend<kMode>::kNeedsDepthOrder ? fma(removal.value, value, motion) : motion);
}

// squared: C' - C if something is left, of all channels. alone: |bg - C|^2. share_weight, weight: of the pixel, in
// maps of the caller's.
template <class Real>
DSMOE_HD void add_pair(Importance<Real>& sum, const Removal<Real>& removal, Real squared, Real alone, Real share_weight,
                       Real weight) {
  const Real squared_change = select(removal.left, squared, alone);
  sum.share = select(removal.takes, fma(share_weight, removal.share, sum.share), sum.share);
  sum.squared_share =
      select(removal.takes, fma(weight * removal.share, removal.share, sum.squared_share), sum.squared_share);
  sum.removal_cost = select(removal.takes, fma(weight, squared_change, sum.removal_cost), sum.removal_cost);
}

}  // namespace dsmoe

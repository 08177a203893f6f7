// One (Gaussian, pixel) pair: the projected kernel G (Eq. 1, 2), the gate alpha = min(0.99, o G), whether the pair
// counts, and the derivatives by its inputs.
#pragma once

#include "dsmoe/constants.h"
#include "dsmoe/vec.h"

namespace dsmoe {

// Which pairs count.
enum class Cut {
  kAlpha,   // 3DGS: alpha >= 1/255
  kStrong,  // the paper's authors: alpha >= 1/2040, or the caller's least alpha. Weaker pairs are tails
  kKernel,  // the paper's text: G >= 1e-5, and the least alpha below
};

// The factors of d.x^2, d.x d.y and d.y^2 in the exponent -1/2 d^T Sigma2D^-1 d, where d = pixel - mean.
template <class S> struct ExponentFactors {
  S xx, xy, yy;

  ExponentFactors() = default;
  DSMOE_HD explicit ExponentFactors(const Sym2<S>& conic)
      : xx(S(-0.5) * conic.xx), xy(-conic.xy), yy(S(-0.5) * conic.yy) {}
};

// The exponent along one column of pixels: d.x is the same for all of them.
template <class Real, class S> struct ColumnExponent {
  Real constant, linear;
  S quadratic;

  DSMOE_HD ColumnExponent(const ExponentFactors<S>& factors, Real dx)
      : constant(Real(factors.xx) * dx * dx), linear(Real(factors.xy) * dx), quadratic(factors.yy) {}
  DSMOE_HD ColumnExponent(const Sym2<S>& conic, Real dx) : ColumnExponent(ExponentFactors<S>(conic), dx) {}
  // With `offset` added to the exponent.
  DSMOE_HD ColumnExponent(const ExponentFactors<S>& factors, Real dx, S offset)
      : constant(fma(Real(factors.xx) * dx, dx, Real(offset))), linear(Real(factors.xy) * dx), quadratic(factors.yy) {}

  DSMOE_HD Real at(Real dy) const { return fma(fma(Real(quadratic), dy, linear), dy, constant); }
};

// The least alpha that counts, in addition to the cut.
template <class S> struct AlphaCut {
  S alpha_min;  // the caller's
  S faint;      // if pairs are cut by G: lambda / 255, and nothing inside 3 sigma

  DSMOE_HD AlphaCut(S alpha_min, S lambda) : alpha_min(alpha_min), faint(static_cast<float>(lambda) * kAlphaCut) {}
  DSMOE_HD S of(S opacity) const { return max(alpha_min, min(faint, opacity * S(kCoreKernel))); }
};

// The squared reach k^2 of a Gaussian that no pixel sees: still negative when a tail's reach is added.
constexpr float kNoReach = -1e30f;

// The squared reach k^2 of a Gaussian of this opacity: no pair with d^T Sigma2D^-1 d > k^2 counts. If it is negative
// no pair counts.
template <class S> DSMOE_HD S squared_reach(Cut cut, S opacity, S least_alpha) {
  if (!(opacity > S(0))) return S(kNoReach);
  if (cut == Cut::kAlpha) least_alpha = S(kAlphaCut);
  if (cut == Cut::kStrong) least_alpha = max(least_alpha, S(kStrongAlpha));
  const S by_alpha = S(2) * log(opacity / least_alpha);
  if (cut != Cut::kKernel) return by_alpha;
  const S by_gate = S(-2) * log(S(kGateCut));
  return least_alpha > S(0) ? min(by_gate, by_alpha) : by_gate;
}

// Pixels from a footprint's centre within which every pixel lies that feels it in any mode, by its tails too. radius:
// 3 sigma along the longer axis.
template <class S> DSMOE_HD S pixel_reach(S radius, S opacity, S squared_reach) {
  const S by_tail = opacity > S(0) ? S(2) * log(opacity / S(kEveryTailAlpha)) : S(kNoReach);
  return radius * sqrt(max(S(9), max(by_tail, squared_reach))) / S(3);
}

// A pair that counts is near if alpha >= 1/255, and within 3 sigma if alpha >= 1/1020; else it is faint. A mode
// with kNearFirst blends the faint pairs of a pixel only where its near pairs have a small gate sum.
//
// The least alpha of a near pair. least_alpha: of a pair that counts.
template <class S> DSMOE_HD S near_alpha(S opacity, S least_alpha) {
  return max(least_alpha, min(S(kAlphaCut), max(S(kCoreAlpha), opacity * S(kCoreKernel))));
}

// The squared reach of a Gaussian's near pairs. squared_reach: of all its pairs.
template <class S> DSMOE_HD S near_reach(S opacity, S squared_reach) {
  if (!(opacity > S(0))) return squared_reach;
  const S outer = S(2) * log(opacity / S(kAlphaCut));  // kCoreAlpha is a quarter of kAlphaCut
  return min(squared_reach, max(outer, min(outer + S(4 * kLn2), S(-2 * kLn2 * kLog2CoreKernel))));
}

template <class Real> struct Gate {
  Real logit;         // o G, before the clamp
  Real alpha;         // min(0.99, o G)
  Mask<Real> counts;  // the pair takes part
  static constexpr bool kClamps = true;
};

// One whose alpha is o G.
template <class Real> struct UnclampedGate : Gate<Real> { static constexpr bool kClamps = false; };

// The alpha of a pair that is a tail; 0 if it is strong, or below tail_alpha (BlendRules). counts: by Cut::kStrong.
template <class Real> DSMOE_HD Real tail_of(const Gate<Real>& gate, Mask<Real> inside, Scalar<Real> tail_alpha) {
  using S = Scalar<Real>;
  const Mask<Real> felt = inside & (gate.logit >= Real(tail_alpha));
  return select(gate.counts, Real(S(0)), select(felt, gate.logit, Real(S(0))));
}

template <class Real> DSMOE_HD Real clamped(Real logit) { return min(logit, Real(Scalar<Real>(kAlphaMax))); }

template <Cut kCut, class Real, class S> DSMOE_HD Gate<Real> evaluate_gate(Real power, S opacity, S least_alpha) {
  // If the exponent is above 0 the conic is not an ellipse. Such a pair does not count, and must not overflow either.
  const Real kernel = exp(min(power, Real(S(0))));
  Gate<Real> gate;
  gate.logit = Real(opacity) * kernel;
  gate.alpha = clamped(gate.logit);
  if constexpr (kCut == Cut::kAlpha) {
    gate.counts = (power <= Real(S(0))) & (gate.logit >= Real(S(kAlphaCut)));
  } else if constexpr (kCut == Cut::kStrong) {
    gate.counts = (power <= Real(S(0))) & (gate.logit >= Real(max(least_alpha, S(kStrongAlpha))));
  } else {
    gate.counts = (power <= Real(S(0))) & (kernel >= Real(S(kGateCut))) & (gate.logit >= Real(least_alpha));
  }
  return gate;
}

// A Gaussian as kernels read it for each of its pixels: log2(o G) is one quadratic form, and which pairs count is two
// comparisons with it. opacity: above 0, as of every Gaussian that reaches a pixel.
template <class S> struct LogGate {
  ExponentFactors<S> factors;  // times log2(e)
  S greatest;                  // log2(o)
  S least;                     // of a pair that counts

  LogGate() = default;
  DSMOE_HD LogGate(const Sym2<S>& conic, S opacity, S squared_reach)
      : factors({S(kLog2E) * conic.xx, S(kLog2E) * conic.xy, S(kLog2E) * conic.yy}),
        greatest(log2(opacity)),
        least(fma(S(-0.5 * kLog2E), squared_reach, greatest)) {}

  template <class Real> DSMOE_HD ColumnExponent<Real, S> column(Real dx) const { return {factors, dx, greatest}; }

  // As near_alpha. Unchanged if `least` is a near pair's already.
  DSMOE_HD S near_least() const {
    return max(least, min(S(kLog2AlphaCut), max(S(kLog2CoreAlpha), greatest + S(kLog2CoreKernel))));
  }

  // Above log2(o) the conic is not an ellipse. Such a pair does not count. least: the least logit that counts.
  template <class Real> DSMOE_HD Gate<Real> evaluate(Real log_logit, Real least) const {
    Gate<Real> gate;
    gate.logit = exp2(log_logit);
    gate.alpha = clamped(gate.logit);
    gate.counts = (log_logit >= least) & inside(log_logit);
    return gate;
  }
  template <class Real> DSMOE_HD Gate<Real> evaluate(Real log_logit) const { return evaluate(log_logit, Real(least)); }
  template <class Real> DSMOE_HD Mask<Real> inside(Real log_logit) const { return log_logit <= Real(greatest); }
};

// Sums over pixels of dL/dpower times 1, d.x, d.y, d.x^2, d.x d.y and d.y^2. The gradients of a Gaussian's shape on the
// image need nothing else.
template <class S> struct GateMoments { S one, x, y, xx, xy, yy; };
constexpr int kNumGateMoments = 6;

// The same sums about another centre: every d becomes d + shift.
template <class S> DSMOE_HD GateMoments<S> shift_moments(const GateMoments<S>& m, Vec2<S> shift) {
  const S x = m.x + shift.x * m.one, y = m.y + shift.y * m.one;
  return {m.one, x, y, m.xx + shift.x * (m.x + x), m.xy + shift.x * m.y + shift.y * x, m.yy + shift.y * (m.y + y)};
}

// dpower/dmean of one pair, from the same derivative as moments_backward; d: pixel - mean.
template <class Real, class S> DSMOE_HD Vec2<Real> power_by_mean(const ExponentFactors<S>& factors, Real dx, Real dy) {
  const Real by_x = fma(Real(S(2) * factors.xx), dx, Real(factors.xy) * dy);
  const Real by_y = fma(Real(factors.xy), dx, Real(S(2) * factors.yy) * dy);
  return {-by_x, -by_y};
}

// Sums over pixels of |dL/dmean|, each axis apart: they do not cancel if pixels pull a centre to and fro.
constexpr int kNumAbsoluteSums = 2;

template <class S> struct GateGradient {
  Vec2<S> mean;   // by the pixel position of the centre
  Sym2<S> conic;  // by the three stored numbers
  S opacity;
};

// power = -1/2 (xx dx^2 + yy dy^2) - xy dx dy, and o dL/do = dL/dpower.
template <class S> DSMOE_HD GateGradient<S> moments_backward(const Sym2<S>& conic, S opacity, const GateMoments<S>& m) {
  return {{conic.xx * m.x + conic.xy * m.y, conic.xy * m.x + conic.yy * m.y},
          {S(-0.5) * m.xx, -m.xy, S(-0.5) * m.yy},
          opacity > S(0) ? m.one / opacity : S(0)};
}

}  // namespace dsmoe

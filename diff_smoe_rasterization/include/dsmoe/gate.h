// One (Gaussian, pixel) pair: the projected kernel G (Eq. 1, 2), the gate alpha = min(0.99, o G), whether the pair
// counts, and the derivatives by all that the pair was made of.
#pragma once

#include "dsmoe/constants.h"
#include "dsmoe/vec.h"

namespace dsmoe {

// Which pairs count.
enum class Cut {
  kAlpha,   // 3DGS: those of alpha >= 1/255
  kKernel,  // the paper: those of G >= 1e-5, and of the least alpha below
};

// A conic by the coefficients of the exponent: xx dx^2 + xy dx dy + yy dy^2.
template <class S> struct ExponentForm {
  S xx, xy, yy;
  ExponentForm() = default;
  DSMOE_HD explicit ExponentForm(const Sym2<S>& conic)
      : xx(S(-0.5) * conic.xx), xy(-conic.xy), yy(S(-0.5) * conic.yy) {}
};

// The exponent -1/2 d^T Sigma2D^-1 d along one column of pixels. d = pixel - mean; d.x is the same for all of them.
template <class Real, class S> struct ColumnExponent {
  Real constant, linear;
  S quadratic;

  DSMOE_HD ColumnExponent(const ExponentForm<S>& form, Real dx)
      : constant(form.xx * dx * dx), linear(form.xy * dx), quadratic(form.yy) {}
  DSMOE_HD ColumnExponent(const Sym2<S>& conic, Real dx) : ColumnExponent(ExponentForm<S>(conic), dx) {}

  DSMOE_HD Real at(S dy) const { return fma(fma(Real(quadratic), Real(dy), linear), Real(dy), constant); }
};

// The least alpha that counts where pairs are cut by G.
template <class S> struct AlphaCut {
  S alpha_min;  // the caller's
  S faint;      // lambda / 255, and nothing inside 3 sigma

  DSMOE_HD AlphaCut(S alpha_min, S background_gate)
      : alpha_min(alpha_min), faint(static_cast<float>(background_gate) * kAlphaCut) {}
  DSMOE_HD S of(S opacity) const { return max(alpha_min, min(faint, opacity * S(kCoreKernel))); }
};

// The squared reach k^2 of a Gaussian of this opacity: no pair with d^T Sigma2D^-1 d > k^2 counts. Where it is negative
// no pair counts.
template <class S> DSMOE_HD S squared_reach(Cut cut, S opacity, S least_alpha) {
  if (!(opacity > S(0))) return S(-1);
  const S by_alpha = S(2) * log(opacity / (cut == Cut::kAlpha ? S(kAlphaCut) : least_alpha));
  if (cut == Cut::kAlpha) return by_alpha;
  const S by_gate = S(-2) * log(S(kGateCut));
  return least_alpha > S(0) ? min(by_gate, by_alpha) : by_gate;
}

template <class Real> struct Gate {
  Real logit;         // o G, before the clamp
  Real alpha;         // min(0.99, o G)
  Mask<Real> counts;  // the pair takes part
};

template <Cut kCut, class Real, class S> DSMOE_HD Gate<Real> evaluate_gate(Real power, S opacity, S least_alpha) {
  // Where the exponent is above 0 the conic is no ellipse. Such a pair does not count, and must not overflow either.
  const Real kernel = exp(min(power, Real(S(0))));
  Gate<Real> gate;
  gate.logit = Real(opacity) * kernel;
  gate.alpha = min(gate.logit, Real(S(kAlphaMax)));
  if constexpr (kCut == Cut::kAlpha) {
    gate.counts = (power <= Real(S(0))) & (gate.alpha >= Real(S(kAlphaCut)));
  } else {
    gate.counts = (power <= Real(S(0))) & (kernel >= Real(S(kGateCut))) & (gate.logit >= Real(least_alpha));
  }
  return gate;
}

// dL/dpower from gamma = alpha dL/dalpha. The clamp passes the gradient straight through, as Inria's rasterizer does
// and a drop-in must: dL/dpower = o G dL/dalpha.
template <class Real> DSMOE_HD Real gate_backward(const Gate<Real>& gate, Real gamma) {
  return gamma * max(Real(Scalar<Real>(1)), gate.logit * Real(Scalar<Real>(1.0 / kAlphaMax)));
}

// Sums over pixels of dL/dpower times 1, d.x, d.y, d.x^2, d.x d.y and d.y^2. The gradients of a Gaussian's shape on the
// image need nothing else.
template <class S> struct GateMoments { S one, x, y, xx, xy, yy; };
constexpr int kNumGateMoments = 6;

// The same sums about another centre: every d becomes d + shift.
template <class S> DSMOE_HD GateMoments<S> shift_moments(const GateMoments<S>& m, Vec2<S> shift) {
  const S x = m.x + shift.x * m.one, y = m.y + shift.y * m.one;
  return {m.one, x, y, m.xx + shift.x * (m.x + x), m.xy + shift.x * m.y + shift.y * x, m.yy + shift.y * (m.y + y)};
}

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

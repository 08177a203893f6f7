// The blend modes. Each is a small policy: `accumulate` takes a pair front to back and returns its weight,
// `background_gate` and `kDivides` make the pixel of the sums, `backward` takes the pairs back to front.
//
// With alpha_i the gate logit, T_i = prod_{j<i} (1 - alpha_j) (Eq. 4), c_i the expert, w_i = alpha_i T_i, W = sum w_i
// and T what is left behind the last pair:
//
//   alpha     Eq. 3   C = sum c_i w_i + T bg
//   smoe      Eq. 7   C = sum c_i w_i / W
//   smoe_tn   Eq. 8   C = sum c_i w_i / sum alpha_i
//   smoe_std  Eq. 6   C = sum c_i alpha_i / sum alpha_i
//
// The first two are the ends of a family, in which the background is one more expert, with the gate lambda:
//
//   C = (sum c_i w_i + lambda T bg) / D,   D = W + lambda T         (smoe at 0; alpha at 1, where D is 1)
//
// Gradients are formed as gamma_i = alpha_i dL/dalpha_i: dL/dalpha grows like 1 / D, gamma stays bounded. With
// g' = dL/dC / D, u_i = g'.c_i - b and the suffix R_i = sum_{j>i} w_j u_j, which begins at lambda T (g'.bg - b):
//
//   gamma_i = w_i u_i - alpha_i / (1 - alpha_i) R_i,   dL/dc_i = w_i g'
//
// where b is g'.C: the pixel's own colour is what each expert is measured against. At lambda = 1 all terms in b cancel,
// and alpha leaves them out. DEVELOPING.md says what else a new mode needs.
#pragma once

#include "dsmoe/gate.h"

namespace dsmoe {

// A pixel behind its last pair.
template <class Real> struct PixelEnd {
  Real transmittance;            // T
  Real gate_sum;                 // W; ablations: sum alpha
  Scalar<Real> background_gate;  // lambda
};

// The running sums of a pixel. The sign of the transmittance says whether the pixel still takes pairs: it is never 0,
// because a pixel closes at kTransmittanceCut.
template <class Real> struct PixelState {
  Real transmittance;  // T; negative once the pixel is full
  Real gate_sum;       // W, accumulated: as 1 - T it would lose all digits where it is small; ablations: sum alpha

  static DSMOE_HD PixelState open() { return {Real(Scalar<Real>(1)), Real(Scalar<Real>(0))}; }
  DSMOE_HD Mask<Real> is_open() const { return transmittance > Real(Scalar<Real>(0)); }
  DSMOE_HD PixelEnd<Real> end(Scalar<Real> background_gate) const {
    return {abs(transmittance), gate_sum, background_gate};
  }
};

template <class Real> struct PairWeight {
  Real weight;             // of the expert in the numerator
  Mask<Real> contributes;  // to the numerator
};

// What the backward pass knows of a pixel; g' itself is one number a channel and stays with the caller.
template <class Real> struct PixelBackward {
  Real transmittance;  // T behind the current pair
  Real suffix;         // R
  Real base;           // b
};

template <class Real> struct PairGradient {
  Real gamma;   // alpha dL/dalpha
  Real weight;  // w; dL/dc = w g'
};

// Eq. 4 and the stop, shared by the modes with transmittance: the pair that would close the pixel is left out.
template <class Real> DSMOE_HD PairWeight<Real> transmit(PixelState<Real>& state, const Gate<Real>& gate) {
  using S = Scalar<Real>;
  const Real before = state.transmittance;
  const Real after = before * (Real(S(1)) - gate.alpha);
  const Mask<Real> takes = gate.counts & state.is_open();
  const Mask<Real> full = takes & (after < Real(S(kTransmittanceCut)));
  const Mask<Real> contributes = takes & (after >= Real(S(kTransmittanceCut)));
  state.transmittance = select(contributes, after, select(full, -before, before));
  return {select(contributes, gate.alpha * before, Real(S(0))), contributes};
}

// The reverse of transmit: recovers T in front of the pair by division and moves the suffix past it.
template <class Real>
DSMOE_HD PairGradient<Real> transmit_backward(PixelBackward<Real>& pixel, const Gate<Real>& gate, Real u,
                                              Mask<Real> contributes) {
  using S = Scalar<Real>;
  const Real inverse = reciprocal(Real(S(1)) - gate.alpha);
  const Real transmittance = pixel.transmittance * inverse;
  const Real weight = select(contributes, gate.alpha * transmittance, Real(S(0)));
  const Real weighted = weight * u;
  const Real gamma = weighted - gate.alpha * inverse * pixel.suffix;
  pixel.transmittance = select(contributes, transmittance, pixel.transmittance);
  pixel.suffix = pixel.suffix + weighted;
  return {select(contributes, gamma, Real(S(0))), weight};
}

// The family, alpha and smoe; the ablations are specialisations.
template <BlendMode kMode> struct Blend {
  static constexpr bool kNeedsDepthOrder = true;
  static constexpr bool kStopsEarly = true;                    // once full, a pixel is done
  static constexpr bool kSuffixAboutBase = true;               // u_i = g'.c_i - b; else g'.c_i
  static constexpr bool kDivides = kMode == BlendMode::kSmoe;  // in alpha D is 1, and never formed
  static constexpr bool kLearnsGate = kDivides;                // lambda is a variable

  template <class S> static DSMOE_HD S background_gate(S lambda) { return kDivides ? lambda : S(1); }

  template <class Real> static DSMOE_HD PairWeight<Real> accumulate(PixelState<Real>& state, const Gate<Real>& gate) {
    const auto pair = transmit(state, gate);
    state.gate_sum = state.gate_sum + pair.weight;
    return pair;
  }

  template <class Real>
  static DSMOE_HD PairGradient<Real> backward(PixelBackward<Real>& pixel, const Gate<Real>& gate, Real value,
                                              Mask<Real> contributes) {
    return transmit_backward(pixel, gate, value - pixel.base, contributes);
  }
};

// The ablations leave the background out, and their denominator runs on behind a full pixel.
struct AblationBlend {
  static constexpr bool kStopsEarly = false, kSuffixAboutBase = false, kDivides = true, kLearnsGate = false;
  template <class S> static DSMOE_HD S background_gate(S) { return S(0); }
};

template <> struct Blend<BlendMode::kSmoeTn> : AblationBlend {
  static constexpr bool kNeedsDepthOrder = true;

  template <class Real> static DSMOE_HD PairWeight<Real> accumulate(PixelState<Real>& state, const Gate<Real>& gate) {
    state.gate_sum = state.gate_sum + select(gate.counts, gate.alpha, Real(Scalar<Real>(0)));
    return transmit(state, gate);
  }

  // The denominator's share, -alpha_i g'.C, comes from every pair that counts, seen or hidden.
  template <class Real>
  static DSMOE_HD PairGradient<Real> backward(PixelBackward<Real>& pixel, const Gate<Real>& gate, Real value,
                                              Mask<Real> contributes) {
    auto pair = transmit_backward(pixel, gate, value, contributes);
    pair.gamma = pair.gamma - select(gate.counts, gate.alpha * pixel.base, Real(Scalar<Real>(0)));
    return pair;
  }
};

template <> struct Blend<BlendMode::kSmoeStd> : AblationBlend {
  static constexpr bool kNeedsDepthOrder = false;

  template <class Real> static DSMOE_HD PairWeight<Real> accumulate(PixelState<Real>& state, const Gate<Real>& gate) {
    const Real weight = select(gate.counts, gate.alpha, Real(Scalar<Real>(0)));
    state.gate_sum = state.gate_sum + weight;
    return {weight, gate.counts};
  }

  template <class Real>
  static DSMOE_HD PairGradient<Real> backward(PixelBackward<Real>& pixel, const Gate<Real>& gate, Real value,
                                              Mask<Real> contributes) {
    const Real zero = Scalar<Real>(0);
    return {select(contributes, gate.alpha * (value - pixel.base), zero), select(contributes, gate.alpha, zero)};
  }
};

// A feature is what a pixel blends: colour channels and, on request, z and 1 / z. This says how one is finished.
enum class FeatureRule {
  kBlended,   // by the mode: colour, and inverse depth over background 0
  kAveraged,  // divided by the gate sum in every mode: expected depth
};

// A feature of a pixel is (sum + weight background) / denominator where some gate is open, else its background.
template <class Real> struct FeatureEnd {
  Real weight, denominator;
  Mask<Real> open;
  bool divides;

  // The background's share: 0 without a gate, even where the background is NaN or infinite.
  DSMOE_HD Real if_gated(Real share) const {
    return select(weight > Real(Scalar<Real>(0)), share, Real(Scalar<Real>(0)));
  }
};

template <BlendMode kMode, class Real>
DSMOE_HD FeatureEnd<Real> feature_end(FeatureRule rule, const PixelEnd<Real>& end) {
  using S = Scalar<Real>;
  const bool averaged = rule == FeatureRule::kAveraged, divides = averaged || Blend<kMode>::kDivides;
  const S gate = averaged ? S(0) : Blend<kMode>::background_gate(end.background_gate);
  const Real weight = Real(gate) * end.transmittance;
  return {weight, divides ? end.gate_sum + weight : Real(S(1)), end.gate_sum >= Real(S(kGateSumCut)), divides};
}

template <BlendMode kMode, class Real>
DSMOE_HD Real finish_feature(FeatureRule rule, const PixelEnd<Real>& end, Real sum, Real background) {
  const auto by = feature_end<kMode>(rule, end);
  return select(by.open, (sum + by.if_gated(by.weight * background)) / by.denominator, background);
}

// Starts a pixel's backward pass; the features join one by one through add_feature.
template <class Real> DSMOE_HD PixelBackward<Real> begin_backward(const PixelEnd<Real>& end, Real dL_dgate_sum) {
  return {end.transmittance, Real(Scalar<Real>(0)), -dL_dgate_sum};
}

// What one feature of a pixel hands on.
template <class Real> struct FeatureBackward {
  Real scaled;           // g', to the experts
  Real background;       // dL/dbackground
  Real background_gate;  // dL/dlambda
};

// Adds one feature's share to b and R. value is the finished feature of the pixel.
template <BlendMode kMode, class Real>
DSMOE_HD FeatureBackward<Real> add_feature(FeatureRule rule, PixelBackward<Real>& pixel, const PixelEnd<Real>& end,
                                           Real dL_dvalue, Real value, Real background) {
  const Real zero = Scalar<Real>(0);
  const auto by = feature_end<kMode>(rule, end);
  const Real scaled = select(by.open, dL_dvalue / by.denominator, zero), weighted = by.weight * scaled;
  const Real distance = background - value;
  if (by.divides) pixel.base = pixel.base + scaled * value;
  pixel.suffix = pixel.suffix + by.if_gated(weighted * (by.divides ? distance : background));
  const bool learns = Blend<kMode>::kLearnsGate && rule == FeatureRule::kBlended;
  return {scaled, select(by.open, weighted, dL_dvalue), learns ? end.transmittance * scaled * distance : zero};
}

// Continues in front of pairs that another walk has taken: `transmittance` is what they met, `behind` their sum w g'.c.
// Where u is g'.c - b, their sum w b is b times the transmittance they took: sum w = T in front of them - T behind.
template <BlendMode kMode, class Real>
DSMOE_HD void resume_backward(PixelBackward<Real>& pixel, Real transmittance, Real behind) {
  pixel.suffix = pixel.suffix + behind;
  if (Blend<kMode>::kSuffixAboutBase) {
    pixel.suffix = pixel.suffix - pixel.base * (transmittance - pixel.transmittance);
  }
  pixel.transmittance = transmittance;
}

}  // namespace dsmoe

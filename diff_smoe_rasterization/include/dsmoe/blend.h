// The blend modes. Each is a small policy: `accumulate` takes a pair front to back and returns its weight, `finalize`
// makes the pixel, `begin_backward` the pixel's constants, `backward` takes the pairs back to front.
//
// With alpha_i the gate logit, T_i = prod_{j<i} (1 - alpha_j) (Eq. 4) and c_i the expert:
//
//   alpha     Eq. 3   C = sum c_i alpha_i T_i + T_{N+1} bg
//   smoe      Eq. 7   C = sum c_i alpha_i T_i / sum alpha_i T_i
//   smoe_tn   Eq. 8   C = sum c_i alpha_i T_i / sum alpha_i
//   smoe_std  Eq. 6   C = sum c_i alpha_i     / sum alpha_i
//
// Gradients are formed as gamma_i = alpha_i dL/dalpha_i: dL/dalpha grows like 1 / gate sum, gamma stays bounded.
// With g' = dL/dC (alpha) or dL/dC / gate sum (SMoE), u_i = g'.c_i - b and the suffix R_i = sum_{j>i} w_j u_j:
//
//   gamma_i = w_i u_i - alpha_i / (1 - alpha_i) R_i,   dL/dc_i = w_i g'
//
// where b is 0 in alpha mode (the suffix starts at T_{N+1} g.bg) and g'.C under a gate: the pixel's own colour takes
// the place of the background. DEVELOPING.md says what else a new mode needs.
#pragma once

#include "dsmoe/gate.h"

namespace dsmoe {

// The running sums of a pixel. The sign of the transmittance says whether the pixel still takes pairs: it is never 0,
// because a pixel closes at kTransmittanceCut.
template <class Real> struct PixelState {
  Real transmittance;  // T; negative once the pixel is full
  Real gate_sum;       // the denominator, accumulated: as 1 - T it would lose all digits where it is small

  static DSMOE_HD PixelState open() { return {Real(Scalar<Real>(1)), Real(Scalar<Real>(0))}; }
  DSMOE_HD Mask<Real> is_open() const { return transmittance > Real(Scalar<Real>(0)); }
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

template <BlendMode kMode> struct Blend;

template <> struct Blend<BlendMode::kAlpha> {
  static constexpr bool kNeedsDepthOrder = true;
  static constexpr bool kStopsEarly = true;  // once full, a pixel is done

  template <class Real> static DSMOE_HD PairWeight<Real> accumulate(PixelState<Real>& state, const Gate<Real>& gate) {
    const auto pair = transmit(state, gate);
    state.gate_sum = state.gate_sum + pair.weight;
    return pair;
  }

  template <class Real> static DSMOE_HD Real finalize(const PixelState<Real>& state, Real sum, Real background) {
    return sum + abs(state.transmittance) * background;
  }

  template <class Real>
  static DSMOE_HD PairGradient<Real> backward(PixelBackward<Real>& pixel, const Gate<Real>& gate, Real value,
                                              Mask<Real> contributes) {
    return transmit_backward(pixel, gate, value - pixel.base, contributes);
  }
};

// What the three gated modes share: the numerator divided by the gate sum, no epsilon; background where no gate is
// open.
struct GatedBlend {
  template <class Real> static DSMOE_HD Real finalize(const PixelState<Real>& state, Real sum, Real background) {
    const Mask<Real> gated = state.gate_sum >= Real(Scalar<Real>(kGateSumCut));
    return select(gated, sum / state.gate_sum, background);
  }
};

template <> struct Blend<BlendMode::kSmoe> : GatedBlend {
  static constexpr bool kNeedsDepthOrder = true;
  static constexpr bool kStopsEarly = true;

  template <class Real> static DSMOE_HD PairWeight<Real> accumulate(PixelState<Real>& state, const Gate<Real>& gate) {
    return Blend<BlendMode::kAlpha>::accumulate(state, gate);
  }

  template <class Real>
  static DSMOE_HD PairGradient<Real> backward(PixelBackward<Real>& pixel, const Gate<Real>& gate, Real value,
                                              Mask<Real> contributes) {
    return transmit_backward(pixel, gate, value - pixel.base, contributes);
  }
};

template <> struct Blend<BlendMode::kSmoeTn> : GatedBlend {
  static constexpr bool kNeedsDepthOrder = true;
  static constexpr bool kStopsEarly = false;  // the denominator runs on behind a full pixel

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

template <> struct Blend<BlendMode::kSmoeStd> : GatedBlend {
  static constexpr bool kNeedsDepthOrder = false;
  static constexpr bool kStopsEarly = false;

  template <class Real> static DSMOE_HD PairWeight<Real> accumulate(PixelState<Real>& state, const Gate<Real>& gate) {
    const Real weight = select(gate.counts, gate.alpha, Real(Scalar<Real>(0)));
    state.gate_sum = state.gate_sum + weight;
    return {weight, gate.counts};
  }

  template <class Real>
  static DSMOE_HD PairGradient<Real> backward(PixelBackward<Real>& pixel, const Gate<Real>& gate, Real value,
                                              Mask<Real> contributes) {
    const Real weight = select(contributes, gate.alpha, Real(Scalar<Real>(0)));
    return {weight * (value - pixel.base), weight};
  }
};

// A feature is what a pixel blends: colour channels and, on request, z and 1 / z. This says how one is finished.
enum class FeatureRule {
  kBlended,   // by the mode: colour, and inverse depth over background 0
  kAveraged,  // divided by the gate sum in every mode: expected depth
};

template <BlendMode kMode, class Real>
DSMOE_HD Real finish_feature(FeatureRule rule, const PixelState<Real>& state, Real sum, Real background) {
  return rule == FeatureRule::kAveraged ? GatedBlend::finalize(state, sum, background)
                                        : Blend<kMode>::finalize(state, sum, background);
}

// Starts a pixel's backward pass; the features join one by one through add_feature.
template <BlendMode kMode, class Real>
DSMOE_HD PixelBackward<Real> begin_backward(Real final_transmittance, Real dL_dgate_sum) {
  return {final_transmittance, Real(Scalar<Real>(0)), -dL_dgate_sum};
}

// Adds one feature's share to b and R, and returns its g'. value is the finished feature of the pixel.
template <BlendMode kMode, class Real>
DSMOE_HD Real add_feature(FeatureRule rule, PixelBackward<Real>& pixel, Real gate_sum, Real dL_dvalue, Real value,
                          Real background) {
  using S = Scalar<Real>;
  if (is_smoe(kMode) || rule == FeatureRule::kAveraged) {
    const Mask<Real> gated = gate_sum >= Real(S(kGateSumCut));
    const Real scaled = select(gated, dL_dvalue / gate_sum, Real(S(0)));
    pixel.base = pixel.base + scaled * value;
    return scaled;
  }
  pixel.suffix = pixel.suffix + pixel.transmittance * dL_dvalue * background;
  return dL_dvalue;
}

// Continues in front of pairs that another walk has taken: `transmittance` is what they met, `behind` their sum w g'.c.
// Where u is g'.c - b, their sum w b is b times the transmittance they took: sum w = T in front of them - T behind.
template <BlendMode kMode, class Real>
DSMOE_HD void resume_backward(PixelBackward<Real>& pixel, Real transmittance, Real behind) {
  const bool about_base = kMode == BlendMode::kAlpha || kMode == BlendMode::kSmoe;  // u = g'.c - b, else g'.c
  pixel.suffix = pixel.suffix + behind;
  if (about_base) pixel.suffix = pixel.suffix - pixel.base * (transmittance - pixel.transmittance);
  pixel.transmittance = transmittance;
}

// dL/dbackground of one pixel and channel.
template <BlendMode kMode, class Real>
DSMOE_HD Real background_backward(Real final_transmittance, Real gate_sum, Real dL_dvalue) {
  using S = Scalar<Real>;
  if constexpr (is_smoe(kMode)) {
    return select(gate_sum >= Real(S(kGateSumCut)), Real(S(0)), dL_dvalue);
  } else {
    return final_transmittance * dL_dvalue;
  }
}

}  // namespace dsmoe

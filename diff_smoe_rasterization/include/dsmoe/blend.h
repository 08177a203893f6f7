// The blend modes. Each is a small policy. `accumulate` takes pairs front to back and returns the weight of each.
// `background_gate` and `kDivides` say how the sums become a pixel (pixel.h). `backward` takes the pairs back to front.
// A policy also carries every fact of its mode. All other code asks the policy, or iterates BlendModes.
//
// With alpha_i = min(0.99, o_i G_i) (the paper's gate logit), T_i = prod_{j<i} (1 - alpha_j) (Eq. 4), the expert c_i,
// w_i = alpha_i T_i, W = sum w_i, and T behind the last pair:
//
//   alpha     Eq. 3   C = sum c_i w_i + T bg
//   smoe              C = (sum c_i w_i + B bg) / (W + B)
//   smoe_eq7  Eq. 7   C = sum c_i w_i / W
//   smoe_tn   Eq. 8   C = sum c_i w_i / sum alpha_i
//   smoe_std  Eq. 6   C = sum c_i alpha_i / sum alpha_i
//
// `smoe` is Eq. 7 as the paper's authors compute it. Their pairs are strong or tails (Cut::kStrong). The sums over i
// are of strong pairs. B is the sum of alpha T over the tails, which takes nothing from T. So where Gaussians end,
// those that almost reach a pixel draw it to the background. That is the rule of wide pixels. A pixel is wide if its
// near pairs (gate.h) have a gate sum below `faint_below`. In the others only near pairs count, and B is 0. smoe_eq7
// has that as an option.
//
// The first three are of one family, in which the background is one more expert, with the gate lambda:
//
//   C = (sum c_i w_i + (B + lambda T) bg) / D,   D = W + B + lambda T
//
// B is 0 but in `smoe`; `alpha` has lambda 1, so that D is 1.
//
// With g' = dL/dC / D, b = g'.C, u_i = g'.c_i - b and the suffix R_i = sum_{j>i} w_j u_j, which begins at
// lambda T (g'.bg - b), with B held constant:
//
//   dL/dalpha_i = T_i u_i - R_i / (1 - alpha_i),   dL/dc_i = w_i g'
//
// Each expert is compared with the pixel's own colour. At lambda = 1 all terms in b cancel, and the mode alpha leaves
// them out.
//
// dL/dalpha grows like 1 / D. What leaves the pair is dL/dpower = o G dL/dalpha, which stays bounded. The clamp of
// alpha passes the gradient straight through, as Inria's rasterizer does and a drop-in must.
#pragma once

#include <limits>
#include <type_traits>

#include "dsmoe/gate.h"

namespace dsmoe {

enum class BlendMode : int { kAlpha, kSmoe, kSmoeEq7, kSmoeTn, kSmoeStd };  // the numbers are the callers'

template <BlendMode kMode> using ModeConstant = std::integral_constant<BlendMode, kMode>;

template <BlendMode... kModes> struct ModeList {
  static constexpr int kSize = sizeof...(kModes);

  // Calls body(ModeConstant<kMode>{}) for each mode. A body may be a host function: the pragma silences nvcc's warning.
#ifdef __CUDACC__
#pragma nv_exec_check_disable
#endif
  template <class Body> static DSMOE_HD constexpr void for_each(Body body) { (body(ModeConstant<kModes>{}), ...); }
};
using BlendModes =
    ModeList<BlendMode::kAlpha, BlendMode::kSmoe, BlendMode::kSmoeEq7, BlendMode::kSmoeTn, BlendMode::kSmoeStd>;

// The policy of a mode.
template <BlendMode kMode> struct Blend;

template <BlendMode kMode, class Real, class S>
DSMOE_HD Gate<Real> evaluate_gate(Real power, S opacity, S least_alpha) {
  return evaluate_gate<Blend<kMode>::kCut>(power, opacity, least_alpha);
}

// A pixel behind its last pair.
template <class Real> struct PixelEnd {
  Real transmittance;                  // T
  Real gate_sum;                       // W; ablations: sum alpha
  Scalar<Real> lambda;                 // of the background
  Real tails = Real(Scalar<Real>(0));  // B, if the mode has tails
};

// What a rendering keeps of a pixel's T: its sign says whether the pixel is wide. T is never 0.
template <class Real> DSMOE_HD Real kept_transmittance(const PixelEnd<Real>& end, Mask<Real> wide) {
  return select(wide, -end.transmittance, end.transmittance);
}
template <class Real> DSMOE_HD Mask<Real> is_wide(Real kept) { return kept < Real(Scalar<Real>(0)); }

// The running sums of a pixel. The sign of the transmittance says whether the pixel still takes pairs: it is never 0,
// because a pixel closes at kTransmittanceCut.
template <class Real> struct PixelState {
  Real transmittance;  // T; negative once the pixel is full
  Real gate_sum;       // W, accumulated: as 1 - T it would lose all digits if it is small; ablations: sum alpha

  static DSMOE_HD PixelState open() { return {Real(Scalar<Real>(1)), Real(Scalar<Real>(0))}; }
  DSMOE_HD Mask<Real> is_open() const { return transmittance > Real(Scalar<Real>(0)); }
  DSMOE_HD PixelEnd<Real> end(Scalar<Real> lambda) const {
    return {abs(transmittance), gate_sum, lambda, Real(Scalar<Real>(0))};
  }
};

template <class Real> struct PairWeight {
  Real weight;             // of the expert in the numerator
  Mask<Real> contributes;  // to the numerator
};

// What the backward pass knows of a pixel. The caller keeps g', which is one number for each channel.
template <class Real> struct PixelBackward {
  Real transmittance;  // T behind the current pair
  Real suffix;         // R
  Real base;           // b
};

// 0 if the pair has no part in the pixel.
template <class Real> struct PairGradient {
  Real power;   // dL/dpower = o G dL/dalpha
  Real weight;  // w; dL/dc = w g'
};

// Eq. 4, for the modes with transmittance, and where a pixel stops: the pair that would close it is left out.
template <class Real> DSMOE_HD PairWeight<Real> transmit(PixelState<Real>& state, const Gate<Real>& gate) {
  using S = Scalar<Real>;
  const Real before = state.transmittance;
  const Real after = before * (Real(S(1)) - gate.alpha);  // negative if the pixel is full
  const Mask<Real> contributes = gate.counts & (after >= Real(S(kTransmittanceCut)));
  state.transmittance = select(contributes, after, select(gate.counts, -abs(before), before));
  return {select(contributes, gate.alpha * before, Real(S(0))), contributes};
}

// The reverse of transmit: recovers T in front of the pair and moves the suffix past it. logit: of the gate, or 0 if
// the pair does not contribute. Then T stays, and so does R if u is a number. kClamps: alpha may be below the logit.
template <bool kClamps, class Real>
DSMOE_HD PairGradient<Real> transmit_backward(PixelBackward<Real>& pixel, Real logit, Real u) {
  const Real one = Scalar<Real>(1), rate = fma(pixel.transmittance, u, -pixel.suffix);  // dL/dalpha times 1 - alpha
  Real power, weight;
  if constexpr (kClamps) {
    const Real alpha = clamped(logit), inverse = reciprocal(one - alpha);
    pixel.transmittance = pixel.transmittance * inverse;
    power = logit * inverse * rate;
    weight = alpha * pixel.transmittance;
  } else {
    const Real odds = logit / (one - logit);
    power = odds * rate;
    weight = odds * pixel.transmittance;
    pixel.transmittance = pixel.transmittance + weight;
  }
  pixel.suffix = fma(weight, u, pixel.suffix);
  return {power, weight};
}

// What a pixel sums. Each mode states its own as kLaw. Algebra that holds only for the gates' law asks for it: a mode
// of another law has no importance (kRemovable), and its backward pass walks long lists whole (kResumes).
enum class Law {
  kGates,  // what GateBlend's parameters say
  kOther,  // the mode has an `accumulate` and a `backward` of its own
};

// The arithmetic of all modes, and the facts that most of them share. kTInNumerator: w_i is alpha_i T_i; else alpha_i.
// kTInDenominator: the denominator sums w_i; else alpha_i of every pair that counts, even behind a full pixel.
template <bool kTInNumerator, bool kTInDenominator> struct GateBlend {
  static constexpr Cut kCut = Cut::kKernel;                  // which pairs count
  static constexpr bool kWithinRadius = false;               // pairs outside the tiles of the 3-sigma square do not
  static constexpr bool kNeedsDepthOrder = kTInNumerator;    // pairs are taken front to back
  static constexpr bool kStopsEarly = kTInDenominator;       // once full, a pixel is done
  static constexpr bool kSuffixAboutBase = kTInDenominator;  // u_i = g'.c_i - b, b in nothing else; else g'.c_i
  static constexpr bool kDivides = true;                     // a pixel is divided by D; else D is 1
  static constexpr bool kLearnsGate = false;                 // the caller gives lambda, and may learn it
  static constexpr bool kTails = false;                      // pairs that do not count may be tails
  static constexpr bool kNearFirst = false;                  // faint pairs and tails may count in wide pixels only
  static constexpr float kFaintBelow = kFaintEverywhere;     // which pixels are wide, unless a caller says otherwise
  template <class S> static DSMOE_HD S background_gate(S) { return S(0); }  // what the mode makes of lambda

  // Reads alpha and counts, and no logit: not every walk has one here.
  template <class Real> static DSMOE_HD PairWeight<Real> accumulate(PixelState<Real>& state, const Gate<Real>& gate) {
    const Real alpha = select(gate.counts, gate.alpha, Real(Scalar<Real>(0)));
    if constexpr (!kTInDenominator) state.gate_sum = state.gate_sum + alpha;
    if constexpr (kTInNumerator) {
      const auto pair = transmit(state, gate);
      if (kTInDenominator) state.gate_sum = state.gate_sum + pair.weight;
      return pair;
    }
    return {alpha, gate.counts};
  }

  // AnyGate: Gate or UnclampedGate.
  template <class Real, class AnyGate>
  static DSMOE_HD PairGradient<Real> backward(PixelBackward<Real>& pixel, const AnyGate& gate, Real value,
                                              Mask<Real> contributes) {
    const Real zero = Scalar<Real>(0), logit = select(contributes, gate.logit, zero);
    if constexpr (kTInNumerator) {
      auto pair = transmit_backward<AnyGate::kClamps>(pixel, logit, kSuffixAboutBase ? value - pixel.base : value);
      pair.power = select(contributes, pair.power, zero);  // logit is 0 then, but u may be NaN
      if (!kTInDenominator) pair.power = pair.power - select(gate.counts, gate.logit * pixel.base, zero);
      return pair;
    }
    return {select(contributes, logit * (value - pixel.base), zero), AnyGate::kClamps ? clamped(logit) : logit};
  }
};

template <> struct Blend<BlendMode::kAlpha> : GateBlend<true, true> {
  static constexpr const char* kName = "alpha";
  static constexpr Law kLaw = Law::kGates;
  static constexpr Cut kCut = Cut::kAlpha;
  static constexpr bool kWithinRadius = true, kDivides = false;
  template <class S> static DSMOE_HD S background_gate(S) { return S(1); }
};

template <> struct Blend<BlendMode::kSmoe> : GateBlend<true, true> {
  static constexpr const char* kName = "smoe";
  static constexpr Law kLaw = Law::kGates;
  static constexpr Cut kCut = Cut::kStrong;
  static constexpr bool kWithinRadius = true, kLearnsGate = true, kTails = true, kNearFirst = true;
  static constexpr float kFaintBelow = ::dsmoe::kFaintBelow;
  template <class S> static DSMOE_HD S background_gate(S lambda) { return lambda; }
};

template <> struct Blend<BlendMode::kSmoeEq7> : GateBlend<true, true> {
  static constexpr const char* kName = "smoe_eq7";
  static constexpr Law kLaw = Law::kGates;
  static constexpr bool kLearnsGate = true, kNearFirst = true;
  template <class S> static DSMOE_HD S background_gate(S lambda) { return lambda; }
};

template <> struct Blend<BlendMode::kSmoeTn> : GateBlend<true, false> {
  static constexpr const char* kName = "smoe_tn";
  static constexpr Law kLaw = Law::kGates;
};

template <> struct Blend<BlendMode::kSmoeStd> : GateBlend<false, false> {
  static constexpr const char* kName = "smoe_std";
  static constexpr Law kLaw = Law::kGates;
};

// What fact(Blend<mode>()) says of a mode that is known at run time; `otherwise` if there is no such mode.
template <class T, class Fact> DSMOE_HD constexpr T fact_of(BlendMode mode, T otherwise, Fact fact) {
  T found = otherwise;
  BlendModes::for_each(
      [&](auto of) { found = decltype(of)::value == mode ? fact(Blend<decltype(of)::value>()) : found; });
  return found;
}
DSMOE_HD constexpr Cut cut_of(BlendMode mode) {
  return fact_of(mode, Cut::kKernel, [](auto blend) { return decltype(blend)::kCut; });
}
DSMOE_HD constexpr bool within_radius(BlendMode mode) {
  return fact_of(mode, false, [](auto blend) { return decltype(blend)::kWithinRadius; });
}
DSMOE_HD constexpr bool has_tails(BlendMode mode) {
  return fact_of(mode, false, [](auto blend) { return decltype(blend)::kTails; });
}
DSMOE_HD constexpr bool near_first(BlendMode mode) {
  return fact_of(mode, false, [](auto blend) { return decltype(blend)::kNearFirst; });
}
DSMOE_HD constexpr float faint_below_of(BlendMode mode) {
  return fact_of(mode, kFaintEverywhere, [](auto blend) { return decltype(blend)::kFaintBelow; });
}

// Adds a pair to the sum of a pixel's tails, B, if it is a tail and the pixel is open. state: of the pixel in front
// of the pair. tail: of the pair, by tail_of.
template <class Real> DSMOE_HD void add_tail(const PixelState<Real>& state, Real& tails, Real tail) {
  tails = fma(select(state.is_open(), tail, Real(Scalar<Real>(0))), state.transmittance, tails);
}

// Whether a backward walk of the mode can be continued by resume_backward. Else one walk takes a whole list.
template <BlendMode kMode> constexpr bool kResumes = Blend<kMode>::kLaw == Law::kGates;

// Continues a backward walk in front of pairs that another walk takes. transmittance: T in front of those pairs.
// behind: their sum w g'.c. If u is g'.c - b, the sum needs their sum w b too, which is b times
// (T in front of them - T behind them).
template <BlendMode kMode, class Real>
DSMOE_HD void resume_backward(PixelBackward<Real>& pixel, Real transmittance, Real behind) {
  static_assert(kResumes<kMode>, "another law has another sum of w, and may have another suffix: ask kResumes first");
  pixel.suffix = pixel.suffix + behind;
  if constexpr (Blend<kMode>::kSuffixAboutBase) {
    static_assert(Blend<kMode>::kNeedsDepthOrder, "the sum of w is taken from T, so w_i has to be alpha_i T_i");
    pixel.suffix = pixel.suffix - pixel.base * (transmittance - pixel.transmittance);
  }
  pixel.transmittance = transmittance;
}

// How a rendering blends: a mode and its parameters, as one value from the caller to the kernels.

constexpr float kFaintBelowOfMode = -std::numeric_limits<float>::infinity();

template <class S> struct BlendRules {
  BlendMode mode = BlendMode::kAlpha;
  S alpha_min = 0;        // SMoE modes: pairs with alpha below this do not count; in kSmoe they are tails
  S background_gate = 0;  // lambda of kSmoe and kSmoeEq7, 0 or more
  // kSmoe, kSmoeEq7: faint pairs and tails count in pixels whose near pairs have a smaller gate sum than this: with 2
  // in all, with 0 in none; kFaintBelowOfMode: the mode's default
  S faint_below = S(kFaintBelowOfMode);
  const S* background_gate_at = nullptr;  // [1] where lambda lies instead, or null

  DSMOE_HD S lambda() const { return background_gate_at != nullptr ? *background_gate_at : background_gate; }
  DSMOE_HD AlphaCut<S> alpha_cut() const { return {alpha_min, cut_of(mode) == Cut::kKernel ? lambda() : S(0)}; }
  DSMOE_HD S wide_below() const { return faint_below == S(kFaintBelowOfMode) ? S(faint_below_of(mode)) : faint_below; }
  // Whether a pixel is first blended with its near pairs only.
  DSMOE_HD bool blends_near_first() const { return near_first(mode) && wide_below() <= S(1); }
  // The least alpha of a tail.
  DSMOE_HD S tail_alpha() const { return S(blends_near_first() ? kTailAlpha : kEveryTailAlpha); }
  // What the tails reach beyond the strong pairs: is added to the squared reach of a footprint when tiles are listed.
  DSMOE_HD S tail_reach() const {
    return has_tails(mode) ? S(2) * log(max(alpha_min, S(kStrongAlpha)) / tail_alpha()) : S(0);
  }

  // The same rules in another precision. Lambda is read: it must lie where the caller can read it.
  template <class To> BlendRules<To> as() const {
    return {mode, static_cast<To>(alpha_min), static_cast<To>(lambda()), static_cast<To>(faint_below), nullptr};
  }
};

}  // namespace dsmoe

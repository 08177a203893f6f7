// A pixel behind its last pair: how its sums become its features, and how its backward pass begins.
#pragma once

#include <cmath>

#include "dsmoe/blend.h"

namespace dsmoe {

// A feature is a number that a pixel blends: a colour channel or, on request, z or 1 / z. This says how it is finished.
enum class FeatureRule {
  kBlended,   // by the mode: colour, and inverse depth over background 0
  kAveraged,  // divided by the gate sum in every mode: expected depth
};

// A feature of a pixel is (sum + weight background) / denominator if some gate is open, else its background.
template <class Real> struct FeatureEnd {
  Real weight;  // of the background: lambda T + B
  Real moving;  // lambda T, the part of it that moves with the pairs
  Real denominator;
  Mask<Real> open;
  bool divides;

  // The background's share: 0 without a gate, even if the background is NaN or infinite.
  DSMOE_HD Real if_gated(Real share) const {
    return select(weight > Real(Scalar<Real>(0)), share, Real(Scalar<Real>(0)));
  }
};

template <BlendMode kMode, class Real>
DSMOE_HD FeatureEnd<Real> feature_end(FeatureRule rule, const PixelEnd<Real>& end) {
  using S = Scalar<Real>;
  const bool averaged = rule == FeatureRule::kAveraged, divides = averaged || Blend<kMode>::kDivides;
  const S gate = averaged ? S(0) : Blend<kMode>::background_gate(end.lambda);
  const Real moving = Real(gate) * end.transmittance;
  const Real weight = Blend<kMode>::kTails && !averaged ? moving + end.tails : moving;
  // If nothing is divided the gate sum is not read: it is an image of the caller's, who may have changed it.
  const S least = divides ? S(kGateSumCut) : S(-INFINITY);
  return {weight, moving, divides ? end.gate_sum + weight : Real(S(1)), end.gate_sum >= Real(least), divides};
}

template <BlendMode kMode, class Real>
DSMOE_HD Real finish_feature(FeatureRule rule, const PixelEnd<Real>& end, Real sum, Real background) {
  const auto by = feature_end<kMode>(rule, end);
  return select(by.open, (sum + by.if_gated(by.weight * background)) / by.denominator, background);
}

// What one feature of a pixel hands on.
template <class Real> struct FeatureBackward {
  Real scaled;      // g', to the experts
  Real background;  // dL/dbackground
  Real lambda;      // dL/dlambda
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
  pixel.suffix = pixel.suffix + by.if_gated(by.moving * scaled * (by.divides ? distance : background));
  const bool learns = Blend<kMode>::kLearnsGate && rule == FeatureRule::kBlended;
  return {scaled, select(by.open, weighted, dL_dvalue), learns ? end.transmittance * scaled * distance : zero};
}

// The alpha image: the gate sum. In a mode with tails it is the share of the pixel that is not the background's, which
// is what a feature of 1 over a background of 0 would be.
template <BlendMode kMode, class Real> DSMOE_HD Real finish_alpha(const PixelEnd<Real>& end) {
  const Real zero = Scalar<Real>(0);
  if constexpr (!Blend<kMode>::kTails) return end.gate_sum;
  return finish_feature<kMode>(FeatureRule::kBlended, end, end.gate_sum, zero);
}

// A pixel where its backward pass begins, and dL/dlambda of its alpha.
template <class Real> struct BackwardBegin {
  PixelBackward<Real> pixel;
  Real lambda;
};

// Starts a pixel's backward pass; the features join one by one through add_feature. dL_dalpha: by the alpha image.
template <BlendMode kMode, class Real>
DSMOE_HD BackwardBegin<Real> begin_backward(const PixelEnd<Real>& end, Real dL_dalpha) {
  const Real zero = Scalar<Real>(0);
  if constexpr (!Blend<kMode>::kTails) return {{end.transmittance, zero, -dL_dalpha}, zero};
  PixelBackward<Real> pixel = {end.transmittance, zero, zero};
  const auto by = add_feature<kMode>(FeatureRule::kBlended, pixel, end, dL_dalpha, finish_alpha<kMode>(end), zero);
  pixel.base = pixel.base - by.scaled;
  return {pixel, by.lambda};
}

}  // namespace dsmoe

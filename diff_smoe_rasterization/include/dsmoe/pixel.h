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
  // Where nothing is divided the gate sum is not read: it is an image of the caller's, who may have changed it.
  const S least = divides ? S(kGateSumCut) : S(-INFINITY);
  return {weight, divides ? end.gate_sum + weight : Real(S(1)), end.gate_sum >= Real(least), divides};
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

}  // namespace dsmoe

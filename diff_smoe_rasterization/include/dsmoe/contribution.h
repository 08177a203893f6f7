// What one (Gaussian, pixel) pair adds to the sums that score its Gaussian. The sums say how much of an image, or of a
// map over it, is due to the Gaussian. Only pairs that the blend took count, with their weight in the numerator of the
// blend mode.
#pragma once

#include "dsmoe/blend.h"

namespace dsmoe {

template <class Real> struct Contribution {
  Real pixel_weight;  // of the pixel, in a map of the caller's
  Real pixels;        // 1
  Real blend_weight;  // w: alpha T; alpha in smoe_std
  Real distance;      // from the pixel to the Gaussian's centre, pixels
};
constexpr int kNumContributions = 4;

template <class Real> DSMOE_HD Contribution<Real> no_contribution() {
  const Real zero = Scalar<Real>(0);
  return {zero, zero, zero, zero};
}

// (dx, dy): pixel - centre.
template <class Real>
DSMOE_HD void add_pair(Contribution<Real>& sum, Mask<Real> contributes, Real pixel_weight, Real weight, Real dx,
                       Real dy) {
  const Real zero = Scalar<Real>(0), one = Scalar<Real>(1);
  sum.pixel_weight = sum.pixel_weight + select(contributes, pixel_weight, zero);
  sum.pixels = sum.pixels + select(contributes, one, zero);
  sum.blend_weight = sum.blend_weight + select(contributes, weight, zero);
  sum.distance = sum.distance + select(contributes, sqrt(fma(dx, dx, dy * dy)), zero);
}

}  // namespace dsmoe

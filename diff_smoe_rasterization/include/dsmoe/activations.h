// From the numbers that an optimizer moves freely to those of a Gaussian: opacity = sigmoid(logit), scale = exp(log),
// rotation = quaternion / |quaternion|. Each backward function returns dL/dinput from the output and dL/doutput.
#pragma once

#include "dsmoe/hd.h"

namespace dsmoe {

template <class S> DSMOE_HD S sigmoid(S logit) { return S(1) / (S(1) + exp(-logit)); }

template <class S> DSMOE_HD S sigmoid_backward(S value, S dL_dvalue) { return dL_dvalue * value * (S(1) - value); }

template <class S> DSMOE_HD S exp_backward(S value, S dL_dvalue) { return dL_dvalue * value; }

// A quaternion that is shorter than this is divided by this instead of its length, as torch's normalize does.
constexpr double kShortestQuaternion = 1e-12;

template <class S> DSMOE_HD S quaternion_length(const S* q) {
  return sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
}

template <class S> DSMOE_HD void normalize_quaternion(const S* q, S* unit) {
  const S inverse = S(1) / max(quaternion_length(q), S(kShortestQuaternion));
  for (int i = 0; i < 4; ++i) unit[i] = q[i] * inverse;
}

// dL/dq = (g - u (u . g)) / |q| with g = dL/dunit. A quaternion that is too short was divided by a constant: there
// dL/dq is g divided by it.
template <class S> DSMOE_HD void normalize_quaternion_backward(const S* q, const S* dL_dunit, S* dL_dq) {
  const S length = quaternion_length(q);
  const bool normalized = length > S(kShortestQuaternion);
  const S inverse = S(1) / max(length, S(kShortestQuaternion));
  S along = 0;
  for (int i = 0; i < 4; ++i) along += q[i] * inverse * dL_dunit[i];
  for (int i = 0; i < 4; ++i) dL_dq[i] = inverse * (dL_dunit[i] - (normalized ? q[i] * inverse * along : S(0)));
}

}  // namespace dsmoe

// One step of Adam (Kingma and Ba 2015, algorithm 1) on one number.
#pragma once

#include <cmath>
#include <cstdint>

#include "dsmoe/hd.h"

namespace dsmoe {

// Constants of a step that all parameters share.
template <class S> struct AdamConstants {
  S beta1, beta2;                      // decay of the two moments
  S one_minus_beta1, one_minus_beta2;  // rounded from double: 1 - 0.999f would be 5e-5 off
  S epsilon;
};

// Constants of one parameter. With bias correction in step t: rate = lr / (1 - beta1^t) and
// root_scale = 1 / sqrt(1 - beta2^t). Without: rate = lr and root_scale = 1.
template <class S> struct AdamRates { S rate, root_scale; };

template <class S> AdamConstants<S> adam_constants(double beta1 = 0.9, double beta2 = 0.999, double epsilon = 1e-8) {
  return {static_cast<S>(beta1), static_cast<S>(beta2), static_cast<S>(1 - beta1), static_cast<S>(1 - beta2),
          static_cast<S>(epsilon)};
}

// With bias correction. step: 1 in the first.
template <class S>
AdamRates<S> adam_rates(double learning_rate, int64_t step, double beta1 = 0.9, double beta2 = 0.999) {
  const auto t = static_cast<double>(step);
  return {static_cast<S>(learning_rate / (1 - std::pow(beta1, t))),
          static_cast<S>(1 / std::sqrt(1 - std::pow(beta2, t)))};
}

// a b + c. In kernels it is always one fused operation, so that all kernels come to the same bits.
template <class S> DSMOE_HD S multiply_add(S a, S b, S c) {
#if defined(__CUDA_ARCH__)
  return fma(a, b, c);
#else
  return a * b + c;
#endif
}

// parameter - rate * moment / (sqrt(square) * root_scale + epsilon). In kernels root and reciprocal of floats are the
// hardware's own: lazy Adam (lazy_adam.h) makes this move for every step that a row has missed, and exact ones would
// take most of its time. The relative error is below 2^-20, of the move and not of the parameter.
template <class S>
DSMOE_HD S adam_move(const AdamConstants<S>& constants, const AdamRates<S>& rates, S parameter, S moment, S square) {
#if defined(__CUDA_ARCH__)
  if constexpr (sizeof(S) == sizeof(float)) {
    float root, inverse;
    asm("sqrt.approx.f32 %0, %1;" : "=f"(root) : "f"(square));
    asm("rcp.approx.ftz.f32 %0, %1;" : "=f"(inverse) : "f"(fma(root, rates.root_scale, constants.epsilon)));
    return fma(-(rates.rate * moment), inverse, parameter);
  }
#endif
  return parameter - rates.rate * moment / (sqrt(square) * rates.root_scale + constants.epsilon);
}

template <class S>
DSMOE_HD void adam_step(const AdamConstants<S>& constants, const AdamRates<S>& rates, S gradient, S& parameter,
                        S& moment, S& square) {
  moment = multiply_add(constants.beta1, moment, constants.one_minus_beta1 * gradient);
  square = multiply_add(constants.beta2, square, constants.one_minus_beta2 * (gradient * gradient));
  parameter = adam_move(constants, rates, parameter, moment, square);
}

// The same with a gradient of zero.
template <class S>
DSMOE_HD void adam_rest_step(const AdamConstants<S>& constants, const AdamRates<S>& rates, S& parameter, S& moment,
                             S& square) {
  moment = constants.beta1 * moment;
  square = constants.beta2 * square;
  parameter = adam_move(constants, rates, parameter, moment, square);
}

}  // namespace dsmoe

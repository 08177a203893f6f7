// One step of Adam (Kingma and Ba 2015, algorithm 1) on one number.
#pragma once

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

template <class S>
DSMOE_HD void adam_step(const AdamConstants<S>& constants, const AdamRates<S>& rates, S gradient, S& parameter,
                        S& moment, S& square) {
  moment = constants.beta1 * moment + constants.one_minus_beta1 * gradient;
  square = constants.beta2 * square + constants.one_minus_beta2 * (gradient * gradient);
  parameter -= rates.rate * moment / (sqrt(square) * rates.root_scale + constants.epsilon);
}

// The same with a gradient of zero.
template <class S>
DSMOE_HD void adam_rest_step(const AdamConstants<S>& constants, const AdamRates<S>& rates, S& parameter, S& moment,
                             S& square) {
  moment = constants.beta1 * moment;
  square = constants.beta2 * square;
  parameter -= rates.rate * moment / (sqrt(square) * rates.root_scale + constants.epsilon);
}

}  // namespace dsmoe

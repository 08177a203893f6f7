// Adam (Kingma and Ba 2015, algorithm 1): a step on one number, on whole tensors, and on rows that wait.
#pragma once

#include <cmath>
#include <cstdint>
#include <vector>

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
// hardware's own: lazy Adam (below) makes this move for every step that a row has missed, and exact ones would
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

// Adam over several tensors at once, on the CPU and on a GPU.

// One parameter tensor, its gradient and its moments. Each is dense and has `size` numbers.
template <class S> struct AdamTensor {
  S* parameter;
  const S* gradient;
  S* moment;  // mean gradient
  S* square;  // mean squared gradient
  int64_t size;
  int64_t row_size;  // numbers per row
  AdamRates<S> rates;
};

// What all tensors of a step have in common.
template <class S> struct AdamStep {
  AdamConstants<S> constants;
  const bool* visible;  // [rows] which rows of every tensor are stepped, or null: all are
};

// What both backends refuse: null pointers, by name, and sizes that would have them read elsewhere. Throws
// std::invalid_argument.
template <class S> void refuse_adam(const char* function, const std::vector<AdamTensor<S>>& tensors);

namespace cpu {

// Steps the parameters and their moments in place. All pointers are to memory of the host.
template <class S> void adam(const std::vector<AdamTensor<S>>& tensors, const AdamStep<S>& step, int num_threads);

}  // namespace cpu

namespace cuda {

// The same on the current device, asynchronously on `stream`, a cudaStream_t. All pointers are to memory of the device.
// Throws std::runtime_error if a launch fails.
template <class S> void adam(const std::vector<AdamTensor<S>>& tensors, const AdamStep<S>& step, void* stream);

}  // namespace cuda

// Adam for tensors when a step reads only a few rows; results equal dense Adam bit for bit.
//
// A Gaussian that no view shows has no gradient, yet dense Adam moves it on by its momentum in every step, and that
// costs as much memory traffic as a gradient does. Nobody reads the row before a view shows the Gaussian again. So its
// last gradient waits with it, and the steps that it has missed are made when it is next read, in registers.

constexpr int kLazyAdamMaxTensors = 4;

// One parameter tensor [N, row_size] with its moments and the gradients that wait, all dense.
template <class S> struct LazyAdamTensor {
  S* parameter;
  S* moment;          // mean gradient
  S* square;          // mean squared gradient
  const S* gradient;  // read if a row's mark says so
  int row_size;       // numbers per row
};

// What to bring up to date. A row's mark says how many steps have been made on it, m, or ~m if the gradient of the
// next one waits; all other steps that it has missed had no gradient.
template <class S> struct LazyAdam {
  LazyAdamTensor<S> tensors[kLazyAdamMaxTensors];
  int num_tensors;
  int64_t num_rows;           // N
  int32_t* marks;             // [N] read, and written: `steps`
  const int32_t* radii;       // [N] above 0 in rows that are brought up to date; or null: all are
  const AdamRates<S>* rates;  // [steps, num_tensors] of each step
  int32_t steps;              // how many there have been
  const S* given_steps;       // [1] a whole number in place of `steps`, or null
  AdamConstants<S> constants;

  DSMOE_HD int32_t num_steps() const { return given_steps != nullptr ? static_cast<int32_t>(*given_steps) : steps; }
};

// A row's mark, spread.
struct LazyAdamMark {
  bool waiting;   // a gradient
  int32_t steps;  // made
  DSMOE_HD explicit LazyAdamMark(int32_t mark) : waiting(mark < 0), steps(mark < 0 ? ~mark : mark) {}
};

// What a step leaves behind: its rates, and marks on the rows whose gradients now wait.
template <class S> struct LazyAdamStep {
  int64_t num_rows;      // N
  int32_t* marks;        // [N] written where radii is above 0; these rows are up to date
  const int32_t* radii;  // [N] above 0 in rows that have a gradient
  AdamRates<S>* rates;   // [steps + 1, num_tensors] of each step; this step's are written
  AdamRates<S> new_rates[kLazyAdamMaxTensors];
  int num_tensors;
  int32_t steps;                    // made before this one
  const S* given_steps;             // [1] a whole number in place of `steps`, or null
  const AdamRates<S>* given_rates;  // [num_tensors] in place of new_rates, or null

  DSMOE_HD int32_t num_steps() const { return given_steps != nullptr ? static_cast<int32_t>(*given_steps) : steps; }
  DSMOE_HD AdamRates<S> new_rate(int t) const { return given_rates != nullptr ? given_rates[t] : new_rates[t]; }
};

// As refuse_adam.
template <class S> void refuse_catch_up(const char* function, const LazyAdam<S>& adam);
template <class S> void refuse_note_step(const char* function, const LazyAdamStep<S>& step);

namespace cpu {

template <class S> void catch_up(const LazyAdam<S>& adam, int num_threads);
template <class S> void note_step(const LazyAdamStep<S>& step);

}  // namespace cpu

namespace cuda {

// The same on the current device, asynchronously on `stream`, a cudaStream_t. All pointers are to memory of the device.
// Throws std::runtime_error if a launch fails.
template <class S> void catch_up(const LazyAdam<S>& adam, void* stream);
template <class S> void note_step(const LazyAdamStep<S>& step, void* stream);

}  // namespace cuda

}  // namespace dsmoe

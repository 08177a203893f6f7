// Adam for tensors when a step reads only a few rows; results equal dense Adam bit for bit.
//
// A Gaussian that no view shows has no gradient, yet dense Adam moves it on by its momentum in every step, and that
// costs as much memory traffic as a gradient does. Nobody reads the row before a view shows the Gaussian again. So its
// last gradient waits with it, and the steps that it has missed are made when it is next read, in registers.
#pragma once

#include <cstdint>

#include "dsmoe/adam.h"

namespace dsmoe {

constexpr int kLazyAdamMaxTensors = 4;

// One parameter tensor [N, row_size] with its moments and the gradients that wait, all dense.
template <class S> struct LazyAdamTensor {
  S* parameter;
  S* moment;          // mean gradient
  S* square;          // mean squared gradient
  const S* gradient;  // read where a row's mark says so
  int row_size;       // numbers per row
};

// What to bring up to date. A row's mark says how many steps have been made on it, m, or ~m where the gradient of the
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
  AdamRates<S>* rates;   // [steps + 1, num_tensors] of each step; those of this one are written
  AdamRates<S> new_rates[kLazyAdamMaxTensors];
  int num_tensors;
  int32_t steps;                    // made before this one
  const S* given_steps;             // [1] a whole number in place of `steps`, or null
  const AdamRates<S>* given_rates;  // [num_tensors] in place of new_rates, or null

  DSMOE_HD int32_t num_steps() const { return given_steps != nullptr ? static_cast<int32_t>(*given_steps) : steps; }
  DSMOE_HD AdamRates<S> new_rate(int t) const { return given_rates != nullptr ? given_rates[t] : new_rates[t]; }
};

namespace cpu {

template <class S> void catch_up(const LazyAdam<S>& adam, int num_threads);
template <class S> void note_step(const LazyAdamStep<S>& step);

}  // namespace cpu

namespace cuda {

// The same on the current device, asynchronously on `stream`, a cudaStream_t. All pointers are to memory of the device.
// Throws std::runtime_error where a launch fails.
template <class S> void catch_up(const LazyAdam<S>& adam, void* stream);
template <class S> void note_step(const LazyAdamStep<S>& step, void* stream);

}  // namespace cuda
}  // namespace dsmoe

// Lazy Adam on the CPU: threads take runs of rows.
#include "dsmoe/lazy_adam.h"

#include "../refuse_training.h"
#include "parallel.h"

namespace dsmoe {
namespace cpu {
namespace {

constexpr int64_t kChunk = 1024;  // rows a thread takes at a time

template <class S> void catch_up_row(const LazyAdam<S>& adam, int32_t steps, int64_t row) {
  const LazyAdamMark mark(adam.marks[row]);
  for (int t = 0; t < adam.num_tensors; ++t) {
    const LazyAdamTensor<S>& tensor = adam.tensors[t];
    const int64_t first = row * tensor.row_size;
    for (int64_t i = first; i < first + tensor.row_size; ++i) {
      int32_t step = mark.steps;
      const auto rates = [&] { return adam.rates[step * adam.num_tensors + t]; };
      if (mark.waiting) {
        adam_step(adam.constants, rates(), tensor.gradient[i], tensor.parameter[i], tensor.moment[i], tensor.square[i]);
        ++step;
      }
      for (; step < steps; ++step) {
        adam_rest_step(adam.constants, rates(), tensor.parameter[i], tensor.moment[i], tensor.square[i]);
      }
    }
  }
  adam.marks[row] = steps;
}

}  // namespace

template <class S> void catch_up(const LazyAdam<S>& adam, int num_threads) {
  refuse_catch_up("cpu::catch_up", adam);
  const int32_t steps = adam.num_steps();
  parallel_for(num_threads, adam.num_rows, kChunk, [&](int64_t begin, int64_t end) {
    for (int64_t row = begin; row < end; ++row) {
      const bool wanted = adam.radii == nullptr || adam.radii[row] > 0;
      if (wanted && adam.marks[row] != steps) catch_up_row(adam, steps, row);
    }
  });
}

template <class S> void note_step(const LazyAdamStep<S>& step) {
  refuse_note_step("cpu::note_step", step);
  const int32_t steps = step.num_steps();
  for (int t = 0; t < step.num_tensors; ++t) step.rates[int64_t(steps) * step.num_tensors + t] = step.new_rate(t);
  for (int64_t row = 0; row < step.num_rows; ++row) {
    if (step.radii[row] > 0) step.marks[row] = ~steps;
  }
}

#define DSMOE_INSTANTIATE(S)                       \
  template void catch_up(const LazyAdam<S>&, int); \
  template void note_step(const LazyAdamStep<S>&);
DSMOE_INSTANTIATE(float)
DSMOE_INSTANTIATE(double)
#undef DSMOE_INSTANTIATE

}  // namespace cpu
}  // namespace dsmoe

// Adam on the CPU: threads take runs of rows.
#include <algorithm>

#include "../refuse_training.h"
#include "dsmoe/adam_tensors.h"
#include "multiversion.h"
#include "parallel.h"

namespace dsmoe {
namespace cpu {
namespace {

constexpr int64_t kChunk = 1 << 16;  // numbers a thread takes at a time

template <class S>
DSMOE_MULTIVERSION void step_range(const AdamConstants<S> constants, const AdamRates<S> rates,
                                   const S* __restrict gradient, S* __restrict parameter, S* __restrict moment,
                                   S* __restrict square, int64_t count) {
  for (int64_t i = 0; i < count; ++i) {
    adam_step(constants, rates, gradient[i], parameter[i], moment[i], square[i]);
  }
}

template <class S>
void step_rows(const AdamTensor<S>& tensor, const AdamConstants<S>& constants, int64_t begin, int64_t end) {
  const int64_t first = begin * tensor.row_size;
  step_range(constants, tensor.rates, tensor.gradient + first, tensor.parameter + first, tensor.moment + first,
             tensor.square + first, (end - begin) * tensor.row_size);
}

// Steps the visible rows of [begin, end), neighbours together.
template <class S> void step_visible(const AdamTensor<S>& tensor, const AdamStep<S>& step, int64_t begin, int64_t end) {
  for (int64_t row = begin; row < end;) {
    const int64_t start = row;
    while (row < end && step.visible[row]) ++row;
    if (row > start) step_rows(tensor, step.constants, start, row);
    while (row < end && !step.visible[row]) ++row;
  }
}

}  // namespace

template <class S> void adam(const std::vector<AdamTensor<S>>& tensors, const AdamStep<S>& step, int num_threads) {
  refuse_adam("cpu::adam", tensors);
  for (const AdamTensor<S>& tensor : tensors) {
    if (tensor.size == 0) continue;
    const int64_t chunk_rows = std::max<int64_t>(1, kChunk / tensor.row_size);
    parallel_for(num_threads, tensor.size / tensor.row_size, chunk_rows, [&](int64_t begin, int64_t end) {
      if (step.visible == nullptr) {
        step_rows(tensor, step.constants, begin, end);
      } else {
        step_visible(tensor, step, begin, end);
      }
    });
  }
}

template void adam(const std::vector<AdamTensor<float>>&, const AdamStep<float>&, int);
template void adam(const std::vector<AdamTensor<double>>&, const AdamStep<double>&, int);

}  // namespace cpu
}  // namespace dsmoe

// Adam on the CPU: threads take runs of rows.
#include "dsmoe/training/adam.h"

#include <algorithm>

#include "cpu/parallel.h"
#include "dsmoe/training/gaussians.h"
#include "refuse.h"

namespace dsmoe {

template <class S> void refuse_adam(const char* function, const std::vector<AdamTensor<S>>& tensors) {
  for (size_t i = 0; i < tensors.size(); ++i) {
    const AdamTensor<S>& t = tensors[i];
    refuse_null_fields(
        function, i, t.size,
        {{"parameter", t.parameter}, {"gradient", t.gradient}, {"moment", t.moment}, {"square", t.square}});
    if (t.size > 0 && (t.row_size < 1 || t.size % t.row_size != 0)) {
      refuse(function, "tensors[", i, "].row_size is ", t.row_size, "; it must be 1 or more and divide ", t.size);
    }
  }
}

template <class S> void refuse_step_gaussians(const char* function, const GaussianAdam<S>& adam) {
  for (size_t i = 0; i < kGaussianAdamTensors; ++i) {
    const ActivatedTensor<S>& t = adam.tensors[i];
    const int64_t size = adam.num_gaussians * t.row_size;
    refuse_null_fields(function, i, size,
                       {{"raw", t.raw}, {"dL_dvalue", t.dL_dvalue}, {"moment", t.moment}, {"square", t.square}});
    if (t.activation != Activation::kNone) refuse_null_fields(function, i, size, {{"value", t.value}});
  }
  refuse_null(function, "radii", adam.radii, "[N]", adam.num_gaussians);
}

static void refuse_num_tensors(const char* function, int num_tensors) {
  if (0 <= num_tensors && num_tensors <= kLazyAdamMaxTensors) return;
  refuse(function, "num_tensors is ", num_tensors, "; it must be 0 to ", kLazyAdamMaxTensors);
}

template <class S> void refuse_catch_up(const char* function, const LazyAdam<S>& adam) {
  refuse_num_tensors(function, adam.num_tensors);
  for (int i = 0; i < adam.num_tensors; ++i) {
    const LazyAdamTensor<S>& t = adam.tensors[i];
    refuse_null_fields(
        function, i, adam.num_rows * t.row_size,
        {{"parameter", t.parameter}, {"moment", t.moment}, {"square", t.square}, {"gradient", t.gradient}});
  }
  refuse_null(function, "marks", adam.marks, "[N]", adam.num_rows);
  refuse_null(function, "rates", adam.rates, "[steps, num_tensors]", adam.num_rows > 0 ? adam.steps : 0);
}

template <class S> void refuse_note_step(const char* function, const LazyAdamStep<S>& step) {
  refuse_num_tensors(function, step.num_tensors);
  refuse_null(function, "marks", step.marks, "[N]", step.num_rows);
  refuse_null(function, "radii", step.radii, "[N]", step.num_rows);
  refuse_null(function, "rates", step.rates, "[steps + 1, num_tensors]", step.num_tensors);
}

template void refuse_adam(const char*, const std::vector<AdamTensor<float>>&);
template void refuse_adam(const char*, const std::vector<AdamTensor<double>>&);
template void refuse_step_gaussians(const char*, const GaussianAdam<float>&);
template void refuse_step_gaussians(const char*, const GaussianAdam<double>&);
template void refuse_catch_up(const char*, const LazyAdam<float>&);
template void refuse_catch_up(const char*, const LazyAdam<double>&);
template void refuse_note_step(const char*, const LazyAdamStep<float>&);
template void refuse_note_step(const char*, const LazyAdamStep<double>&);

namespace cpu {
namespace {

// What a thread takes at a time: numbers of a tensor, rows that wait, Gaussians with activations.
constexpr int64_t kNumbers = 1 << 16, kRows = 1024, kGaussians = 1 << 14;

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
    const int64_t chunk_rows = std::max<int64_t>(1, kNumbers / tensor.row_size);
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

// Lazy Adam.

namespace {

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
  parallel_for(num_threads, adam.num_rows, kRows, [&](int64_t begin, int64_t end) {
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

// Adam with activations.

namespace {

template <class S>
void step_number_at(const GaussianAdam<S>& adam, const ActivatedTensor<S>& tensor, const AdamRates<S>& rates, bool seen,
                    int64_t i) {
  ActivatedNumbers<S, 1> n = {};
  const bool activated = tensor.activation != Activation::kNone;
  n.raw[0] = tensor.raw[i], n.moment[0] = tensor.moment[i], n.square[0] = tensor.square[i];
  if (activated) n.value[0] = tensor.value[i];
  if (seen) n.dL_dvalue[0] = tensor.dL_dvalue[i];
  step_number(adam.constants, tensor.activation, rates, n);
  tensor.raw[i] = n.raw[0], tensor.moment[i] = n.moment[0], tensor.square[i] = n.square[0];
  if (activated) tensor.value[i] = n.value[0];
}

template <class S>
void step_quaternion_at(const GaussianAdam<S>& adam, const ActivatedTensor<S>& tensor, const AdamRates<S>& rates,
                        bool seen, int64_t i) {
  ActivatedNumbers<S, 4> n = {};
  std::copy_n(tensor.raw + i, 4, n.raw);
  std::copy_n(tensor.moment + i, 4, n.moment);
  std::copy_n(tensor.square + i, 4, n.square);
  if (seen) std::copy_n(tensor.dL_dvalue + i, 4, n.dL_dvalue);
  step_quaternion(adam.constants, rates, seen, n);
  std::copy_n(n.raw, 4, tensor.raw + i);
  std::copy_n(n.moment, 4, tensor.moment + i);
  std::copy_n(n.square, 4, tensor.square + i);
  std::copy_n(n.value, 4, tensor.value + i);
}

}  // namespace

template <class S> void step_gaussians(const GaussianAdam<S>& adam, int num_threads) {
  refuse_step_gaussians("cpu::step_gaussians", adam);
  parallel_for(num_threads, adam.num_gaussians, kGaussians, [&](int64_t begin, int64_t end) {
    for (int t = 0; t < kGaussianAdamTensors; ++t) {
      const ActivatedTensor<S>& tensor = adam.tensors[t];
      const AdamRates<S> rates = adam.rates(t);
      const int group = tensor.group(), size = tensor.row_size;
      for (int64_t i = begin * size; i < end * size; i += group) {
        const bool seen = adam.radii[i / size] > 0;
        group == 4 ? step_quaternion_at(adam, tensor, rates, seen, i) : step_number_at(adam, tensor, rates, seen, i);
      }
    }
  });
}

template void step_gaussians(const GaussianAdam<float>&, int);
template void step_gaussians(const GaussianAdam<double>&, int);

}  // namespace cpu
}  // namespace dsmoe

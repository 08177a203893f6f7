// Adam with activations on the CPU: threads take runs of Gaussians.
#include "dsmoe/gaussian_adam.h"

#include <algorithm>

#include "../refuse_training.h"
#include "parallel.h"

namespace dsmoe {
namespace cpu {
namespace {

constexpr int64_t kChunk = 1 << 14;  // Gaussians a thread takes at a time

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
  parallel_for(num_threads, adam.num_gaussians, kChunk, [&](int64_t begin, int64_t end) {
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

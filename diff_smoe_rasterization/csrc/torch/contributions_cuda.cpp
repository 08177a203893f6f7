// The op `contributions` on CUDA.
#include <ATen/Dispatch.h>
#include <ATen/cuda/CUDAContext.h>
#include <c10/cuda/CUDAGuard.h>
#include <torch/library.h>

#include "contributions.h"
#include "cuda_tensors.h"

namespace dsmoe {
namespace binding {
namespace {

template <class S>
void sum_contributions(const at::Tensor& pixel_weights, const Outputs& outputs, const at::Tensor& background_gate,
                       const Options& blend, const ContributionTensors& sums) {
  const at::Tensor& image = outputs[kLastContributor];
  Options options = {};
  options.deterministic = outputs[kInstances].size(1) == 2;  // instances of such a rendering have slots
  cuda::contributions(outputs[kProjected].size(0), static_cast<int>(image.size(1)), static_cast<int>(image.size(0)),
                      contribution_config<S>(background_gate, blend), saved_on_device<S>(outputs, options),
                      image_outputs<S>(outputs), pixel_weights.data_ptr<S>(), contribution_sums<S>(sums),
                      at::cuda::getCurrentCUDAStream());
}

void contributions_any(const at::Tensor& pixel_weights, const Outputs& outputs, const at::Tensor& background_gate,
                       const Options& blend, const ContributionTensors& sums) {
  const c10::cuda::CUDAGuard guard(pixel_weights.device());
  AT_DISPATCH_FLOATING_TYPES(pixel_weights.scalar_type(), "contributions", [&] {
    sum_contributions<scalar_t>(pixel_weights, outputs, background_gate, blend, sums);
  });
}

}  // namespace
}  // namespace binding
}  // namespace dsmoe

TORCH_LIBRARY_IMPL(diff_smoe_rasterization, CUDA, m) {
  m.impl("contributions", &dsmoe::binding::contributions<&dsmoe::binding::contributions_any>);
}

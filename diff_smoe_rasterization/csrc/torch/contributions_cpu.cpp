// The op `contributions` on the CPU.
#include <ATen/Dispatch.h>
#include <ATen/Parallel.h>
#include <torch/library.h>

#include "contributions.h"

namespace dsmoe {
namespace binding {
namespace {

template <class S>
void sum_contributions(const at::Tensor& pixel_weights, const Outputs& outputs, const at::Tensor& background_gate,
                       const Options& blend, const ContributionTensors& sums) {
  const int64_t num_instances = outputs[kInstances].size(0);
  const int64_t counted = outputs[kInstanceOffsets][-1].item<int64_t>();
  TORCH_CHECK_VALUE(counted == num_instances, "contributions: instances has ", num_instances,
                    " rows, but instance_offsets counts ", counted, "; both must come from one call of rasterize");
  auto config = contribution_config<S>(background_gate, blend);
  config.num_threads = at::get_num_threads();
  const at::Tensor& image = outputs[kLastContributor];
  cpu::contributions(outputs[kProjected].size(0), static_cast<int>(image.size(1)), static_cast<int>(image.size(0)),
                     config, saved_forward<S>(outputs), pixel_weights.data_ptr<S>(), contribution_sums<S>(sums));
}

void contributions_any(const at::Tensor& pixel_weights, const Outputs& outputs, const at::Tensor& background_gate,
                       const Options& blend, const ContributionTensors& sums) {
  AT_DISPATCH_FLOATING_TYPES(pixel_weights.scalar_type(), "contributions", [&] {
    sum_contributions<scalar_t>(pixel_weights, outputs, background_gate, blend, sums);
  });
}

}  // namespace
}  // namespace binding
}  // namespace dsmoe

TORCH_LIBRARY_IMPL(diff_smoe_rasterization, CPU, m) {
  m.impl("contributions", &dsmoe::binding::contributions<&dsmoe::binding::contributions_any>);
}

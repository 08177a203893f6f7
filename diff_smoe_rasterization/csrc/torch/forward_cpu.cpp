// The forward ops on the CPU.
#include <ATen/Dispatch.h>
#include <ATen/Parallel.h>
#include <torch/library.h>

#include <algorithm>
#include <stdexcept>

#include "ops.h"
#include "profiling.h"

namespace dsmoe {
namespace binding {
namespace {

template <class S> Outputs forward(const Inputs& inputs, const Options& options, ForwardOptions own) {
  const auto gaussians = gaussian_inputs<S>(inputs, options);
  const auto view = camera<S>(inputs, options);
  auto config = raster_config<S>(inputs, options);
  config.num_threads = at::get_num_threads();
  if (own.strict) refuse_non_finite(inputs, cpu::first_non_finite(gaussians, config.num_channels));
  if (own.prefiltered) {
    const at::Tensor visible = at::empty({gaussians.num_gaussians}, at::kBool);
    cpu::mark_visible(gaussians.num_gaussians, gaussians.means3D, view, visible.data_ptr<bool>());
    refuse_culled(inputs, visible);
  }

  Outputs outputs = allocate_outputs(inputs, options);
  auto saved = saved_forward<S>(outputs);
  const auto images = image_outputs<S>(outputs);
  StageRecorder recorder(Pass::kForward);
  try {
    const int64_t num_instances = cpu::project(gaussians, view, config, saved, images, recorder.times());
    outputs[kInstances] = at::empty({num_instances, 2}, at::kInt);
    saved.instances = saved_forward<S>(outputs).instances;
    cpu::bin(gaussians.num_gaussians, view, config, saved, images.radii, recorder.times());
  } catch (const std::overflow_error& error) {
    TORCH_CHECK(false, error.what());
  }
  cpu::blend(view, config, saved, images, recorder.times());
  return outputs;
}

Outputs forward_any(const Inputs& inputs, const Options& options, ForwardOptions own) {
  Outputs outputs;
  AT_DISPATCH_FLOATING_TYPES(inputs[kMeans3D].scalar_type(), "rasterize",
                             [&] { outputs = forward<scalar_t>(inputs, options, own); });
  return outputs;
}

at::Tensor mark_visible(const at::Tensor& positions, const at::Tensor& viewmatrix, double near) {
  check_positions(positions, viewmatrix);
  const at::Tensor points = positions.contiguous(), view = viewmatrix.contiguous();
  const at::Tensor visible = at::empty({points.size(0)}, at::kBool);
  AT_DISPATCH_FLOATING_TYPES(points.scalar_type(), "mark_visible", [&] {
    Camera<scalar_t> camera;
    std::copy_n(view.data_ptr<scalar_t>(), 16, camera.view);
    camera.near = static_cast<float>(near);
    cpu::mark_visible(points.size(0), points.data_ptr<scalar_t>(), camera, visible.data_ptr<bool>());
  });
  return visible;
}

}  // namespace
}  // namespace binding
}  // namespace dsmoe

TORCH_LIBRARY_IMPL(diff_smoe_rasterization, CPU, m) {
  m.impl("rasterize", &dsmoe::binding::rasterize<&dsmoe::binding::forward_any>);
  m.impl("mark_visible", &dsmoe::binding::mark_visible);
}

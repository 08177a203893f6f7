// The backward op on the CPU.
#include <ATen/Dispatch.h>
#include <ATen/Parallel.h>
#include <torch/library.h>

#include "ops.h"
#include "profiling.h"

namespace dsmoe {
namespace binding {
namespace {

template <class S>
void backward(const Inputs& inputs, const Options& options, const Outputs& outputs,
              const ImageGradientTensors& image_gradient_tensors, const Inputs& gradients) {
  const int64_t num_instances = outputs[kInstances].size(0);
  const int64_t counted = outputs[kInstanceOffsets][-1].item<int64_t>();
  TORCH_CHECK_VALUE(counted == num_instances, "rasterize_backward: instances has ", num_instances,
                    " rows, but instance_offsets counts ", counted, "; both must come from one call of rasterize");
  auto config = raster_config<S>(inputs, options);
  config.num_threads = at::get_num_threads();
  auto gaussian_gradient = gaussian_gradients<S>(gradients);
  const auto camera_gradient = camera_joint(gradients, inputs[kMeans3D]);
  const auto background_gradient = background_joint(inputs, gradients);
  gaussian_gradient.camera = reinterpret_cast<CameraGradient<S>*>(mutable_data<S>(camera_gradient.whole));
  gaussian_gradient.background = mutable_data<S>(background_gradient.whole);
  StageRecorder recorder(Pass::kBackward);
  cpu::backward(gaussian_inputs<S>(inputs, options), camera<S>(inputs, options), config, saved_forward<S>(outputs),
                image_outputs<S>(outputs), image_gradients<S>(image_gradient_tensors), gaussian_gradient,
                recorder.times());
  camera_gradient.store(gradients);
  background_gradient.store(gradients);
}

void backward_any(const Inputs& inputs, const Options& options, const Outputs& outputs,
                  const ImageGradientTensors& image_gradient_tensors, const Inputs& gradients) {
  AT_DISPATCH_FLOATING_TYPES(inputs[kMeans3D].scalar_type(), "rasterize_backward",
                             [&] { backward<scalar_t>(inputs, options, outputs, image_gradient_tensors, gradients); });
}

}  // namespace
}  // namespace binding
}  // namespace dsmoe

TORCH_LIBRARY_IMPL(diff_smoe_rasterization, CPU, m) {
  m.impl("rasterize_backward", &dsmoe::binding::rasterize_backward<&dsmoe::binding::backward_any>);
}

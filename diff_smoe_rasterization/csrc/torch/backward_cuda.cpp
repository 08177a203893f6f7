// The backward op on CUDA.
#include <ATen/Dispatch.h>
#include <ATen/cuda/CUDAContext.h>
#include <c10/cuda/CUDAGuard.h>
#include <torch/library.h>

#include "cuda_tensors.h"
#include "event_clock.h"
#include "ops.h"
#include "profiling.h"

namespace dsmoe {
namespace binding {
namespace {

template <class S>
void backward(const Inputs& inputs, const Options& options, const Outputs& outputs,
              const ImageGradientTensors& image_gradient_tensors, const Inputs& gradients) {
  const cudaStream_t stream = at::cuda::getCurrentCUDAStream();
  const auto gaussians = gaussian_inputs<S>(inputs, options);
  const auto camera = device_camera<S>(inputs, options);
  const auto config = raster_config<S>(inputs, options);
  const auto saved = saved_on_device<S>(outputs, options);
  const auto images = image_outputs<S>(outputs);
  const at::Tensor& like = inputs[kMeans3D];
  const int64_t record = kNumGateMoments + config.num_features();

  auto gaussian_gradient = gaussian_gradients<S>(gradients);
  const auto camera_gradient = camera_joint(gradients, like);
  const auto background_gradient = background_joint(inputs, gradients);
  gaussian_gradient.camera = reinterpret_cast<CameraGradient<S>*>(mutable_data<S>(camera_gradient.whole));
  gaussian_gradient.background = mutable_data<S>(background_gradient.whole);

  StageRecorder recorder(Pass::kBackward);
  at::Tensor pairs;
  if (recorder.times() != nullptr) pairs = at::zeros({1}, like.options().dtype(at::kLong));
  EventClock clock(recorder.times(), stream);
  const at::Tensor dL_dgaussians = at::zeros({gaussians.num_gaussians, record}, like.options());
  at::Tensor slots;
  if (options.deterministic) slots = at::zeros({saved.capacity, cuda::kSlotsPerInstance, record}, like.options());
  TensorScratch scratch(like);
  cuda::blend_backward(
      gaussians.num_gaussians, camera, config, saved, images, image_gradients<S>(image_gradient_tensors),
      dL_dgaussians.data_ptr<S>(), mutable_data<S>(slots), gaussian_gradient.background, scratch,
      pairs.defined() ? reinterpret_cast<unsigned long long*>(pairs.data_ptr<int64_t>()) : nullptr, stream);
  clock.end(&cpu::StageTimes::blend_backward);
  cuda::project_backward(gaussians, camera, config, saved, images.radii, dL_dgaussians.data_ptr<S>(),
                         mutable_data<S>(slots), gaussian_gradient, scratch, stream);
  clock.end(&cpu::StageTimes::project_backward);
  clock.finish();
  if (pairs.defined()) recorder.times()->backward_pairs = pairs.item<int64_t>();

  camera_gradient.store(gradients);
  background_gradient.store(gradients);
}

void backward_any(const Inputs& inputs, const Options& options, const Outputs& outputs,
                  const ImageGradientTensors& image_gradient_tensors, const Inputs& gradients) {
  const c10::cuda::CUDAGuard guard(inputs[kMeans3D].device());
  AT_DISPATCH_FLOATING_TYPES(inputs[kMeans3D].scalar_type(), "rasterize_backward",
                             [&] { backward<scalar_t>(inputs, options, outputs, image_gradient_tensors, gradients); });
}

}  // namespace
}  // namespace binding
}  // namespace dsmoe

TORCH_LIBRARY_IMPL(diff_smoe_rasterization, CUDA, m) {
  m.impl("rasterize_backward", &dsmoe::binding::rasterize_backward<&dsmoe::binding::backward_any>);
}

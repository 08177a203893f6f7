// The forward ops on CUDA.
#include <ATen/Dispatch.h>
#include <ATen/cuda/CUDAContext.h>
#include <c10/cuda/CUDAGuard.h>
#include <torch/library.h>

#include <limits>

#include "capacity.h"
#include "cuda_tensors.h"
#include "event_clock.h"
#include "ops.h"
#include "profiling.h"

namespace dsmoe {
namespace binding {
namespace {

// The first Gaussian with an attribute that is not finite, or -1. Waits for the device.
int64_t first_non_finite(const Inputs& inputs) {
  at::Tensor finite = at::ones({num_gaussians(inputs)}, inputs[kMeans3D].options().dtype(at::kBool));
  for (int i = kMeans3D; i <= kCov3DPrecomp; ++i) {
    if (i == kMeans2D || !inputs[i].defined() || inputs[i].numel() == 0) continue;
    finite = finite.logical_and(at::isfinite(inputs[i]).reshape({finite.size(0), -1}).all(1));
  }
  const at::Tensor indices = at::logical_not(finite).nonzero();
  return indices.numel() == 0 ? -1 : indices[0][0].item<int64_t>();
}

at::Tensor visible_positions(const at::Tensor& positions, const at::Tensor& view, double near) {
  const at::Tensor visible = at::empty({positions.size(0)}, positions.options().dtype(at::kBool));
  AT_DISPATCH_FLOATING_TYPES(positions.scalar_type(), "mark_visible", [&] {
    cuda::mark_visible<scalar_t>(positions.size(0), positions.data_ptr<scalar_t>(), view.data_ptr<scalar_t>(),
                                 static_cast<float>(near), visible.data_ptr<bool>(), at::cuda::getCurrentCUDAStream());
  });
  return visible;
}

// The number of instances. Waits for the device.
template <class S>
int64_t counted_instances(const cuda::DeviceCamera<S>& camera, const RasterConfig<S>& config,
                          const cuda::SavedForward<S>& saved, const int32_t* radii, int64_t num_gaussians,
                          const at::Tensor& like, cudaStream_t stream) {
  TensorScratch scratch(like);
  cuda::count_instances(num_gaussians, camera, config, saved, radii, scratch, stream);
  int64_t count = 0;
  cuda::check(cudaMemcpyAsync(&count, saved.num_instances, sizeof(count), cudaMemcpyDeviceToHost, stream),
              "counting instances");
  cuda::check(cudaStreamSynchronize(stream), "projecting Gaussians");
  return count;
}

template <class S> Outputs forward(const Inputs& inputs, const Options& options, bool for_backward) {
  const cudaStream_t stream = at::cuda::getCurrentCUDAStream();
  const auto gaussians = gaussian_inputs<S>(inputs, options);
  const auto camera = device_camera<S>(inputs, options);
  const auto config = raster_config<S>(inputs, options);
  const int64_t count = gaussians.num_gaussians;
  const at::Tensor& like = inputs[kMeans3D];

  Outputs outputs = allocate_outputs(inputs, options);
  auto saved = saved_on_device<S>(outputs, options);
  const auto images = image_outputs<S>(outputs);

  StageRecorder recorder(Pass::kForward);
  EventClock clock(recorder.times(), stream);
  {
    TensorScratch scratch(like);
    cuda::DepthKeys<S> keys;
    const bool sorted = cuda::needs_depth_order(config.mode);
    if (sorted) keys.depths = static_cast<cuda::DepthBits<S>*>(scratch.allocate(count * sizeof(S)));
    keys.gaussians = sorted ? static_cast<int32_t*>(scratch.allocate(count * sizeof(int32_t))) : saved.order;
    cuda::project(gaussians, camera, config, saved, images, keys, stream);
    clock.end(&cpu::StageTimes::project);
    if (sorted) cuda::sort_by_depth(count, keys, saved.order, scratch, stream);
    clock.end(&cpu::StageTimes::sort);
  }
  const auto key =
      InstanceCapacities::key(like.get_device(), options.image_width, options.image_height, options.blend_mode, count);
  int64_t capacity = InstanceCapacities::shared().likely(key);
  if (is_capturing(stream)) {
    if (capacity < 0) capacity = 8 * count + 1024;
  } else if (capacity < 0 || options.deterministic) {
    capacity = counted_instances(camera, config, saved, images.radii, count, like, stream);
  }
  TORCH_CHECK(!options.deterministic || capacity <= std::numeric_limits<uint32_t>::max(), "rasterize: ", capacity,
              " tile instances; with deterministic=True the most is ", std::numeric_limits<uint32_t>::max());
  outputs[kInstances] = at::empty({capacity, saved.instance_width}, like.options().dtype(at::kInt));
  if (!outputs[kSegments].defined()) {
    const int64_t rows = for_backward ? cuda::num_segment_rows(capacity) : 0;
    const int64_t entries = for_backward ? cuda::num_queue_entries(capacity) : 0;
    outputs[kSegments] = at::empty({rows, cuda::kSegmentRow}, like.options());
    outputs[kSegmentQueue] = at::empty({entries, 2}, like.options().dtype(at::kInt));
  }
  saved = saved_on_device<S>(outputs, options);
  {
    TensorScratch scratch(like);
    cuda::bin(count, camera, config, saved, images.radii, scratch, stream);
  }
  InstanceCapacities::shared().learn(key, saved.num_instances, stream);
  clock.end(&cpu::StageTimes::bin);

  at::Tensor pairs;
  if (recorder.times() != nullptr) pairs = at::zeros({1}, like.options().dtype(at::kLong));
  cuda::blend(count, camera, config, saved, images,
              pairs.defined() ? reinterpret_cast<unsigned long long*>(pairs.data_ptr<int64_t>()) : nullptr, stream);
  clock.end(&cpu::StageTimes::blend);
  clock.finish();
  if (pairs.defined()) recorder.times()->forward_pairs = pairs.item<int64_t>();
  return outputs;
}

Outputs forward_any(const Inputs& inputs, const Options& options, ForwardOptions own) {
  const c10::cuda::CUDAGuard guard(inputs[kMeans3D].device());
  if (own.strict) refuse_non_finite(inputs, first_non_finite(inputs));
  if (own.prefiltered) {
    refuse_culled(inputs, visible_positions(inputs[kMeans3D], inputs[kViewMatrix], options.near));
  }
  Outputs outputs;
  AT_DISPATCH_FLOATING_TYPES(inputs[kMeans3D].scalar_type(), "rasterize",
                             [&] { outputs = forward<scalar_t>(inputs, options, own.for_backward); });
  return outputs;
}

at::Tensor mark_visible(const at::Tensor& positions, const at::Tensor& viewmatrix, double near) {
  const c10::cuda::CUDAGuard guard(positions.device());
  check_positions(positions, viewmatrix);
  return visible_positions(positions.contiguous(), viewmatrix.contiguous(), near);
}

}  // namespace
}  // namespace binding
}  // namespace dsmoe

TORCH_LIBRARY_IMPL(diff_smoe_rasterization, CUDA, m) {
  m.impl("rasterize", &dsmoe::binding::rasterize<&dsmoe::binding::forward_any>);
  m.impl("mark_visible", &dsmoe::binding::mark_visible);
}

// The ops on CUDA: on the inputs' device, on torch's current stream.
#include <ATen/cuda/CUDAContext.h>
#include <c10/cuda/CUDAGuard.h>

#include "dsmoe/rasterize_cuda.h"
#include "ops.h"
#include "profiling.h"

namespace dsmoe {
namespace binding {
namespace {

struct Cuda {
  using Guard = c10::cuda::CUDAGuard;

  template <class S> static cuda::Frame<S> frame(const Inputs& inputs, const Options& options, const Images& images) {
    cuda::Frame<S> frame;
    fill_frame<S>(frame, inputs, options);
    frame.camera.view = data<S>(inputs[kViewMatrix]);
    frame.camera.projection = data<S>(inputs[kProjMatrix]);
    frame.camera.position = data<S>(inputs[kCampos]);
    frame.images = image_outputs<S>(images);
    return frame;
  }

  static cuda::Run run(const Options& options, StageTimes* times) {
    cuda::Run run;
    run.stream = at::cuda::getCurrentCUDAStream();
    run.deterministic = options.deterministic;
    run.for_backward = options.for_backward;
    run.times = times;
    return run;
  }

  template <class S>
  static void forward(const Inputs& inputs, const Options& options, const Images& images, Allocator& memory) {
    auto own = frame<S>(inputs, options, images);
    StageRecorder recorder(Pass::kForward);
    cuda::forward(own, run(options, recorder.times()), memory);
  }

  template <class S>
  static void radii(const Inputs& inputs, const Options& options, const Images& images, Allocator& memory) {
    cuda::radii(frame<S>(inputs, options, images), run(options, nullptr), memory);
  }

  // Checks what a rendering saved, and points to it. The capacity, and whether there are segments, is what it has.
  template <class S>
  static cuda::SavedForward<S> unpack(const char* function, const Saved& tensors, cuda::SavedSizes sizes,
                                      at::Device device) {
    cuda::SavedForward<S> saved;
    sizes.segments = saved_length(tensors, saved, "segments") > 0;
    sizes.capacity = saved_length(tensors, saved, "instances");
    unpack_saved(function, tensors, saved, sizes, device);
    complete(saved, sizes);
    return saved;
  }

  template <class S>
  static void backward(const Inputs& inputs, const Options& options, const Images& images, const Saved& saved,
                       const Images& image_gradient_tensors, const Inputs& gradient_tensors) {
    auto own = frame<S>(inputs, options, images);
    StageRecorder recorder(Pass::kBackward);
    const cuda::Run how = run(options, recorder.times());
    own.saved = unpack<S>("rasterize_backward", saved, cuda::saved_sizes(own, how), inputs[kMeans3D].device());
    own.saved.gate_sum = own.images.gate_sum;
    cuda::Gradients<S> gradients;
    gradients.images = image_gradients<S>(image_gradient_tensors);
    TensorMemory memory(inputs[kMeans3D]);
    with_input_gradients<S>(inputs, gradient_tensors, gradients, [&] { cuda::backward(own, gradients, how, memory); });
  }

  template <class S>
  static void contributions(const at::Tensor& pixel_weights, const at::Tensor& radii, const Saved& saved,
                            const RasterConfig<S>& config, const Options& options, const ContributionSums<S>& sums) {
    cuda::Frame<S> own;
    own.inputs.num_gaussians = radii.numel();
    own.config = config;
    own.images.radii = mutable_data<int32_t>(radii);
    set_image(own.camera, options);
    const cuda::Run how = run(options, nullptr);
    auto sizes = cuda::saved_sizes(own, how);
    sizes.num_features = -1;
    own.saved = unpack<S>("contributions", saved, sizes, radii.device());
    TensorMemory memory(pixel_weights);
    cuda::contributions(own, {data<S>(pixel_weights), sums}, {how.stream, &memory});
  }

  template <class S>
  static void importance(const at::Tensor& gate_sum, const at::Tensor& radii, const Saved& saved,
                         const RasterConfig<S>& config, const Options& options, const ImportanceMap<S>& map) {
    cuda::Frame<S> own;
    own.inputs.num_gaussians = radii.numel();
    own.config = config;
    own.images.radii = mutable_data<int32_t>(radii);
    set_image(own.camera, options);
    const cuda::Run how = run(options, nullptr);
    own.saved = unpack<S>("importance", saved, cuda::saved_sizes(own, how), radii.device());
    own.saved.gate_sum = mutable_data<S>(gate_sum);
    TensorMemory memory(gate_sum);
    cuda::importance(own, map, {how.stream, &memory});
  }

  static at::Tensor visible(const at::Tensor& positions, const at::Tensor& view, double near) {
    const at::Tensor visible = at::empty({positions.size(0)}, positions.options().dtype(at::kBool));
    dispatch(positions, [&](auto zero) {
      using S = decltype(zero);
      cuda::Frame<S> frame;
      frame.inputs.num_gaussians = positions.size(0);
      frame.inputs.means3D = positions.data_ptr<S>();
      frame.camera.view = view.data_ptr<S>();
      frame.camera.near = static_cast<float>(near);
      cuda::mark_visible(frame, visible.data_ptr<bool>(), {at::cuda::getCurrentCUDAStream()});
    });
    return visible;
  }
};

}  // namespace
}  // namespace binding
}  // namespace dsmoe

TORCH_LIBRARY_IMPL(diff_smoe_rasterization, CUDA, m) { dsmoe::binding::register_ops<dsmoe::binding::Cuda>(m); }

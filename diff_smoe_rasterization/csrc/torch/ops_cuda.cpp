// The ops on CUDA: on the inputs' device, on torch's current stream.
#include <cuda_runtime_api.h>

#include "dsmoe/rasterize_cuda.h"
#include "ops.h"
#include "ops/all.h"
#include "process.h"

#ifndef DSMOE_STABLE_ABI
#include <ATen/cuda/CUDAContext.h>
#else
#include <dlfcn.h>
#endif

namespace dsmoe {
namespace binding {
namespace {

// PyTorch's current CUDA stream of the current device.
#ifndef DSMOE_STABLE_ABI
cudaStream_t current_stream() { return at::cuda::getCurrentCUDAStream(); }
#else
// Looked up when it is called, so that the module loads with a PyTorch that has no CUDA.
cudaStream_t current_stream() {
  static const auto function = [] {
    void* const library = dlopen("libtorch_cuda.so", RTLD_LAZY | RTLD_NOLOAD);
    return reinterpret_cast<decltype(&aoti_torch_get_current_cuda_stream)>(
        library == nullptr ? nullptr : dlsym(library, "aoti_torch_get_current_cuda_stream"));
  }();
  DSMOE_CHECK(function != nullptr, "PyTorch's CUDA library is not loaded");
  void* stream;
  TORCH_ERROR_CODE_CHECK(function(torch::stable::accelerator::getCurrentDeviceIndex(), &stream));
  return static_cast<cudaStream_t>(stream);
}
#endif

struct Cuda {
  static constexpr bool kOnHost = false;
  static cudaStream_t where() { return current_stream(); }
  using Guard = DeviceGuard;

  template <class S>
  static cuda::Frame<S> frame_of_gaussians(const Inputs& inputs, const Options& options, const Images& images) {
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
    run.stream = current_stream();
    run.deterministic = options.deterministic;
    run.for_backward = options.for_backward;
    run.times = times;
    return run;
  }

  template <class S>
  static void forward(const Inputs& inputs, const Options& options, const Images& images, Allocator& memory) {
    auto own = frame_of_gaussians<S>(inputs, options, images);
    StageRecorder recorder(Pass::kForward);
    cuda::forward(own, run(options, recorder.times()), memory);
  }

  template <class S>
  static void radii(const Inputs& inputs, const Options& options, const Images& images, Allocator& memory) {
    cuda::radii(frame_of_gaussians<S>(inputs, options, images), run(options, nullptr), memory);
  }

  static int64_t feature_columns(int64_t num_features) { return cuda::feature_stride(static_cast<int>(num_features)); }

  template <class S>
  static void project(const Inputs& inputs, const Options& options, const Images& images, const Tensor& gates,
                      const Tensor& features, Allocator& memory) {
    auto own = frame_of_gaussians<S>(inputs, options, images);
    own.saved.projected = reinterpret_cast<ProjectedGaussian<S>*>(mutable_data<S>(gates));
    own.saved.features = mutable_data<S>(features);
    StageRecorder recorder(Pass::kForward);
    cuda::project_footprints(own, run(options, recorder.times()), memory);
  }

  // The frame of some footprints, nothing saved yet.
  template <class S>
  static cuda::Frame<S> frame_of_footprints(const Footprints& of, const Options& options, const Images& images) {
    cuda::Frame<S> frame;
    frame.inputs.num_gaussians = of.gates.size(0);
    frame.config = footprint_config<S>(of.background, of.background_gate, options);
    set_image(frame.camera, options);
    frame.images = image_outputs<S>(images);
    return frame;
  }

  template <class S>
  static void blend(const Footprints& of, const Options& options, const Images& images, Allocator& memory) {
    auto own = frame_of_footprints<S>(of, options, images);
    own.saved.projected = reinterpret_cast<ProjectedGaussian<S>*>(of.gates.data_ptr<S>());
    own.saved.features = of.features.data_ptr<S>();
    StageRecorder recorder(Pass::kForward);
    cuda::blend_footprints(own, run(options, recorder.times()), memory);
  }

  template <class S>
  static void blend_backward(const Expect& expect, const Footprints& of, const Options& options, const Images& images,
                             const Saved& saved, const Images& image_gradient_tensors, const Tensor& records,
                             const Tensor& background) {
    auto own = frame_of_footprints<S>(of, options, images);
    StageRecorder recorder(Pass::kBackward);
    const cuda::Run how = run(options, recorder.times());
    own.saved = unpack<S>(expect, saved, cuda::saved_sizes(own, how));
    set_sums(own.saved, cuda::saved_sizes(own, how), own.images.gate_sum);
    cuda::Gradients<S> gradients;
    gradients.images = image_gradients<S>(image_gradient_tensors);
    gradients.inputs.background = mutable_data<S>(background);
    TensorMemory memory(of.gates);
    cuda::blend_footprints_backward(own, gradients, {mutable_data<S>(records), nullptr}, how, memory);
  }

  template <class S>
  static void project_backward(const Inputs& inputs, const Options& options, const Tensor& features,
                               const Tensor& radii, const Tensor& records, const Tensor& dL_ddepths,
                               const Inputs& gradient_tensors) {
    auto own = frame_of_gaussians<S>(inputs, options, Images());
    own.saved.features = mutable_data<S>(features);
    own.images.radii = mutable_data<int32_t>(radii);
    StageRecorder recorder(Pass::kBackward);
    const cuda::Run how = run(options, recorder.times());
    cuda::Gradients<S> gradients;
    TensorMemory memory(features);
    with_input_gradients<S>(inputs, gradient_tensors, false, gradients, [&] {
      cuda::project_footprints_backward(own, {mutable_data<S>(records), data<S>(dL_ddepths)}, gradients.inputs, how,
                                        memory);
    });
  }

  // Checks what a rendering saved, and points to it. The capacity, and whether there are segments, is what it has.
  template <class S>
  static cuda::SavedForward<S> unpack(const Expect& expect, const Saved& tensors, cuda::SavedSizes sizes) {
    cuda::SavedForward<S> saved;
    sizes.segments = saved_length(tensors, saved, "segments") > 0;
    sizes.capacity = saved_length(tensors, saved, "instances");
    unpack_saved(expect, tensors, saved, sizes);
    complete(saved, sizes);
    return saved;
  }

  template <class S>
  static void backward(const Expect& expect, const Inputs& inputs, const Options& options, const Images& images,
                       const Saved& saved, const Images& image_gradient_tensors, const Inputs& gradient_tensors,
                       bool seen_only) {
    auto own = frame_of_gaussians<S>(inputs, options, images);
    StageRecorder recorder(Pass::kBackward);
    const cuda::Run how = run(options, recorder.times());
    own.saved = unpack<S>(expect, saved, cuda::saved_sizes(own, how));
    set_sums(own.saved, cuda::saved_sizes(own, how), own.images.gate_sum);
    cuda::Gradients<S> gradients;
    gradients.images = image_gradients<S>(image_gradient_tensors);
    TensorMemory memory(inputs[kMeans3D]);
    with_input_gradients<S>(inputs, gradient_tensors, seen_only, gradients,
                            [&] { cuda::backward(own, gradients, how, memory); });
  }

  // The frame of a rendering that is walked again, what it saved not yet in it.
  template <class S>
  static cuda::Frame<S> frame_of_rendering(const Tensor& radii, const RasterConfig<S>& config, const Options& options) {
    cuda::Frame<S> frame;
    frame.inputs.num_gaussians = radii.numel();
    frame.config = config;
    frame.images.radii = mutable_data<int32_t>(radii);
    set_image(frame.camera, options);
    return frame;
  }

  // The same with what it saved, for passes that read no features.
  template <class S>
  static cuda::Frame<S> walked(const Expect& expect, const Tensor& radii, const Saved& saved,
                               const RasterConfig<S>& config, const Options& options) {
    auto own = frame_of_rendering<S>(radii, config, options);
    auto sizes = cuda::saved_sizes(own, run(options, nullptr));
    sizes.num_features = -1;
    own.saved = unpack<S>(expect, saved, sizes);
    return own;
  }

  template <class S>
  static void contributions(const Expect& expect, const Tensor& pixel_weights, const Tensor& radii, const Saved& saved,
                            const RasterConfig<S>& config, const Options& options, const ContributionSums<S>& sums) {
    TensorMemory memory(pixel_weights);
    cuda::contributions(walked<S>(expect, radii, saved, config, options), {data<S>(pixel_weights), sums},
                        {current_stream(), &memory, nullptr, options.deterministic});
  }

  template <class S>
  static void gate_map(const Expect& expect, const Tensor& gate_sum, const Tensor& radii, const Saved& saved,
                       const RasterConfig<S>& config, const Options& options, const GateMap& map) {
    auto own = walked<S>(expect, radii, saved, config, options);
    set_sums(own.saved, cuda::saved_sizes(own, run(options, nullptr)), mutable_data<S>(gate_sum));
    TensorMemory memory(radii);
    cuda::gate_map(own, map, {current_stream(), &memory});
  }

  template <class S>
  static void importance(const Expect& expect, const Tensor& gate_sum, const Tensor& radii, const Saved& saved,
                         const RasterConfig<S>& config, const Options& options, const ImportanceMap<S>& map) {
    auto own = frame_of_rendering<S>(radii, config, options);
    const cuda::Run how = run(options, nullptr);
    own.saved = unpack<S>(expect, saved, cuda::saved_sizes(own, how));
    set_sums(own.saved, cuda::saved_sizes(own, how), mutable_data<S>(gate_sum));
    TensorMemory memory(gate_sum);
    cuda::importance(own, map, {how.stream, &memory, nullptr, how.deterministic});
  }

  using ViewBatch = cuda::ViewBatch;
  static void count_rows(const ViewBatch& batch) { cuda::count_rows(batch, {current_stream()}); }
  static void project_rows(const ViewBatch& batch) { cuda::project_rows(batch, {current_stream()}); }
  static void project_rows_backward(const ViewBatch& batch, const GaussianGradients<float>& gradients) {
    cuda::project_rows_backward(batch, gradients, {current_stream()});
  }

  static Tensor visible(const char* function, const Tensor& positions, const Tensor& view, double near,
                        int64_t camera_model) {
    const Tensor visible = empty({positions.size(0)}, positions, kBool);
    dispatch(function, positions, [&](auto zero) {
      using S = decltype(zero);
      cuda::Frame<S> frame;
      frame.inputs.num_gaussians = positions.size(0);
      frame.inputs.means3D = positions.data_ptr<S>();
      frame.camera.view = view.data_ptr<S>();
      frame.camera.near = static_cast<float>(near);
      frame.camera.lens.model = static_cast<LensModel>(camera_model);
      cuda::mark_visible(frame, visible.data_ptr<bool>(), {current_stream()});
    });
    return visible;
  }
};

}  // namespace
}  // namespace binding
}  // namespace dsmoe

DSMOE_LIBRARY_IMPL(CUDA, m) {
  dsmoe::binding::register_ops<dsmoe::binding::Cuda>(m);
  dsmoe::binding::all_ops<dsmoe::binding::Cuda>(dsmoe::binding::Implementations{m});
}

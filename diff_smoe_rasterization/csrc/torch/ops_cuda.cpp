// The ops on CUDA: on the inputs' device, on torch's current stream.
#include <cuda_runtime_api.h>

#include "backend.h"
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

struct CudaCore {
  static constexpr bool kOnHost = false;
  static cudaStream_t where() { return current_stream(); }
  using Guard = DeviceGuard;
  template <class S> using Frame = cuda::Frame<S>;
  template <class S> using Gradients = cuda::Gradients<S>;
  using ViewBatch = cuda::ViewBatch;

  static int64_t feature_columns(int64_t num_features) { return cuda::feature_stride(static_cast<int>(num_features)); }
  template <class Config> static void set_threads(Config&) {}
  template <class Camera, class S> static void set_view(Camera& camera, const S* view) { camera.view = view; }
  template <class Camera, class S> static void set_view_end(Camera& camera, const S* view) { camera.view_end = view; }
  template <class Camera, class S>
  static void set_camera(Camera& camera, const S* view, const S* projection, const S* position) {
    camera.view = view, camera.projection = projection, camera.position = position;
  }

  static cuda::Run run(const Options& options, StageTimes* times) {
    cuda::Run run;
    run.stream = current_stream();
    run.deterministic = options.deterministic;
    run.for_backward = options.for_backward;
    run.times = times;
    return run;
  }
  static cuda::Run run(const Call& call) { return run(call.options, call.times); }

  static cuda::Work work(const Options& options, Allocator& memory) {
    return {current_stream(), &memory, nullptr, options.deterministic};
  }

  template <class Frame> static cuda::SavedSizes saved_sizes(const Frame& frame, const Options& options) {
    return cuda::saved_sizes(frame, run(options, nullptr));
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

  template <class Frame> static void forward(Frame& frame, const Call& call) {
    cuda::forward(frame, run(call), call.memory);
  }
  template <class Frame, class Gradients>
  static void backward(const Frame& frame, const Gradients& gradients, const Call& call) {
    cuda::backward(frame, gradients, run(call), call.memory);
  }
  template <class Frame> static void radii(const Frame& frame, const Call& call) {
    cuda::radii(frame, run(call), call.memory);
  }
  template <class Frame> static void project(const Frame& frame, const Call& call) {
    cuda::project_footprints(frame, run(call), call.memory);
  }
  template <class Frame, class Footprints, class Gradients>
  static void project_backward(const Frame& frame, const Footprints& footprints, const Gradients& gradients,
                               const Call& call) {
    cuda::project_footprints_backward(frame, footprints, gradients, run(call), call.memory);
  }
  template <class Frame> static void blend(Frame& frame, const Call& call) {
    cuda::blend_footprints(frame, run(call), call.memory);
  }
  template <class Frame, class Gradients, class Footprints>
  static void blend_backward(const Frame& frame, const Gradients& gradients, const Footprints& footprints,
                             const Call& call) {
    cuda::blend_footprints_backward(frame, gradients, footprints, run(call), call.memory);
  }
  template <class Frame> static void mark_visible(const Frame& frame, bool* visible) {
    cuda::mark_visible(frame, visible, {current_stream()});
  }

  static void count_rows(const ViewBatch& batch) { cuda::count_rows(batch, {current_stream()}); }
  static void project_rows(const ViewBatch& batch) { cuda::project_rows(batch, {current_stream()}); }
  static void project_rows_backward(const ViewBatch& batch, const GaussianGradients<float>& gradients) {
    cuda::project_rows_backward(batch, gradients, {current_stream()});
  }
};

using Cuda = Backend<CudaCore>;

}  // namespace
}  // namespace binding
}  // namespace dsmoe

DSMOE_LIBRARY_IMPL(CUDA, m) {
  dsmoe::binding::register_ops<dsmoe::binding::Cuda>(m);
  dsmoe::binding::all_ops<dsmoe::binding::Cuda>(dsmoe::binding::Implementations{m});
}

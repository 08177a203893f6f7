// What the ops ask of a backend, written once on a Core: CpuCore (ops_cpu.cpp) or CudaCore (ops_cuda.cpp). A Core has
// the backend's types, and its functions with arguments of one form.
#pragma once

#include "dsmoe/rasterize_cuda.h"
#include "op.h"
#include "process.h"

// Calls a pass over the pixels of a rendering (dsmoe/passes), which both backends have, on a Backend.
#define DSMOE_WALK(Backend, pass, frame, map, options, memory) \
  if constexpr (Backend::kOnHost) {                            \
    cpu::pass(frame, map);                                     \
  } else {                                                     \
    cuda::pass(frame, map, Backend::work(options, memory));    \
  }

namespace dsmoe {
namespace binding {

// How a function of a Core is called, besides what it computes.
struct Call {
  const Options& options;
  Allocator& memory;
  StageTimes* times;
};

template <class Core> struct Backend : Core {
  template <class S> using Frame = typename Core::template Frame<S>;
  template <class S> using Gradients = typename Core::template Gradients<S>;

  template <class S>
  static Frame<S> frame_of_gaussians(const Inputs& inputs, const Options& options, const Images& images) {
    Frame<S> frame;
    fill_frame<S>(frame, inputs, options);
    Core::set_camera(frame.camera, data<S>(inputs[kViewMatrix]), data<S>(inputs[kProjMatrix]),
                     data<S>(inputs[kCampos]));
    Core::set_view_end(frame.camera, data<S>(inputs[kViewMatrixEnd]));
    Core::set_threads(frame.config);
    frame.images = image_outputs<S>(images);
    return frame;
  }

  template <class S>
  static void forward(const Inputs& inputs, const Options& options, const Images& images, Allocator& memory) {
    auto own = frame_of_gaussians<S>(inputs, options, images);
    StageRecorder recorder(Pass::kForward);
    Core::forward(own, {options, memory, recorder.times()});
  }

  template <class S>
  static void radii(const Inputs& inputs, const Options& options, const Images& images, Allocator& memory) {
    Core::radii(frame_of_gaussians<S>(inputs, options, images), {options, memory, nullptr});
  }

  template <class S>
  static void project(const Inputs& inputs, const Options& options, const Images& images, const Tensor& gates,
                      const Tensor& features, Allocator& memory) {
    auto own = frame_of_gaussians<S>(inputs, options, images);
    own.saved.projected = reinterpret_cast<ProjectedGaussian<S>*>(mutable_data<S>(gates));
    own.saved.features = mutable_data<S>(features);
    StageRecorder recorder(Pass::kForward);
    Core::project(own, {options, memory, recorder.times()});
  }

  // The frame of some footprints, nothing saved yet.
  template <class S>
  static Frame<S> frame_of_footprints(const Footprints& of, const Options& options, const Images& images) {
    Frame<S> frame;
    frame.inputs.num_gaussians = of.gates.size(0);
    frame.config = footprint_config<S>(of.background, of.background_gate, options);
    Core::set_threads(frame.config);
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
    Core::blend(own, {options, memory, recorder.times()});
  }

  template <class S>
  static void blend_backward(const Expect& expect, const Footprints& of, const Options& options, const Images& images,
                             const Saved& saved, const Images& image_gradient_tensors, const Tensor& records,
                             const Tensor& background) {
    auto own = frame_of_footprints<S>(of, options, images);
    StageRecorder recorder(Pass::kBackward);
    take_saved(own, expect, saved, own.images.gate_sum, options);
    Gradients<S> gradients;
    gradients.images = image_gradients<S>(image_gradient_tensors);
    gradients.inputs.background = mutable_data<S>(background);
    TensorMemory memory(of.gates);
    Core::blend_backward(own, gradients, FootprintGradients<S>{mutable_data<S>(records), nullptr},
                         {options, memory, recorder.times()});
  }

  template <class S>
  static void project_backward(const Inputs& inputs, const Options& options, const Tensor& features,
                               const Tensor& radii, const Tensor& records, const Tensor& dL_ddepths,
                               const Inputs& gradient_tensors) {
    auto own = frame_of_gaussians<S>(inputs, options, Images());
    own.saved.features = mutable_data<S>(features);
    own.images.radii = mutable_data<int32_t>(radii);
    StageRecorder recorder(Pass::kBackward);
    Gradients<S> gradients;
    TensorMemory memory(features);
    with_input_gradients<S>(inputs, gradient_tensors, false, gradients, [&] {
      Core::project_backward(own, FootprintGradients<S>{mutable_data<S>(records), data<S>(dL_ddepths)},
                             gradients.inputs, {options, memory, recorder.times()});
    });
  }

  template <class S>
  static void backward(const Expect& expect, const Inputs& inputs, const Options& options, const Images& images,
                       const Saved& saved, const Images& image_gradient_tensors, const Inputs& gradient_tensors,
                       bool seen_only) {
    auto own = frame_of_gaussians<S>(inputs, options, images);
    StageRecorder recorder(Pass::kBackward);
    take_saved(own, expect, saved, own.images.gate_sum, options);
    Gradients<S> gradients;
    gradients.images = image_gradients<S>(image_gradient_tensors);
    TensorMemory memory(inputs[kMeans3D]);
    with_input_gradients<S>(inputs, gradient_tensors, seen_only, gradients, [&] {
      Core::backward(own, gradients, {options, memory, recorder.times()});
    });
  }

  // The frame of a rendering that is walked again, what it saved not yet in it.
  template <class S>
  static Frame<S> frame_of_rendering(const Tensor& radii, const RasterConfig<S>& config, const Options& options) {
    Frame<S> frame;
    frame.inputs.num_gaussians = radii.numel();
    frame.config = config;
    Core::set_threads(frame.config);
    frame.images.radii = mutable_data<int32_t>(radii);
    set_image(frame.camera, options);
    return frame;
  }

  // Checks what a rendering saved, and points the frame to it; then the gate sums, which the caller has.
  template <class S>
  static void take_saved(Frame<S>& frame, const Expect& expect, const Saved& saved, S* gate_sum,
                         const Options& options) {
    frame.saved = Core::template unpack<S>(expect, saved, Core::saved_sizes(frame, options));
    set_sums(frame.saved, Core::saved_sizes(frame, options), gate_sum);
  }

  // The frame of a rendering with what it saved, for passes that read no features.
  template <class S>
  static Frame<S> walked(const Expect& expect, const Tensor& radii, const Saved& saved, const RasterConfig<S>& config,
                         const Options& options) {
    auto own = frame_of_rendering<S>(radii, config, options);
    auto sizes = Core::saved_sizes(own, options);
    sizes.num_features = -1;
    own.saved = Core::template unpack<S>(expect, saved, sizes);
    return own;
  }

  // view_end: undefined if the shutter does not roll.
  static Tensor visible(const char* function, const Tensor& positions, const Tensor& view, const Tensor& view_end,
                        double near, int64_t camera_model) {
    const Tensor visible = empty({positions.size(0)}, positions, kBool);
    dispatch(function, positions, [&](auto zero) {
      using S = decltype(zero);
      Frame<S> frame;
      frame.inputs.num_gaussians = positions.size(0);
      frame.inputs.means3D = positions.data_ptr<S>();
      Core::set_view(frame.camera, view.data_ptr<S>());
      Core::set_view_end(frame.camera, data<S>(view_end));
      if (view_end.defined()) frame.camera.shutter = Shutter::kTopToBottom;
      frame.camera.near = static_cast<float>(near);
      frame.camera.lens.model = static_cast<LensModel>(camera_model);
      Core::mark_visible(frame, visible.data_ptr<bool>());
    });
    return visible;
  }
};

}  // namespace binding
}  // namespace dsmoe

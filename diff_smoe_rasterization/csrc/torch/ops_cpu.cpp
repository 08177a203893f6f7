// The ops on the CPU.
#include "ops.h"
#include "ops/all.h"
#include "process.h"

namespace dsmoe {
namespace binding {
namespace {

struct Cpu {
  static constexpr bool kOnHost = true;
  static int where() { return num_threads(); }
  struct Guard {
    explicit Guard(Device) {}
  };

  template <class S>
  static cpu::Frame<S> frame_of_gaussians(const Inputs& inputs, const Options& options, const Images& images) {
    cpu::Frame<S> frame;
    fill_frame<S>(frame, inputs, options);
    std::copy_n(data<S>(inputs[kViewMatrix]), 16, frame.camera.view);
    std::copy_n(data<S>(inputs[kProjMatrix]), 16, frame.camera.projection);
    std::copy_n(data<S>(inputs[kCampos]), 3, frame.camera.position);
    frame.config.num_threads = num_threads();
    frame.images = image_outputs<S>(images);
    return frame;
  }

  template <class S>
  static void forward(const Inputs& inputs, const Options& options, const Images& images, Allocator& memory) {
    auto own = frame_of_gaussians<S>(inputs, options, images);
    StageRecorder recorder(Pass::kForward);
    cpu::forward(own, memory, recorder.times());
  }

  template <class S>
  static void radii(const Inputs& inputs, const Options& options, const Images& images, Allocator& memory) {
    cpu::radii(frame_of_gaussians<S>(inputs, options, images), memory);
  }

  static int64_t feature_columns(int64_t num_features) { return num_features; }

  template <class S>
  static void project(const Inputs& inputs, const Options& options, const Images& images, const Tensor& gates,
                      const Tensor& features, Allocator&) {
    auto own = frame_of_gaussians<S>(inputs, options, images);
    own.saved.projected = reinterpret_cast<ProjectedGaussian<S>*>(mutable_data<S>(gates));
    own.saved.features = mutable_data<S>(features);
    StageRecorder recorder(Pass::kForward);
    cpu::project(own, recorder.times());
  }

  // The frame of some footprints, nothing saved yet.
  template <class S>
  static cpu::Frame<S> frame_of_footprints(const Footprints& of, const Options& options, const Images& images) {
    cpu::Frame<S> frame;
    frame.inputs.num_gaussians = of.gates.size(0);
    frame.config = footprint_config<S>(of.background, of.background_gate, options);
    frame.config.num_threads = num_threads();
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
    cpu::blend_footprints(own, memory, recorder.times());
  }

  template <class S>
  static void blend_backward(const Expect& expect, const Footprints& of, const Options& options, const Images& images,
                             const Saved& saved, const Images& image_gradient_tensors, const Tensor& records,
                             const Tensor& background) {
    auto own = frame_of_footprints<S>(of, options, images);
    own.saved = unpack<S>(expect, saved, cpu::saved_sizes(own));
    set_sums(own.saved, cpu::saved_sizes(own), own.images.gate_sum);
    cpu::Gradients<S> gradients;
    gradients.images = image_gradients<S>(image_gradient_tensors);
    gradients.inputs.background = mutable_data<S>(background);
    StageRecorder recorder(Pass::kBackward);
    cpu::blend_footprints_backward(own, gradients, {mutable_data<S>(records), nullptr}, recorder.times());
  }

  template <class S>
  static void project_backward(const Inputs& inputs, const Options& options, const Tensor& features,
                               const Tensor& radii, const Tensor& records, const Tensor& dL_ddepths,
                               const Inputs& gradient_tensors) {
    auto own = frame_of_gaussians<S>(inputs, options, Images());
    own.saved.features = mutable_data<S>(features);
    own.images.radii = mutable_data<int32_t>(radii);
    cpu::Gradients<S> gradients;
    with_input_gradients<S>(inputs, gradient_tensors, false, gradients, [&] {
      StageRecorder recorder(Pass::kBackward);
      cpu::project_backward(own, {mutable_data<S>(records), data<S>(dL_ddepths)}, gradients.inputs, recorder.times());
    });
  }

  // Checks what a rendering saved, and points to it.
  template <class S> static SavedForward<S> unpack(const Expect& expect, const Saved& tensors, SavedSizes sizes) {
    SavedForward<S> saved;
    unpack_saved(expect, tensors, saved, sizes);
    sizes.num_instances =
        saved_length(tensors, saved, "instances") > 0 ? saved.instance_offsets[sizes.num_gaussians] : 0;
    unpack_saved(expect, tensors, saved, sizes);
    return saved;
  }

  template <class S>
  static void backward(const Expect& expect, const Inputs& inputs, const Options& options, const Images& images,
                       const Saved& saved, const Images& image_gradient_tensors, const Inputs& gradient_tensors,
                       bool seen_only) {
    auto own = frame_of_gaussians<S>(inputs, options, images);
    own.saved = unpack<S>(expect, saved, cpu::saved_sizes(own));
    set_sums(own.saved, cpu::saved_sizes(own), own.images.gate_sum);
    cpu::Gradients<S> gradients;
    gradients.images = image_gradients<S>(image_gradient_tensors);
    with_input_gradients<S>(inputs, gradient_tensors, seen_only, gradients, [&] {
      StageRecorder recorder(Pass::kBackward);
      cpu::backward(own, gradients, recorder.times());
    });
  }

  // The frame of a rendering that is walked again, what it saved not yet in it.
  template <class S>
  static cpu::Frame<S> frame_of_rendering(const Tensor& radii, const RasterConfig<S>& config, const Options& options) {
    cpu::Frame<S> frame;
    frame.inputs.num_gaussians = radii.numel();
    frame.config = config;
    frame.config.num_threads = num_threads();
    frame.images.radii = mutable_data<int32_t>(radii);
    set_image(frame.camera, options);
    return frame;
  }

  // The same with what it saved, for passes that read no features.
  template <class S>
  static cpu::Frame<S> walked(const Expect& expect, const Tensor& radii, const Saved& saved,
                              const RasterConfig<S>& config, const Options& options) {
    auto own = frame_of_rendering<S>(radii, config, options);
    SavedSizes sizes = cpu::saved_sizes(own);
    sizes.num_features = -1;
    own.saved = unpack<S>(expect, saved, sizes);
    return own;
  }

  template <class S>
  static void contributions(const Expect& expect, const Tensor& pixel_weights, const Tensor& radii, const Saved& saved,
                            const RasterConfig<S>& config, const Options& options, const ContributionSums<S>& sums) {
    cpu::contributions(walked<S>(expect, radii, saved, config, options), {data<S>(pixel_weights), sums});
  }

  template <class S>
  static void gate_map(const Expect& expect, const Tensor& gate_sum, const Tensor& radii, const Saved& saved,
                       const RasterConfig<S>& config, const Options& options, const GateMap& map) {
    auto own = walked<S>(expect, radii, saved, config, options);
    set_sums(own.saved, cpu::saved_sizes(own), mutable_data<S>(gate_sum));
    cpu::gate_map(own, map);
  }

  template <class S>
  static void importance(const Expect& expect, const Tensor& gate_sum, const Tensor& radii, const Saved& saved,
                         const RasterConfig<S>& config, const Options& options, const ImportanceMap<S>& map) {
    auto own = frame_of_rendering<S>(radii, config, options);
    own.saved = unpack<S>(expect, saved, cpu::saved_sizes(own));
    set_sums(own.saved, cpu::saved_sizes(own), mutable_data<S>(gate_sum));
    cpu::importance(own, map);
  }

  using ViewBatch = cpu::ViewBatch;
  static void count_rows(const ViewBatch& batch) { cpu::count_rows(batch); }
  static void project_rows(const ViewBatch& batch) { cpu::project_rows(batch); }
  static void project_rows_backward(const ViewBatch& batch, const GaussianGradients<float>& gradients) {
    cpu::project_rows_backward(batch, gradients);
  }

  static Tensor visible(const char* function, const Tensor& positions, const Tensor& view, double near,
                        int64_t camera_model) {
    const Tensor visible = empty({positions.size(0)}, positions, kBool);
    dispatch(function, positions, [&](auto zero) {
      using S = decltype(zero);
      cpu::Frame<S> frame;
      frame.inputs.num_gaussians = positions.size(0);
      frame.inputs.means3D = positions.data_ptr<S>();
      std::copy_n(view.data_ptr<S>(), 16, frame.camera.view);
      frame.camera.near = static_cast<float>(near);
      frame.camera.lens.model = static_cast<LensModel>(camera_model);
      cpu::mark_visible(frame, visible.data_ptr<bool>());
    });
    return visible;
  }
};

}  // namespace
}  // namespace binding
}  // namespace dsmoe

DSMOE_LIBRARY_FRAGMENT(m) { dsmoe::binding::all_ops<dsmoe::binding::Cpu>(dsmoe::binding::Definitions{m}); }

DSMOE_LIBRARY_IMPL(CPU, m) {
  dsmoe::binding::register_ops<dsmoe::binding::Cpu>(m);
  dsmoe::binding::all_ops<dsmoe::binding::Cpu>(dsmoe::binding::Implementations{m});
}

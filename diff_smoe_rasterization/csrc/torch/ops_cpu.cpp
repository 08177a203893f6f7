// The ops on the CPU.
#include <ATen/Parallel.h>

#include "ops.h"
#include "profiling.h"

namespace dsmoe {
namespace binding {
namespace {

struct Cpu {
  struct Guard {
    explicit Guard(at::Device) {}
  };

  template <class S> static cpu::Frame<S> frame(const Inputs& inputs, const Options& options, const Images& images) {
    cpu::Frame<S> frame;
    fill_frame<S>(frame, inputs, options);
    std::copy_n(data<S>(inputs[kViewMatrix]), 16, frame.camera.view);
    std::copy_n(data<S>(inputs[kProjMatrix]), 16, frame.camera.projection);
    std::copy_n(data<S>(inputs[kCampos]), 3, frame.camera.position);
    frame.config.num_threads = at::get_num_threads();
    frame.images = image_outputs<S>(images);
    return frame;
  }

  template <class S>
  static void forward(const Inputs& inputs, const Options& options, const Images& images, Allocator& memory) {
    auto own = frame<S>(inputs, options, images);
    StageRecorder recorder(Pass::kForward);
    cpu::forward(own, memory, recorder.times());
  }

  template <class S>
  static void radii(const Inputs& inputs, const Options& options, const Images& images, Allocator& memory) {
    cpu::radii(frame<S>(inputs, options, images), memory);
  }

  // Checks what a rendering saved, and points to it.
  template <class S>
  static SavedForward<S> unpack(const char* function, const Saved& tensors, SavedSizes sizes, at::Device device) {
    SavedForward<S> saved;
    unpack_saved(function, tensors, saved, sizes, device);
    sizes.num_instances =
        saved_length(tensors, saved, "instances") > 0 ? saved.instance_offsets[sizes.num_gaussians] : 0;
    unpack_saved(function, tensors, saved, sizes, device);
    return saved;
  }

  template <class S>
  static void backward(const Inputs& inputs, const Options& options, const Images& images, const Saved& saved,
                       const Images& image_gradient_tensors, const Inputs& gradient_tensors) {
    auto own = frame<S>(inputs, options, images);
    own.saved = unpack<S>("rasterize_backward", saved, cpu::saved_sizes(own), inputs[kMeans3D].device());
    own.saved.gate_sum = own.images.gate_sum;
    cpu::Gradients<S> gradients;
    gradients.images = image_gradients<S>(image_gradient_tensors);
    with_input_gradients<S>(inputs, gradient_tensors, gradients, [&] {
      StageRecorder recorder(Pass::kBackward);
      cpu::backward(own, gradients, recorder.times());
    });
  }

  template <class S>
  static void contributions(const at::Tensor& pixel_weights, const at::Tensor& radii, const Saved& saved,
                            RasterConfig<S> config, const Options& options, const ContributionSums<S>& sums) {
    cpu::Frame<S> own;
    own.inputs.num_gaussians = radii.numel();
    own.config = config;
    own.config.num_threads = at::get_num_threads();
    own.images.radii = mutable_data<int32_t>(radii);
    set_image(own.camera, options);
    SavedSizes sizes = cpu::saved_sizes(own);
    sizes.num_features = -1;
    own.saved = unpack<S>("contributions", saved, sizes, radii.device());
    cpu::contributions(own, {data<S>(pixel_weights), sums});
  }

  template <class S>
  static void importance(const at::Tensor& gate_sum, const at::Tensor& radii, const Saved& saved,
                         const RasterConfig<S>& config, const Options& options, const ImportanceMap<S>& map) {
    cpu::Frame<S> own;
    own.inputs.num_gaussians = radii.numel();
    own.config = config;
    own.config.num_threads = at::get_num_threads();
    own.images.radii = mutable_data<int32_t>(radii);
    set_image(own.camera, options);
    own.saved = unpack<S>("importance", saved, cpu::saved_sizes(own), radii.device());
    own.saved.gate_sum = mutable_data<S>(gate_sum);
    cpu::importance(own, map);
  }

  static at::Tensor visible(const at::Tensor& positions, const at::Tensor& view, double near) {
    const at::Tensor visible = at::empty({positions.size(0)}, at::kBool);
    dispatch(positions, [&](auto zero) {
      using S = decltype(zero);
      cpu::Frame<S> frame;
      frame.inputs.num_gaussians = positions.size(0);
      frame.inputs.means3D = positions.data_ptr<S>();
      std::copy_n(view.data_ptr<S>(), 16, frame.camera.view);
      frame.camera.near = static_cast<float>(near);
      cpu::mark_visible(frame, visible.data_ptr<bool>());
    });
    return visible;
  }
};

}  // namespace
}  // namespace binding
}  // namespace dsmoe

TORCH_LIBRARY_IMPL(diff_smoe_rasterization, CPU, m) { dsmoe::binding::register_ops<dsmoe::binding::Cpu>(m); }

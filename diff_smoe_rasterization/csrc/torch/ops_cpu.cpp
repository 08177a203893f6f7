// The ops on the CPU.
#include <algorithm>

#include "backend.h"
#include "ops.h"
#include "ops/all.h"

namespace dsmoe {
namespace binding {
namespace {

struct CpuCore {
  static constexpr bool kOnHost = true;
  static int where() { return num_threads(); }
  struct Guard {
    explicit Guard(Device) {}
  };
  template <class S> using Frame = cpu::Frame<S>;
  template <class S> using Gradients = cpu::Gradients<S>;
  using ViewBatch = cpu::ViewBatch;

  static int64_t feature_columns(int64_t num_features) { return num_features; }
  template <class Config> static void set_threads(Config& config) { config.num_threads = num_threads(); }
  template <class S> static void set_view(Camera<S>& camera, const S* view) { std::copy_n(view, 16, camera.view); }
  template <class S> static void set_view_end(Camera<S>& camera, const S* view) {
    if (view != nullptr) std::copy_n(view, 16, camera.view_end);
  }
  template <class S> static void set_camera(Camera<S>& camera, const S* view, const S* projection, const S* position) {
    set_view(camera, view);
    std::copy_n(projection, 16, camera.projection);
    std::copy_n(position, 3, camera.position);
  }

  template <class Frame> static SavedSizes saved_sizes(const Frame& frame, const Options&) {
    return cpu::saved_sizes(frame);
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

  template <class Frame> static void forward(Frame& frame, const Call& call) {
    cpu::forward(frame, call.memory, call.times);
  }
  template <class Frame, class Gradients>
  static void backward(const Frame& frame, const Gradients& gradients, const Call& call) {
    cpu::backward(frame, gradients, call.times);
  }
  template <class Frame> static void radii(const Frame& frame, const Call& call) { cpu::radii(frame, call.memory); }
  template <class Frame> static void project(Frame& frame, const Call& call) { cpu::project(frame, call.times); }
  template <class Frame, class Footprints, class Gradients>
  static void project_backward(const Frame& frame, const Footprints& footprints, const Gradients& gradients,
                               const Call& call) {
    cpu::project_backward(frame, footprints, gradients, call.times);
  }
  template <class Frame> static void blend(Frame& frame, const Call& call) {
    cpu::blend_footprints(frame, call.memory, call.times);
  }
  template <class Frame, class Gradients, class Footprints>
  static void blend_backward(const Frame& frame, const Gradients& gradients, const Footprints& footprints,
                             const Call& call) {
    cpu::blend_footprints_backward(frame, gradients, footprints, call.times);
  }
  template <class Frame> static void mark_visible(const Frame& frame, bool* visible) {
    cpu::mark_visible(frame, visible);
  }

  static void count_rows(const ViewBatch& batch) { cpu::count_rows(batch); }
  static void project_rows(const ViewBatch& batch) { cpu::project_rows(batch); }
  static void project_rows_backward(const ViewBatch& batch, const GaussianGradients<float>& gradients) {
    cpu::project_rows_backward(batch, gradients);
  }
};

using Cpu = Backend<CpuCore>;

}  // namespace
}  // namespace binding
}  // namespace dsmoe

DSMOE_LIBRARY_FRAGMENT(m) { dsmoe::binding::all_ops<dsmoe::binding::Cpu>(dsmoe::binding::Definitions{m}); }

DSMOE_LIBRARY_IMPL(CPU, m) {
  dsmoe::binding::register_ops<dsmoe::binding::Cpu>(m);
  dsmoe::binding::all_ops<dsmoe::binding::Cpu>(dsmoe::binding::Implementations{m});
}

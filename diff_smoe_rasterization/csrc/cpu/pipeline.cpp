// The order of the stages, and the memory between them.
#include "dsmoe/rasterize.h"

namespace dsmoe {
namespace cpu {

template <class S> void forward(Frame<S>& frame, Allocator& memory, StageTimes* times) {
  auto& [inputs, camera, config, images, saved] = frame;
  SavedSizes sizes = saved_sizes(frame);
  saved = {};
  saved.gate_sum = images.gate_sum;
  allocate_saved(saved, sizes, memory);
  sizes.num_instances = project(inputs, camera, config, saved, images, times);
  allocate_saved(saved, sizes, memory);
  bin(inputs.num_gaussians, camera, config, saved, images.radii, times);
  blend(camera, config, saved, images, times);
}

template <class S> void backward(const Frame<S>& frame, const Gradients<S>& gradients, StageTimes* times) {
  backward(frame.inputs, frame.camera, frame.config, frame.saved, frame.images, gradients.images, gradients.inputs,
           times);
}

template <class S> void radii(const Frame<S>& frame, Scratch& scratch) {
  const int64_t count = frame.inputs.num_gaussians;
  SavedForward<S> unused;
  const auto allocate = [&](auto*& pointer, int64_t size) {
    pointer = static_cast<std::remove_reference_t<decltype(pointer)>>(scratch.allocate(size * sizeof(*pointer)));
  };
  allocate(unused.projected, count);
  allocate(unused.features, count * frame.config.num_features());
  allocate(unused.instance_offsets, count + 1);
  project(frame.inputs, frame.camera, frame.config, unused, frame.images);
}

#define DSMOE_INSTANTIATE(S)                                                 \
  template void forward(Frame<S>&, Allocator&, StageTimes*);                 \
  template void backward(const Frame<S>&, const Gradients<S>&, StageTimes*); \
  template void radii(const Frame<S>&, Scratch&);
DSMOE_INSTANTIATE(float)
DSMOE_INSTANTIATE(double)
#undef DSMOE_INSTANTIATE

}  // namespace cpu
}  // namespace dsmoe

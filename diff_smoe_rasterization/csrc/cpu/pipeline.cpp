// The order of the stages, and the memory between them.
#include "dsmoe/rasterize.h"

namespace dsmoe {
namespace cpu {

template <class S> void forward(Frame<S>& frame, Allocator& memory, StageTimes* times) {
  SavedSizes sizes = saved_sizes(frame);
  frame.saved = {};
  frame.saved.gate_sum = frame.images.gate_sum;
  allocate_saved(frame.saved, sizes, memory);
  sizes.num_instances = project(frame, times);
  allocate_saved(frame.saved, sizes, memory);
  bin(frame, times);
  blend(frame, times);
}

template <class S> void blend_footprints(Frame<S>& frame, Allocator& memory, StageTimes* times) {
  SavedSizes sizes = saved_sizes(frame);
  const SavedForward<S> given = frame.saved;
  frame.saved = {};
  frame.saved.projected = given.projected, frame.saved.features = given.features;
  frame.saved.gate_sum = frame.images.gate_sum;
  allocate_saved(frame.saved, sizes, memory);
  sizes.num_instances = count_instances(frame, times);
  allocate_saved(frame.saved, sizes, memory);
  bin(frame, times);
  blend(frame, times);
}

template <class S> void radii(const Frame<S>& frame, Scratch& scratch) {
  const int64_t count = frame.inputs.num_gaussians;
  Frame<S> projected = frame;
  const auto allocate = [&](auto*& pointer, int64_t size) {
    void* memory = scratch.allocate(size * sizeof(*pointer));
    if (memory == nullptr && size > 0) throw std::bad_alloc();
    pointer = static_cast<std::remove_reference_t<decltype(pointer)>>(memory);
  };
  allocate(projected.saved.projected, count);
  allocate(projected.saved.features, count * frame.config.num_features());
  projected.saved.instance_offsets = nullptr;
  project(projected);
}

#define DSMOE_INSTANTIATE(S)                                          \
  template void forward(Frame<S>&, Allocator&, StageTimes*);          \
  template void blend_footprints(Frame<S>&, Allocator&, StageTimes*); \
  template void radii(const Frame<S>&, Scratch&);
DSMOE_INSTANTIATE(float)
DSMOE_INSTANTIATE(double)
#undef DSMOE_INSTANTIATE

}  // namespace cpu
}  // namespace dsmoe

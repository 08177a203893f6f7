// The order of the stages, and the memory between them.
#include <new>

#include "../refuse.h"
#include "dsmoe/rasterize.h"

namespace dsmoe {
namespace cpu {
namespace {

constexpr std::align_val_t kAlignment{256};  // as Scratch promises

// From the footprints to the images. Lists are kept if they fit.
template <class S>
void draw(Frame<S>& frame, SavedSizes sizes, int64_t num_instances, Allocator& memory, StageTimes* times) {
  const bool fit = num_instances <= frame.config.most_instances;
  sizes.num_instances = fit ? num_instances : 0;
  allocate_saved(frame.saved, sizes, memory);
  set_sums(frame.saved, sizes, frame.images.gate_sum);
  if (fit) {
    bin(frame, times);
  } else {
    frame.saved.instances = nullptr;
  }
  blend(frame, times);
}

}  // namespace

template <class S> void forward(Frame<S>& frame, Allocator& memory, StageTimes* times) {
  refuse_forward("cpu::forward", frame);
  SavedSizes sizes = saved_sizes(frame);
  frame.saved = {};
  allocate_saved(frame.saved, sizes, memory);
  draw(frame, sizes, project(frame, times), memory, times);
}

template <class S> void blend_footprints(Frame<S>& frame, Allocator& memory, StageTimes* times) {
  refuse_blend_footprints("cpu::blend_footprints", frame);
  SavedSizes sizes = saved_sizes(frame);
  const SavedForward<S> given = frame.saved;
  frame.saved = {};
  frame.saved.projected = given.projected, frame.saved.features = given.features;
  allocate_saved(frame.saved, sizes, memory);
  draw(frame, sizes, count_instances(frame, times), memory, times);
}

template <class S> void radii(const Frame<S>& frame, Scratch& scratch) {
  refuse_radii("cpu::radii", frame);
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

Heap::~Heap() {
  for (void* block : blocks_) ::operator delete(block, kAlignment);
}

void* Heap::allocate(size_t bytes) {
  blocks_.reserve(blocks_.size() + 1);  // so that no block is lost
  blocks_.push_back(::operator new(bytes, kAlignment));
  return blocks_.back();
}

void* Heap::keep(int, const SavedArray& array) { return allocate(array.bytes()); }

void Heap::release() {}

}  // namespace cpu
}  // namespace dsmoe

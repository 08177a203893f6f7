// The order of the stages, and the memory between them. A capacity that turns out too small costs time, not
// correctness (rasterize_cuda.h). So only the first call of a kind waits for the number of instances.
#include <algorithm>

#include "../refuse.h"
#include "capacity.h"
#include "check.h"
#include "dsmoe/rasterize_cuda.h"
#include "event_clock.h"
#include "scratch.h"

namespace dsmoe {
namespace cuda {
namespace {

template <class T> T* allocate_zeros(Scratch& scratch, int64_t count, cudaStream_t stream) {
  T* memory = allocate<T>(scratch, count);
  if (count > 0) check(cudaMemsetAsync(memory, 0, count * sizeof(T), stream), "clearing scratch memory");
  return memory;
}

// Memory for what the depth sort sorts; null in a mode without a depth order.
template <class S> DepthBits<S>* allocate_depths(const Frame<S>& frame, Scratch& scratch) {
  if (!needs_depth_order(frame.config.blend.mode)) return nullptr;
  return allocate<DepthBits<S>>(scratch, frame.inputs.num_gaussians);
}

// Adds the pairs that were counted. Waits for them.
void add_pairs(const Work& work, int64_t* sum) {
  if (sum != nullptr) *sum += static_cast<int64_t>(read(work.pairs, "counting pairs", work.stream));
}

template <class S> InstanceCapacities::Key capacity_key(const Frame<S>& frame) {
  int device = 0;
  check(cudaGetDevice(&device), "asking for the device");
  return InstanceCapacities::key(device, frame.camera.width, frame.camera.height,
                                 static_cast<int>(frame.config.blend.mode), frame.inputs.num_gaussians);
}

// Returns for how many instances there will be room, 1 or more; 0 if there are more than are listed at once.
template <class S>
int64_t choose_capacity(const Frame<S>& frame, const InstanceCapacities::Key& key, const Run& run, const Work& work) {
  const int64_t most = frame.config.most_instances;
  const bool captured = is_capturing(run.stream);
  int64_t capacity = InstanceCapacities::shared().likely(key, frame.inputs.num_gaussians, captured);
  if (captured) {  // nothing can be counted then
    if (capacity < 0) capacity = 8 * frame.inputs.num_gaussians + 1024;
    return std::max<int64_t>(1, std::min(capacity, most));
  }
  if (capacity > 0 && capacity <= most) return capacity;
  count_instances(frame, work);
  const auto count = read(frame.saved.num_instances, "projecting Gaussians", run.stream);
  if (count > most) return 0;
  // Some more, because the lists are made by squares of 8x8 pixels, which round elsewhere than the count by tiles.
  return std::min(most, count + count / 8 + 1);
}

// Allocates the missing arrays of frame.saved whose sizes do not depend on the instance count.
template <class S> SavedSizes begin_saved(Frame<S>& frame, const Run& run, Allocator& memory) {
  const SavedSizes sizes = saved_sizes(frame, run);
  allocate_saved(frame.saved, sizes, memory);
  complete(frame.saved, sizes);
  set_sums(frame.saved, sizes, frame.images.gate_sum);
  return sizes;
}

// From the footprints and their depths to the images.
template <class S>
void draw(Frame<S>& frame, SavedSizes sizes, const DepthBits<S>* depths, const Run& run, Allocator& memory,
          EventClock& clock) {
  auto& saved = frame.saved;
  Work work = {run.stream, &memory};
  if (depths != nullptr) sort_by_depth(frame, depths, work);
  clock.end(&StageTimes::sort);
  memory.release();

  const auto key = capacity_key(frame);
  sizes.capacity = choose_capacity(frame, key, run, work);
  memory.release();
  sizes.segments = sizes.segments && sizes.capacity > 0;
  allocate_saved(saved, sizes, memory);
  complete(saved, sizes);
  if (sizes.capacity > 0) bin(frame, work);
  memory.release();
  InstanceCapacities::shared().learn(key, frame.inputs.num_gaussians, saved.num_instances, run.stream);
  clock.end(&StageTimes::bin);

  if (run.times != nullptr) work.pairs = allocate_zeros<unsigned long long>(memory, 1, run.stream);
  blend(frame, work);
  clock.end(&StageTimes::blend);
  clock.finish();
  add_pairs(work, run.times != nullptr ? &run.times->forward_pairs : nullptr);
  memory.release();
}

// The caller's records, or zeroed memory for them.
template <class S> S* begin_records(const Frame<S>& frame, S* given, const Run& run, Allocator& memory) {
  const int64_t size = frame.inputs.num_gaussians * (kNumGateMoments + frame.config.num_features());
  if (given == nullptr) return allocate_zeros<S>(memory, size, run.stream);
  if (size > 0) check(cudaMemsetAsync(given, 0, size * sizeof(S), run.stream), "clearing gradients");
  return given;
}

}  // namespace

template <class S> void forward(Frame<S>& frame, const Run& run, Allocator& memory) {
  refuse_forward("cuda::forward", frame);
  EventClock clock(run.times, run.stream);
  frame.saved = {};
  const SavedSizes sizes = begin_saved(frame, run, memory);
  DepthBits<S>* depths = allocate_depths(frame, memory);
  project(frame, depths, {run.stream, &memory});
  clock.end(&StageTimes::project);
  draw(frame, sizes, depths, run, memory, clock);
}

template <class S> void project_footprints(const Frame<S>& frame, const Run& run, Allocator& memory) {
  refuse_project("cuda::project_footprints", frame);
  EventClock clock(run.times, run.stream);
  project<S>(frame, nullptr, {run.stream, &memory});
  clock.end(&StageTimes::project);
  clock.finish();
  memory.release();
}

template <class S> void blend_footprints(Frame<S>& frame, const Run& run, Allocator& memory) {
  refuse_blend_footprints("cuda::blend_footprints", frame);
  EventClock clock(run.times, run.stream);
  const SavedForward<S> given = frame.saved;
  frame.saved = {};
  frame.saved.projected = given.projected, frame.saved.features = given.features;
  const SavedSizes sizes = begin_saved(frame, run, memory);
  DepthBits<S>* depths = allocate_depths(frame, memory);
  key_footprints(frame, depths, {run.stream, &memory});
  draw(frame, sizes, depths, run, memory, clock);
}

template <class S>
void backward(const Frame<S>& frame, const Gradients<S>& gradients, const Run& run, Allocator& memory) {
  refuse_backward("cuda::backward", frame, gradients.images, saved_sizes(frame, run));
  Work work = {run.stream, &memory};
  if (run.times != nullptr) work.pairs = allocate_zeros<unsigned long long>(memory, 1, run.stream);
  EventClock clock(run.times, run.stream);
  BackwardPass<S> pass;
  pass.gradients = gradients;
  pass.deterministic = run.deterministic;
  pass.dL_dgaussians = begin_records<S>(frame, nullptr, run, memory);
  blend_backward(frame, pass, work);
  clock.end(&StageTimes::blend_backward);
  project_backward(frame, pass, work);
  clock.end(&StageTimes::project_backward);
  clock.finish();
  add_pairs(work, run.times != nullptr ? &run.times->backward_pairs : nullptr);
  memory.release();
}

template <class S>
void blend_footprints_backward(const Frame<S>& frame, const Gradients<S>& gradients,
                               const FootprintGradients<S>& footprints, const Run& run, Allocator& memory) {
  refuse_blend_backward("cuda::blend_footprints_backward", frame, gradients.images, footprints,
                        saved_sizes(frame, run));
  Work work = {run.stream, &memory};
  if (run.times != nullptr) work.pairs = allocate_zeros<unsigned long long>(memory, 1, run.stream);
  EventClock clock(run.times, run.stream);
  BackwardPass<S> pass;
  pass.gradients = gradients;
  pass.deterministic = run.deterministic;
  pass.dL_dgaussians = begin_records(frame, footprints.records, run, memory);
  blend_backward(frame, pass, work);
  finish_records(frame, pass, work);
  clock.end(&StageTimes::blend_backward);
  clock.finish();
  add_pairs(work, run.times != nullptr ? &run.times->backward_pairs : nullptr);
  memory.release();
}

template <class S>
void project_footprints_backward(const Frame<S>& frame, const FootprintGradients<S>& footprints,
                                 const GaussianGradients<S>& gradients, const Run& run, Allocator& memory) {
  refuse_project_backward("cuda::project_footprints_backward", frame, footprints);
  EventClock clock(run.times, run.stream);
  BackwardPass<S> pass;
  pass.gradients.inputs = gradients;
  pass.dL_dgaussians = footprints.records;
  pass.by_footprints = true;
  pass.dL_ddepths = footprints.depths;
  project_backward(frame, pass, {run.stream, &memory});
  clock.end(&StageTimes::project_backward);
  clock.finish();
  memory.release();
}

template <class S> void radii(const Frame<S>& frame, const Run& run, Allocator& memory) {
  refuse_radii("cuda::radii", frame);
  if (frame.config.num_features() <= kMostHeldFeatures) return project_radii(frame, {run.stream});
  const int64_t count = frame.inputs.num_gaussians;
  Frame<S> projected = frame;
  projected.saved.projected = allocate<ProjectedGaussian<S>>(memory, count);
  projected.saved.features = allocate<S>(memory, count * feature_stride(frame.config.num_features()));
  projected.saved.order = nullptr;
  project<S>(projected, nullptr, {run.stream, &memory});
  memory.release();
}

#define DSMOE_INSTANTIATE(S)                                                                                  \
  template void forward(Frame<S>&, const Run&, Allocator&);                                                   \
  template void backward(const Frame<S>&, const Gradients<S>&, const Run&, Allocator&);                       \
  template void project_footprints(const Frame<S>&, const Run&, Allocator&);                                  \
  template void blend_footprints(Frame<S>&, const Run&, Allocator&);                                          \
  template void blend_footprints_backward(const Frame<S>&, const Gradients<S>&, const FootprintGradients<S>&, \
                                          const Run&, Allocator&);                                            \
  template void project_footprints_backward(const Frame<S>&, const FootprintGradients<S>&,                    \
                                            const GaussianGradients<S>&, const Run&, Allocator&);             \
  template void radii(const Frame<S>&, const Run&, Allocator&);
DSMOE_INSTANTIATE(float)
DSMOE_INSTANTIATE(double)
#undef DSMOE_INSTANTIATE

}  // namespace cuda
}  // namespace dsmoe

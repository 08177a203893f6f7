// The order of the stages, and the memory between them. A capacity that turns out too small costs time, not
// correctness (rasterize_cuda.h). So only the first call of a kind waits for the number of instances.
#include <algorithm>

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
  if (!needs_depth_order(frame.config.mode)) return nullptr;
  return allocate<DepthBits<S>>(scratch, frame.inputs.num_gaussians);
}

// Adds the pairs that were counted. Waits for them.
void add_pairs(const Work& work, int64_t* sum) {
  if (sum != nullptr) *sum += static_cast<int64_t>(read(work.pairs, "counting pairs", work.stream));
}

template <class S> InstanceCapacities::Key capacity_key(const Frame<S>& frame) {
  int device = 0;
  check(cudaGetDevice(&device), "asking for the device");
  return InstanceCapacities::key(device, frame.camera.width, frame.camera.height, static_cast<int>(frame.config.mode),
                                 frame.inputs.num_gaussians);
}

// Returns for how many instances there will be room, 1 or more; 0 where there are more than are listed at once.
template <class S>
int64_t choose_capacity(const Frame<S>& frame, const InstanceCapacities::Key& key, const Run& run, const Work& work) {
  const int64_t most = frame.config.most_instances;
  int64_t capacity = InstanceCapacities::shared().likely(key);
  if (is_capturing(run.stream)) {  // nothing can be counted then
    if (capacity < 0) capacity = 8 * frame.inputs.num_gaussians + 1024;
    return std::min(capacity, most);
  }
  if (capacity > 0 && capacity <= most) return capacity;
  count_instances(frame, work);
  const auto count = read(frame.saved.num_instances, "projecting Gaussians", run.stream);
  if (count > most) return 0;
  // The lists of macro tiles must fit too. Seldom are they longer, by macro tiles that long Gaussians only pass by.
  return std::min(most, count + count / 8 + 1);
}

}  // namespace

template <class S> void forward(Frame<S>& frame, const Run& run, Allocator& memory) {
  auto& saved = frame.saved;
  Work work = {run.stream, &memory};
  EventClock clock(run.times, run.stream);

  SavedSizes sizes = saved_sizes(frame, run);
  saved = {};
  saved.gate_sum = frame.images.gate_sum;
  allocate_saved(saved, sizes, memory);
  complete(saved, sizes);
  DepthBits<S>* depths = allocate_depths(frame, memory);
  project(frame, depths, work);
  clock.end(&StageTimes::project);
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
  InstanceCapacities::shared().learn(key, saved.num_instances, run.stream);
  clock.end(&StageTimes::bin);

  if (run.times != nullptr) work.pairs = allocate_zeros<unsigned long long>(memory, 1, run.stream);
  blend(frame, work);
  clock.end(&StageTimes::blend);
  clock.finish();
  add_pairs(work, run.times != nullptr ? &run.times->forward_pairs : nullptr);
  memory.release();
}

template <class S>
void backward(const Frame<S>& frame, const Gradients<S>& gradients, const Run& run, Allocator& memory) {
  const int64_t count = frame.inputs.num_gaussians;
  const int64_t record = kNumGateMoments + frame.config.num_features();
  Work work = {run.stream, &memory};
  if (run.times != nullptr) work.pairs = allocate_zeros<unsigned long long>(memory, 1, run.stream);
  EventClock clock(run.times, run.stream);
  BackwardPass<S> pass;
  pass.gradients = gradients;
  pass.deterministic = run.deterministic;
  pass.dL_dgaussians = allocate_zeros<S>(memory, count * record, run.stream);
  blend_backward(frame, pass, work);
  clock.end(&StageTimes::blend_backward);
  project_backward(frame, pass, work);
  clock.end(&StageTimes::project_backward);
  clock.finish();
  add_pairs(work, run.times != nullptr ? &run.times->backward_pairs : nullptr);
  memory.release();
}

template <class S> void radii(const Frame<S>& frame, const Run& run, Allocator& memory) {
  const int64_t count = frame.inputs.num_gaussians;
  Frame<S> projected = frame;
  projected.saved.projected = allocate<ProjectedGaussian<S>>(memory, count);
  projected.saved.features = allocate<S>(memory, count * feature_stride(frame.config.num_features()));
  projected.saved.order = nullptr;
  project<S>(projected, nullptr, {run.stream, &memory});
  memory.release();
}

#define DSMOE_INSTANTIATE(S)                                                            \
  template void forward(Frame<S>&, const Run&, Allocator&);                             \
  template void backward(const Frame<S>&, const Gradients<S>&, const Run&, Allocator&); \
  template void radii(const Frame<S>&, const Run&, Allocator&);
DSMOE_INSTANTIATE(float)
DSMOE_INSTANTIATE(double)
#undef DSMOE_INSTANTIATE

}  // namespace cuda
}  // namespace dsmoe

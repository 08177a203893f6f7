// Stage 2: the depth order. Only Gaussians that are not culled are sorted.
#include "device.cuh"
#include "radix_sort.cuh"

namespace dsmoe {
namespace cuda {

template <class S> constexpr int kPasses = 8 * int(sizeof(S)) / kDepthDigit;

template <class S> void sort_by_depth(const Frame<S>& frame, const DepthBits<S>* depths, const Work& work) {
  const int64_t count = frame.inputs.num_gaussians;
  const cudaStream_t stream = work.stream;
  if (count == 0) return;  // `project` has said so
  Scratch& scratch = *work.scratch;
  constexpr int kBins = 1 << kDepthDigit;
  const int64_t of_groups = num_groups(count) * kBins, size = kPasses<S> * of_groups;
  auto* zeros = allocate<uint32_t>(scratch, size);
  check(cudaMemsetAsync(zeros, 0, size * sizeof(*zeros), stream), "sorting by depth");

  DepthBits<S>* keys[2] = {allocate<DepthBits<S>>(scratch, count), allocate<DepthBits<S>>(scratch, count)};
  int32_t* values = allocate<int32_t>(scratch, count);
  RadixPass<DepthBits<S>> pass = {};
  pass.capacity = count;
  pass.keys = depths;
  pass.strips = allocate<uint32_t>(scratch, num_strips(count) * kBins);
  for (int p = 0; p < kPasses<S>; ++p) {
    const bool last = p + 1 == kPasses<S>;
    pass.sorted_keys = last ? nullptr : keys[p % 2];
    pass.sorted_values = p % 2 == 0 ? values : frame.saved.order;  // the last one is odd
    pass.total = p == 0 ? frame.saved.num_ordered : nullptr;
    pass.groups = zeros + p * of_groups;
    pass.shift = p * kDepthDigit;
    launch_radix_pass<kDepthDigit>(pass, stream);
    pass.count = frame.saved.num_ordered;
    pass.keys = pass.sorted_keys;
    pass.values = pass.sorted_values;
  }
}
static_assert(kPasses<float> % 2 == 0 && kPasses<double> % 2 == 0, "the last pass writes the order");

#define DSMOE_INSTANTIATE(S) template void sort_by_depth(const Frame<S>&, const DepthBits<S>*, const Work&);
DSMOE_INSTANTIATE(float)
DSMOE_INSTANTIATE(double)
#undef DSMOE_INSTANTIATE

}  // namespace cuda
}  // namespace dsmoe

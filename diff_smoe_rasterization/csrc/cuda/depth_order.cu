// Stage 2: the depth order. Only Gaussians that are not culled are sorted.
#include "device.cuh"
#include "radix_sort.cuh"

namespace dsmoe {
namespace cuda {
namespace {

constexpr int kBins = 1 << kDepthDigit;
template <class S> constexpr int kPasses = 8 * int(sizeof(S)) / kDepthDigit;

template <class S> struct HistogramArguments {
  int64_t count;               // N
  const DepthBits<S>* depths;  // [N] the greatest number for culled Gaussians
  uint32_t* histograms;        // [kPasses, kBins] depths with each digit, culled ones left out; zero before
};

template <class S>
__global__ void __launch_bounds__(kSortBlock)
    depth_histogram_kernel(const __grid_constant__ HistogramArguments<S> arguments) {
  constexpr int kCopies = kHistogramCopies<S>, kSize = kPasses<S> * kBins;
  __shared__ uint32_t counts[kSize * kCopies];
  for (int i = threadIdx.x; i < kSize * kCopies; i += kSortBlock) counts[i] = 0;
  __syncthreads();
  const int copy = threadIdx.x % kCopies;
  const int64_t step = int64_t(gridDim.x) * kSortBlock;
  for (int64_t first = int64_t(blockIdx.x) * kSortBlock + threadIdx.x; first < arguments.count;
       first += kDepthsAtOnce * step) {
    constexpr DepthBits<S> kCulled = ~DepthBits<S>(0);
    DepthBits<S> depths[kDepthsAtOnce];  // read together, so that the loads do not wait for each other
#pragma unroll
    for (int i = 0; i < kDepthsAtOnce; ++i) {
      depths[i] = first + i * step < arguments.count ? arguments.depths[first + i * step] : kCulled;
    }
#pragma unroll
    for (int i = 0; i < kDepthsAtOnce; ++i) {
      if (depths[i] == kCulled) continue;
#pragma unroll
      for (int pass = 0; pass < kPasses<S>; ++pass) {
        const int digit = static_cast<int>(depths[i] >> (pass * kDepthDigit)) & (kBins - 1);
        atomicAdd(&counts[(pass * kBins + digit) * kCopies + copy], 1u);
      }
    }
  }
  __syncthreads();
  for (int i = threadIdx.x; i < kSize; i += kSortBlock) {
    uint32_t sum = 0;
    for (int c = 0; c < kCopies; ++c) sum += counts[i * kCopies + c];
    if (sum > 0) atomicAdd(arguments.histograms + i, sum);
  }
}

}  // namespace

template <class S> void sort_by_depth(const Frame<S>& frame, const DepthBits<S>* depths, const Work& work) {
  const int64_t count = frame.inputs.num_gaussians;
  const cudaStream_t stream = work.stream;
  if (count == 0) return;  // `project` has said so
  Scratch& scratch = *work.scratch;
  // The histograms, the states of the look-backs and their counters, in one piece.
  const int64_t histograms = kPasses<S> * kBins, states = radix_states<DepthBits<S>>(count, kBins);
  const int64_t size = histograms + kPasses<S> * (states + 1);
  auto* zeros = allocate<uint32_t>(scratch, size);
  check(cudaMemsetAsync(zeros, 0, size * sizeof(*zeros), stream), "sorting by depth");
  HistogramArguments<S> histogram = {};
  histogram.count = count;
  histogram.depths = depths;
  histogram.histograms = zeros;
  const unsigned blocks =
      min(blocks_for(count, kSortBlock), kHistogramBlocks * static_cast<unsigned>(num_multiprocessors()));
  depth_histogram_kernel<S><<<blocks, kSortBlock, 0, stream>>>(histogram);
  DSMOE_CHECK_LAUNCH("depth_histogram");

  DepthBits<S>* keys[2] = {allocate<DepthBits<S>>(scratch, count), allocate<DepthBits<S>>(scratch, count)};
  int32_t* values = allocate<int32_t>(scratch, count);
  RadixPass<DepthBits<S>> pass = {};
  pass.capacity = count;
  pass.keys = depths;
  for (int p = 0; p < kPasses<S>; ++p) {
    const bool last = p + 1 == kPasses<S>;
    pass.sorted_keys = last ? nullptr : keys[p % 2];
    pass.sorted_values = p % 2 == 0 ? values : frame.saved.order;  // the last one is odd
    pass.histogram = zeros + p * kBins;
    pass.states = zeros + histograms + p * states;
    pass.next_block = zeros + histograms + kPasses<S> * states + p;
    pass.total = p == 0 ? frame.saved.num_ordered : nullptr;
    pass.shift = p * kDepthDigit;
    launch_radix_pass<kDepthDigit>(pass, stream);
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

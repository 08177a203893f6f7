// What is summed over the pixels of each Gaussian: the blend's walk once more, without features. A warp sums its
// pixels, then adds the four numbers to the Gaussian's own by atomics.
#include "../dispatch.h"
#include "dsmoe/contribution.h"
#include "dsmoe/rasterize.h"
#include "reduce.cuh"
#include "tile_walk.cuh"

namespace dsmoe {
namespace cuda {
namespace {

template <class S> struct ContributionArguments : BlendArguments<S> {
  const S* pixel_weights;  // [H, W]
  ContributionSums<S> sums;
};

// Adds number `number` of a Contribution to its Gaussian's sums.
template <class S> __device__ void add_number(const ContributionSums<S>& sums, int32_t gaussian, int number, S value) {
  if (number == 1) {
    atomicAdd(sums.pixels + gaussian, static_cast<int32_t>(value));
  } else {
    atomicAdd((number == 0 ? sums.pixel_weights : number == 2 ? sums.blend_weights : sums.distances) + gaussian, value);
  }
}

template <class S, BlendMode kMode>
__global__ void __launch_bounds__(kWarpsPerTile* kWarp)
    contributions_kernel(const __grid_constant__ ContributionArguments<S> arguments) {
  __shared__ ProjectedGaussian<S> staged[kWarpsPerTile][kWarp];
  __shared__ int32_t staged_gaussian[kWarpsPerTile][kWarp];
  WarpTile<S> tile(arguments);
  if (tile.empty) return;
  const int warp = threadIdx.x / kWarp;

  PixelState<S> state[kLanePixels];
  S pixel_weight[kLanePixels];
  int32_t last[kLanePixels], seen = 0;  // entries of the list that the pixels' numerators have seen
  for (int k = 0; k < kLanePixels; ++k) {
    const bool inside = tile.inside(arguments, k);
    const int64_t index = inside ? tile.pixel_index(arguments, k) : 0;
    state[k] = PixelState<S>::open();
    pixel_weight[k] = inside ? arguments.pixel_weights[index] : S(0);
    last[k] = inside ? arguments.saved.last_contributor[index] : 0;
    seen = seen > last[k] ? seen : last[k];
  }
  tile.length = max_over_lanes(seen);
  const TransposedSum<kNumContributions> sum_pixels(tile.lane);
  const AlphaCut<S> cut = arguments.config.alpha_cut();

  auto next = load_entry<false>(arguments, tile, tile.lane, 0);
  for (int32_t chunk = 0; chunk < tile.length; chunk += kWarp) {
    const bool meets = meets_pixels(next, tile);
    if (meets) {
      staged[warp][tile.lane] = next.staged.gaussian;
      staged_gaussian[warp][tile.lane] = next.gaussian;
    }
    unsigned left = __ballot_sync(kAllLanes, meets);
    __syncwarp();
    next = load_entry<false>(arguments, tile, chunk + kWarp + tile.lane, 0);
    for (; left != 0; left &= left - 1) {
      const int j = __ffs(left) - 1;
      const ProjectedGaussian<S> gaussian = staged[warp][j];
      const S dx = S(tile.x) - gaussian.mean.x, dy = S(tile.y) - gaussian.mean.y;
      const ColumnExponent<S, S> exponent(gaussian.conic, dx);
      const S least_alpha = cut.of(gaussian.opacity);
      auto sum = no_contribution<S>();
      bool any = false;
#pragma unroll
      for (int k = 0; k < kLanePixels; ++k) {
        const S below = dy + S(k * kLaneStep);
        const auto gate = evaluate_gate<kMode>(exponent.at(below), gaussian.opacity, least_alpha);
        const auto pair = Blend<kMode>::accumulate(state[k], gate);
        const bool contributes = pair.contributes && chunk + j < last[k];
        any |= contributes;
        add_pair(sum, contributes, pixel_weight[k], pair.weight, dx, below);
      }
      if (!__any_sync(kAllLanes, any)) continue;
      S numbers[kNumContributions] = {sum.pixel_weight, sum.pixels, sum.blend_weight, sum.distance};
      sum_pixels(numbers);
      if (sum_pixels.holds) add_number(arguments.sums, staged_gaussian[warp][j], sum_pixels.number, numbers[0]);
    }
    __syncwarp();
  }
}

}  // namespace

template <class S> void contributions(const Frame<S>& frame, const ContributionMap<S>& map, const Work& work) {
  const int64_t num_gaussians = frame.inputs.num_gaussians;
  const RasterConfig<S>& config = frame.config;
  const ContributionSums<S>& sums = map.sums;
  const cudaStream_t stream = work.stream;
  const auto clear = [&](auto* numbers) {
    if (num_gaussians == 0) return;
    check(cudaMemsetAsync(numbers, 0, num_gaussians * sizeof(*numbers), stream), "clearing the contributions");
  };
  clear(sums.pixel_weights), clear(sums.pixels), clear(sums.blend_weights), clear(sums.distances);
  ContributionArguments<S> arguments{blend_arguments(frame, work)};
  arguments.pixel_weights = map.pixel_weights;
  arguments.sums = sums;
  const unsigned tiles = static_cast<unsigned>(num_tiles(frame.camera.width, frame.camera.height));
  dispatch_blend(config.mode, kAnyFeatures, [&](auto mode, auto) {
    contributions_kernel<S, decltype(mode)::value><<<tiles, kWarpsPerTile * kWarp, 0, stream>>>(arguments);
    DSMOE_CHECK_LAUNCH("contributions");
  });
}

#define DSMOE_INSTANTIATE(S) template void contributions(const Frame<S>&, const ContributionMap<S>&, const Work&);
DSMOE_INSTANTIATE(float)
DSMOE_INSTANTIATE(double)
#undef DSMOE_INSTANTIATE

}  // namespace cuda
}  // namespace dsmoe

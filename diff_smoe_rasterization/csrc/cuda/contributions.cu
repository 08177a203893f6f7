// Sums over the pixels of each Gaussian. The kernel repeats the blend's walk, without features. A warp sums over its
// pixels, then adds the four numbers to those of the Gaussian by atomics, or exactly where the sums must be the same
// bits every time.
#include <type_traits>

#include "../dispatch.h"
#include "../refuse.h"
#include "bands.h"
#include "dsmoe/contribution.h"
#include "dsmoe/params.h"
#include "exact_sums.cuh"
#include "reduce.cuh"
#include "tile_walk.cuh"

namespace dsmoe {
namespace cuda {
namespace {

template <class S, class Sums> struct ContributionArguments : BlendArguments<S> {
  const S* pixel_weights;  // [H, W] a map of the caller's
  int32_t* pixels;         // [N] sums; null where another walk counts them
  Sums sums;               // AtomicSums or ExactSums, of the numbers but the pixels

  // Adds number `number` of a Contribution to its Gaussian's sums.
  __device__ void add_number(int32_t gaussian, int number, S value) const {
    if (number != 1) {
      sums.add(number == 0 ? 0 : number - 1, gaussian, value);
    } else if (pixels != nullptr) {
      atomicAdd(pixels + gaussian, static_cast<int32_t>(value));
    }
  }
};

// What the walk knows of a lane's pixels.
template <class S> struct ScoredPixels {
  PixelState<S> state[kLanePixels];
  S weight[kLanePixels];      // in the caller's map
  int32_t last[kLanePixels];  // entries of the list that the numerator has seen
  bool wide[kLanePixels];     // the pixel is
};

// Walks front to back, as the blend does, up to the last pair that the blend took.
template <class S, BlendMode kMode, class Sums, Pairs kWanted> struct ContributionVisitor {
  static constexpr bool kBackToFront = false, kStopsEarly = false;
  static constexpr bool kReadsFeatures = false, kInSegments = false;
  static constexpr bool kNearFirst = Blend<kMode>::kNearFirst;
  static constexpr Pairs kPairs = kWanted;
  static constexpr int kUnroll = 1;

  __device__ __forceinline__ void begin_batch(int32_t) {}

  __device__ __forceinline__ void visit(const StagedGaussian<S, false>& staged, const int32_t& number) {
    const auto gaussian = staged;
    const S dx = S(tile.x) - gaussian.mean.x, dy = S(tile.y) - gaussian.mean.y;
    const auto exponent = gaussian.gate.column(dx);
    auto sum = no_contribution<S>();
    bool any = false;
#pragma unroll
    for (int k = 0; k < kLanePixels; ++k) {
      const S pixel_dy = below(dy, k);
      const auto gate = evaluate_pair<kPairs>(gaussian.gate, exponent.at(pixel_dy), pixels.wide[k]);
      const auto pair = Blend<kMode>::accumulate(pixels.state[k], gate);
      const bool contributes = pair.contributes && gaussian.seen <= pixels.last[k];
      any |= contributes;
      add_pair(sum, contributes, pixels.weight[k], pair.weight, dx, pixel_dy);
    }
    if (!__any_sync(kAllLanes, any)) return;
    S numbers[kNumContributions] = {sum.pixel_weight, sum.pixels, sum.blend_weight, sum.distance};
    sum_pixels(numbers);
    if (sum_pixels.holds) arguments.add_number(number, sum_pixels.number, numbers[0]);
  }

  const ContributionArguments<S, Sums>& arguments;
  const WarpTile<S>& tile;
  ScoredPixels<S>& pixels;
  TransposedSum<kNumContributions> sum_pixels;
};

template <class S, BlendMode kMode, class Sums>
__global__ void __launch_bounds__(kWalkBlock)
    contributions_kernel(const __grid_constant__ ContributionArguments<S, Sums> arguments) {
  __shared__ Stage<S, false> stages[kWarpsPerTile];
  const WarpTile<S> tile(arguments);
  if (tile.empty) return;

  ScoredPixels<S> pixels;
  int32_t seen = 0;
  bool wide = false;
  for (int k = 0; k < kLanePixels; ++k) {
    const bool inside = tile.inside(arguments, k);
    const int64_t index = inside ? tile.pixel_index(arguments, k) : 0;
    pixels.state[k] = PixelState<S>::open();
    pixels.weight[k] = inside ? arguments.pixel_weights[index] : S(0);
    pixels.last[k] = inside ? arguments.saved.last_contributor[index] : 0;
    pixels.wide[k] = inside && is_wide(arguments.saved.final_transmittance[index]);
    wide |= pixels.wide[k];
    seen = seen > pixels.last[k] ? seen : pixels.last[k];
  }
  const WalkRange range = {0, max_over_lanes(seen)};
  walk_pairs<kMode>(wide, [&](auto pairs) {
    ContributionVisitor<S, kMode, Sums, decltype(pairs)::value> visitor = {arguments, tile, pixels,
                                                                           TransposedSum<kNumContributions>(tile.lane)};
    walk_tile<S>(stages[threadIdx.x / kWarp], range, visitor);
  });
}

}  // namespace

template <class S> void contributions(const Frame<S>& frame, const ContributionMap<S>& map, const Work& work) {
  refuse_contributions("cuda::contributions", frame, map);
  const int64_t num_gaussians = frame.inputs.num_gaussians;
  const RasterConfig<S>& config = frame.config;
  const ContributionSums<S>& sums = map.sums;
  const cudaStream_t stream = work.stream;
  if (num_gaussians > 0) {
    check(cudaMemsetAsync(sums.pixels, 0, num_gaussians * sizeof(int32_t), stream), "clearing the pixel counts");
  }
  const auto walk = [&](const auto& to) {
    using Sums = std::decay_t<decltype(to)>;
    for_each_band(frame, work, [&](const Frame<S>& band) {
      ContributionArguments<S, Sums> arguments = {};
      static_cast<BlendArguments<S>&>(arguments) = blend_arguments(band, work);
      arguments.pixel_weights = map.pixel_weights;
      arguments.pixels = to.is_first_walk() ? sums.pixels : nullptr;
      arguments.sums = to;
      const unsigned tiles = static_cast<unsigned>(num_band_tiles(band));
      dispatch_blend(config.mode, kAnyFeatures, [&](auto mode, auto) {
        contributions_kernel<S, decltype(mode)::value, Sums><<<tiles, kWalkBlock, 0, stream>>>(arguments);
        DSMOE_CHECK_LAUNCH("contributions");
      });
    });
  };
  sum_terms(frame, SumTargets<S>{{sums.pixel_weights, sums.blend_weights, sums.distances}, 3}, work, walk);
}

#define DSMOE_INSTANTIATE(S) template void contributions(const Frame<S>&, const ContributionMap<S>&, const Work&);
DSMOE_INSTANTIATE(float)
DSMOE_INSTANTIATE(double)
#undef DSMOE_INSTANTIATE

}  // namespace cuda
}  // namespace dsmoe

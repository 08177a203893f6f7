// The kernel of passes over the pixels of a rendering (dsmoe/passes/pass.h). A warp sums over its pixels, then adds the
// numbers to those of the Gaussian by atomics, or exactly if the sums must be the same bits every time.
#pragma once

#include <type_traits>

#include "../dispatch.h"
#include "bands.h"
#include "dsmoe/passes/pass.h"
#include "exact_sums.cuh"
#include "reduce.cuh"
#include "tile_walk.cuh"

namespace dsmoe {
namespace cuda {

// Blocks that one multiprocessor holds at once in a pass with sums: 7 x 128 threads leave each thread 72 registers.
// Left to choose (0), the compiler takes 64 in some modes, and spills.
template <class S, class Pass> constexpr int kPassBlocks = sizeof(S) == 4 && Pass::template Sums<S>::kNum > 0 ? 7 : 0;

// sums: AtomicSums or ExactSums, of the real numbers; NoSums in a pass without sums.
template <class S, class Pass, class To> struct PassArguments : BlendArguments<S> {
  Pass pass;
  To sums;
  int32_t* counts;  // [N] the number in front of them, if kCounts; null if another walk counts

  __device__ void add(int32_t gaussian, int number, S value) const {
    if (number >= Pass::kCounts) {
      sums.add(number - Pass::kCounts, gaussian, value);
    } else if (counts != nullptr) {
      atomicAdd(counts + gaussian, static_cast<int32_t>(value));
    }
  }
};

// What the walk knows of a lane's pixels.
template <class S, class Pass> struct PassPixels {
  PixelState<S> walked[kLanePixels];
  typename Pass::template State<S> state[kLanePixels];
  int32_t last[kLanePixels];  // entries of the list that the numerator has seen
  bool wide[kLanePixels];     // the pixel is
};

// Walks front to back, as the blend does, up to the last pair that the blend took.
template <class S, BlendMode kMode, class Pass, class To, Pairs kWanted> struct PassVisitor {
  static constexpr bool kBackToFront = false, kStopsEarly = false;
  static constexpr bool kReadsFeatures = false, kInSegments = false;
  static constexpr bool kNearFirst = Blend<kMode>::kNearFirst;
  static constexpr Pairs kPairs = kWanted;
  static constexpr int kUnroll = 1;
  using Sums = typename Pass::template Sums<S>;

  __device__ __forceinline__ void begin_batch(int32_t) {}

  __device__ __forceinline__ void visit(const StagedGaussian<S, false>& staged, const int32_t& number) {
    const auto gaussian = staged;
    const S dx = S(tile.x) - gaussian.mean.x, dy = S(tile.y) - gaussian.mean.y;
    const auto exponent = gaussian.gate.column(dx);
    Sums sums = {};
    bool any = false;
#pragma unroll
    for (int k = 0; k < kLanePixels; ++k) {
      const S pixel_dy = below(dy, k);
      const auto gate = evaluate_pair<kPairs>(gaussian.gate, exponent.at(pixel_dy), pixels.wide[k]);
      const WalkedPair<S> pair = {gate, dx, pixel_dy, gaussian.seen, gaussian.seen <= pixels.last[k]};
      any |= arguments.pass.template visit<kMode>(pixels.walked[k], pixels.state[k], pair, sums);
    }
    if constexpr (Sums::kNum > 0) {
      if (!__any_sync(kAllLanes, any)) return;
      S numbers[Sums::kNum];
      S* next = numbers;
      Sums::for_each([&](S sum) { *next++ = sum; }, sums);
      sum_lanes(numbers);
      if (sum_lanes.holds) arguments.add(number, sum_lanes.number, numbers[0]);
    }
  }

  const PassArguments<S, Pass, To>& arguments;
  const WarpTile<S>& tile;
  PassPixels<S, Pass>& pixels;
  TransposedSum<Sums::kNum> sum_lanes;
};

template <class S, BlendMode kMode, class Pass, class To>
__global__ void __launch_bounds__(kWalkBlock, kPassBlocks<S, Pass>)
    pass_kernel(const __grid_constant__ PassArguments<S, Pass, To> arguments) {
  using Sums = typename Pass::template Sums<S>;
  __shared__ Stage<S, false> stages[kWarpsPerTile];
  const WarpTile<S> tile(arguments);
  if (tile.empty) return;

  PassPixels<S, Pass> pixels = {};
  int32_t seen = 0;
  bool wide = false;
#pragma unroll
  for (int k = 0; k < kLanePixels; ++k) {
    pixels.walked[k] = PixelState<S>::open();
    if (!tile.inside(arguments, k)) continue;
    const int64_t index = tile.pixel_index(arguments, k);
    pixels.state[k] = arguments.pass.template begin<kMode>(index);
    pixels.last[k] = arguments.saved.last_contributor[index];
    pixels.wide[k] = Blend<kMode>::kNearFirst && is_wide(arguments.saved.final_transmittance[index]);
    wide |= pixels.wide[k];
    seen = seen > pixels.last[k] ? seen : pixels.last[k];
  }
  const WalkRange range = {0, max_over_lanes(seen)};
  walk_pairs<kMode>(wide, [&](auto pairs) {
    PassVisitor<S, kMode, Pass, To, decltype(pairs)::value> visitor = {arguments, tile, pixels,
                                                                       TransposedSum<Sums::kNum>(tile.lane)};
    walk_tile<S>(stages[threadIdx.x / kWarp], range, visitor);
  });
  if constexpr (Sums::kNum == 0) {
    const auto gaussian_at = [&](int32_t i) { return tile.source.gaussian(tile.source.entry(i)); };
    for (int k = 0; k < kLanePixels; ++k) {
      if (tile.inside(arguments, k)) arguments.pass.end(pixels.state[k], tile.pixel_index(arguments, k), gaussian_at);
    }
  }
}

// Runs a pass without sums, or a walk of one with sums.
template <class S, class Pass, class To = NoSums>
void walk_tiles(const Frame<S>& frame, const Pass& pass, const Work& work, const To& sums = {},
                int32_t* counts = nullptr) {
  for_each_band(frame, work, [&](const Frame<S>& band) {
    const PassArguments<S, Pass, To> arguments = {blend_arguments(band, work), pass, sums, counts};
    const unsigned tiles = static_cast<unsigned>(num_band_tiles(band));
    dispatch_blend(frame.config.blend.mode, kAnyFeatures, [&](auto mode, auto) {
      pass_kernel<S, decltype(mode)::value><<<tiles, kWalkBlock, 0, work.stream>>>(arguments);
      DSMOE_CHECK_LAUNCH("pass over pixels");
    });
  });
}

// Runs a pass with sums.
template <class S, class Pass> void sum_pixels(const Frame<S>& frame, const Pass& pass, const Work& work) {
  const SumTargets<S> to = pass.targets();
  if (to.counts != nullptr) {
    const size_t bytes = frame.inputs.num_gaussians * sizeof(int32_t);
    check(cudaMemsetAsync(to.counts, 0, bytes, work.stream), "clearing counts");
  }
  sum_terms(frame, to, work,
            [&](const auto& sums) { walk_tiles(frame, pass, work, sums, sums.is_first_walk() ? to.counts : nullptr); });
}

}  // namespace cuda
}  // namespace dsmoe

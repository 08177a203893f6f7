// What each Gaussian is worth to an image. The kernel repeats the blend's walk beside the finished pixels. A warp sums
// over its pixels, a batch of Gaussians at a time, and adds their numbers by atomics, or exactly if the sums must be
// the same bits every time.
#include <type_traits>

#include "cuda/bands.h"
#include "cuda/exact_sums.cuh"
#include "cuda/reduce.cuh"
#include "cuda/segments.cuh"
#include "dispatch.h"
#include "dsmoe/passes/importance.h"
#include "refuse.h"

namespace dsmoe {
namespace cuda {
namespace {

// Visits that are interleaved if the number of channels is known. And blocks that one multiprocessor then holds at
// once: 5 x 128 threads leave each thread 96 registers.
constexpr int kUnrolledVisits = 2;
constexpr int kBlocks = 5;

template <class S> struct ImportanceArguments : BlendArguments<S> {
  ImportanceMap<S> map;
  S* fronts;  // [C, H, W] the sums A, if the number of channels is not known
  int tiles;  // of the band
};

template <class S, class Sums> struct ImportanceWithSums : ImportanceArguments<S> {
  Sums sums;  // AtomicSums or ExactSums
};

// C and A of one lane's pixels, a channel at a time: in registers if the number of channels is known, else in
// memory.
template <class S, int kChannels> struct ChannelSums {
  S values[kLanePixels][kChannels], fronts[kLanePixels][kChannels];

  __device__ void begin(const ImportanceArguments<S>& arguments, const WarpTile<S>& tile, int k) {
    const int64_t pixels = int64_t(arguments.width) * arguments.height;
    for (int c = 0; c < kChannels; ++c) {
      const bool inside = tile.inside(arguments, k);
      values[k][c] = inside ? arguments.map.color[c * pixels + tile.pixel_index(arguments, k)] : S(0);
      fronts[k][c] = S(0);
    }
  }
  __device__ S value(const ImportanceArguments<S>&, const WarpTile<S>&, int k, int c) const { return values[k][c]; }
  __device__ S front(const ImportanceArguments<S>&, const WarpTile<S>&, int k, int c) const { return fronts[k][c]; }
  __device__ void set_front(const ImportanceArguments<S>&, const WarpTile<S>&, int k, int c, S sum) {
    fronts[k][c] = sum;
  }
};
template <class S> struct ChannelSums<S, kAnyFeatures> {
  __device__ static int64_t at(const ImportanceArguments<S>& arguments, const WarpTile<S>& tile, int k, int c) {
    return int64_t(c) * arguments.width * arguments.height + tile.pixel_index(arguments, k);
  }
  __device__ void begin(const ImportanceArguments<S>& arguments, const WarpTile<S>& tile, int k) {
    for (int c = 0; c < arguments.config.num_channels; ++c) set_front(arguments, tile, k, c, S(0));
  }
  __device__ S value(const ImportanceArguments<S>& arguments, const WarpTile<S>& tile, int k, int c) const {
    return tile.inside(arguments, k) ? arguments.map.color[at(arguments, tile, k, c)] : S(0);
  }
  __device__ S front(const ImportanceArguments<S>& arguments, const WarpTile<S>& tile, int k, int c) const {
    return tile.inside(arguments, k) ? arguments.fronts[at(arguments, tile, k, c)] : S(0);
  }
  __device__ void set_front(const ImportanceArguments<S>& arguments, const WarpTile<S>& tile, int k, int c, S sum) {
    if (tile.inside(arguments, k)) arguments.fronts[at(arguments, tile, k, c)] = sum;
  }
};

// What the walk knows of a lane's pixels.
template <class S, int kChannels> struct WeighedPixels {
  PixelState<S> state[kLanePixels];
  PixelEnd<S> end[kLanePixels];
  ChannelSums<S, kChannels> channels;
  S weight[kLanePixels], share_weight[kLanePixels];  // in the caller's maps
  S alone[kLanePixels];                              // |bg - C|^2
  int32_t last[kLanePixels];                         // entries of the list that the numerator has seen
  bool wide[kLanePixels];                            // whether the pixel is wide
};

// The numbers of one Gaussian in shared memory, by lane. Four lanes sum a row. Rows are padded, so that lanes of eight
// rows read from different banks.
template <class S> struct ImportanceRow {
  alignas(16) S numbers[Importance<S>::kNum][kWarp];
  S apart[16 / sizeof(S)];
};

// Sums the rows of up to kVisitsPerCheck Gaussians, and adds them to the sums of these.
template <class S, class Sums>
__device__ void add_rows(const Sums& sums, const ImportanceRow<S>* rows, const int32_t* gaussians, int count,
                         int lane) {
  constexpr int kParts = kWarp / kVisitsPerCheck, kPart = kWarp / kParts;
  const int g = lane / kParts, part = lane % kParts;
  S totals[Importance<S>::kNum];
#pragma unroll
  for (int n = 0; n < Importance<S>::kNum; ++n) {
    S values[kPart];
#pragma unroll
    for (int i = 0; i < kPart; ++i) values[i] = rows[g].numbers[n][part * kPart + i];
#pragma unroll
    for (int half = kPart / 2; half > 0; half /= 2) {
#pragma unroll
      for (int i = 0; i < half; ++i) values[i] += values[i + half];
    }
    totals[n] = values[0];
#pragma unroll
    for (int step = kParts / 2; step > 0; step /= 2) totals[n] += __shfl_xor_sync(kAllLanes, totals[n], step);
  }
  if (g >= count || part >= Importance<S>::kNum) return;
  sums.add(part, gaussians[g], part == 0 ? totals[0] : part == 1 ? totals[1] : totals[2]);
}

// Walks front to back, as the blend does.
template <class S, BlendMode kMode, int kChannels, class Sums, Pairs kWanted> struct ImportanceVisitor {
  static constexpr bool kBackToFront = false, kStopsEarly = false;
  static constexpr bool kReadsFeatures = true, kInSegments = false;
  static constexpr bool kNearFirst = Blend<kMode>::kNearFirst;
  static constexpr Pairs kPairs = kWanted;
  static constexpr int kUnroll = kChannels != kAnyFeatures ? kUnrolledVisits : 1;

  __device__ __forceinline__ int num_channels() const {
    return kChannels != kAnyFeatures ? kChannels : arguments.config.num_channels;
  }

  __device__ __forceinline__ void begin_batch(int32_t) {}

  __device__ __forceinline__ void visit(const StagedGaussian<S, true>& staged, const int32_t& number) {
    const auto gaussian = staged;
    const auto exponent = gaussian.gate.column(S(tile.x) - gaussian.mean.x);
    const S dy = S(tile.y) - gaussian.mean.y;
    const int32_t index = number;
    const S* features = arguments.saved.features + int64_t(index) * feature_stride(arguments.config.num_features());
    Importance<S> sum = {};
#pragma unroll
    for (int k = 0; k < kLanePixels; ++k) {
      const auto gate = evaluate_pair<kPairs>(gaussian.gate, exponent.at(below(dy, k)), pixels.wide[k]);
      const auto removal = remove_pair<kMode>(pixels.state[k], pixels.end[k], gate, gaussian.seen <= pixels.last[k]);
      S squared = S(0);
      for (int c = 0; c < num_channels(); ++c) {
        const S feature = kChannels != kAnyFeatures ? gaussian.features[c] : features[c];
        const S value = pixels.channels.value(arguments, tile, k, c), distance = feature - value;
        const S front = pixels.channels.front(arguments, tile, k, c);
        const S change = channel_change<kMode>(removal, distance, front, value);
        squared = fma(change, change, squared);
        pixels.channels.set_front(arguments, tile, k, c, fma(removal.weight, distance, front));
      }
      add_pair(sum, removal, squared, pixels.alone[k], pixels.share_weight[k], pixels.weight[k]);
    }
    S* const numbers = row->numbers[0] + tile.lane;
    numbers[0] = sum.share, numbers[kWarp] = sum.squared_share, numbers[2 * kWarp] = sum.removal_cost;
    ++row;
  }

  __device__ __forceinline__ void end_visits(const StagedGaussian<S, true>*, const int32_t* gaussians, int count) {
    __syncwarp();
    row -= count;
    add_rows(arguments.sums, row, gaussians, count, tile.lane);
    __syncwarp();
  }

  const ImportanceWithSums<S, Sums>& arguments;
  const WarpTile<S>& tile;
  WeighedPixels<S, kChannels>& pixels;
  ImportanceRow<S>* row;  // for the next Gaussian
};

// Whether a warp may begin at a segment: what lies in front of it is known there by T.
template <class S, BlendMode kMode, int kChannels>
constexpr bool kWeighsSegments = kWalksSegments<S, kMode, kChannels>&& Blend<kMode>::kStopsEarly;

// Whether a segment can start from the saved T alone. For small W, 1 - T loses digits; a background gate keeps D large
// enough. Behind 1,300 opacities of 2e-5 to 5e-5 the norm of the costs is off by 4.4e-4 at gate 0, by 1.2e-4 at 0.03.
template <BlendMode kMode, class Config> __device__ bool knows_front(const Config& config) {
  return !Blend<kMode>::kDivides || config.blend.lambda() >= 0.01f;
}

// Sets what a warp's pixels start with at the list's begin. The tails' sum is held constant, as in the backward pass.
// So it stands in front of all pairs, with the background's colour.
template <BlendMode kMode, class S, int kChannels>
__device__ __forceinline__ void begin_pixels(const ImportanceArguments<S>& arguments, const WarpTile<S>& tile,
                                             WeighedPixels<S, kChannels>& pixels) {
  const S lambda = arguments.config.blend.lambda();
  const int num_channels = kChannels != kAnyFeatures ? kChannels : arguments.config.num_channels;
  for (int k = 0; k < kLanePixels; ++k) {
    const bool inside = tile.inside(arguments, k);
    const int64_t index = inside ? tile.pixel_index(arguments, k) : 0;
    const S tails = Blend<kMode>::kTails && inside ? arguments.saved.tails[index] : S(0);
    pixels.state[k] = {S(1), tails};
    const S kept = arguments.saved.final_transmittance[index];
    pixels.wide[k] = inside && is_wide(kept);
    pixels.end[k] = {abs(kept), inside ? arguments.saved.gate_sum[index] + tails : S(0), lambda, S(0)};
    pixels.weight[k] = inside ? arguments.map.pixel_weights[index] : S(0);
    pixels.share_weight[k] = inside ? arguments.map.share_weights[index] : S(0);
    pixels.last[k] = inside ? arguments.saved.last_contributor[index] : 0;
    pixels.channels.begin(arguments, tile, k);
    pixels.alone[k] = S(0);
    for (int c = 0; c < num_channels; ++c) {
      const S distance = arguments.config.background[c] - pixels.channels.value(arguments, tile, k, c);
      pixels.alone[k] = fma(distance, distance, pixels.alone[k]);
      if (Blend<kMode>::kTails && tails > S(0)) pixels.channels.set_front(arguments, tile, k, c, tails * distance);
    }
  }
}

// Moves the pixels to the beginning of a segment. A is the sum of w (c - C) in front of it. That is minus the sum
// behind it, with lambda T (bg - C), because over a whole pixel they sum to 0.
template <class S, BlendMode kMode, int kChannels>
__device__ __forceinline__ void move_to_segment(const ImportanceArguments<S>& arguments, const WarpTile<S>& tile,
                                                int segment, WeighedPixels<S, kChannels>& pixels) {
  for (int k = 0; k < kLanePixels; ++k) {
    if (!tile.inside(arguments, k)) continue;
    const SegmentPixel<S> begin = segment_pixel(arguments.saved, tile, segment, k);
    const PixelEnd<S>& end = pixels.end[k];
    const auto by = feature_end<kMode>(FeatureRule::kBlended, end);
    pixels.state[k] = {begin.transmittance, S(1) - begin.transmittance};
    if constexpr (Blend<kMode>::kTails) {
      const S tails = arguments.saved.tails[tile.pixel_index(arguments, k)];
      pixels.state[k].gate_sum = pixels.state[k].gate_sum + tails;
    }
    for (int c = 0; c < kChannels; ++c) {
      const S value = pixels.channels.value(arguments, tile, k, c);
      const S behind = fma(-value, begin.transmittance - end.transmittance, begin.sums[c]);
      pixels.channels.set_front(arguments, tile, k, c,
                                -(behind + by.if_gated(by.weight * (arguments.config.background[c] - value))));
    }
  }
}

template <class S, BlendMode kMode, int kChannels, class Sums>
__global__ void __launch_bounds__(kWalkBlock,
                                  sizeof(S) == 4 && kChannels != kAnyFeatures ? kBlocks : kGeneralWalkBlocks)
    importance_kernel(const __grid_constant__ ImportanceWithSums<S, Sums> arguments) {
  __shared__ Stage<S, true> stages[kWarpsPerTile];
  __shared__ ImportanceRow<S> rows[kWarpsPerTile][kVisitsPerCheck];
  WarpSegment place = {};
  if constexpr (kWeighsSegments<S, kMode, kChannels>) {
    if (is_idle_block(arguments.saved, arguments.tiles)) return;
    place = segment_of_warp(arguments.saved);
    if (place.tile < 0) return;
  } else {
    place = {arguments.saved.tile_order[blockIdx.x], static_cast<int>(threadIdx.x) / kWarp, 0};
  }
  const WarpTile<S> tile(arguments, place.tile, place.quarter);
  if (tile.empty) return;

  WeighedPixels<S, kChannels> pixels;
  begin_pixels<kMode>(arguments, tile, pixels);
  WalkRange range = {0, tile.source.length};
  if (Blend<kMode>::kStopsEarly) {
    int32_t seen = 0;
    for (int k = 0; k < kLanePixels; ++k) seen = seen > pixels.last[k] ? seen : pixels.last[k];
    range.end = max_over_lanes(seen);
  }
  if constexpr (kWeighsSegments<S, kMode, kChannels>) {
    if (!knows_front<kMode>(arguments.config)) {
      if (place.segment > 0) return;
    } else if (has_segments(arguments.saved, tile)) {
      range.begin = place.segment * kSegmentLength;
      range.end = min(range.end, range.begin + kSegmentLength);
      if (range.begin >= range.end) return;
      if (place.segment > 0) move_to_segment<S, kMode>(arguments, tile, place.segment, pixels);
    }
  }
  const int warp = threadIdx.x / kWarp;
  bool wide = false;
  for (int k = 0; k < kLanePixels; ++k) wide |= pixels.wide[k];
  walk_pairs<kMode>(wide, [&](auto pairs) {
    ImportanceVisitor<S, kMode, kChannels, Sums, decltype(pairs)::value> visitor = {arguments, tile, pixels,
                                                                                    rows[warp]};
    walk_tile<S>(stages[warp], range, visitor);
  });
}

}  // namespace

template <class S> void importance(const Frame<S>& frame, const ImportanceMap<S>& map, const Work& work) {
  refuse_importance("cuda::importance", frame, ImportancePass<S>{map});
  const int64_t num_gaussians = frame.inputs.num_gaussians;
  const int width = frame.camera.width, height = frame.camera.height;
  if (num_gaussians == 0) return;
  const int num_channels = frame.config.num_channels;
  S* fronts = nullptr;
  if (num_channels != 3) fronts = allocate<S>(*work.scratch, int64_t(num_channels) * width * height);
  const auto walk = [&](const auto& sums) {
    using Sums = std::decay_t<decltype(sums)>;
    for_each_band(frame, work, [&](const Frame<S>& band) {
      ImportanceWithSums<S, Sums> arguments = {};
      static_cast<BlendArguments<S>&>(arguments) = blend_arguments(band, work);
      arguments.map = map;
      arguments.fronts = fronts;
      arguments.tiles = static_cast<int>(num_band_tiles(band));
      arguments.sums = sums;
      // Whether lists have segments depends on earlier renderings, as in the backward pass.
      if (work.deterministic) arguments.saved.segments = nullptr;
      dispatch_blend(frame.config.blend.mode, num_channels, [&](auto mode, auto channels) {
        constexpr BlendMode kMode = decltype(mode)::value;
        constexpr int kChannels = decltype(channels)::value;
        if constexpr (kRemovable<kMode>) {
          const bool segments = kWeighsSegments<S, kMode, kChannels> && arguments.saved.segments != nullptr;
          const int64_t blocks = arguments.tiles + (segments ? num_segment_rows(band.saved.capacity) : 0);
          importance_kernel<S, kMode, kChannels, Sums>
              <<<static_cast<unsigned>(blocks), kWalkBlock, 0, work.stream>>>(arguments);
          DSMOE_CHECK_LAUNCH("importance");
        }
      });
    });
  };
  sum_terms(frame, ImportancePass<S>{map}.targets(), work, walk);
}

#define DSMOE_INSTANTIATE(S) template void importance(const Frame<S>&, const ImportanceMap<S>&, const Work&);
DSMOE_INSTANTIATE(float)
DSMOE_INSTANTIATE(double)
#undef DSMOE_INSTANTIATE

}  // namespace cuda
}  // namespace dsmoe

// Stage 3: the images.
#include "../dispatch.h"
#include "bands.h"
#include "dsmoe/params.h"
#include "segments.cuh"

namespace dsmoe {
namespace cuda {
namespace {

// What a lane's pixels have blended so far. A lane has kLanePixels of a square, or one if two warps share the
// square.
template <class S, int kSums, int kPixels> struct BlendedPixels {
  int first;  // of these pixels, in a lane that has all of them
  PixelState<S> state[kPixels];
  S sums[kPixels][kSums];  // of weighted features
  int32_t last[kPixels];   // entries of the list that the numerator has seen
  bool wide[kPixels];      // the pixel is: known behind the narrow walk
};

// Saves the state of the pixels where a segment begins; in a wide walk only of wide pixels, if `kept`.
template <class S, int kSums, int kPixels>
__device__ void note_segment(const BlendArguments<S>& arguments, const WarpTile<S>& tile, int segment,
                             const BlendedPixels<S, kSums, kPixels>& pixels, bool kept) {
#pragma unroll
  for (int k = 0; k < kPixels; ++k) {
    if (kept && !pixels.wide[k]) continue;
    SegmentPixel<S> begin = {abs(pixels.state[k].transmittance), {}};
    for (int f = 0; f < kSums; ++f) begin.sums[f] = pixels.sums[k][f];
    segment_pixel(arguments.saved, tile, segment, pixels.first + k) = begin;
  }
}

// Called at the end of the list: turns the sums in front of each segment into the sums from there to the end.
template <class S, int kSums, int kPixels>
__device__ void end_segments(const BlendArguments<S>& arguments, const WarpTile<S>& tile, int last,
                             const BlendedPixels<S, kSums, kPixels>& pixels) {
#pragma unroll 1
  for (int segment = 1; segment <= last; ++segment) {
#pragma unroll
    for (int k = 0; k < kPixels; ++k) {
      SegmentPixel<S> begin = segment_pixel(arguments.saved, tile, segment, pixels.first + k);
      for (int f = 0; f < kSums; ++f) begin.sums[f] = pixels.sums[k][f] - begin.sums[f];
      segment_pixel(arguments.saved, tile, segment, pixels.first + k) = begin;
    }
  }
}

// Blends kSums features, front to back. A wide walk has only wide pixels open, and sums their tails too.
template <class S, BlendMode kMode, int kSums, int kPixels, bool kWide> struct BlendVisitor {
  static constexpr bool kBackToFront = false, kStopsEarly = Blend<kMode>::kStopsEarly;
  static constexpr bool kReadsFeatures = true, kInSegments = kWalksSegments<S, kMode, kSums>;
  static constexpr bool kNearFirst = Blend<kMode>::kNearFirst, kTails = kWide && Blend<kMode>::kTails;
  static constexpr Pairs kPairs = kTails ? Pairs::kWithTails : kWide ? Pairs::kWide : Pairs::kNarrow;
  static constexpr int kUnroll = kPixels == kLanePixels ? kBlendUnroll : kSharedBlendUnroll;

  __device__ __forceinline__ void begin_batch(int32_t position) {
    if constexpr (kInSegments) begin_segments(position);
  }

  // Begins all segments up to the entry at `position`, and queues them for the backward pass.
  __device__ __forceinline__ void begin_segments(int32_t position) {
    for (; next_segment <= position; next_segment += kSegmentLength) {
      const int segment = next_segment / kSegmentLength;
      note_segment(arguments, tile, segment, pixels, kWide && segment <= narrow_last);
      if (tile.lane == 0 && !(kWide && segment <= narrow_last) &&
          (kPixels == kLanePixels || atomicMax(begun, segment) < segment)) {
        segment_queue(arguments.saved).push(tile.index, tile.quarter, segment);
      }
    }
  }

  __device__ __forceinline__ void visit(const StagedGaussian<S, true>& staged, const int32_t&) {
    const auto gaussian = staged;
    const auto exponent = gaussian.gate.column(S(tile.x) - gaussian.mean.x);
    const S dy = S(tile.y) - gaussian.mean.y;
#pragma unroll
    for (int k = 0; k < kPixels; ++k) {
      const S log_logit = exponent.at(below(dy, pixels.first + k));
      const auto gate = gaussian.gate.evaluate(log_logit);
      if constexpr (kTails) {
        const bool inside = gaussian.gate.inside(log_logit);
        add_tail(pixels.state[k], tails[k], tail_of(gate, inside, arguments.tail_alpha));
      }
      const auto pair = Blend<kMode>::accumulate(pixels.state[k], gate);
      for (int f = 0; f < kSums; ++f) pixels.sums[k][f] = fma(pair.weight, gaussian.features[f], pixels.sums[k][f]);
      pixels.last[k] = pair.contributes ? gaussian.seen : pixels.last[k];
    }
  }

  __device__ __forceinline__ bool is_done() const {
    bool open = false;
    for (int k = 0; k < kPixels; ++k) open |= pixels.state[k].is_open();
    return !__any_sync(kAllLanes, open);
  }

  const BlendArguments<S>& arguments;
  const WarpTile<S>& tile;
  BlendedPixels<S, kSums, kPixels>& pixels;
  int32_t next_segment;  // where the next segment begins; beyond the list if it is not noted in segments
  int* begun;            // the last segment that a warp of a shared square has begun
  int narrow_last = 0;   // the last segment that the warp's narrow walk has begun
  S tails[kPixels] = {};
};

// Closes the pixels that the narrow walk has covered, and opens the others anew. Returns whether the warp has one.
template <class S, int kSums, int kPixels>
__device__ bool open_wide(const BlendArguments<S>& arguments, const WarpTile<S>& tile,
                          BlendedPixels<S, kSums, kPixels>& pixels) {
  bool any = false;
  for (int k = 0; k < kPixels; ++k) {
    auto& state = pixels.state[k];
    pixels.wide[k] =
        tile.inside(arguments, pixels.first + k) && (!arguments.near_first || state.gate_sum < arguments.wide_below);
    any |= pixels.wide[k];
    state.transmittance = pixels.wide[k] ? S(1) : -abs(state.transmittance);
    state.gate_sum = pixels.wide[k] ? S(0) : state.gate_sum;
    for (int f = 0; f < kSums; ++f) pixels.sums[k][f] = pixels.wide[k] ? S(0) : pixels.sums[k][f];
    pixels.last[k] = pixels.wide[k] ? 0 : pixels.last[k];
  }
  return __any_sync(kAllLanes, any);
}

// Blends kSums features from `first_feature` on, and writes them. If two warps share a square, first_pixel says
// which half is the warp's, begun is 0 in shared memory, and all warps of the block call this that have pixels in the
// image.
template <BlendMode kMode, int kSums, int kPixels = kLanePixels, class S>
__device__ void blend_features(const BlendArguments<S>& arguments, const WarpTile<S>& tile, Stage<S, true>& stage,
                               int first_feature, int first_pixel = 0, int* begun = nullptr) {
  const RasterConfig<S>& config = arguments.config;
  BlendedPixels<S, kSums, kPixels> blended;
  blended.first = kPixels == kLanePixels ? 0 : first_pixel;
  for (int k = 0; k < kPixels; ++k) {
    blended.state[k] = PixelState<S>::open();
    if (!tile.inside(arguments, blended.first + k)) {  // closed
      blended.state[k].transmittance = -blended.state[k].transmittance;
    }
    for (int f = 0; f < kSums; ++f) blended.sums[k][f] = S(0);
    blended.last[k] = 0;
    blended.wide[k] = false;
  }
  using Visitor = BlendVisitor<S, kMode, kSums, kPixels, false>;
  const bool segments = Visitor::kInSegments && has_segments(arguments.saved, tile);
  const WalkRange range = {0, tile.source.length, first_feature};
  Visitor visitor = {arguments, tile, blended, segments ? kSegmentLength : INT32_MAX, begun};
  unsigned met = 0;
  // If near pairs are not blended first, all pixels of a mode with tails are wide.
  if (!Blend<kMode>::kTails || arguments.near_first) met = walk_tile(stage, range, visitor);
  int last = segments ? visitor.next_segment / kSegmentLength - 1 : 0;
  [[maybe_unused]] S tails[kPixels] = {};
  if constexpr (Blend<kMode>::kNearFirst) {
    if ((Blend<kMode>::kTails || arguments.near_first) && open_wide(arguments, tile, blended)) {
      using WideVisitor = BlendVisitor<S, kMode, kSums, kPixels, true>;
      WideVisitor wide = {arguments, tile, blended, segments ? kSegmentLength : INT32_MAX, begun, last};
      met += walk_tile(stage, range, wide);
      if (Visitor::kInSegments && segments) {
        wide.begin_segments(last * kSegmentLength);  // which the narrow walk has begun
        last = wide.next_segment / kSegmentLength - 1;
      }
      for (int k = 0; k < kPixels; ++k) tails[k] = wide.tails[k];
    }
  }
  if (Visitor::kInSegments && segments) {
    // If pixels do not stop, the backward pass walks the whole list.
    if (!Visitor::kStopsEarly) {
      visitor.begin_segments(tile.source.length - 1);
      last = visitor.next_segment / kSegmentLength - 1;
    }
    if constexpr (kPixels != kLanePixels) {
      // The backward pass asks for both halves of a segment that one of the warps has begun.
      __syncthreads();
      for (int segment = last + 1; segment <= *begun; ++segment) note_segment(arguments, tile, segment, blended, false);
      last = *begun;
    }
    end_segments(arguments, tile, last, blended);
  }

  const int64_t pixels = int64_t(arguments.width) * arguments.height;
  for (int k = 0; k < kPixels; ++k) {
    if (!tile.inside(arguments, blended.first + k)) continue;
    const int64_t index = tile.pixel_index(arguments, blended.first + k);
    auto end = blended.state[k].end(config.blend.lambda());
    if constexpr (Blend<kMode>::kTails) end.tails = tails[k];
    if (first_feature == 0) {
      arguments.saved.final_transmittance[index] = kept_transmittance(end, blended.wide[k]);
      if constexpr (Blend<kMode>::kTails) arguments.saved.tails[index] = tails[k];
      arguments.saved.gate_sum[index] = end.gate_sum;
      arguments.saved.last_contributor[index] = blended.last[k];
      if constexpr (Blend<kMode>::kTails) arguments.images.gate_sum[index] = finish_alpha<kMode>(end);
    }
    for (int f = 0; f < kSums; ++f) {
      const int feature = first_feature + f;
      if (kSums == kFeatureChunk && feature >= config.num_features()) break;
      feature_image(config, arguments.images, feature, pixels)[index] = finish_feature<kMode>(
          feature_rule(config, feature), end, blended.sums[k][f], feature_background(config, feature));
    }
  }
  if (first_feature == 0) count_pairs(arguments, tile.lane, met, kPixels * kWarp);
}

// The first blocks come in pairs, for the tiles with the longest lists. If such a list is long, each of the two has
// half of the tile, and two warps share a square of pixels. Else the first of them has the tile, as all other blocks
// do. Which lists are shared may change from run to run, with the order of tiles of one class. So both ways must come
// to the same bits: products are added by fma or behind a select, and the compiler has no choice.
template <class S, BlendMode kMode, int kFeatures>
__global__ void __launch_bounds__(kWalkBlock,
                                  sizeof(S) == 4 && kFeatures != kAnyFeatures ? kBlendBlocks : kGeneralWalkBlocks)
    blend_kernel(const __grid_constant__ BlendArguments<S> arguments, int paired_tiles) {
  constexpr int kSums = kFeatures != kAnyFeatures ? kFeatures : kFeatureChunk;
  __shared__ Stage<S, true> stages[kWarpsPerTile];
  __shared__ int begun[kWarpsPerTile];
  const int block = blockIdx.x, warp = threadIdx.x / kWarp;
  const bool paired = block < 2 * paired_tiles;
  const int index = arguments.saved.tile_order[paired ? block / 2 : block - paired_tiles];
  auto& stage = stages[warp];
  if constexpr (kFeatures != kAnyFeatures) {
    if (paired) {
      const int square = block % 2 * 2 + warp / 2;
      const WarpTile<S> tile(arguments, index, square);
      if (tile.source.length > kSharedFrom) {
        if (threadIdx.x < kWarpsPerTile) begun[threadIdx.x] = 0;
        __syncthreads();
        if (!tile.empty) blend_features<kMode, kSums, 1>(arguments, tile, stage, 0, warp % 2, begun + square);
        return;
      }
      if (block % 2 > 0) return;
    }
  }
  const WarpTile<S> tile(arguments, index, warp);
  if (tile.empty) return;
  if constexpr (kFeatures != kAnyFeatures) {
    blend_features<kMode, kSums>(arguments, tile, stage, 0);
  } else {
    for (int feature = 0; feature < arguments.config.num_features(); feature += kSums) {
      blend_features<kMode, kSums>(arguments, tile, stage, feature);
    }
  }
}

}  // namespace

template <class S> void blend(const Frame<S>& frame, const Work& work) {
  const RasterConfig<S>& config = frame.config;
  for_each_band(frame, work, [&](const Frame<S>& band) {
    const unsigned tiles = static_cast<unsigned>(num_band_tiles(band));
    // Double is for checking: it has only the general kernel.
    const int num_features = sizeof(S) == 4 ? config.num_features() : kAnyFeatures;
    dispatch_blend(config.blend.mode, num_features, [&](auto mode, auto features) {
      constexpr int kFeatures = sizeof(S) == 4 ? decltype(features)::value : kAnyFeatures;
      const unsigned paired_tiles = kFeatures != kAnyFeatures ? min(tiles, kMostSharedTiles) : 0;
      blend_kernel<S, decltype(mode)::value, kFeatures>
          <<<tiles + paired_tiles, kWalkBlock, 0, work.stream>>>(blend_arguments(band, work), paired_tiles);
      DSMOE_CHECK_LAUNCH("blend");
    });
  });
}

#define DSMOE_INSTANTIATE(S) template void blend(const Frame<S>&, const Work&);
DSMOE_INSTANTIATE(float)
DSMOE_INSTANTIATE(double)
#undef DSMOE_INSTANTIATE

}  // namespace cuda
}  // namespace dsmoe

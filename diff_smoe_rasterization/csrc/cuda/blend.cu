// Stage 3: the images.
#include "../dispatch.h"
#include "bands.h"
#include "dsmoe/params.h"
#include "segments.cuh"

namespace dsmoe {
namespace cuda {
namespace {

// Notes the state of the pixels where a segment begins, and queues the segment for the backward pass.
template <class S, int kSums>
__device__ void begin_segment(const BlendArguments<S>& arguments, const WarpTile<S>& tile, int segment,
                              const PixelState<S> (&state)[kLanePixels], const S (&sums)[kLanePixels][kSums]) {
#pragma unroll
  for (int k = 0; k < kLanePixels; ++k) {
    SegmentPixel<S> begin = {abs(state[k].transmittance), {}};
    for (int f = 0; f < kSums; ++f) begin.sums[f] = sums[k][f];
    segment_pixel(arguments.saved, tile, segment, k) = begin;
  }
  if (tile.lane == 0) {
    segment_queue(arguments.saved).push(tile.index, tile.quarter, segment);
  }
}

// Called at the end of the list: turns the sums in front of each segment into the sums from there to the end.
template <class S, int kSums>
__device__ void end_segments(const BlendArguments<S>& arguments, const WarpTile<S>& tile, int last,
                             const S (&sums)[kLanePixels][kSums]) {
#pragma unroll 1
  for (int segment = 1; segment <= last; ++segment) {
#pragma unroll
    for (int k = 0; k < kLanePixels; ++k) {
      SegmentPixel<S> begin = segment_pixel(arguments.saved, tile, segment, k);
      for (int f = 0; f < kSums; ++f) begin.sums[f] = sums[k][f] - begin.sums[f];
      segment_pixel(arguments.saved, tile, segment, k) = begin;
    }
  }
}

// What a lane's pixels have blended so far.
template <class S, int kSums> struct BlendedPixels {
  PixelState<S> state[kLanePixels];
  S sums[kLanePixels][kSums];  // of weighted features
  int32_t last[kLanePixels];   // entries of the list that the numerator has seen
};

// Blends kSums features, front to back.
template <class S, BlendMode kMode, int kSums> struct BlendVisitor {
  static constexpr bool kBackToFront = false, kStopsEarly = Blend<kMode>::kStopsEarly;
  static constexpr bool kReadsFeatures = true, kInSegments = kWalksSegments<S, kMode, kSums>;
  static constexpr int kUnroll = kBlendUnroll;

  __device__ __forceinline__ void begin_batch(int32_t position) {
    if constexpr (kInSegments) begin_segments(position);
  }

  // Begins the segments up to that of the entry at `position`.
  __device__ __forceinline__ void begin_segments(int32_t position) {
    for (; next_segment <= position; next_segment += kSegmentLength) {
      begin_segment(arguments, tile, next_segment / kSegmentLength, pixels.state, pixels.sums);
    }
  }

  __device__ __forceinline__ void visit(const StagedGaussian<S, true>& staged, const int32_t&) {
    const auto gaussian = staged;
    const auto exponent = gaussian.gate.column(S(tile.x) - gaussian.mean.x);
    const S dy = S(tile.y) - gaussian.mean.y;
#pragma unroll
    for (int k = 0; k < kLanePixels; ++k) {
      const auto gate = gaussian.gate.evaluate(exponent.at(below(dy, k)));
      const auto pair = Blend<kMode>::accumulate(pixels.state[k], gate);
      for (int f = 0; f < kSums; ++f) pixels.sums[k][f] = fma(pair.weight, gaussian.features[f], pixels.sums[k][f]);
      pixels.last[k] = pair.contributes ? gaussian.seen : pixels.last[k];
    }
  }

  __device__ __forceinline__ bool is_done() const {
    bool open = false;
    for (int k = 0; k < kLanePixels; ++k) open |= pixels.state[k].is_open();
    return !__any_sync(kAllLanes, open);
  }

  const BlendArguments<S>& arguments;
  const WarpTile<S>& tile;
  BlendedPixels<S, kSums>& pixels;
  int32_t next_segment;  // where the next segment begins; beyond the list where it is not noted in segments
};

// Blends kSums features from `first_feature` on, and writes them.
template <class S, BlendMode kMode, int kSums>
__device__ void blend_features(const BlendArguments<S>& arguments, const WarpTile<S>& tile,
                               WarpStage<S, BlendVisitor<S, kMode, kSums>>& stage, int first_feature) {
  const RasterConfig<S>& config = arguments.config;
  BlendedPixels<S, kSums> blended;
  for (int k = 0; k < kLanePixels; ++k) {
    blended.state[k] = PixelState<S>::open();
    if (!tile.inside(arguments, k)) blended.state[k].transmittance = -blended.state[k].transmittance;  // closed
    for (int f = 0; f < kSums; ++f) blended.sums[k][f] = S(0);
    blended.last[k] = 0;
  }
  using Visitor = BlendVisitor<S, kMode, kSums>;
  const bool segments = Visitor::kInSegments && has_segments(arguments.saved, tile);
  Visitor visitor = {arguments, tile, blended, segments ? kSegmentLength : INT32_MAX};
  const unsigned met = walk_tile(stage, {0, tile.source.length, first_feature}, visitor);
  if (Visitor::kInSegments && segments) {
    // Where pixels do not stop, the backward pass walks the whole list.
    if (!Visitor::kStopsEarly) visitor.begin_segments(tile.source.length - 1);
    end_segments(arguments, tile, visitor.next_segment / kSegmentLength - 1, blended.sums);
  }

  const int64_t pixels = int64_t(arguments.width) * arguments.height;
  for (int k = 0; k < kLanePixels; ++k) {
    if (!tile.inside(arguments, k)) continue;
    const int64_t index = tile.pixel_index(arguments, k);
    const auto end = blended.state[k].end(config.gate_of_background());
    if (first_feature == 0) {
      arguments.saved.final_transmittance[index] = end.transmittance;
      arguments.saved.gate_sum[index] = end.gate_sum;
      arguments.saved.last_contributor[index] = blended.last[k];
    }
    for (int f = 0; f < kSums; ++f) {
      const int feature = first_feature + f;
      if (kSums == kFeatureChunk && feature >= config.num_features()) break;
      feature_image(config, arguments.images, feature, pixels)[index] = finish_feature<kMode>(
          feature_rule(config, feature), end, blended.sums[k][f], feature_background(config, feature));
    }
  }
  if (first_feature == 0) count_pairs(arguments, tile.lane, met);
}

template <class S, BlendMode kMode, int kFeatures>
__global__ void __launch_bounds__(kWalkBlock,
                                  sizeof(S) == 4 && kFeatures != kAnyFeatures ? kBlendBlocks : kGeneralWalkBlocks)
    blend_kernel(const __grid_constant__ BlendArguments<S> arguments) {
  constexpr int kSums = kFeatures != kAnyFeatures ? kFeatures : kFeatureChunk;
  __shared__ WarpStage<S, BlendVisitor<S, kMode, kSums>> stages[kWarpsPerTile];
  const WarpTile<S> tile(arguments, arguments.saved.tile_order[blockIdx.x], threadIdx.x / kWarp);
  if (tile.empty) return;
  auto& stage = stages[threadIdx.x / kWarp];
  if constexpr (kFeatures != kAnyFeatures) {
    blend_features<S, kMode, kSums>(arguments, tile, stage, 0);
  } else {
    for (int feature = 0; feature < arguments.config.num_features(); feature += kSums) {
      blend_features<S, kMode, kSums>(arguments, tile, stage, feature);
    }
  }
}

}  // namespace

template <class S> void blend(const Frame<S>& frame, const Work& work) {
  const RasterConfig<S>& config = frame.config;
  for_each_band(frame, work, [&](const Frame<S>& band) {
    const unsigned tiles = static_cast<unsigned>(num_band_tiles(band));
    // Double is for checking: it has only the general kernel.
    dispatch_blend(config.mode, sizeof(S) == 4 ? config.num_features() : kAnyFeatures, [&](auto mode, auto features) {
      constexpr int kFeatures = sizeof(S) == 4 ? decltype(features)::value : kAnyFeatures;
      blend_kernel<S, decltype(mode)::value, kFeatures>
          <<<tiles, kWalkBlock, 0, work.stream>>>(blend_arguments(band, work));
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

// Stage 3: the images.
#include "../dispatch.h"
#include "bands.h"
#include "dsmoe/params.h"
#include "long_lists.cuh"

namespace dsmoe {
namespace cuda {
namespace {

template <class S> struct ForwardArguments : BlendArguments<S> {
  LongLists<S> lists;
  int tiles;  // of the band
};

// Notes the state of the pixels where a segment begins.
template <class S, int kSums>
__device__ void begin_segment(const BlendArguments<S>& arguments, const WarpTile<S>& tile, int segment,
                              const BlendedPixel<S, kSums> (&pixels)[kLanePixels]) {
#pragma unroll
  for (int k = 0; k < kLanePixels; ++k) {
    SegmentPixel<S> begin = {abs(pixels[k].state.transmittance), {}};
    for (int f = 0; f < kSums; ++f) begin.sums[f] = pixels[k].sums[f];
    segment_pixel(arguments.saved, tile, segment, k) = begin;
  }
}

// Called at the end of the list: turns the sums in front of each segment into the sums from there to the end.
template <class S, int kSums>
__device__ void end_segments(const BlendArguments<S>& arguments, const WarpTile<S>& tile, int last,
                             const BlendedPixel<S, kSums> (&pixels)[kLanePixels]) {
#pragma unroll 1
  for (int segment = 1; segment <= last; ++segment) {
#pragma unroll
    for (int k = 0; k < kLanePixels; ++k) {
      SegmentPixel<S> begin = segment_pixel(arguments.saved, tile, segment, k);
      for (int f = 0; f < kSums; ++f) begin.sums[f] = pixels[k].sums[f] - begin.sums[f];
      segment_pixel(arguments.saved, tile, segment, k) = begin;
    }
  }
}

template <class S, int kSums> __device__ bool are_full(const BlendedPixel<S, kSums> (&pixels)[kLanePixels]) {
  bool open = false;
  for (int k = 0; k < kLanePixels; ++k) open |= pixels[k].state.is_open();
  return !__any_sync(kAllLanes, open);
}

// Blends kSums features, front to back.
template <class S, BlendMode kMode, int kSums> struct BlendVisitor {
  static constexpr bool kBackToFront = false, kStopsEarly = Blend<kMode>::kStopsEarly;
  static constexpr bool kReadsFeatures = true, kInSegments = kWalksSegments<S, kSums>;
  static constexpr int kUnroll = kBlendUnroll;

  __device__ __forceinline__ void begin_batch(int32_t position) {
    if constexpr (kInSegments) begin_segments(position);
  }

  // Begins the segments up to that of the entry at `position`.
  __device__ __forceinline__ void begin_segments(int32_t position) {
    for (; next_segment <= position; next_segment += kSegmentLength) {
      const int segment = next_segment / kSegmentLength;
      begin_segment(arguments, tile, segment, pixels);
      if (tile.lane == 0) segment_queue(arguments.saved).push(tile.index, tile.quarter, segment);
    }
  }

  __device__ __forceinline__ void visit(const StagedGaussian<S, true>& staged) {
    const auto gaussian = staged;
    const ColumnExponent<S, S> exponent(gaussian.conic, S(tile.x) - gaussian.mean.x);
    const S dy = S(tile.y) - gaussian.mean.y, least_alpha = cut.of(gaussian.opacity);
#pragma unroll
    for (int k = 0; k < kLanePixels; ++k) {
      const auto gate = evaluate_gate<kMode>(exponent.at(below(dy, k)), gaussian.opacity, least_alpha);
      BlendedPixel<S, kSums>& pixel = pixels[k];
      const auto pair = Blend<kMode>::accumulate(pixel.state, gate);
      for (int f = 0; f < kSums; ++f) pixel.sums[f] = fma(pair.weight, gaussian.features[f], pixel.sums[f]);
      pixel.last = pair.contributes ? gaussian.position + 1 : pixel.last;
    }
  }

  __device__ __forceinline__ bool is_done() const { return are_full(pixels); }

  const BlendArguments<S>& arguments;
  const WarpTile<S>& tile;
  BlendedPixel<S, kSums> (&pixels)[kLanePixels];
  AlphaCut<S> cut;
  int32_t next_segment;  // where the next segment begins; beyond the list where it is not noted in segments
};

// Keeps what a segment's pixels have blended. Returns whether its list's other segments are done too.
template <class S>
__device__ bool keep_segment(const LongLists<S>& lists, const WarpTile<S>& tile, int first_row, const ListPart& part,
                             const BlendedPixel<S, kFastFeatures> (&pixels)[kLanePixels]) {
  for (int k = 0; k < kLanePixels; ++k) lists.blends[lists.at(first_row + part.segment, tile, k)] = pixels[k];
  __threadfence();
  __syncwarp();
  int arrived = 0;
  if (tile.lane == 0) arrived = 1 + atomicAdd(lists.arrivals + first_row * kWarpsPerTile + tile.quarter, 1);
  __threadfence();
  return __shfl_sync(kAllLanes, arrived, 0) == part.segments;
}

// Appends the segments of a list to one another, and notes where they begin, as a walk of the whole list does.
template <BlendMode kMode, class S>
__device__ void append_segments(const ForwardArguments<S>& arguments, const WarpTile<S>& tile, int first_row,
                                int segments, BlendedPixel<S, kFastFeatures> (&pixels)[kLanePixels]) {
  const LongLists<S>& lists = arguments.lists;
  const bool noted = arguments.saved.segments != nullptr;
  for (auto& pixel : pixels) pixel = {PixelState<S>::open(), {}, 0};
  int segment = 0;
  for (; segment < segments; ++segment) {
    if (Blend<kMode>::kStopsEarly && are_full(pixels)) break;
    if (noted && segment > 0) begin_segment(arguments, tile, segment, pixels);
    for (int k = 0; k < kLanePixels; ++k) {
      const auto next = lists.blends[lists.at(first_row + segment, tile, k)];
      if (!append<kMode>(pixels[k].state, next.state)) continue;
      for (int f = 0; f < kFastFeatures; ++f) pixels[k].sums[f] += next.sums[f];
      pixels[k].last = max(pixels[k].last, next.last);
    }
  }
  if (noted) end_segments(arguments, tile, segment - 1, pixels);
}

// T in front of a segment: the product of those of the segments before it.
template <class S>
__device__ S transmittance_before(const LongLists<S>& lists, const WarpTile<S>& tile, int first_row, int segment,
                                  int k) {
  S product = S(1);
#pragma unroll 4
  for (int s = 0; s < segment; ++s) product *= lists.transmittances[lists.at(first_row + s, tile, k)];
  return product;
}

template <class S, BlendMode kMode, int kSums>
__device__ void write_pixels(const ForwardArguments<S>& arguments, const WarpTile<S>& tile, int first_feature,
                             const BlendedPixel<S, kSums> (&blended)[kLanePixels]) {
  const RasterConfig<S>& config = arguments.config;
  const int64_t pixels = int64_t(arguments.width) * arguments.height;
  for (int k = 0; k < kLanePixels; ++k) {
    if (!tile.inside(arguments, k)) continue;
    const int64_t index = tile.pixel_index(arguments, k);
    const auto end = blended[k].state.end(config.gate_of_background());
    if (first_feature == 0) {
      arguments.saved.final_transmittance[index] = end.transmittance;
      arguments.saved.gate_sum[index] = end.gate_sum;
      arguments.saved.last_contributor[index] = blended[k].last;
    }
    for (int f = 0; f < kSums; ++f) {
      const int feature = first_feature + f;
      if (kSums == kFeatureChunk && feature >= config.num_features()) break;
      feature_image(config, arguments.images, feature, pixels)[index] = finish_feature<kMode>(
          feature_rule(config, feature), end, blended[k].sums[f], feature_background(config, feature));
    }
  }
}

// Blends kSums features of a part of a list from `first_feature` on, and writes them where the list is done.
template <class S, BlendMode kMode, int kSums>
__device__ void blend_part(const ForwardArguments<S>& arguments, const WarpTile<S>& tile, const ListPart& part,
                           WarpStage<S, BlendVisitor<S, kMode, kSums>>& stage, int first_feature) {
  using Visitor = BlendVisitor<S, kMode, kSums>;
  const bool whole = !Visitor::kInSegments || part.segments == 0;
  const int first_row = static_cast<int>(blockIdx.x) - arguments.tiles - part.segment;  // of the list, in `lists`
  BlendedPixel<S, kSums> blended[kLanePixels];
  for (int k = 0; k < kLanePixels; ++k) {
    blended[k] = {PixelState<S>::open(), {}, 0};
    if (!whole && Blend<kMode>::kNeedsDepthOrder) {
      blended[k].state = PixelState<S>::behind(transmittance_before(arguments.lists, tile, first_row, part.segment, k));
    }
    if (!tile.inside(arguments, k)) blended[k].state = PixelState<S>::behind(S(0));  // full
  }
  WalkRange range = {0, tile.source.length, first_feature};
  if (!whole) {
    range.begin = part.segment * kSegmentLength;
    range.end = min(range.begin + kSegmentLength, range.end);
    if (Blend<kMode>::kStopsEarly && are_full(blended)) range.end = range.begin;
  }
  const bool noted = whole && Visitor::kInSegments && has_segments(arguments.saved, tile);
  Visitor visitor = {arguments, tile, blended, arguments.config.alpha_cut(), noted ? kSegmentLength : INT32_MAX};
  const unsigned met = walk_tile(stage, range, visitor);
  if (first_feature == 0) count_pairs(arguments, tile.lane, met);
  if constexpr (Visitor::kInSegments) {
    if (noted) {
      // Where pixels do not stop, the backward pass walks the whole list.
      if (!Visitor::kStopsEarly) visitor.begin_segments(tile.source.length - 1);
      end_segments(arguments, tile, visitor.next_segment / kSegmentLength - 1, blended);
    }
    if (!whole) {
      if (!keep_segment(arguments.lists, tile, first_row, part, blended)) return;
      append_segments<kMode>(arguments, tile, first_row, part.segments, blended);
    }
  }
  write_pixels<S, kMode>(arguments, tile, first_feature, blended);
}

template <class S, BlendMode kMode, int kFeatures>
__global__ void __launch_bounds__(kWalkBlock,
                                  sizeof(S) == 4 && kFeatures != kAnyFeatures ? kBlendBlocks : kGeneralWalkBlocks)
    blend_kernel(const __grid_constant__ ForwardArguments<S> arguments) {
  constexpr int kSums = kFeatures != kAnyFeatures ? kFeatures : kFeatureChunk;
  __shared__ WarpStage<S, BlendVisitor<S, kMode, kSums>> stages[kWarpsPerTile];
  const int warp = threadIdx.x / kWarp;
  ListPart part = {static_cast<int>(blockIdx.x), 0, 0};
  if constexpr (kWalksSegments<S, kFeatures>) part = part_of_block(arguments.saved, arguments.lists, arguments.tiles);
  if (part.tile < 0) return;
  const WarpTile<S> tile(arguments, part.tile, warp);
  if (tile.empty) return;
  if constexpr (kFeatures != kAnyFeatures) {
    blend_part<S, kMode, kSums>(arguments, tile, part, stages[warp], 0);
  } else {
    for (int feature = 0; feature < arguments.config.num_features(); feature += kSums) {
      blend_part<S, kMode, kSums>(arguments, tile, part, stages[warp], feature);
    }
  }
}

template <class S, BlendMode kMode>
__global__ void __launch_bounds__(kWalkBlock, kBlendBlocks)
    transmit_kernel(const __grid_constant__ ForwardArguments<S> arguments) {
  __shared__ WarpStage<S, TransmitVisitor<S, kMode>> stages[kWarpsPerTile];
  const LongLists<S>& lists = arguments.lists;
  const int row = blockIdx.x, warp = threadIdx.x / kWarp;
  if (row >= lists.num_segments()) return;
  const ListPart part = lists.parts[row];
  if (part.segment + 1 == part.segments) return;  // nothing lies behind it
  const WarpTile<S> tile(arguments, part.tile, warp);
  if (tile.empty) return;
  S transmittance[kLanePixels];
  for (int k = 0; k < kLanePixels; ++k) transmittance[k] = tile.inside(arguments, k) ? S(1) : S(0);
  TransmitVisitor<S, kMode> visitor = {arguments, tile, arguments.config.alpha_cut(), transmittance};
  const int begin = part.segment * kSegmentLength;
  walk_tile(stages[warp], {begin, begin + kSegmentLength}, visitor);
  for (int k = 0; k < kLanePixels; ++k) lists.transmittances[lists.at(row, tile, k)] = transmittance[k];
}

template <class S, BlendMode kMode> void transmit(const ForwardArguments<S>& arguments, cudaStream_t stream) {
  if (arguments.lists.rows == 0) return;
  transmit_kernel<S, kMode><<<arguments.lists.rows, kWalkBlock, 0, stream>>>(arguments);
  DSMOE_CHECK_LAUNCH("transmit");
}

}  // namespace

template <class S> void blend(const Frame<S>& frame, const Work& work) {
  const RasterConfig<S>& config = frame.config;
  for_each_band(frame, work, [&](const Frame<S>& band) {
    ForwardArguments<S> arguments{blend_arguments(band, work)};
    arguments.tiles = static_cast<int>(num_band_tiles(band));
    // Double is for checking: it has only the general kernel.
    dispatch_blend(config.mode, sizeof(S) == 4 ? config.num_features() : kAnyFeatures, [&](auto mode, auto features) {
      constexpr BlendMode kMode = decltype(mode)::value;
      constexpr int kFeatures = sizeof(S) == 4 ? decltype(features)::value : kAnyFeatures;
      if constexpr (kWalksSegments<S, kFeatures>) {
        if (frame.saved.capacity > 0) arguments.lists = find_long_lists(frame, work);
        if constexpr (Blend<kMode>::kNeedsDepthOrder) transmit<S, kMode>(arguments, work.stream);
      }
      blend_kernel<S, kMode, kFeatures>
          <<<arguments.tiles + arguments.lists.rows, kWalkBlock, 0, work.stream>>>(arguments);
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

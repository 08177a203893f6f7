// Stage 3: the images.
#include "../dispatch.h"
#include "dsmoe/rasterize.h"
#include "segments.cuh"

namespace dsmoe {
namespace cuda {
namespace {

// Notes the pixels' state where a segment begins, and that the backward pass has something to do there.
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
    segment_queue(arguments.saved).push(tile.tile_y * arguments.tile_columns + tile.tile_x, tile.quarter, segment);
  }
}

// At the end of the list: from the sums in front of each segment to those behind.
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

// Blends kSums features from `first_feature` on.
template <class S, BlendMode kMode, int kSums>
__device__ void blend_features(const BlendArguments<S>& arguments, const WarpTile<S>& tile, StagedGaussian<S>* staged,
                               int first_feature) {
  const RasterConfig<S>& config = arguments.config;
  PixelState<S> state[kLanePixels];
  S sums[kLanePixels][kSums];
  int32_t last[kLanePixels];
  for (int k = 0; k < kLanePixels; ++k) {
    state[k] = PixelState<S>::open();
    if (!tile.inside(arguments, k)) state[k].transmittance = -state[k].transmittance;  // closed
    for (int f = 0; f < kSums; ++f) sums[k][f] = S(0);
    last[k] = 0;
  }
  const AlphaCut<S> cut = config.alpha_cut();
  unsigned hits = 0;
  constexpr bool kSegments = kWalksSegments<S, kSums>;
  const bool segments = kSegments && has_segments(arguments.saved, tile);
  int segment = 0;

  auto next = load_entry(arguments, tile, tile.lane, first_feature);
  for (int32_t chunk = 0; chunk < tile.length; chunk += kWarp) {
    if constexpr (kSegments) {
      if (segments && chunk == (segment + 1) * kSegmentLength) {
        begin_segment(arguments, tile, ++segment, state, sums);
      }
    }
    const bool meets = meets_pixels(next, tile);
    if (meets) staged[tile.lane] = next.staged;
    unsigned left = __ballot_sync(kAllLanes, meets);
    __syncwarp();
    next = load_entry(arguments, tile, chunk + kWarp + tile.lane, first_feature);
    hits += __popc(left);
    for (; left != 0; left &= left - 1) {
      const int j = __ffs(left) - 1;
      const StagedGaussian<S> current = staged[j];
      const ProjectedGaussian<S>& gaussian = current.gaussian;
      const ColumnExponent<S, S> exponent(gaussian.conic, S(tile.x) - gaussian.mean.x);
      const S dy = S(tile.y) - gaussian.mean.y, least_alpha = cut.of(gaussian.opacity);
#pragma unroll
      for (int k = 0; k < kLanePixels; ++k) {
        const auto gate = evaluate_gate<kMode>(exponent.at(dy + S(k * kLaneStep)), gaussian.opacity, least_alpha);
        const auto pair = Blend<kMode>::accumulate(state[k], gate);
        for (int f = 0; f < kSums; ++f) sums[k][f] = fma(pair.weight, current.features[f], sums[k][f]);
        last[k] = pair.contributes ? chunk + j + 1 : last[k];
      }
    }
    __syncwarp();
    if (Blend<kMode>::kStopsEarly) {
      bool open = false;
      for (int k = 0; k < kLanePixels; ++k) open |= state[k].is_open();
      if (!__any_sync(kAllLanes, open)) break;
    }
  }
  if constexpr (kSegments) end_segments(arguments, tile, segment, sums);

  const int64_t pixels = int64_t(arguments.width) * arguments.height;
  for (int k = 0; k < kLanePixels; ++k) {
    if (!tile.inside(arguments, k)) continue;
    const int64_t index = tile.pixel_index(arguments, k);
    const auto end = state[k].end(config.gate_of_background());
    if (first_feature == 0) {
      arguments.saved.final_transmittance[index] = end.transmittance;
      arguments.saved.gate_sum[index] = end.gate_sum;
      arguments.saved.last_contributor[index] = last[k];
    }
    for (int f = 0; f < kSums; ++f) {
      const int feature = first_feature + f;
      if (kSums == kFeatureChunk && feature >= config.num_features()) break;
      feature_image(config, arguments.images, feature, pixels)[index] =
          finish_feature<kMode>(feature_rule(config, feature), end, sums[k][f], feature_background(config, feature));
    }
  }
  if (arguments.pairs != nullptr && first_feature == 0 && tile.lane == 0) {
    atomicAdd(arguments.pairs, static_cast<unsigned long long>(hits) * (kWarpTile * kWarpTile));
  }
}

template <class S, BlendMode kMode, int kFeatures>
__global__ void __launch_bounds__(kWarpsPerTile* kWarp)
    blend_kernel(const __grid_constant__ BlendArguments<S> arguments) {
  __shared__ StagedGaussian<S> staged[kWarpsPerTile][kWarp];
  const WarpTile<S> tile(arguments);
  if (tile.empty) return;
  StagedGaussian<S>* mine = staged[threadIdx.x / kWarp];
  if constexpr (kFeatures != kAnyFeatures) {
    blend_features<S, kMode, kFeatures>(arguments, tile, mine, 0);
  } else {
    for (int feature = 0; feature < arguments.config.num_features(); feature += kFeatureChunk) {
      blend_features<S, kMode, kFeatureChunk>(arguments, tile, mine, feature);
    }
  }
}

}  // namespace

template <class S> void blend(const Frame<S>& frame, const Work& work) {
  const DeviceCamera<S>& camera = frame.camera;
  const RasterConfig<S>& config = frame.config;
  const cudaStream_t stream = work.stream;
  const auto arguments = blend_arguments(frame, work);
  const unsigned tiles = static_cast<unsigned>(num_tiles(camera.width, camera.height));
  // Double is for checking: it has the general kernel alone.
  dispatch_blend(config.mode, sizeof(S) == 4 ? config.num_features() : kAnyFeatures, [&](auto mode, auto features) {
    constexpr int kFeatures = sizeof(S) == 4 ? decltype(features)::value : kAnyFeatures;
    blend_kernel<S, decltype(mode)::value, kFeatures><<<tiles, kWarpsPerTile * kWarp, 0, stream>>>(arguments);
    DSMOE_CHECK_LAUNCH("blend");
  });
}

#define DSMOE_INSTANTIATE(S) template void blend(const Frame<S>&, const Work&);
DSMOE_INSTANTIATE(float)
DSMOE_INSTANTIATE(double)
#undef DSMOE_INSTANTIATE

}  // namespace cuda
}  // namespace dsmoe

// What each Gaussian is worth to an image. The kernel repeats the blend's walk beside the finished pixels. A warp sums
// over its pixels, then adds the three numbers to those of the Gaussian by atomics.
#include "../dispatch.h"
#include "../refuse.h"
#include "bands.h"
#include "dsmoe/params.h"
#include "dsmoe/removal.h"
#include "reduce.cuh"
#include "tile_walk.cuh"

namespace dsmoe {
namespace cuda {
namespace {

template <class S> struct ImportanceArguments : BlendArguments<S> {
  ImportanceMap<S> map;
  S* fronts;  // [C, H, W] the sums A, where the number of channels is not known
};

// C and A of one lane's pixels, a channel at a time: in registers where the number of channels is known, else in
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
  int32_t last[kLanePixels];                         // entries of the list that the numerator has seen
};

// Walks front to back, as the blend does.
template <class S, BlendMode kMode, int kChannels> struct ImportanceVisitor {
  static constexpr bool kBackToFront = false, kStopsEarly = false;
  static constexpr bool kReadsFeatures = true, kInSegments = false;
  static constexpr int kUnroll = 1;

  __device__ __forceinline__ int num_channels() const {
    return kChannels != kAnyFeatures ? kChannels : arguments.config.num_channels;
  }

  __device__ __forceinline__ void begin_batch(int32_t) {}

  __device__ __forceinline__ void visit(const StagedGaussian<S, true>& staged, const int32_t& number) {
    const auto gaussian = staged;
    const S dx = S(tile.x) - gaussian.mean.x, dy = S(tile.y) - gaussian.mean.y;
    const auto exponent = gaussian.gate.column(dx);
    Gate<S> gate[kLanePixels];
    bool any = false;
#pragma unroll
    for (int k = 0; k < kLanePixels; ++k) {
      gate[k] = gaussian.gate.evaluate(exponent.at(below(dy, k)));
      any |= gate[k].counts && (!Blend<kMode>::kStopsEarly || gaussian.seen <= pixels.last[k]);
    }
    if (!__any_sync(kAllLanes, any)) return;

    const int32_t index = number;
    const S* features = arguments.saved.features + int64_t(index) * feature_stride(arguments.config.num_features());
    auto sum = no_importance<S>();
#pragma unroll
    for (int k = 0; k < kLanePixels; ++k) {
      const auto removal = remove_pair<kMode>(pixels.state[k], pixels.end[k], gate[k], gaussian.seen <= pixels.last[k]);
      S squared = S(0);
      for (int c = 0; c < num_channels(); ++c) {
        const S feature = kChannels != kAnyFeatures ? gaussian.features[c] : features[c];
        const S value = pixels.channels.value(arguments, tile, k, c), distance = feature - value;
        const S front = pixels.channels.front(arguments, tile, k, c);
        const S change = channel_change<kMode>(removal, distance, front, value, arguments.config.background[c]);
        squared = fma(change, change, squared);
        pixels.channels.set_front(arguments, tile, k, c, fma(removal.weight, distance, front));
      }
      add_pair(sum, removal, squared, pixels.share_weight[k], pixels.weight[k]);
    }
    S numbers[kNumImportances] = {sum.share, sum.squared_share, sum.removal_cost};
    sum_pixels(numbers);
    if (!sum_pixels.holds) return;
    const ImportanceSums<S>& sums = arguments.map.sums;
    S* const of_number = sum_pixels.number == 0   ? sums.shares
                         : sum_pixels.number == 1 ? sums.squared_shares
                                                  : sums.removal_costs;
    atomicAdd(of_number + index, numbers[0]);
  }

  const ImportanceArguments<S>& arguments;
  const WarpTile<S>& tile;
  WeighedPixels<S, kChannels>& pixels;
  TransposedSum<kNumImportances> sum_pixels;
};

template <class S, BlendMode kMode, int kChannels>
__global__ void __launch_bounds__(kWalkBlock)
    importance_kernel(const __grid_constant__ ImportanceArguments<S> arguments) {
  using Visitor = ImportanceVisitor<S, kMode, kChannels>;
  __shared__ WarpStage<S, Visitor> stages[kWarpsPerTile];
  const WarpTile<S> tile(arguments);
  if (tile.empty) return;

  const S background_gate = arguments.config.gate_of_background();
  WeighedPixels<S, kChannels> pixels;
  int32_t seen = 0;
  for (int k = 0; k < kLanePixels; ++k) {
    const bool inside = tile.inside(arguments, k);
    const int64_t index = inside ? tile.pixel_index(arguments, k) : 0;
    pixels.state[k] = PixelState<S>::open();
    pixels.end[k] = {arguments.saved.final_transmittance[index], inside ? arguments.saved.gate_sum[index] : S(0),
                     background_gate};
    pixels.weight[k] = inside ? arguments.map.pixel_weights[index] : S(0);
    pixels.share_weight[k] = inside ? arguments.map.share_weights[index] : S(0);
    pixels.last[k] = inside ? arguments.saved.last_contributor[index] : 0;
    pixels.channels.begin(arguments, tile, k);
    seen = seen > pixels.last[k] ? seen : pixels.last[k];
  }
  Visitor visitor = {arguments, tile, pixels, TransposedSum<kNumImportances>(tile.lane)};
  const int32_t end = Blend<kMode>::kStopsEarly ? max_over_lanes(seen) : tile.source.length;
  walk_tile(stages[threadIdx.x / kWarp], {0, end}, visitor);
}

}  // namespace

template <class S> void importance(const Frame<S>& frame, const ImportanceMap<S>& map, const Work& work) {
  refuse_importance("cuda::importance", frame, map);
  const int64_t num_gaussians = frame.inputs.num_gaussians;
  const int width = frame.camera.width, height = frame.camera.height;
  if (num_gaussians == 0) return;
  const auto clear = [&](S* numbers) {
    check(cudaMemsetAsync(numbers, 0, num_gaussians * sizeof(S), work.stream), "clearing the importance");
  };
  clear(map.sums.shares), clear(map.sums.squared_shares), clear(map.sums.removal_costs);
  const int num_channels = frame.config.num_channels;
  S* fronts = nullptr;
  if (num_channels != 3) fronts = allocate<S>(*work.scratch, int64_t(num_channels) * width * height);
  for_each_band(frame, work, [&](const Frame<S>& band) {
    ImportanceArguments<S> arguments{blend_arguments(band, work)};
    arguments.map = map;
    arguments.fronts = fronts;
    const unsigned tiles = static_cast<unsigned>(num_band_tiles(band));
    dispatch_blend(frame.config.mode, num_channels, [&](auto mode, auto channels) {
      importance_kernel<S, decltype(mode)::value, decltype(channels)::value>
          <<<tiles, kWalkBlock, 0, work.stream>>>(arguments);
      DSMOE_CHECK_LAUNCH("importance");
    });
  });
}

#define DSMOE_INSTANTIATE(S) template void importance(const Frame<S>&, const ImportanceMap<S>&, const Work&);
DSMOE_INSTANTIATE(float)
DSMOE_INSTANTIATE(double)
#undef DSMOE_INSTANTIATE

}  // namespace cuda
}  // namespace dsmoe

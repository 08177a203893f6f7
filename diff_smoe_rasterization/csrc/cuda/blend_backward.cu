// From image gradients to one record per Gaussian: the moments of dL/dpower over its pixels, and dL/dfeatures.
#include "../dispatch.h"
#include "dsmoe/rasterize.h"
#include "reduce.cuh"
#include "segments.cuh"
#include "tensor_sums.cuh"

namespace dsmoe {
namespace cuda {
namespace {

template <class S> struct BackwardArguments : BlendArguments<S> {
  ImageGradients<S> dL_dimages;
  S* dL_dgaussians;        // [N, record]
  S* slots;                // [capacity, kSlotsPerInstance, record], or null
  S* dL_dbackground_rows;  // [tiles * kWarpsPerTile, C + 1] of each warp, or null
  S* scaled;               // [F, H, W] g', where the number of features is not known
  int num_features;
  int tiles;
};

// g' of one lane's pixels: in registers where the number of features is known, else in memory.
template <class S, int kFeatures> struct ScaledGradients {
  S values[kLanePixels][kFeatures];
  __device__ S get(const BackwardArguments<S>&, const WarpTile<S>&, int k, int f) const { return values[k][f]; }
  __device__ void set(const BackwardArguments<S>&, const WarpTile<S>&, int k, int f, S value) { values[k][f] = value; }
};
template <class S> struct ScaledGradients<S, kAnyFeatures> {
  __device__ S* at(const BackwardArguments<S>& arguments, const WarpTile<S>& tile, int k, int f) const {
    return arguments.scaled + int64_t(f) * arguments.width * arguments.height + tile.pixel_index(arguments, k);
  }
  __device__ S get(const BackwardArguments<S>& arguments, const WarpTile<S>& tile, int k, int f) const {
    return tile.inside(arguments, k) ? *at(arguments, tile, k, f) : S(0);
  }
  __device__ void set(const BackwardArguments<S>& arguments, const WarpTile<S>& tile, int k, int f, S value) {
    if (tile.inside(arguments, k)) *at(arguments, tile, k, f) = value;
  }
};

// Whether gradients go to slots, one for each warp that lists a Gaussian, instead of records that warps share.
template <class S> __device__ bool has_slots(const BackwardArguments<S>& arguments, const WarpTile<S>& tile) {
  return arguments.slots != nullptr && tile.listed;
}

template <class S> __device__ int64_t slot_of(const WarpTile<S>& tile, int32_t position) {
  const uint32_t of_tile = static_cast<uint32_t>(tile.list[2 * int64_t(position) + 1]);
  return int64_t(of_tile) * kSlotsPerInstance + tile.quarter;
}

// Adds the first `count` Gaussians of a batch to their records.
[[maybe_unused]] __device__ void add_batch(const BackwardArguments<float>& arguments, const WarpTile<float>& tile,
                                           const TensorStage& stage, const TensorBasis& basis, int count) {
  __syncwarp();
  TensorSums sums = sum_pixels(stage, basis, tile.lane);
  const TensorLane at(tile.lane);
  const float4 gaussian = stage.gaussians[at.row];
  recentre(sums, {gaussian.x, gaussian.y}, tile.lane);
  __syncwarp();
  if (at.row >= count || at.column >= kTensorFeatures) return;
  const int moment = 2 * at.column, feature = kNumGateMoments + at.column;
  if (has_slots(arguments, tile)) {
    float* record = arguments.slots + slot_of(tile, __float_as_int(gaussian.w)) * kTensorRecord;
    record[moment] = sums.moments[0], record[moment + 1] = sums.moments[1], record[feature] = sums.feature;
  } else {
    float* record = arguments.dL_dgaussians + int64_t(__float_as_int(gaussian.z)) * kTensorRecord;
    atomicAdd(record + moment, sums.moments[0]);
    atomicAdd(record + moment + 1, sums.moments[1]);
    atomicAdd(record + feature, sums.feature);
  }
}

// Adds numbers that one warp has summed to the record of a Gaussian, `first` numbers into it.
template <class S, int kCount>
__device__ void add_to_record(const BackwardArguments<S>& arguments, const TransposedSum<kCount>& sum,
                              S (&values)[kCount], const WarpTile<S>& tile, int32_t gaussian, int32_t position,
                              int first, int wanted) {
  sum(values);
  if (!sum.holds || sum.number >= wanted) return;
  const int record = kNumGateMoments + arguments.num_features;
  if (has_slots(arguments, tile)) {
    arguments.slots[slot_of(tile, position) * record + first + sum.number] = values[0];
  } else {
    atomicAdd(arguments.dL_dgaussians + int64_t(gaussian) * record + first + sum.number, values[0]);
  }
}

// The six moments of a lane's pixels, one below the other.
template <class S> __device__ void column_moments(const S (&dL_dpower)[kLanePixels], S dx, S dy, S* moments) {
  S one = S(0), y = S(0), yy = S(0);
#pragma unroll
  for (int k = 0; k < kLanePixels; ++k) {
    const S d = dy + S(k * kLaneStep), first = dL_dpower[k] * d;
    one = one + dL_dpower[k];
    y = y + first;
    yy = fma(first, d, yy);
  }
  const GateMoments<S> sums = {one, one * dx, y, one * dx * dx, y * dx, yy};
  moments[0] = sums.one, moments[1] = sums.x, moments[2] = sums.y;
  moments[3] = sums.xx, moments[4] = sums.xy, moments[5] = sums.yy;
}

template <class S, BlendMode kMode, int kFeatures>
__global__ void __launch_bounds__(kWarpsPerTile* kWarp, sizeof(S) == 4 && kFeatures != kAnyFeatures ? 5 : 1)
    blend_backward_kernel(const __grid_constant__ BackwardArguments<S> arguments) {
  __shared__ StagedGaussian<S> staged[kWarpsPerTile][kWarp];
  __shared__ int32_t staged_gaussian[kWarpsPerTile][kWarp];
  constexpr bool kTensor = kHasTensorSums && sizeof(S) == sizeof(float) && kFeatures == kTensorFeatures;
  __shared__ TensorStage tensor_stages[kTensor ? kWarpsPerTile : 1];
  __shared__ TensorBasis moment_basis;
  if (is_idle_block(arguments.saved, arguments.tiles)) return;
  if constexpr (kTensor) {
    fill_moment_basis(moment_basis);
    __syncthreads();
  }
  const auto [tile_index, quarter, segment] = segment_of_warp(arguments.saved, arguments.tiles);
  if (tile_index < 0) return;
  const WarpTile<S> tile(arguments, tile_index, quarter);
  const int warp = threadIdx.x / kWarp;
  const RasterConfig<S>& config = arguments.config;
  const int num_features = kFeatures != kAnyFeatures ? kFeatures : arguments.num_features;
  const int64_t pixels = int64_t(arguments.width) * arguments.height;

  PixelBackward<S> pixel[kLanePixels];
  PixelEnd<S> pixel_end[kLanePixels];
  ScaledGradients<S, kFeatures> scaled;
  int32_t last[kLanePixels];
  for (int k = 0; k < kLanePixels; ++k) {
    const bool inside = tile.inside(arguments, k);
    const int64_t index = inside ? tile.pixel_index(arguments, k) : 0;
    pixel_end[k] = {S(1), S(0), config.gate_of_background()};
    if (inside) {
      pixel_end[k].transmittance = arguments.saved.final_transmittance[index];
      pixel_end[k].gate_sum = arguments.saved.gate_sum[index];
    }
    const S* dL_dgate_sum = arguments.dL_dimages.gate_sum;
    pixel[k] = begin_backward(pixel_end[k], inside && dL_dgate_sum != nullptr ? dL_dgate_sum[index] : S(0));
    last[k] = inside ? arguments.saved.last_contributor[index] : 0;
  }
  S* dL_dbackground = nullptr;  // the warp's row
  if (arguments.dL_dbackground_rows != nullptr && segment == 0) {
    dL_dbackground =
        arguments.dL_dbackground_rows + (int64_t(tile_index) * kWarpsPerTile + quarter) * (config.num_channels + 1);
  }
  S dL_dbackground_gate = S(0);
  for (int f = 0; f < num_features; ++f) {
    const S* gradient = feature_image(config, arguments.dL_dimages, f, pixels);
    S share = S(0);
    for (int k = 0; k < kLanePixels; ++k) {
      S value = S(0), dL_dvalue = S(0);
      if (gradient != nullptr && tile.inside(arguments, k)) {
        const int64_t index = tile.pixel_index(arguments, k);
        value = feature_image(config, arguments.images, f, pixels)[index], dL_dvalue = gradient[index];
      }
      const auto feature = add_feature<kMode>(feature_rule(config, f), pixel[k], pixel_end[k], dL_dvalue, value,
                                              feature_background(config, f));
      scaled.set(arguments, tile, k, f, feature.scaled);
      share += feature.background, dL_dbackground_gate += feature.background_gate;
    }
    if (dL_dbackground == nullptr || f >= config.num_channels) continue;
    share = sum_lanes(share);
    if (tile.lane == 0) dL_dbackground[f] = share;
  }
  if (dL_dbackground != nullptr) {
    const S share = sum_lanes(dL_dbackground_gate);
    if (tile.lane == 0) dL_dbackground[config.num_channels] = share;
  }
  if (tile.empty) return;

  int32_t end = tile.length;
  if (Blend<kMode>::kStopsEarly) {
    int32_t seen = 0;
    for (int k = 0; k < kLanePixels; ++k) seen = seen > last[k] ? seen : last[k];
    end = max_over_lanes(seen);
  }
  int32_t begin = 0;
  if (kWalksSegments<S, kFeatures> && has_segments(arguments.saved, tile)) {
    begin = segment * kSegmentLength;
    if (begin >= end) return;
    const int segments = (end + kSegmentLength - 1) / kSegmentLength;
    if (segment + 1 < segments) {
      for (int k = 0; k < kLanePixels; ++k) {
        if (!tile.inside(arguments, k)) continue;
        const SegmentPixel<S> next_begin = segment_pixel(arguments.saved, tile, segment + 1, k);
        S behind = S(0);
        for (int f = 0; f < kSegmentFeatures; ++f) {
          behind = fma(scaled.get(arguments, tile, k, f), next_begin.sums[f], behind);
        }
        resume_backward<kMode>(pixel[k], next_begin.transmittance, behind);
      }
      end = begin + kSegmentLength;
    }
  }
  TensorStage& tensor_stage = tensor_stages[kTensor ? warp : 0];
  int batch = 0;  // Gaussians that wait in the stage
  if constexpr (kTensor) fill_gradient_basis(tensor_stage, scaled.values, tile.lane);
  constexpr int kTogether = kNumGateMoments + (kFeatures != kAnyFeatures ? kFeatures : 0);
  const TransposedSum<kTogether> sum(tile.lane);
  const AlphaCut<S> cut = config.alpha_cut();
  unsigned hits = 0;

  // Back to front: lane 0 takes the last entry of a chunk.
  auto next = load_entry(arguments, tile, end - 1 - tile.lane, 0, begin);
  for (int32_t chunk = end - 1; chunk >= begin; chunk -= kWarp) {
    const bool meets = meets_pixels(next, tile);
    if (meets) {
      staged[warp][tile.lane] = next.staged;
      staged_gaussian[warp][tile.lane] = next.gaussian;
    }
    unsigned left = __ballot_sync(kAllLanes, meets);
    __syncwarp();
    next = load_entry(arguments, tile, chunk - kWarp - tile.lane, 0, begin);
    hits += __popc(left);
    for (; left != 0; left &= left - 1) {
      const int j = __ffs(left) - 1;
      const StagedGaussian<S> current = staged[warp][j];
      const ProjectedGaussian<S>& gaussian = current.gaussian;
      const int32_t position = chunk - j;
      const S dx = S(tile.x) - gaussian.mean.x, dy = S(tile.y) - gaussian.mean.y;
      const ColumnExponent<S, S> exponent(gaussian.conic, dx);
      const S least_alpha = cut.of(gaussian.opacity);
      Gate<S> gate[kLanePixels];
      bool contributes[kLanePixels], any = false;
#pragma unroll
      for (int k = 0; k < kLanePixels; ++k) {
        gate[k] = evaluate_gate<kMode>(exponent.at(dy + S(k * kLaneStep)), gaussian.opacity, least_alpha);
        contributes[k] = gate[k].counts && position < last[k];
        any |= Blend<kMode>::kStopsEarly ? contributes[k] : gate[k].counts;
      }
      if (!__any_sync(kAllLanes, any)) continue;

      const int32_t index = staged_gaussian[warp][j];
      const S* features = arguments.saved.features + int64_t(index) * feature_stride(num_features);
      const auto feature = [&](int f) { return kFeatures != kAnyFeatures ? current.features[f] : features[f]; };
      S weight[kLanePixels], dL_dpower[kLanePixels];
#pragma unroll
      for (int k = 0; k < kLanePixels; ++k) {
        S value = S(0);
        for (int f = 0; f < num_features; ++f) value = fma(scaled.get(arguments, tile, k, f), feature(f), value);
        const auto pair = Blend<kMode>::backward(pixel[k], gate[k], value, contributes[k]);
        weight[k] = pair.weight;
        dL_dpower[k] = gate_backward(gate[k], pair.gamma);
      }
      if constexpr (kTensor) {
        *reinterpret_cast<float2*>(&tensor_stage.values[batch][2 * tile.lane]) =
            make_float2(dL_dpower[0], dL_dpower[1]);
        *reinterpret_cast<float2*>(&tensor_stage.values[kTensorBatch + batch][2 * tile.lane]) =
            make_float2(weight[0], weight[1]);
        if (tile.lane == 0) {
          tensor_stage.gaussians[batch] =
              make_float4(dx + kWarpTileCentre, dy + kWarpTileCentre, __int_as_float(index), __int_as_float(position));
        }
        if (++batch == kTensorBatch) {
          add_batch(arguments, tile, tensor_stage, moment_basis, batch);
          batch = 0;
        }
        continue;
      }
      S values[kTogether];
      column_moments(dL_dpower, dx, dy, values);
      if constexpr (kFeatures != kAnyFeatures) {
        for (int f = 0; f < kFeatures; ++f) {
          S share = S(0);
          for (int k = 0; k < kLanePixels; ++k) share = fma(weight[k], scaled.values[k][f], share);
          values[kNumGateMoments + f] = share;
        }
      }
      add_to_record(arguments, sum, values, tile, index, position, 0, kTogether);
      if constexpr (kFeatures == kAnyFeatures) {
        const TransposedSum<kFeatureChunk> sum_features(tile.lane);
        for (int first = 0; first < num_features; first += kFeatureChunk) {
          S shares[kFeatureChunk];
          for (int f = 0; f < kFeatureChunk; ++f) {
            shares[f] = S(0);
            if (first + f >= num_features) continue;
            for (int k = 0; k < kLanePixels; ++k) {
              shares[f] = fma(weight[k], scaled.get(arguments, tile, k, first + f), shares[f]);
            }
          }
          add_to_record(arguments, sum_features, shares, tile, index, position, kNumGateMoments + first,
                        num_features - first);
        }
      }
    }
    __syncwarp();
  }
  if constexpr (kTensor) {
    if (batch > 0) add_batch(arguments, tile, tensor_stage, moment_basis, batch);
  }
  if (arguments.pairs != nullptr && tile.lane == 0) {
    atomicAdd(arguments.pairs, static_cast<unsigned long long>(hits) * (kWarpTile * kWarpTile));
  }
}

}  // namespace

template <class S> void blend_backward(const Frame<S>& frame, const BackwardPass<S>& pass, const Work& work) {
  const DeviceCamera<S>& camera = frame.camera;
  const RasterConfig<S>& config = frame.config;
  const SavedForward<S>& saved = frame.saved;
  S* dL_dbackground = pass.gradients.inputs.background;
  Scratch& scratch = *work.scratch;
  const cudaStream_t stream = work.stream;
  const int64_t tiles = num_tiles(camera.width, camera.height);
  const bool known = sizeof(S) == 4 && config.num_features() == 3;
  BackwardArguments<S> arguments{blend_arguments(frame, work)};
  arguments.dL_dimages = pass.gradients.images;
  arguments.dL_dgaussians = pass.dL_dgaussians;
  arguments.slots = pass.slots;
  arguments.num_features = config.num_features();
  arguments.tiles = static_cast<int>(tiles);
  const int64_t blocks = tiles + (known && saved.segments != nullptr ? num_segment_rows(saved.capacity) : 0);
  const int64_t warps = tiles * kWarpsPerTile;
  if (dL_dbackground != nullptr)
    arguments.dL_dbackground_rows = allocate<S>(scratch, warps * (config.num_channels + 1));
  if (!known) {
    arguments.scaled = allocate<S>(scratch, int64_t(camera.width) * camera.height * arguments.num_features);
  }
  dispatch_blend(config.mode, known ? 3 : kAnyFeatures, [&](auto mode, auto features) {
    constexpr int kFeatures = sizeof(S) == 4 ? decltype(features)::value : kAnyFeatures;
    blend_backward_kernel<S, decltype(mode)::value, kFeatures>
        <<<static_cast<unsigned>(blocks), kWarpsPerTile * kWarp, 0, stream>>>(arguments);
    DSMOE_CHECK_LAUNCH("blend_backward");
  });
  if (dL_dbackground != nullptr) {
    sum_columns(arguments.dL_dbackground_rows, warps, config.num_channels + 1, dL_dbackground, stream);
  }
}

#define DSMOE_INSTANTIATE(S) template void blend_backward(const Frame<S>&, const BackwardPass<S>&, const Work&);
DSMOE_INSTANTIATE(float)
DSMOE_INSTANTIATE(double)
#undef DSMOE_INSTANTIATE

}  // namespace cuda
}  // namespace dsmoe

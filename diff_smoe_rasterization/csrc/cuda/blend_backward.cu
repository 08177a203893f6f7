// From image gradients to one record per Gaussian: the moments of dL/dpower over its pixels, and dL/dfeatures. If
// sums of absolute gradients by the mean are wanted, they follow in the record, and are split off at the end.
#include "../dispatch.h"
#include "bands.h"
#include "dsmoe/arrays.h"
#include "dsmoe/params.h"
#include "integer_sums.cuh"
#include "reduce.cuh"
#include "segments.cuh"
#include "tensor_sums.cuh"

namespace dsmoe {
namespace cuda {
namespace {

// Where the sums over a warp's pixels go. Each Gaussian has a record of numbers: the moments of dL/dpower, then the
// gradients of its features. Every warp that meets the Gaussian has a term for each number.
//
// RecordSink adds terms to the records by atomics, in any order. IntegerSink adds them as integers, so that gradients
// are the same bits every time.
template <class S> struct RecordSink {
  S* records;  // [N, length] sums; zero before
  int length;  // numbers a record

  // Calls put(add), where add(k, term) adds to number `first` + k of a Gaussian's record. numbers: how many a record
  // has, a constant if the caller knows it.
  template <class Put>
  __device__ __forceinline__ void to_record(int32_t gaussian, int numbers, int first, Put put) const {
    S* from_first = records + int64_t(gaussian) * numbers + first;
    put([from_first](int k, S term) { atomicAdd(from_first + k, term); });
  }
};

template <class S> struct IntegerSink {
  IntegerSums<S> sums;
  int length;  // numbers a record

  template <class Put> __device__ __forceinline__ void to_record(int32_t gaussian, int, int first, Put put) const {
    const SumExtent extent = sums.extents[gaussian];
    put([&](int k, S term) { sums.add(gaussian, extent, first + k, term); });
  }
};

template <class S> struct BackwardArguments : BlendArguments<S> {
  ImageGradients<S> dL_dimages;  // [features, H, W], and of the gate sum [H, W]; any may be null
  S* dL_dbackground_rows;        // [tiles * kWarpsPerTile, C + 1] of each warp of the band, or null
  S* scaled;                     // [F, H, W] g', if the number of features is not known
  int num_features;              // F
  int tiles;                     // of the band
  bool absolute;                 // records end with the sums of absolute gradients
};

template <class S, class Sink> struct BackwardWithSink : BackwardArguments<S> {
  Sink sink;  // where each warp's sums go
};

// g' of one lane's pixels: in registers if the number of features is known, else in memory.
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

// Sums a batch by tensor cores, and gives the sums of its `count` Gaussians to the sink. If the batch is not full,
// the other rows hold old values, and their sums are not used. kRecord: numbers of a record.
template <int kRecord, class Sink>
__device__ void add_batch(const Sink& sink, const WarpTile<float>& tile, const TensorStage& stage,
                          const TensorBasis& basis, const StagedGaussian<float, true>* gaussians,
                          const int32_t* numbers, int count) {
  __syncwarp();
  TensorSums sums = sum_pixels(stage, basis, tile.lane);
  const TensorLane at(tile.lane);
  const Vec2<float> mean = gaussians[at.row].mean;
  const int32_t number = numbers[at.row];
  recentre(sums, {tile.rect.x0 + kWarpTileCentre - mean.x, tile.rect.y0 + kWarpTileCentre - mean.y}, tile.lane);
  __syncwarp();
  if (at.row >= count || at.column >= kFastFeatures) return;
  sink.to_record(number, kRecord, 2 * at.column, [&](auto add) {
    add(0, sums.moments[0]);
    add(1, sums.moments[1]);
    add(kNumGateMoments - at.column, sums.feature);
  });
}

// Sums `values` over the warp, and gives the first `wanted` sums to the sink: numbers `first`, first + 1, ... of the
// Gaussian's record.
template <class S, int kCount, class Sink>
__device__ void add_values(const Sink& sink, const WarpTile<S>& tile, S (&values)[kCount], int32_t gaussian, int first,
                           int wanted) {
  const TransposedSum<kCount> sum(tile.lane);
  sum(values);
  if (!sum.holds || sum.number >= wanted) return;
  sink.to_record(gaussian, sink.length, first + sum.number, [&](auto add) { add(0, values[0]); });
}

// Sums the six moments over a lane's pixels, which lie one below the other.
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

// What the walk knows of a lane's pixels.
template <class S, int kFeatures> struct BackwardPixels {
  PixelBackward<S> state[kLanePixels];
  S value_begin[kLanePixels];            // with what the sum g'.c begins
  ScaledGradients<S, kFeatures> scaled;  // g'
  int32_t last[kLanePixels];             // entries of the list that the numerator has seen
  bool wide[kLanePixels];                // the pixel is
};

// A warp's part in the sums by tensor cores, in shared memory.
struct TensorShare {
  TensorStage& stage;               // the warp's own
  const TensorBasis& moment_basis;  // the block's
};

// Walks back to front, and sums for each Gaussian the moments of dL/dpower and the gradients of its features.
// kAbsolute: also sums |dL/dmean|. If the number of features is not known, the arguments say that instead.
template <class S, BlendMode kMode, int kFeatures, bool kAbsolute, class Sink, Pairs kWanted> struct BackwardVisitor {
  static constexpr bool kBackToFront = true, kStopsEarly = false;
  static constexpr bool kReadsFeatures = true, kInSegments = false;
  static constexpr bool kNearFirst = Blend<kMode>::kNearFirst;
  static constexpr Pairs kPairs = kWanted;
  static constexpr bool kTensor = kSumsByTensors<S, kFeatures>;
  static constexpr int kUnroll = kTensor ? kBackwardUnroll : 1;
  [[maybe_unused]] static constexpr int kRecord = kTensorRecord + (kAbsolute ? kNumAbsoluteSums : 0);  // if kTensor

  __device__ __forceinline__ bool is_absolute() const {
    return kFeatures != kAnyFeatures ? kAbsolute : arguments.absolute;
  }
  __device__ __forceinline__ int num_features() const {
    return kFeatures != kAnyFeatures ? kFeatures : arguments.num_features;
  }

  __device__ __forceinline__ void begin_batch(int32_t) {}

  __device__ __forceinline__ void visit(const StagedGaussian<S, true>& staged, const int32_t& number) {
    const auto gaussian = staged;
    const S dx = S(tile.x) - gaussian.mean.x, dy = S(tile.y) - gaussian.mean.y;
    const auto exponent = gaussian.gate.column(dx);
    Gate<S> gate[kLanePixels];
    bool contributes[kLanePixels], any = false;
#pragma unroll
    for (int k = 0; k < kLanePixels; ++k) {
      gate[k] = evaluate_pair<kPairs>(gaussian.gate, exponent.at(below(dy, k)), pixels.wide[k]);
      contributes[k] = gate[k].counts && gaussian.seen <= pixels.last[k];
      any |= Blend<kMode>::kStopsEarly ? contributes[k] : gate[k].counts;
    }
    // By tensor cores every Gaussian has its row, also the few that touch no pixel.
    if (!kTensor && !__any_sync(kAllLanes, any)) return;

    const auto feature = [&](int f) {
      if constexpr (kFeatures != kAnyFeatures) {
        return gaussian.features[f];
      } else {
        return arguments.saved.features[int64_t(number) * feature_stride(num_features()) + f];
      }
    };
    S weight[kLanePixels], dL_dpower[kLanePixels];
#pragma unroll
    for (int k = 0; k < kLanePixels; ++k) {
      S value = pixels.value_begin[k];
      for (int f = 0; f < num_features(); ++f) {
        value = fma(pixels.scaled.get(arguments, tile, k, f), feature(f), value);
      }
      const auto pair = Blend<kMode>::backward(pixels.state[k], gate[k], value, contributes[k]);
      weight[k] = pair.weight;
      dL_dpower[k] = pair.power;
    }
    if (is_absolute() && (!kTensor || __any_sync(kAllLanes, any))) {
      add_absolute(dL_dpower, gaussian.gate.factors, dx, dy, number);
    }
    if constexpr (kTensor) {
      row->values[tile.lane] = make_float4(dL_dpower[0], weight[0], dL_dpower[1], weight[1]);
      ++row;
    } else {
      add_by_shuffles(dL_dpower, weight, dx, dy, number);
    }
  }

  __device__ __forceinline__ void end_visits(const StagedGaussian<S, true>* gaussians, const int32_t* numbers,
                                             int count) {
    if constexpr (kTensor) {
      add_batch<kRecord>(sink, tile, tensors.stage, tensors.moment_basis, gaussians, numbers, count);
      row = tensors.stage.rows;
    }
  }

  // factors: times log2(e).
  __device__ __forceinline__ void add_absolute(const S (&dL_dpower)[kLanePixels], const ExponentFactors<S>& factors,
                                               S dx, S dy, int32_t index) {
    S sums[kNumAbsoluteSums] = {};
#pragma unroll
    for (int k = 0; k < kLanePixels; ++k) {
      const auto by_mean = power_by_mean(factors, dx, below(dy, k));
      sums[0] += abs(dL_dpower[k] * by_mean.x) * S(kLn2);
      sums[1] += abs(dL_dpower[k] * by_mean.y) * S(kLn2);
    }
    add_values(sink, tile, sums, index, kNumGateMoments + num_features(), kNumAbsoluteSums);
  }

  __device__ __forceinline__ void add_by_shuffles(const S (&dL_dpower)[kLanePixels], const S (&weight)[kLanePixels],
                                                  S dx, S dy, int32_t index) {
    constexpr int kTogether = kNumGateMoments + (kFeatures != kAnyFeatures ? kFeatures : 0);
    S values[kTogether];
    column_moments(dL_dpower, dx, dy, values);
    if constexpr (kFeatures != kAnyFeatures) {
      for (int f = 0; f < kFeatures; ++f) {
        S share = S(0);
        for (int k = 0; k < kLanePixels; ++k) share = fma(weight[k], pixels.scaled.values[k][f], share);
        values[kNumGateMoments + f] = share;
      }
    }
    add_values(sink, tile, values, index, 0, kTogether);
    if constexpr (kFeatures == kAnyFeatures) {
      for (int first = 0; first < num_features(); first += kFeatureChunk) {
        S shares[kFeatureChunk];
        for (int f = 0; f < kFeatureChunk; ++f) {
          shares[f] = S(0);
          if (first + f >= num_features()) continue;
          for (int k = 0; k < kLanePixels; ++k) {
            shares[f] = fma(weight[k], pixels.scaled.get(arguments, tile, k, first + f), shares[f]);
          }
        }
        add_values(sink, tile, shares, index, kNumGateMoments + first, num_features() - first);
      }
    }
  }

  const BackwardArguments<S>& arguments;
  const Sink& sink;
  const WarpTile<S>& tile;
  BackwardPixels<S, kFeatures>& pixels;
  TensorShare tensors;
  TensorRow* row;  // of the tensor stage, for the next Gaussian
};

// Sets what a warp's pixels start with, before any pair. If the background's gradients are wanted, it also writes
// the warp's row of them; the warp of the list's first segment does that.
template <BlendMode kMode, class S, int kFeatures>
__device__ __forceinline__ void begin_pixels(const BackwardArguments<S>& arguments, const WarpTile<S>& tile,
                                             const WarpSegment& place, BackwardPixels<S, kFeatures>& pixels) {
  const RasterConfig<S>& config = arguments.config;
  const int num_features = kFeatures != kAnyFeatures ? kFeatures : arguments.num_features;
  const int64_t size = int64_t(arguments.width) * arguments.height;
  PixelEnd<S> end[kLanePixels];
  S dL_dlambda = S(0);
  for (int k = 0; k < kLanePixels; ++k) {
    const bool inside = tile.inside(arguments, k);
    const int64_t index = inside ? tile.pixel_index(arguments, k) : 0;
    end[k] = {S(1), S(0), config.blend.lambda(), S(0)};
    pixels.wide[k] = false;
    if (inside) {
      const S kept = arguments.saved.final_transmittance[index];
      end[k].transmittance = abs(kept);
      pixels.wide[k] = is_wide(kept);
      end[k].gate_sum = arguments.saved.gate_sum[index];
      if constexpr (Blend<kMode>::kTails) end[k].tails = arguments.saved.tails[index];
    }
    const S* dL_dalpha = arguments.dL_dimages.gate_sum;
    const auto begin = begin_backward<kMode>(end[k], inside && dL_dalpha != nullptr ? dL_dalpha[index] : S(0));
    pixels.state[k] = begin.pixel;
    if constexpr (Blend<kMode>::kTails) dL_dlambda += begin.lambda;
    pixels.last[k] = inside ? arguments.saved.last_contributor[index] : 0;
  }
  S* dL_dbackground = nullptr;  // the warp's row
  if (arguments.dL_dbackground_rows != nullptr && place.segment == 0) {
    dL_dbackground = arguments.dL_dbackground_rows +
                     (int64_t(place.tile) * kWarpsPerTile + place.quarter) * (config.num_channels + 1);
  }
  for (int f = 0; f < num_features; ++f) {
    const S* gradient = feature_image(config, arguments.dL_dimages, f, size);
    S share = S(0);
    for (int k = 0; k < kLanePixels; ++k) {
      S value = S(0), dL_dvalue = S(0);
      if (gradient != nullptr && tile.inside(arguments, k)) {
        const int64_t index = tile.pixel_index(arguments, k);
        value = feature_image(config, arguments.images, f, size)[index], dL_dvalue = gradient[index];
      }
      const auto feature = add_feature<kMode>(feature_rule(config, f), pixels.state[k], end[k], dL_dvalue, value,
                                              feature_background(config, f));
      pixels.scaled.set(arguments, tile, k, f, feature.scaled);
      share += feature.background, dL_dlambda += feature.lambda;
    }
    if (dL_dbackground == nullptr || f >= config.num_channels) continue;
    share = sum_lanes(share);
    if (tile.lane == 0) dL_dbackground[f] = share;
  }
  if (dL_dbackground != nullptr) {
    const S share = sum_lanes(dL_dlambda);
    if (tile.lane == 0) dL_dbackground[config.num_channels] = share;
  }
}

// Returns the part of the list that a warp walks: up to the last pair that some pixel has taken, and in a list with
// segments only its own one. The part may be empty. If another segment lies behind, the pixels get its state.
template <BlendMode kMode, class S, int kFeatures>
__device__ __forceinline__ WalkRange range_of_segment(const BackwardArguments<S>& arguments, const WarpTile<S>& tile,
                                                      int segment, BackwardPixels<S, kFeatures>& pixels) {
  WalkRange range = {0, tile.source.length};
  if (Blend<kMode>::kStopsEarly) {
    int32_t seen = 0;
    for (int k = 0; k < kLanePixels; ++k) seen = seen > pixels.last[k] ? seen : pixels.last[k];
    range.end = max_over_lanes(seen);
  }
  if (kWalksSegments<S, kMode, kFeatures> && has_segments(arguments.saved, tile)) {
    range.begin = segment * kSegmentLength;
    if (range.begin >= range.end) return range;
    const int segments = (range.end + kSegmentLength - 1) / kSegmentLength;
    if (segment + 1 < segments) {
      for (int k = 0; k < kLanePixels; ++k) {
        if (!tile.inside(arguments, k)) continue;
        const SegmentPixel<S> next_begin = segment_pixel(arguments.saved, tile, segment + 1, k);
        S behind = S(0);
        for (int f = 0; f < kFastFeatures; ++f) {
          behind = fma(pixels.scaled.get(arguments, tile, k, f), next_begin.sums[f], behind);
        }
        if constexpr (kResumes<kMode>) resume_backward<kMode>(pixels.state[k], next_begin.transmittance, behind);
      }
      range.end = range.begin + kSegmentLength;
    }
  }
  return range;
}

template <class S, BlendMode kMode, int kFeatures, bool kAbsolute, class Sink>
__global__ void __launch_bounds__(kWalkBlock, sizeof(S) == 4 && kFeatures != kAnyFeatures && !kAbsolute
                                                  ? kBackwardBlocks
                                                  : kGeneralWalkBlocks)
    blend_backward_kernel(const __grid_constant__ BackwardWithSink<S, Sink> arguments) {
  using Visitor = BackwardVisitor<S, kMode, kFeatures, kAbsolute, Sink, Pairs::kNarrow>;
  __shared__ WarpStage<S, Visitor> stages[kWarpsPerTile];
  __shared__ TensorStage tensor_stages[Visitor::kTensor ? kWarpsPerTile : 1];
  __shared__ TensorBasis moment_basis;
  if (is_idle_block(arguments.saved, arguments.tiles)) return;
  if constexpr (Visitor::kTensor) {
    fill_moment_basis(moment_basis);
    __syncthreads();
  }
  const WarpSegment place = segment_of_warp(arguments.saved);
  if (place.tile < 0) return;
  const WarpTile<S> tile(arguments, place.tile, place.quarter);
  const int warp = threadIdx.x / kWarp;

  BackwardPixels<S, kFeatures> pixels;
  begin_pixels<kMode, S>(arguments, tile, place, pixels);
  if (tile.empty) return;
  const WalkRange range = range_of_segment<kMode, S>(arguments, tile, place.segment, pixels);
  if (range.begin >= range.end) return;
  // If u is g'.c - b, the sum g'.c begins with -b, and b is 0 from here on. That saves a subtraction a pair.
  for (int k = 0; k < kLanePixels; ++k) {
    pixels.value_begin[k] = Blend<kMode>::kSuffixAboutBase ? -pixels.state[k].base : S(0);
    if (Blend<kMode>::kSuffixAboutBase) pixels.state[k].base = S(0);
  }

  TensorStage& tensor_stage = tensor_stages[Visitor::kTensor ? warp : 0];
  if constexpr (Visitor::kTensor) fill_gradient_basis(tensor_stage, pixels.scaled.values, tile.lane);
  bool wide = false;
  for (int k = 0; k < kLanePixels; ++k) wide |= pixels.wide[k];
  walk_pairs<kMode>(wide, [&](auto pairs) {
    BackwardVisitor<S, kMode, kFeatures, kAbsolute, Sink, decltype(pairs)::value> visitor = {
        arguments, arguments.sink, tile, pixels, {tensor_stage, moment_basis}, tensor_stage.rows};
    count_pairs(arguments, tile.lane, walk_tile<S>(stages[warp], range, visitor));
  });
}

template <class S, int kFeatures, bool kAbsolute = false, class Sink>
void launch_backward(const BackwardWithSink<S, Sink>& arguments, int64_t blocks, cudaStream_t stream) {
  dispatch_blend(arguments.config.blend.mode, kFeatures, [&](auto mode, auto) {
    blend_backward_kernel<S, decltype(mode)::value, kFeatures, kAbsolute>
        <<<static_cast<unsigned>(blocks), kWalkBlock, 0, stream>>>(arguments);
    DSMOE_CHECK_LAUNCH("blend_backward");
  });
}

// Walks with all terms going to `sink`.
template <class S, class Sink>
void walk_backward(const BackwardArguments<S>& arguments, const Sink& sink, cudaStream_t stream) {
  BackwardWithSink<S, Sink> with_sink = {};
  static_cast<BackwardArguments<S>&>(with_sink) = arguments;
  with_sink.sink = sink;
  if constexpr (sizeof(S) == sizeof(float)) {  // double is for checking: it has only the general kernel
    const SavedForward<S>& saved = arguments.saved;
    const int64_t segment_blocks = saved.segments != nullptr ? num_segment_rows(saved.capacity) : 0;
    if (arguments.scaled == nullptr && arguments.absolute) {
      return launch_backward<S, kFastFeatures, true>(with_sink, arguments.tiles + segment_blocks, stream);
    }
    if (arguments.scaled == nullptr) {
      return launch_backward<S, kFastFeatures>(with_sink, arguments.tiles + segment_blocks, stream);
    }
  }
  launch_backward<S, kAnyFeatures>(with_sink, arguments.tiles, stream);
}

template <class S> struct SplitRecords {
  int64_t num_gaussians;   // N
  int length;              // numbers a record without its absolute sums
  int width, height;       // of the image, pixels
  const int32_t* radii;    // [N] pixels
  bool seen_only;          // rows of means2D_abs where the radius is 0 stay as they are
  const S* with_absolute;  // [N, length + kNumAbsoluteSums]
  S* records;              // [N, length] written
  S* means2D_abs;          // [N, kNumAbsoluteSums] written
};

template <class S> __global__ void split_records_kernel(const __grid_constant__ SplitRecords<S> arguments) {
  const int length = arguments.length, both = length + kNumAbsoluteSums;
  const int64_t at = int64_t(blockIdx.x) * kStoreBlock + threadIdx.x, i = at / both;
  const int number = static_cast<int>(at - i * both);
  if (i >= arguments.num_gaussians) return;
  if (number < length) arguments.records[i * length + number] = arguments.with_absolute[at];
  if (number != length || (arguments.seen_only && arguments.radii[i] <= 0)) return;
  store_absolute(arguments.with_absolute + at, arguments, arguments.means2D_abs, i);
}

// Records with absolute sums, zero.
template <class S> S* absolute_records(int64_t size, const Work& work) {
  S* records = allocate<S>(*work.scratch, size);
  if (size > 0) check(cudaMemsetAsync(records, 0, size * sizeof(S), work.stream), "clearing gradients");
  return records;
}

}  // namespace

template <class S> void blend_backward(const Frame<S>& frame, const BackwardPass<S>& pass, const Work& work) {
  const DeviceCamera<S>& camera = frame.camera;
  const RasterConfig<S>& config = frame.config;
  S* dL_dbackground = pass.gradients.inputs.background;
  Scratch& scratch = *work.scratch;
  const cudaStream_t stream = work.stream;
  const int64_t warps = num_tiles(camera.width, camera.height) * kWarpsPerTile;
  const int num_features = config.num_features();
  S* means2D_abs = pass.gradients.inputs.means2D_abs;
  const bool absolute = means2D_abs != nullptr;
  const int length = kNumGateMoments + num_features + (absolute ? kNumAbsoluteSums : 0);
  const int64_t size = frame.inputs.num_gaussians * length;
  S* records = absolute ? absolute_records<S>(size, work) : pass.dL_dgaussians;
  S *rows = nullptr, *scaled = nullptr;
  if (dL_dbackground != nullptr) rows = allocate<S>(scratch, warps * (config.num_channels + 1));
  if (sizeof(S) == sizeof(double) || num_features != kFastFeatures) {
    scaled = allocate<S>(scratch, int64_t(camera.width) * camera.height * num_features);
  }
  const auto walk = [&](const auto& sink) {
    S* band_rows = rows;
    for_each_band(frame, work, [&](const Frame<S>& band) {
      BackwardArguments<S> arguments = {};
      static_cast<BlendArguments<S>&>(arguments) = blend_arguments(band, work);
      if (pass.deterministic) arguments.saved.segments = nullptr;
      arguments.dL_dimages = pass.gradients.images;
      arguments.dL_dbackground_rows = band_rows;
      arguments.scaled = scaled;
      arguments.num_features = num_features;
      arguments.tiles = static_cast<int>(num_band_tiles(band));
      arguments.absolute = absolute;
      walk_backward(arguments, sink, stream);
      if (rows != nullptr) band_rows += num_band_tiles(band) * kWarpsPerTile * (config.num_channels + 1);
    });
  };
  if (pass.deterministic) {
    const auto sums = begin_integer_sums(frame, pass.gradients, work);
    walk(IntegerSink<S>{sums, length});
    store_integer_sums(frame, sums, records, work);
  } else {
    walk(RecordSink<S>{records, length});
  }
  if (absolute && size > 0) {
    split_records_kernel<S><<<blocks_for(size, kStoreBlock), kStoreBlock, 0, stream>>>(
        {frame.inputs.num_gaussians, length - kNumAbsoluteSums, camera.width, camera.height, frame.images.radii,
         pass.gradients.inputs.seen_only, records, pass.dL_dgaussians, means2D_abs});
    DSMOE_CHECK_LAUNCH("split_records");
  }
  if (rows != nullptr) sum_columns(rows, warps, config.num_channels + 1, dL_dbackground, stream);
}

#define DSMOE_INSTANTIATE(S) template void blend_backward(const Frame<S>&, const BackwardPass<S>&, const Work&);
DSMOE_INSTANTIATE(float)
DSMOE_INSTANTIATE(double)
#undef DSMOE_INSTANTIATE

}  // namespace cuda
}  // namespace dsmoe

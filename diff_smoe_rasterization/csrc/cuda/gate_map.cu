// Which Gaussian has the greatest gate in each pixel. The kernel repeats the blend's walk, without features; each lane
// keeps the greatest weight of its own pixels.
#include "../dispatch.h"
#include "../refuse.h"
#include "bands.h"
#include "dsmoe/params.h"
#include "reduce.cuh"
#include "tile_walk.cuh"

namespace dsmoe {
namespace cuda {
namespace {

// What the walk knows of a lane's pixels.
template <class S> struct MappedPixels {
  PixelState<S> state[kLanePixels];
  S greatest_weight[kLanePixels];
  int32_t greatest[kLanePixels];  // the Gaussian of that weight
  int32_t count[kLanePixels];     // pairs that contributed
  bool wide[kLanePixels];         // the pixel is
};

// All gates of a pixel have one denominator, so the greatest weight is the greatest gate.
template <class S, BlendMode kMode, Pairs kWanted> struct GateMapVisitor {
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
#pragma unroll
    for (int k = 0; k < kLanePixels; ++k) {
      const auto gate = evaluate_pair<kPairs>(gaussian.gate, exponent.at(below(dy, k)), pixels.wide[k]);
      const auto pair = Blend<kMode>::accumulate(pixels.state[k], gate);
      pixels.count[k] += pair.contributes;
      if (!pair.contributes || !(pair.weight > pixels.greatest_weight[k])) continue;
      pixels.greatest_weight[k] = pair.weight;
      pixels.greatest[k] = number;
    }
  }

  const BlendArguments<S>& arguments;
  const WarpTile<S>& tile;
  MappedPixels<S>& pixels;
};

template <class S, BlendMode kMode>
__global__ void __launch_bounds__(kWalkBlock)
    gate_map_kernel(const __grid_constant__ BlendArguments<S> arguments, GateMap map) {
  __shared__ Stage<S, false> stages[kWarpsPerTile];
  const WarpTile<S> tile(arguments);
  if (tile.empty) return;

  MappedPixels<S> pixels;
  int32_t seen = 0;  // entries of the list that the numerator of some pixel has seen
  bool wide = false;
  for (int k = 0; k < kLanePixels; ++k) {
    const bool inside = tile.inside(arguments, k);
    pixels.state[k] = PixelState<S>::open();
    pixels.greatest_weight[k] = S(0);
    pixels.greatest[k] = -1;
    pixels.count[k] = 0;
    const int64_t index = inside ? tile.pixel_index(arguments, k) : 0;
    const int32_t last = inside ? arguments.saved.last_contributor[index] : 0;
    seen = seen > last ? seen : last;
    pixels.wide[k] = inside && is_wide(arguments.saved.final_transmittance[index]);
    wide |= pixels.wide[k];
  }
  const WalkRange range = {0, max_over_lanes(seen)};
  walk_pairs<kMode>(wide, [&](auto pairs) {
    GateMapVisitor<S, kMode, decltype(pairs)::value> visitor = {arguments, tile, pixels};
    walk_tile<S>(stages[threadIdx.x / kWarp], range, visitor);
  });
  for (int k = 0; k < kLanePixels; ++k) {
    if (!tile.inside(arguments, k)) continue;
    const int64_t index = tile.pixel_index(arguments, k);
    map.gaussians[index] = pixels.greatest[k];
    map.counts[index] = pixels.count[k];
  }
}

}  // namespace

template <class S> void gate_map(const Frame<S>& frame, const GateMap& map, const Work& work) {
  refuse_gate_map("cuda::gate_map", frame, map);
  for_each_band(frame, work, [&](const Frame<S>& band) {
    const unsigned tiles = static_cast<unsigned>(num_band_tiles(band));
    dispatch_blend(frame.config.mode, kAnyFeatures, [&](auto mode, auto) {
      gate_map_kernel<S, decltype(mode)::value>
          <<<tiles, kWalkBlock, 0, work.stream>>>(blend_arguments(band, work), map);
      DSMOE_CHECK_LAUNCH("gate_map");
    });
  });
}

#define DSMOE_INSTANTIATE(S) template void gate_map(const Frame<S>&, const GateMap&, const Work&);
DSMOE_INSTANTIATE(float)
DSMOE_INSTANTIATE(double)
#undef DSMOE_INSTANTIATE

}  // namespace cuda
}  // namespace dsmoe

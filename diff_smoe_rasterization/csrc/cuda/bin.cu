// Stage 2, the tile lists: how much room they need. macro_lists.cu makes the lists.
#include "../dispatch.h"
#include "bands.h"
#include "device.cuh"
#include "dsmoe/blend.h"
#include "dsmoe/params.h"
#include "macro_lists.h"
#include "reduce.cuh"
#include "tile_rows.cuh"
#include "tuning.cuh"

namespace dsmoe {
namespace cuda {
namespace {

template <class S> struct CountArguments {
  int gaussians_per_warp;  // 1 to 32
  BlendMode mode;          // decides the bounds of footprints
  TileGrid grid;           // of the image
  SavedForward<S> saved;   // projected, order and num_ordered are read; num_instances is added to
  const int32_t* radii;    // [N] pixels
  S tail_reach;            // of BlendRules
};

// The rows of tiles that the warp's Gaussians meet. position: of the lane's Gaussian in the depth order.
template <class S>
__device__ WarpTileRows<S> rows_at(const CountArguments<S>& count, int64_t position,
                                   typename WarpTileRows<S>::Shared* shared, int lane) {
  const bool exists = lane < count.gaussians_per_warp && position < *count.saved.num_ordered;
  const int32_t gaussian = exists ? count.saved.order[position] : -1;
  FootprintTiles<S> tiles;
  if (gaussian >= 0) {
    const ProjectedGaussian<S> projected = count.saved.projected[gaussian];
    TileRect bounds =
        tile_bounds(count.mode, count.grid, projected.mean, bounding_radius<S>(count.mode, count.radii, gaussian));
    bounds.y0 = max(bounds.y0, count.saved.band.begin), bounds.y1 = min(bounds.y1, count.saved.band.end);
    tiles = {projected.conic, projected.mean, projected.squared_reach + count.tail_reach, bounds};
  }
  return {tiles, shared, lane};
}

template <class S>
__global__ void __launch_bounds__(kListBlock)
    count_instances_kernel(const __grid_constant__ CountArguments<S> arguments) {
  __shared__ typename WarpTileRows<S>::Shared tiles[kListBlock];
  const int warp = threadIdx.x / kWarp, lane = threadIdx.x % kWarp;
  const auto rows = rows_at(arguments, (int64_t(blockIdx.x) * kListWarps + warp) * arguments.gaussians_per_warp + lane,
                            tiles + warp * kWarp, lane);
  unsigned long long count = 0;
#pragma unroll 1
  for (unsigned first = 0; first < rows.total(); first += kWarp) count += rows.width(first + lane);
  count = sum_lanes(count);
  auto* sum = reinterpret_cast<unsigned long long*>(arguments.saved.num_instances);
  if (lane == 0 && count > 0) atomicAdd(sum, count);
}

// Makes the count of instances the room that they and the entries of macro tiles need.
__global__ void take_larger_kernel(int64_t* num_instances, const int64_t* num_entries) {
  *num_instances = max(*num_instances, *num_entries);
}

__global__ void write_number_kernel(const int64_t* number, int64_t* to) { *to = *number; }

}  // namespace

void write_number(const int64_t* number, int64_t* to, cudaStream_t stream) {
  write_number_kernel<<<1, 1, 0, stream>>>(number, to);
  DSMOE_CHECK_LAUNCH("write_number");
}

bool needs_depth_order(BlendMode mode) {
  bool needed = false;
  dispatch_blend(mode, kAnyFeatures,
                 [&](auto mode_constant, auto) { needed = Blend<decltype(mode_constant)::value>::kNeedsDepthOrder; });
  return needed;
}

template <class S> void count_instances(const Frame<S>& frame, const Work& work) {
  const int64_t num_gaussians = frame.inputs.num_gaussians;
  CountArguments<S> arguments = {};
  arguments.gaussians_per_warp = rows_per_warp(num_gaussians, 1);
  arguments.mode = frame.config.blend.mode;
  arguments.grid = TileGrid(frame.camera.width, frame.camera.height);
  arguments.saved = frame.saved;
  arguments.radii = frame.images.radii;
  arguments.tail_reach = frame.config.blend.tail_reach();
  int64_t* num_entries = allocate<int64_t>(*work.scratch, 1);
  const auto clear = [&](int64_t* count) {
    check(cudaMemsetAsync(count, 0, sizeof(*count), work.stream), "counting instances");
  };
  clear(frame.saved.num_instances), clear(num_entries);
  const unsigned blocks = blocks_for(num_gaussians, kListWarps * arguments.gaussians_per_warp);
  if (blocks == 0) return;
  count_instances_kernel<<<blocks, kListBlock, 0, work.stream>>>(arguments);
  DSMOE_CHECK_LAUNCH("count_instances");
  count_macro_entries(frame, num_entries, work);
  take_larger_kernel<<<1, 1, 0, work.stream>>>(frame.saved.num_instances, num_entries);
  DSMOE_CHECK_LAUNCH("take_larger");
}

template <class S> void bin(const Frame<S>& frame, const Work& work) { bin_by_macro_tiles(frame, work); }

#define DSMOE_INSTANTIATE(S)                                   \
  template void count_instances(const Frame<S>&, const Work&); \
  template void bin(const Frame<S>&, const Work&);
DSMOE_INSTANTIATE(float)
DSMOE_INSTANTIATE(double)
#undef DSMOE_INSTANTIATE

}  // namespace cuda
}  // namespace dsmoe

// Stage 2: the depth order, and the tile lists front to back. First the Gaussians are sorted by depth. Then a stable
// sort by tile sorts their instances. So the keys of the second sort are short. (Faster-GS, arXiv:2602.09999, does the
// same.)
#include <cub/device/device_radix_sort.cuh>
#include <limits>

#include "../dispatch.h"
#include "bands.h"
#include "device.cuh"
#include "dsmoe/blend.h"
#include "dsmoe/params.h"
#include "look_back.cuh"
#include "reduce.cuh"
#include "tile_rows.cuh"
#include "tuning.cuh"

namespace dsmoe {
namespace cuda {
namespace {

// Runs a CUB algorithm in two calls: the first says how much memory it needs, the second does the work.
template <class Algorithm> void with_temporary(Scratch& scratch, const char* what, Algorithm algorithm) {
  size_t bytes = 0;
  check(algorithm(nullptr, bytes), what);
  check(algorithm(allocate<char>(scratch, bytes), bytes), what);
}

template <class S, class Key> struct ListArguments {
  int64_t num_gaussians;   // N
  int gaussians_per_warp;  // 1 to 32
  BlendMode mode;          // decides the bounds of footprints
  TileGrid grid;           // of the image
  SavedForward<S> saved;   // projected and order are read; num_instances is written
  const int32_t* radii;    // [N] pixels
  LookBack look_back;      // zero before
  // These are null where the instances are only counted:
  Key* keys;        // [capacity] tile
  int32_t* values;  // [capacity] Gaussian; sorted with the keys
};

// The rows of tiles that the warp's Gaussians meet. position: of the lane's Gaussian in the depth order.
template <class S, class Key>
__device__ WarpTileRows<S> rows_at(const ListArguments<S, Key>& list, int64_t position,
                                   typename WarpTileRows<S>::Shared* shared, int lane) {
  const bool exists = lane < list.gaussians_per_warp && position < list.num_gaussians;
  const int32_t gaussian = exists ? list.saved.order[position] : -1;
  FootprintTiles<S> tiles;
  if (gaussian >= 0) {
    const ProjectedGaussian<S> projected = list.saved.projected[gaussian];
    TileRect bounds =
        tile_bounds(list.mode, list.grid, projected.mean, bounding_radius<S>(list.mode, list.radii, gaussian));
    bounds.y0 = max(bounds.y0, list.saved.band.begin), bounds.y1 = min(bounds.y1, list.saved.band.end);
    tiles = {projected.conic, projected.mean, projected.squared_reach, bounds};
  }
  return {gaussian, tiles, list.grid.columns, list.saved.band.begin, shared, lane};
}

// Lists the tiles of one row a lane, from `place` on and not beyond `end`. Neighbouring lanes write side by side.
template <class S, class Key>
__device__ void list_rows(const ListArguments<S, Key>& list, const TileRow& row, int64_t& place, int64_t end,
                          int lane) {
  const WarpLine instances(row.width, lane);
  const unsigned fit = static_cast<unsigned>(max<int64_t>(0, min<int64_t>(end - place, instances.total)));
  Key* keys = list.keys + place;
  int32_t* values = list.values + place;
  for (unsigned k = lane; k - lane < fit; k += kWarp) {
    const int owner = instances.owner(k);
    const uint32_t tile = from_lane(row.tile - instances.begin, owner) + k;
    const int32_t gaussian = from_lane(row.gaussian, owner);
    if (k >= fit) continue;
    keys[k] = static_cast<Key>(tile);
    values[k] = gaussian;
  }
  place += instances.total;
}

template <class S, class Key>
__global__ void __launch_bounds__(kListBlock)
    list_instances_kernel(const __grid_constant__ ListArguments<S, Key> list) {
  __shared__ typename WarpTileRows<S>::Shared tiles[kListBlock];
  __shared__ TileRow kept_rows[kKeptRows / kWarp][kListBlock];
  __shared__ unsigned shared_block;
  __shared__ unsigned long long counts[kListWarps], shared_before;
  if (threadIdx.x == 0) shared_block = take_block_number(list.look_back);
  __syncthreads();
  const unsigned block = shared_block;
  const int warp = threadIdx.x / kWarp, lane = threadIdx.x % kWarp;
  const auto rows =
      rows_at(list, (int64_t(block) * kListWarps + warp) * list.gaussians_per_warp + lane, tiles + warp * kWarp, lane);

  // The loop runs twice over the rows: it counts their tiles, then lists them. It is one loop, so that both times it
  // finds the same rows.
  int64_t place = 0, end = 0;
#pragma unroll 1
  for (bool listing = false;; listing = true) {
    unsigned long long count = 0;
#pragma unroll 1
    for (unsigned first = 0; first < rows.total(); first += kWarp) {
      const bool keep = first < kKeptRows;
      TileRow& kept = kept_rows[keep ? first / kWarp : 0][threadIdx.x];
      const TileRow row = listing && keep ? kept : rows.at(first + lane);
      if (listing) {
        list_rows(list, row, place, end, lane);
      } else {
        if (keep) kept = row;
        count += row.width;
      }
    }
    if (listing) return;

    count = sum_lanes(count);
    if (lane == 0) counts[warp] = count;
    __syncthreads();
    unsigned long long before = 0, total = 0;
    for (int w = 0; w < kListWarps; ++w) {
      if (w == warp) before = total;
      total += counts[w];
    }
    if (warp == 0) {
      const unsigned long long before_block = sum_before(list.look_back, block, total);
      if (lane == 0) {
        shared_before = before_block;
        if (block == gridDim.x - 1) *list.saved.num_instances = static_cast<int64_t>(before_block + total);
      }
    }
    __syncthreads();
    if (list.keys == nullptr) return;
    place = static_cast<int64_t>(shared_before + before);
    end = min(place + static_cast<int64_t>(count), list.saved.capacity);
  }
}

template <class Key> struct OffsetArguments {
  int64_t tiles;           // of the band
  int64_t capacity;        // keys
  const Key* keys;         // [capacity] sorted
  int64_t* offsets;        // [tiles + 1] written
  int32_t* segment_queue;  // its counter is set to 0; or null
};

// Finds the first instance of each tile, and empties the queue of segments for the blend. A warp searches for one tile:
// it cuts the remaining sorted keys into 32 parts, and continues in the first part whose last key is not below the
// tile.
template <class Key> __global__ void tile_offsets_kernel(const __grid_constant__ OffsetArguments<Key> arguments) {
  if (arguments.segment_queue != nullptr && blockIdx.x == 0 && threadIdx.x == 0) arguments.segment_queue[0] = 0;
  const int64_t tile = (int64_t(blockIdx.x) * kListBlock + threadIdx.x) / kWarp;
  const int lane = threadIdx.x % kWarp;
  if (tile > arguments.tiles) return;
  int64_t low = 0, high = arguments.capacity;
  while (low < high) {
    const int64_t part = (high - low + kWarp - 1) / kWarp, last = min(low + (lane + 1) * part, high) - 1;
    const bool before = static_cast<int64_t>(arguments.keys[last]) < tile;
    const int parts_before = __popc(__ballot_sync(kAllLanes, before));
    low = min(low + parts_before * part, high);
    high = min(low + part - 1, high);
  }
  if (lane == 0) arguments.offsets[tile] = low;
}

// How many warps are enough to keep the current device busy.
int64_t enough_warps() {
  int device = 0, multiprocessors = 0;
  check(cudaGetDevice(&device), "asking for the device");
  check(cudaDeviceGetAttribute(&multiprocessors, cudaDevAttrMultiProcessorCount, device), "asking for its size");
  return int64_t(kEnoughWarpsPerMultiprocessor) * multiprocessors;
}

// Lists the instances into the memory that `list` has, or only counts them.
template <class Key, class S> void list_instances(ListArguments<S, Key> list, Scratch& scratch, cudaStream_t stream) {
  const int64_t enough = enough_warps();
  list.gaussians_per_warp = kWarp;
  while (list.gaussians_per_warp > 1 && list.num_gaussians < enough * list.gaussians_per_warp) {
    list.gaussians_per_warp /= 2;
  }
  const unsigned blocks = blocks_for(list.num_gaussians, kListWarps * list.gaussians_per_warp);
  if (blocks == 0) {
    check(cudaMemsetAsync(list.saved.num_instances, 0, sizeof(int64_t), stream), "counting instances");
    return;
  }
  // The states of the look-back; its counter lies behind them.
  auto* states = allocate<unsigned long long>(scratch, int64_t(blocks) + 1);
  check(cudaMemsetAsync(states, 0, (size_t(blocks) + 1) * sizeof(*states), stream), "listing instances");
  list.look_back = {states, reinterpret_cast<unsigned*>(states + blocks)};
  list_instances_kernel<<<blocks, kListBlock, 0, stream>>>(list);
  DSMOE_CHECK_LAUNCH("list_instances");
}

// Calls launch with a key of the type that holds every tile, and one number above them. Counting and listing must use
// the same kernel, so that both find the same instances; so both choose its key here.
template <class Launch> void dispatch_keys(int64_t tiles, Launch launch) {
  tiles < std::numeric_limits<uint16_t>::max() ? launch(uint16_t()) : launch(uint32_t());
}

template <class Key, class S> ListArguments<S, Key> list_arguments(const Frame<S>& frame) {
  ListArguments<S, Key> list = {};
  list.num_gaussians = frame.inputs.num_gaussians;
  list.mode = frame.config.mode;
  list.grid = TileGrid(frame.camera.width, frame.camera.height);
  list.saved = frame.saved;
  list.radii = frame.images.radii;
  return list;
}

template <class Key, class S> void bin_by(const Frame<S>& frame, Scratch& scratch, cudaStream_t stream) {
  const SavedForward<S>& saved = frame.saved;
  const int64_t tiles = num_band_tiles(frame), capacity = saved.capacity;
  auto list = list_arguments<Key>(frame);
  list.keys = allocate<Key>(scratch, capacity);
  list.values = allocate<int32_t>(scratch, capacity);
  Key* sorted_keys = allocate<Key>(scratch, capacity);
  // Keys behind the last instance are above every tile.
  check(cudaMemsetAsync(list.keys, 0xff, capacity * sizeof(Key), stream), "listing instances");
  list_instances(list, scratch, stream);
  if (capacity > 0) {
    int bits = 1;  // of the greatest tile, and of the key above all tiles
    while (int64_t(1) << bits <= tiles) ++bits;
    with_temporary(scratch, "sorting instances", [&](void* memory, size_t& bytes) {
      return cub::DeviceRadixSort::SortPairs(memory, bytes, list.keys, sorted_keys, list.values, saved.instances,
                                             capacity, 0, bits, stream);
    });
  }
  OffsetArguments<Key> offsets = {};
  offsets.tiles = tiles;
  offsets.capacity = capacity;
  offsets.keys = sorted_keys;
  offsets.offsets = saved.tile_offsets;
  offsets.segment_queue = saved.segment_queue;
  tile_offsets_kernel<<<blocks_for((tiles + 1) * kWarp, kListBlock), kListBlock, 0, stream>>>(offsets);
  DSMOE_CHECK_LAUNCH("tile_offsets");
}

}  // namespace

bool needs_depth_order(BlendMode mode) {
  bool needed = false;
  dispatch_blend(mode, kAnyFeatures,
                 [&](auto mode_constant, auto) { needed = Blend<decltype(mode_constant)::value>::kNeedsDepthOrder; });
  return needed;
}

template <class S> void sort_by_depth(const Frame<S>& frame, const DepthKeys<S>& keys, const Work& work) {
  const int64_t num_gaussians = frame.inputs.num_gaussians;
  if (num_gaussians == 0) return;
  auto* sorted_keys = allocate<DepthBits<S>>(*work.scratch, num_gaussians);
  with_temporary(*work.scratch, "sorting by depth", [&](void* memory, size_t& bytes) {
    return cub::DeviceRadixSort::SortPairs(memory, bytes, keys.depths, sorted_keys, keys.gaussians, frame.saved.order,
                                           num_gaussians, 0, 8 * int(sizeof(S)), work.stream);
  });
}

template <class S> void count_instances(const Frame<S>& frame, const Work& work) {
  dispatch_keys(num_band_tiles(frame),
                [&](auto key) { list_instances(list_arguments<decltype(key)>(frame), *work.scratch, work.stream); });
}

template <class S> void bin(const Frame<S>& frame, const Work& work) {
  dispatch_keys(num_band_tiles(frame), [&](auto key) { bin_by<decltype(key)>(frame, *work.scratch, work.stream); });
}

#define DSMOE_INSTANTIATE(S)                                                      \
  template void sort_by_depth(const Frame<S>&, const DepthKeys<S>&, const Work&); \
  template void count_instances(const Frame<S>&, const Work&);                    \
  template void bin(const Frame<S>&, const Work&);
DSMOE_INSTANTIATE(float)
DSMOE_INSTANTIATE(double)
#undef DSMOE_INSTANTIATE

}  // namespace cuda
}  // namespace dsmoe

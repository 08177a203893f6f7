// Stage 2, the tile lists, front to back. macro_lists.cu has the usual way. Here is the one for instances with slots:
// they are listed in depth order, Gaussian by Gaussian, so that a Gaussian's slots lie side by side. A stable sort by
// tile sorts them. (Faster-GS, arXiv:2602.09999, sorts so.)
#include <cub/device/device_radix_sort.cuh>
#include <limits>

#include "../dispatch.h"
#include "device.cuh"
#include "dsmoe/blend.h"
#include "dsmoe/params.h"
#include "look_back.cuh"
#include "macro_lists.h"
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
  SavedForward<S> saved;   // projected and order are read; num_instances and slot_ranges are written
  const int32_t* radii;    // [N] pixels
  LookBack look_back;      // zero before
  // These are null where the instances are only counted:
  Key* keys;             // [capacity] tile
  int32_t* values;       // [capacity] sorted with the keys: the slot
  int32_t* slot_owners;  // [capacity] Gaussian of each slot
};

// The rows of tiles that the warp's Gaussians meet. position: of the lane's Gaussian in the depth order.
template <class S, class Key>
__device__ WarpTileRows<S> rows_at(const ListArguments<S, Key>& list, int64_t position,
                                   typename WarpTileRows<S>::Shared* shared, int lane) {
  const bool exists = lane < list.gaussians_per_warp && position < *list.saved.num_ordered;
  const int32_t gaussian = exists ? list.saved.order[position] : -1;
  FootprintTiles<S> tiles;
  if (gaussian >= 0) {
    const ProjectedGaussian<S> projected = list.saved.projected[gaussian];
    const TileRect bounds =
        tile_bounds(list.mode, list.grid, projected.mean, bounding_radius<S>(list.mode, list.radii, gaussian));
    tiles = {projected.conic, projected.mean, projected.squared_reach, bounds};
  }
  if (list.saved.slot_ranges != nullptr && gaussian >= 0 && tiles.end() <= tiles.begin()) {
    list.saved.slot_ranges[2 * int64_t(gaussian)] = list.saved.slot_ranges[2 * int64_t(gaussian) + 1] = 0;
  }
  return {gaussian, tiles, list.grid.columns, shared, lane};
}

// Lists the tiles of one row a lane, from `slot` on and not beyond `end`. Neighbouring lanes write neighbouring places.
template <class S, class Key>
__device__ void list_rows(const ListArguments<S, Key>& list, const TileRow& row, int64_t& slot, int64_t end, int lane) {
  const WarpLine instances(row.width, lane);
  if (list.saved.slot_ranges != nullptr) {
    int64_t* range = list.saved.slot_ranges + 2 * int64_t(row.gaussian);
    if (row.ends & kFirstRow) range[0] = slot + instances.begin;
    if (row.ends & kLastRow) range[1] = slot + instances.begin + row.width;
  }
  const unsigned fit = static_cast<unsigned>(max<int64_t>(0, min<int64_t>(end - slot, instances.total)));
  Key* keys = list.keys + slot;
  int32_t* values = list.values + slot;
  for (unsigned k = lane; k - lane < fit; k += kWarp) {
    const int owner = instances.owner(k);
    const uint32_t tile = from_lane(row.tile - instances.begin, owner) + k;
    const int32_t gaussian = from_lane(row.gaussian, owner);
    if (k >= fit) continue;
    keys[k] = static_cast<Key>(tile);
    values[k] = static_cast<int32_t>(slot + k);
    list.slot_owners[slot + k] = gaussian;
  }
  slot += instances.total;
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
  int64_t slot = 0, end = 0;
#pragma unroll 1
  for (bool listing = false;; listing = true) {
    unsigned long long count = 0;
#pragma unroll 1
    for (unsigned first = 0; first < rows.total(); first += kWarp) {
      const bool keep = first < kKeptRows;
      TileRow& kept = kept_rows[keep ? first / kWarp : 0][threadIdx.x];
      const TileRow row = listing && keep ? kept : rows.at(first + lane);
      if (listing) {
        list_rows(list, row, slot, end, lane);
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
    slot = static_cast<int64_t>(shared_before + before);
    end = min(slot + static_cast<int64_t>(count), list.saved.capacity);
  }
}

template <class Key> struct OffsetArguments {
  int64_t tiles;           // of the image
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

struct SlotArguments {
  int64_t capacity;              // instances there is room for
  const int64_t* num_instances;  // [1]
  const int32_t* slots;          // [capacity] by tile, front to back
  const int32_t* owners;         // [capacity] Gaussian of each slot
  int32_t* instances;            // [capacity, 2] written: Gaussian, slot
};

// Where the instances do not fit, nothing is written, because nobody reads the lists then.
__global__ void pair_with_slots_kernel(const __grid_constant__ SlotArguments arguments) {
  const int64_t i = int64_t(blockIdx.x) * kListBlock + threadIdx.x, count = *arguments.num_instances;
  if (i >= count || count > arguments.capacity) return;
  arguments.instances[2 * i] = arguments.owners[static_cast<uint32_t>(arguments.slots[i])];
  arguments.instances[2 * i + 1] = arguments.slots[i];
}

// Lists the instances into the memory that `list` has, or only counts them.
template <class Key, class S> void list_instances(ListArguments<S, Key> list, Scratch& scratch, cudaStream_t stream) {
  const int64_t enough = int64_t(kEnoughWarpsPerMultiprocessor) * num_multiprocessors();  // to keep the device busy
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

template <class Key, class S> void bin_with_slots(const Frame<S>& frame, Scratch& scratch, cudaStream_t stream) {
  const SavedForward<S>& saved = frame.saved;
  const int64_t tiles = num_tiles(frame.camera.width, frame.camera.height), capacity = saved.capacity;
  auto list = list_arguments<Key>(frame);
  list.keys = allocate<Key>(scratch, capacity);
  list.values = allocate<int32_t>(scratch, capacity);
  list.slot_owners = allocate<int32_t>(scratch, capacity);
  Key* sorted_keys = allocate<Key>(scratch, capacity);
  int32_t* sorted_values = allocate<int32_t>(scratch, capacity);
  // Keys behind the last instance are above every tile.
  check(cudaMemsetAsync(list.keys, 0xff, capacity * sizeof(Key), stream), "listing instances");
  list_instances(list, scratch, stream);
  if (capacity > 0) {
    int bits = 1;  // of the greatest tile, and of the key above all tiles
    while (int64_t(1) << bits <= tiles) ++bits;
    with_temporary(scratch, "sorting instances", [&](void* memory, size_t& bytes) {
      return cub::DeviceRadixSort::SortPairs(memory, bytes, list.keys, sorted_keys, list.values, sorted_values,
                                             capacity, 0, bits, stream);
    });
    SlotArguments pairs = {};
    pairs.capacity = capacity;
    pairs.num_instances = saved.num_instances;
    pairs.slots = sorted_values;
    pairs.owners = list.slot_owners;
    pairs.instances = saved.instances;
    pair_with_slots_kernel<<<blocks_for(capacity, kListBlock), kListBlock, 0, stream>>>(pairs);
    DSMOE_CHECK_LAUNCH("pair_with_slots");
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

template <class S> void count_instances(const Frame<S>& frame, const Work& work) {
  Frame<S> counted = frame;
  counted.saved.slot_ranges = nullptr;
  dispatch_keys(num_tiles(frame.camera.width, frame.camera.height),
                [&](auto key) { list_instances(list_arguments<decltype(key)>(counted), *work.scratch, work.stream); });
}

template <class S> void bin(const Frame<S>& frame, const Work& work) {
  if (frame.saved.instance_width == 1) return bin_by_macro_tiles(frame, work);
  dispatch_keys(num_tiles(frame.camera.width, frame.camera.height),
                [&](auto key) { bin_with_slots<decltype(key)>(frame, *work.scratch, work.stream); });
}

#define DSMOE_INSTANTIATE(S)                                   \
  template void count_instances(const Frame<S>&, const Work&); \
  template void bin(const Frame<S>&, const Work&);
DSMOE_INSTANTIATE(float)
DSMOE_INSTANTIATE(double)
#undef DSMOE_INSTANTIATE

}  // namespace cuda
}  // namespace dsmoe

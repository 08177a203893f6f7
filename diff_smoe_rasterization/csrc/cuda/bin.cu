// Stage 2: the depth order, and the tile lists front to back. One sort of the Gaussians by depth, then a stable sort of
// their instances by tile, so that the second sort's keys are short.
#include <cub/block/block_scan.cuh>
#include <cub/device/device_radix_sort.cuh>
#include <limits>

#include "../dispatch.h"
#include "device.cuh"
#include "dsmoe/blend.h"
#include "dsmoe/rasterize.h"
#include "look_back.cuh"
#include "tile_rows.cuh"

namespace dsmoe {
namespace cuda {
namespace {

constexpr int kBlock = 256;
constexpr int kSmallRows = 4;    // a Gaussian with more rows of tiles,
constexpr int kSmallTiles = 16;  // or more tiles, is listed by a warp of its own

// Runs a CUB algorithm: it says how much memory it needs, gets it, and works.
template <class Algorithm> void with_temporary(Scratch& scratch, const char* what, Algorithm algorithm) {
  size_t bytes = 0;
  check(algorithm(nullptr, bytes), what);
  check(algorithm(allocate<char>(scratch, bytes), bytes), what);
}

struct LargeGaussian {
  int64_t begin;  // its first instance
  int32_t gaussian;
  uint32_t count;  // of its instances
};

template <class S, class Key> struct ListArguments {
  int64_t num_gaussians;
  BlendMode mode;
  int width, height, columns;
  SavedForward<S> saved;
  const int32_t* radii;
  LookBack look_back;
  // Null where the instances are only counted:
  Key* keys;             // [capacity] tile
  int32_t* values;       // [capacity] what goes along: the Gaussian, or the slot where gradients go by slot
  int32_t* slot_owners;  // [capacity] Gaussian of each slot, or null
  LargeGaussian* large;  // [max_large] those beyond are listed by one thread each
  unsigned max_large;
  unsigned* num_large;

  __device__ void write(int64_t slot, int32_t gaussian, int x, int y) const {
    keys[slot] = static_cast<Key>(y * columns + x);
    if (slot_owners != nullptr) slot_owners[slot] = gaussian;
    values[slot] = slot_owners != nullptr ? static_cast<int32_t>(slot) : gaussian;
  }
};

template <class S, class Key>
__device__ TileRect bounds_of(const ListArguments<S, Key>& list, const ProjectedGaussian<S>& projected,
                              int32_t gaussian) {
  return footprint_bounds(list.mode, list.width, list.height, projected.mean, list.radii, gaussian);
}

template <class S, class Key>
__device__ FootprintTiles<S> tiles_of_large(const ListArguments<S, Key>& list, int32_t gaussian) {
  const ProjectedGaussian<S> projected = list.saved.projected[gaussian];
  return shared_tiles(projected, bounds_of(list, projected, gaussian));
}

template <class S, class Key>
__device__ void list_alone(const ListArguments<S, Key>& list, int32_t gaussian, int64_t slot) {
  const auto tiles = tiles_of_large(list, gaussian);
  for (int y = tiles.begin(); y < tiles.end(); ++y) {
    const auto span = row_of(tiles, y);
    for (int x = span.x0; x < span.x1; ++x) list.write(slot++, gaussian, x, y);
  }
}

template <class S, class Key>
__global__ void __launch_bounds__(kBlock) list_instances_kernel(const __grid_constant__ ListArguments<S, Key> list) {
  using BlockScan = cub::BlockScan<unsigned long long, kBlock>;
  __shared__ typename BlockScan::TempStorage scan_memory;
  __shared__ unsigned shared_block;
  __shared__ unsigned long long shared_before;
  if (threadIdx.x == 0) shared_block = take_block_number(list.look_back);
  __syncthreads();
  const unsigned block = shared_block;
  const int64_t position = int64_t(block) * kBlock + threadIdx.x;

  int32_t gaussian = 0;
  unsigned long long count = 0;
  int first_row = 0, num_rows = 0;
  bool is_large = false;
  typename FootprintTiles<S>::Span spans[kSmallRows];
  if (position < list.num_gaussians) {
    gaussian = list.saved.order[position];
    if (list.radii[gaussian] > 0) {
      const ProjectedGaussian<S> projected = list.saved.projected[gaussian];
      const FootprintTiles<S> tiles(projected.conic, projected.mean, projected.squared_reach,
                                    bounds_of(list, projected, gaussian));
      first_row = tiles.begin(), num_rows = tiles.end() - tiles.begin();
      if (num_rows <= kSmallRows) {
#pragma unroll
        for (int r = 0; r < kSmallRows; ++r) {
          spans[r] = {0, 0};
          if (r < num_rows) spans[r] = tiles.row(first_row + r);
          count += max(0, spans[r].x1 - spans[r].x0);
        }
      }
      is_large = num_rows > kSmallRows || count > kSmallTiles;
      if (is_large) count = count_tiles(tiles_of_large(list, gaussian));
    }
  }
  unsigned long long begin, total;
  BlockScan(scan_memory).ExclusiveSum(count, begin, total);
  if (threadIdx.x < kWarp) {
    const unsigned long long before = sum_before(list.look_back, block, total);
    if (threadIdx.x == 0) {
      shared_before = before;
      if (block == gridDim.x - 1) *list.saved.num_instances = static_cast<int64_t>(before + total);
    }
  }
  __syncthreads();
  if (list.keys == nullptr || position >= list.num_gaussians) return;
  int64_t slot = static_cast<int64_t>(shared_before + begin);
  const int64_t end = slot + static_cast<int64_t>(count);
  if (list.saved.slot_ranges != nullptr) {
    list.saved.slot_ranges[2 * int64_t(gaussian)] = slot, list.saved.slot_ranges[2 * int64_t(gaussian) + 1] = end;
  }
  if (count == 0 || end > list.saved.capacity) return;
  if (is_large) {
    const unsigned i = atomicAdd(list.num_large, 1u);
    if (i < list.max_large) {
      list.large[i] = {slot, gaussian, static_cast<uint32_t>(count)};
    } else {
      list_alone(list, gaussian, slot);
    }
    return;
  }
#pragma unroll
  for (int r = 0; r < kSmallRows; ++r) {
    if (r >= num_rows) break;
    for (int x = spans[r].x0; x < spans[r].x1; ++x) list.write(slot++, gaussian, x, first_row + r);
  }
}

// One warp lists one large Gaussian at a time: 32 rows are measured together, then written one after another.
template <class S, class Key>
__global__ void __launch_bounds__(kBlock) list_large_kernel(const __grid_constant__ ListArguments<S, Key> list) {
  const int lane = threadIdx.x % kWarp;
  const unsigned warps = gridDim.x * (kBlock / kWarp), count = min(*list.num_large, list.max_large);
  for (unsigned i = (blockIdx.x * kBlock + threadIdx.x) / kWarp; i < count; i += warps) {
    const LargeGaussian large = list.large[i];
    const auto tiles = tiles_of_large(list, large.gaussian);
    int64_t slot = large.begin;
    const int64_t end = slot + large.count;
    for (int y0 = tiles.begin(); y0 < tiles.end(); y0 += kWarp) {
      typename FootprintTiles<S>::Span mine = {0, 0};
      if (y0 + lane < tiles.end()) mine = row_of(tiles, y0 + lane);
      for (int r = 0; r < kWarp && y0 + r < tiles.end(); ++r) {
        const int x0 = __shfl_sync(kAllLanes, mine.x0, r), x1 = __shfl_sync(kAllLanes, mine.x1, r);
        for (int x = x0 + lane; x < x1; x += kWarp) {
          if (slot + x - x0 < end) list.write(slot + x - x0, large.gaussian, x, y0 + r);
        }
        slot += max(0, x1 - x0);
      }
    }
  }
}

// The first instance of each tile, by bisection of the sorted keys.
template <class Key>
__global__ void tile_offsets_kernel(int64_t tiles, int64_t capacity, const Key* keys, int64_t* offsets) {
  const int64_t tile = int64_t(blockIdx.x) * kBlock + threadIdx.x;
  if (tile > tiles) return;
  int64_t low = 0, high = capacity;
  while (low < high) {
    const int64_t middle = (low + high) / 2;
    if (static_cast<int64_t>(keys[middle]) < tile) {
      low = middle + 1;
    } else {
      high = middle;
    }
  }
  offsets[tile] = low;
}

__global__ void pair_with_slots_kernel(int64_t capacity, const int64_t* num_instances, const int32_t* slots,
                                       const int32_t* slot_owners, int32_t* instances) {
  const int64_t i = int64_t(blockIdx.x) * kBlock + threadIdx.x;
  if (i >= *num_instances || *num_instances > capacity) return;
  instances[2 * i] = slot_owners[static_cast<uint32_t>(slots[i])];
  instances[2 * i + 1] = slots[i];
}

// Lists the instances into the memory that `list` has, or only counts them.
template <class Key, class S> void list_instances(ListArguments<S, Key> list, Scratch& scratch, cudaStream_t stream) {
  const unsigned blocks = blocks_for(list.num_gaussians, kBlock);
  if (blocks == 0) {
    check(cudaMemsetAsync(list.saved.num_instances, 0, sizeof(int64_t), stream), "counting instances");
    return;
  }
  // The states of the look-back, and two counters behind them.
  auto* states = allocate<unsigned long long>(scratch, int64_t(blocks) + 1);
  check(cudaMemsetAsync(states, 0, (size_t(blocks) + 1) * sizeof(*states), stream), "listing instances");
  auto* counters = reinterpret_cast<unsigned*>(states + blocks);
  list.look_back = {states, counters};
  list.num_large = counters + 1;
  list_instances_kernel<<<blocks, kBlock, 0, stream>>>(list);
  DSMOE_CHECK_LAUNCH("list_instances");
  if (list.keys == nullptr) return;
  constexpr unsigned kLargeBlocks = 1024;
  list_large_kernel < <<blocks<kLargeBlocks ? blocks : kLargeBlocks, kBlock, 0, stream>>>(list);
  DSMOE_CHECK_LAUNCH("list_large");
}

template <class Key, class S>
ListArguments<S, Key> list_arguments(int64_t num_gaussians, const DeviceCamera<S>& camera,
                                     const RasterConfig<S>& config, const SavedForward<S>& saved,
                                     const int32_t* radii) {
  ListArguments<S, Key> list = {};
  list.num_gaussians = num_gaussians;
  list.mode = config.mode;
  list.width = camera.width, list.height = camera.height;
  list.columns = TileGrid(camera.width, camera.height).columns;
  list.saved = saved;
  list.radii = radii;
  return list;
}

template <class Key, class S>
void bin_by(int64_t num_gaussians, const DeviceCamera<S>& camera, const RasterConfig<S>& config,
            const SavedForward<S>& saved, const int32_t* radii, Scratch& scratch, cudaStream_t stream) {
  const int64_t tiles = num_tiles(camera.width, camera.height), capacity = saved.capacity;
  const bool slots = saved.instance_width == 2;
  auto list = list_arguments<Key>(num_gaussians, camera, config, saved, radii);
  list.keys = allocate<Key>(scratch, capacity);
  list.values = allocate<int32_t>(scratch, capacity);
  list.slot_owners = slots ? allocate<int32_t>(scratch, capacity) : nullptr;
  list.max_large = static_cast<unsigned>(min<int64_t>(capacity / 8 + 1024, num_gaussians));
  list.large = allocate<LargeGaussian>(scratch, list.max_large);
  Key* sorted_keys = allocate<Key>(scratch, capacity);
  int32_t* sorted_values = slots ? allocate<int32_t>(scratch, capacity) : saved.instances;
  // Behind the last instance: keys above every tile.
  check(cudaMemsetAsync(list.keys, 0xff, capacity * sizeof(Key), stream), "listing instances");
  list_instances(list, scratch, stream);
  if (capacity > 0) {
    int bits = 1;  // of the greatest tile, and of the key above all tiles
    while (int64_t(1) << bits <= tiles) ++bits;
    with_temporary(scratch, "sorting instances", [&](void* memory, size_t& bytes) {
      return cub::DeviceRadixSort::SortPairs(memory, bytes, list.keys, sorted_keys, list.values, sorted_values,
                                             capacity, 0, bits, stream);
    });
    if (slots) {
      pair_with_slots_kernel<<<blocks_for(capacity, kBlock), kBlock, 0, stream>>>(
          capacity, saved.num_instances, sorted_values, list.slot_owners, saved.instances);
      DSMOE_CHECK_LAUNCH("pair_with_slots");
    }
  }
  tile_offsets_kernel<<<blocks_for(tiles + 1, kBlock), kBlock, 0, stream>>>(tiles, capacity, sorted_keys,
                                                                            saved.tile_offsets);
  DSMOE_CHECK_LAUNCH("tile_offsets");
}

}  // namespace

bool needs_depth_order(BlendMode mode) {
  bool needed = false;
  dispatch_blend(mode, kAnyFeatures,
                 [&](auto mode_constant, auto) { needed = Blend<decltype(mode_constant)::value>::kNeedsDepthOrder; });
  return needed;
}

template <class S>
void sort_by_depth(int64_t num_gaussians, const DepthKeys<S>& keys, int32_t* order, Scratch& scratch,
                   cudaStream_t stream) {
  if (num_gaussians == 0) return;
  auto* sorted_keys = allocate<DepthBits<S>>(scratch, num_gaussians);
  with_temporary(scratch, "sorting by depth", [&](void* memory, size_t& bytes) {
    return cub::DeviceRadixSort::SortPairs(memory, bytes, keys.depths, sorted_keys, keys.gaussians, order,
                                           num_gaussians, 0, 8 * int(sizeof(S)), stream);
  });
}

template <class S>
void count_instances(int64_t num_gaussians, const DeviceCamera<S>& camera, const RasterConfig<S>& config,
                     const SavedForward<S>& saved, const int32_t* radii, Scratch& scratch, cudaStream_t stream) {
  auto counted = saved;
  counted.slot_ranges = nullptr;
  list_instances(list_arguments<uint32_t>(num_gaussians, camera, config, counted, radii), scratch, stream);
}

template <class S>
void bin(int64_t num_gaussians, const DeviceCamera<S>& camera, const RasterConfig<S>& config,
         const SavedForward<S>& saved, const int32_t* radii, Scratch& scratch, cudaStream_t stream) {
  if (num_tiles(camera.width, camera.height) < std::numeric_limits<uint16_t>::max()) {
    bin_by<uint16_t>(num_gaussians, camera, config, saved, radii, scratch, stream);
  } else {
    bin_by<uint32_t>(num_gaussians, camera, config, saved, radii, scratch, stream);
  }
}

#define DSMOE_INSTANTIATE(S)                                                                                         \
  template void sort_by_depth(int64_t, const DepthKeys<S>&, int32_t*, Scratch&, cudaStream_t);                       \
  template void count_instances(int64_t, const DeviceCamera<S>&, const RasterConfig<S>&, const SavedForward<S>&,     \
                                const int32_t*, Scratch&, cudaStream_t);                                             \
  template void bin(int64_t, const DeviceCamera<S>&, const RasterConfig<S>&, const SavedForward<S>&, const int32_t*, \
                    Scratch&, cudaStream_t);
DSMOE_INSTANTIATE(float)
DSMOE_INSTANTIATE(double)
#undef DSMOE_INSTANTIATE

}  // namespace cuda
}  // namespace dsmoe

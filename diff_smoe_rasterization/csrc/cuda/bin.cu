// Stage 2: the depth order, and the tile lists front to back. One sort of the Gaussians by depth, then a stable sort of
// their instances by tile, so that the second sort's keys are short.
#include <thrust/iterator/counting_iterator.h>
#include <thrust/iterator/transform_iterator.h>

#include <cub/device/device_radix_sort.cuh>
#include <cub/device/device_scan.cuh>
#include <limits>
#include <type_traits>

#include "../dispatch.h"
#include "device.cuh"
#include "dsmoe/blend.h"
#include "dsmoe/rasterize.h"
#include "tile_rows.cuh"

namespace dsmoe {
namespace cuda {
namespace {

constexpr int kBlock = 256;

// The bits of a positive float, read as an integer, are in the order of the float.
template <class S> using DepthBits = std::conditional_t<sizeof(S) == 4, uint32_t, uint64_t>;
__device__ uint32_t depth_bits(float depth) { return __float_as_uint(depth); }
__device__ uint64_t depth_bits(double depth) { return __double_as_longlong(depth); }

template <class S>
__global__ void depth_keys_kernel(int64_t num_gaussians, const ProjectedGaussian<S>* projected, const int32_t* radii,
                                  DepthBits<S>* keys, int32_t* indices) {
  const int64_t i = int64_t(blockIdx.x) * kBlock + threadIdx.x;
  if (i >= num_gaussians) return;
  indices[i] = static_cast<int32_t>(i);
  if (keys != nullptr) keys[i] = radii[i] > 0 ? depth_bits(projected[i].depth) : ~DepthBits<S>(0);
}

// Tiles of the Gaussian at a position of the depth order; 0 after the last.
struct CountAtPosition {
  int64_t num_gaussians;
  const int32_t* order;
  const int32_t* tile_counts;
  __host__ __device__ int64_t operator()(int64_t position) const {
    return position < num_gaussians ? tile_counts[order[position]] : 0;
  }
};

// Runs a CUB algorithm: it says how much memory it needs, gets it, and works.
template <class Algorithm> void with_temporary(Scratch& scratch, const char* what, Algorithm algorithm) {
  size_t bytes = 0;
  check(algorithm(nullptr, bytes), what);
  check(algorithm(allocate<char>(scratch, bytes), bytes), what);
}

// What an instance carries through the sort: its Gaussian, or its slot where gradients go by slot.
template <class S, class Key> struct InstanceWriter {
  Key* keys;
  int32_t* values;
  int32_t* slot_owners;  // [capacity] Gaussian of each slot, or null
  int columns;

  __device__ void operator()(int64_t slot, int32_t gaussian, int x, int y) const {
    keys[slot] = static_cast<Key>(y * columns + x);
    if (slot_owners != nullptr) slot_owners[slot] = gaussian;
    values[slot] = slot_owners != nullptr ? static_cast<int32_t>(slot) : gaussian;
  }
};

constexpr int kTilesOfOneThread = 24;  // a Gaussian with more is listed by its warp together

template <class S, class Key>
__global__ void __launch_bounds__(kBlock)
    list_instances_kernel(int64_t num_gaussians, BlendMode mode, int width, int height, SavedForward<S> saved,
                          const int32_t* radii, const int64_t* instance_offsets, InstanceWriter<S, Key> write) {
  const int64_t position = int64_t(blockIdx.x) * kBlock + threadIdx.x;
  const int lane = threadIdx.x % kWarp;
  const bool listed = !overflows(saved);
  // Behind the last instance: keys above every tile.
  if (position < saved.capacity && (!listed || position >= *saved.num_instances)) {
    write.keys[position] = static_cast<Key>(~Key(0));
  }
  if (!listed) return;

  int64_t begin = 0, end = 0;
  int32_t gaussian = 0;
  if (position < num_gaussians) {
    begin = instance_offsets[position], end = instance_offsets[position + 1];
    gaussian = saved.order[position];
    if (saved.slot_ranges != nullptr)
      saved.slot_ranges[2 * gaussian] = begin, saved.slot_ranges[2 * gaussian + 1] = end;
  }
  const auto tiles_at = [&](int32_t index) {
    const ProjectedGaussian<S> projected = saved.projected[index];
    return tiles_of(projected, bounds_of(mode, width, height, projected.mean, radii[index]));
  };
  const bool together = end - begin > kTilesOfOneThread;
  if (begin < end && !together) {
    const auto tiles = tiles_at(gaussian);
    int64_t slot = begin;
    for (int y = tiles.begin(); y < tiles.end(); ++y) {
      const auto span = row_of(tiles, y);
      for (int x = span.x0; x < span.x1 && slot < end; ++x) write(slot++, gaussian, x, y);
    }
  }
  for (unsigned left = __ballot_sync(kAllLanes, together); left != 0; left &= left - 1) {
    const int owner = __ffs(left) - 1;
    const int32_t index = __shfl_sync(kAllLanes, gaussian, owner);
    int64_t slot = __shfl_sync(kAllLanes, begin, owner);
    const int64_t last = __shfl_sync(kAllLanes, end, owner);
    const auto tiles = tiles_at(index);
    for (int y0 = tiles.begin(); y0 < tiles.end(); y0 += kWarp) {
      typename FootprintTiles<S>::Span span = {0, 0};
      if (y0 + lane < tiles.end()) span = row_of(tiles, y0 + lane);
      const int width_here = max(0, span.x1 - span.x0);
      int until = width_here;  // tiles of this row and those above it
      for (int step = 1; step < kWarp; step *= 2) {
        const int above = __shfl_up_sync(kAllLanes, until, step);
        if (lane >= step) until += above;
      }
      int64_t next = slot + until - width_here;
      for (int x = span.x0; x < span.x1 && next < last; ++x) write(next++, index, x, y0 + lane);
      slot += __shfl_sync(kAllLanes, until, kWarp - 1);
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
  if (i >= capacity || i >= *num_instances || *num_instances > capacity) return;
  const uint32_t slot = static_cast<uint32_t>(slots[i]);
  instances[2 * i] = slot_owners[slot];
  instances[2 * i + 1] = slots[i];
}

template <class Key, class S>
void bin_by(int64_t num_gaussians, const DeviceCamera<S>& camera, const RasterConfig<S>& config,
            const SavedForward<S>& saved, const int32_t* radii, const Binning& binning, Scratch& scratch,
            cudaStream_t stream) {
  const int64_t tiles = num_tiles(camera.width, camera.height), capacity = saved.capacity;
  const bool slots = saved.instance_width == 2;
  Key* keys = allocate<Key>(scratch, capacity);
  Key* sorted_keys = allocate<Key>(scratch, capacity);
  int32_t* values = allocate<int32_t>(scratch, capacity);
  int32_t* sorted_values = slots ? allocate<int32_t>(scratch, capacity) : saved.instances;
  int32_t* slot_owners = slots ? allocate<int32_t>(scratch, capacity) : nullptr;
  const int64_t threads = num_gaussians > capacity ? num_gaussians : capacity;
  if (threads > 0) {
    list_instances_kernel<S, Key><<<blocks_for(threads, kBlock), kBlock, 0, stream>>>(
        num_gaussians, config.mode, camera.width, camera.height, saved, radii, binning.instance_offsets,
        InstanceWriter<S, Key>{keys, values, slot_owners, TileGrid(camera.width, camera.height).columns});
    DSMOE_CHECK_LAUNCH("list_instances");
  }
  if (capacity > 0) {
    int bits = 1;  // of the greatest tile, and of the key above all tiles
    while (int64_t(1) << bits <= tiles) ++bits;
    with_temporary(scratch, "sorting instances", [&](void* memory, size_t& bytes) {
      return cub::DeviceRadixSort::SortPairs(memory, bytes, keys, sorted_keys, values, sorted_values, capacity, 0, bits,
                                             stream);
    });
    if (slots) {
      pair_with_slots_kernel<<<blocks_for(capacity, kBlock), kBlock, 0, stream>>>(
          capacity, saved.num_instances, sorted_values, slot_owners, saved.instances);
      DSMOE_CHECK_LAUNCH("pair_with_slots");
    }
  }
  tile_offsets_kernel<<<blocks_for(tiles + 1, kBlock), kBlock, 0, stream>>>(tiles, capacity, sorted_keys,
                                                                            saved.tile_offsets);
  DSMOE_CHECK_LAUNCH("tile_offsets");
}

}  // namespace

template <class S>
void sort_by_depth(int64_t num_gaussians, const RasterConfig<S>& config, const SavedForward<S>& saved,
                   const int32_t* radii, const Binning& binning, Scratch& scratch, cudaStream_t stream) {
  bool ordered = false;
  dispatch_blend(config.mode, kAnyFeatures,
                 [&](auto mode, auto) { ordered = Blend<decltype(mode)::value>::kNeedsDepthOrder; });
  if (num_gaussians > 0) {
    DepthBits<S>* keys = ordered ? allocate<DepthBits<S>>(scratch, num_gaussians) : nullptr;
    int32_t* indices = ordered ? allocate<int32_t>(scratch, num_gaussians) : saved.order;
    depth_keys_kernel<<<blocks_for(num_gaussians, kBlock), kBlock, 0, stream>>>(num_gaussians, saved.projected, radii,
                                                                                keys, indices);
    DSMOE_CHECK_LAUNCH("depth_keys");
    if (ordered) {
      DepthBits<S>* sorted_keys = allocate<DepthBits<S>>(scratch, num_gaussians);
      with_temporary(scratch, "sorting by depth", [&](void* memory, size_t& bytes) {
        return cub::DeviceRadixSort::SortPairs(memory, bytes, keys, sorted_keys, indices, saved.order, num_gaussians, 0,
                                               8 * int(sizeof(S)), stream);
      });
    }
  }
  const auto counts = thrust::make_transform_iterator(thrust::make_counting_iterator(int64_t(0)),
                                                      CountAtPosition{num_gaussians, saved.order, binning.tile_counts});
  with_temporary(scratch, "counting instances", [&](void* memory, size_t& bytes) {
    return cub::DeviceScan::ExclusiveSum(memory, bytes, counts, binning.instance_offsets, num_gaussians + 1, stream);
  });
  check(cudaMemcpyAsync(saved.num_instances, binning.instance_offsets + num_gaussians, sizeof(int64_t),
                        cudaMemcpyDeviceToDevice, stream),
        "counting instances");
}

template <class S>
void bin(int64_t num_gaussians, const DeviceCamera<S>& camera, const RasterConfig<S>& config,
         const SavedForward<S>& saved, const int32_t* radii, const Binning& binning, Scratch& scratch,
         cudaStream_t stream) {
  const int64_t tiles = num_tiles(camera.width, camera.height);
  if (tiles < std::numeric_limits<uint16_t>::max()) {
    bin_by<uint16_t>(num_gaussians, camera, config, saved, radii, binning, scratch, stream);
  } else {
    bin_by<uint32_t>(num_gaussians, camera, config, saved, radii, binning, scratch, stream);
  }
}

#define DSMOE_INSTANTIATE(S)                                                                                           \
  template void sort_by_depth(int64_t, const RasterConfig<S>&, const SavedForward<S>&, const int32_t*, const Binning&, \
                              Scratch&, cudaStream_t);                                                                 \
  template void bin(int64_t, const DeviceCamera<S>&, const RasterConfig<S>&, const SavedForward<S>&, const int32_t*,   \
                    const Binning&, Scratch&, cudaStream_t);
DSMOE_INSTANTIATE(float)
DSMOE_INSTANTIATE(double)
#undef DSMOE_INSTANTIATE

}  // namespace cuda
}  // namespace dsmoe

// The three nearest neighbours of every point: exact, by leaving out boxes that are too far.
#include <cmath>

#include "cuda/tuning.cuh"
#include "dsmoe/hd.h"
#include "dsmoe/training/neighbors.h"
#include "refuse.h"

namespace dsmoe {
namespace cuda {
namespace {

constexpr int kBitsPerAxis = 21;  // three axes fill an int64

// The lowest kBitsPerAxis bits, each with two zeros above it.
__device__ uint64_t spread_bits(uint64_t bits) {
  bits = (bits | bits << 32) & 0x001f00000000ffffull;
  bits = (bits | bits << 16) & 0x001f0000ff0000ffull;
  bits = (bits | bits << 8) & 0x100f00f00f00f00full;
  bits = (bits | bits << 4) & 0x10c30c30c30c30c3ull;
  bits = (bits | bits << 2) & 0x1249249249249249ull;
  return bits;
}

template <class S>
__global__ void __launch_bounds__(kStoreBlock) morton_kernel(const __grid_constant__ MortonCodes<S> morton) {
  const int64_t i = int64_t(blockIdx.x) * kStoreBlock + threadIdx.x;
  if (i >= morton.count) return;
  uint64_t code = 0;
  for (int axis = 0; axis < 3; ++axis) {
    const S low = morton.low[axis], extent = morton.high[axis] - low;
    const S share = extent > 0 ? (morton.points[3 * i + axis] - low) / extent : S(0);
    const auto cell = static_cast<uint64_t>(clamp(share, S(0), S(1)) * S((1 << kBitsPerAxis) - 1));
    code |= spread_bits(cell) << axis;
  }
  morton.codes[i] = static_cast<int64_t>(code);
}

// Finds the least and the greatest coordinates of the points of each box. A warp does one box.
template <class S>
__global__ void __launch_bounds__(kWarp) box_kernel(const __grid_constant__ NeighborDistances<S> search) {
  const S* points = search.points;
  const int64_t first = int64_t(blockIdx.x) * kBoxPoints;
  const int64_t last = min<int64_t>(first + kBoxPoints, search.count);
  for (int axis = 0; axis < 3; ++axis) {
    S low = points[3 * first + axis], high = low;
    for (int64_t i = first + threadIdx.x; i < last; i += kWarp) {
      low = min(low, points[3 * i + axis]);
      high = max(high, points[3 * i + axis]);
    }
    for (int offset = kWarp / 2; offset > 0; offset /= 2) {
      low = min(low, __shfl_down_sync(kAllLanes, low, offset));
      high = max(high, __shfl_down_sync(kAllLanes, high, offset));
    }
    if (threadIdx.x == 0) {
      search.boxes[6 * blockIdx.x + axis] = low;
      search.boxes[6 * blockIdx.x + 3 + axis] = high;
    }
  }
}

// Rounds in one way for points and for boxes: a box is never further than a point in it.
template <class S> __device__ S squared_length(S x, S y, S z) { return x * x + y * y + z * z; }

// How far x is outside [low, high].
template <class S> __device__ S outside(S x, S low, S high) { return max(max(low - x, x - high), S(0)); }

// What is known of the neighbours of a point.
template <class S> struct Nearest {
  int64_t self;           // the point's index
  S point[3];             // where it lies
  S squared[kNeighbors];  // the smallest squared distances to others, in order

  __device__ void insert(S value) {
#pragma unroll
    for (int k = 0; k < kNeighbors; ++k) {
      const S smaller = min(value, squared[k]);
      value = max(value, squared[k]);
      squared[k] = smaller;
    }
  }
};

// Looks for neighbours among the points of a box.
template <class S> __device__ void search_box(const NeighborDistances<S>& search, int64_t box, Nearest<S>& nearest) {
  const S *points = search.points, *point = nearest.point;
  const int64_t last = min<int64_t>((box + 1) * kBoxPoints, search.count);
  for (int64_t j = box * kBoxPoints; j < last; ++j) {
    const S squared =
        squared_length(points[3 * j] - point[0], points[3 * j + 1] - point[1], points[3 * j + 2] - point[2]);
    if (j != nearest.self && squared < nearest.squared[kNeighbors - 1]) nearest.insert(squared);
  }
}

template <class S>
__global__ void __launch_bounds__(kSearchBlock) nearest_kernel(const __grid_constant__ NeighborDistances<S> search) {
  const int64_t i = int64_t(blockIdx.x) * kSearchBlock + threadIdx.x, count = search.count;
  if (i >= count) return;
  Nearest<S> nearest = {i, {search.points[3 * i], search.points[3 * i + 1], search.points[3 * i + 2]}, {}};
  for (int k = 0; k < kNeighbors; ++k) nearest.squared[k] = static_cast<S>(INFINITY);

  // The point's own box first: it holds near ones, and most other boxes are then too far.
  const int64_t own = i / kBoxPoints, num_boxes = (count + kBoxPoints - 1) / kBoxPoints;
  search_box(search, own, nearest);
  for (int64_t box = 0; box < num_boxes; ++box) {
    if (box == own) continue;
    const S *low = search.boxes + 6 * box, *high = low + 3;
    const S* point = nearest.point;
    const S squared = squared_length(outside(point[0], low[0], high[0]), outside(point[1], low[1], high[1]),
                                     outside(point[2], low[2], high[2]));
    if (squared >= nearest.squared[kNeighbors - 1]) continue;
    search_box(search, box, nearest);
  }

  const int found = static_cast<int>(min<int64_t>(kNeighbors, count - 1));
  S sum = 0;
#pragma unroll
  for (int k = 0; k < kNeighbors; ++k) sum += k < found ? nearest.squared[k] : S(0);
  search.result[search.order[i]] = found > 0 ? sum / S(found) : S(0);
}

}  // namespace

template <class S> void morton_codes(const MortonCodes<S>& morton, void* stream) {
  if (morton.count == 0) return;
  const unsigned blocks = blocks_for(morton.count, kStoreBlock);
  morton_kernel<<<blocks, kStoreBlock, 0, static_cast<cudaStream_t>(stream)>>>(morton);
  DSMOE_CHECK_LAUNCH("Morton codes");
}

template <class S> void mean_squared_distances(const NeighborDistances<S>& search, void* stream) {
  const char* function = "cuda::mean_squared_distances";
  refuse_null(function, "points", search.points, "[N, 3]", search.count);
  refuse_null(function, "order", search.order, "[N]", search.count);
  refuse_null(function, "boxes", search.boxes, "[ceil(N / kBoxPoints), 2, 3]", search.count);
  refuse_null(function, "result", search.result, "[N]", search.count);
  if (search.count == 0) return;
  const auto cuda_stream = static_cast<cudaStream_t>(stream);
  box_kernel<<<blocks_for(search.count, kBoxPoints), kWarp, 0, cuda_stream>>>(search);
  DSMOE_CHECK_LAUNCH("boxes of points");
  nearest_kernel<<<blocks_for(search.count, kSearchBlock), kSearchBlock, 0, cuda_stream>>>(search);
  DSMOE_CHECK_LAUNCH("the search for neighbours");
}

#define DSMOE_INSTANTIATE(S)                                \
  template void morton_codes(const MortonCodes<S>&, void*); \
  template void mean_squared_distances(const NeighborDistances<S>&, void*);
DSMOE_INSTANTIATE(float)
DSMOE_INSTANTIATE(double)
#undef DSMOE_INSTANTIATE

}  // namespace cuda
}  // namespace dsmoe

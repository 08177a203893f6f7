// The three nearest neighbours of every point: exact, by leaving out boxes that are too far.
#include <cmath>

#include "device.cuh"
#include "dsmoe/hd.h"
#include "dsmoe/neighbors.h"

namespace dsmoe {
namespace cuda {
namespace {

constexpr int kBlock = 256;
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
__global__ void __launch_bounds__(kBlock)
    morton_kernel(const S* points, int64_t count, const S* low, const S* high, int64_t* codes) {
  const int64_t i = int64_t(blockIdx.x) * kBlock + threadIdx.x;
  if (i >= count) return;
  uint64_t code = 0;
  for (int axis = 0; axis < 3; ++axis) {
    const S extent = high[axis] - low[axis];
    const S share = extent > 0 ? (points[3 * i + axis] - low[axis]) / extent : S(0);
    const auto cell = static_cast<uint64_t>(clamp(share, S(0), S(1)) * S((1 << kBitsPerAxis) - 1));
    code |= spread_bits(cell) << axis;
  }
  codes[i] = static_cast<int64_t>(code);
}

// A warp per box.
template <class S> __global__ void __launch_bounds__(32) box_kernel(const S* points, int64_t count, S* boxes) {
  const int64_t first = int64_t(blockIdx.x) * kBoxPoints;
  const int64_t last = min<int64_t>(first + kBoxPoints, count);
  for (int axis = 0; axis < 3; ++axis) {
    S low = points[3 * first + axis], high = low;
    for (int64_t i = first + threadIdx.x; i < last; i += 32) {
      low = min(low, points[3 * i + axis]);
      high = max(high, points[3 * i + axis]);
    }
    for (int offset = 16; offset > 0; offset /= 2) {
      low = min(low, __shfl_down_sync(0xffffffffu, low, offset));
      high = max(high, __shfl_down_sync(0xffffffffu, high, offset));
    }
    if (threadIdx.x == 0) {
      boxes[6 * blockIdx.x + axis] = low;
      boxes[6 * blockIdx.x + 3 + axis] = high;
    }
  }
}

// Rounds in one way for points and for boxes: a box is never further than a point in it.
template <class S> __device__ S squared_length(S x, S y, S z) { return x * x + y * y + z * z; }

// How far x is outside [low, high].
template <class S> __device__ S outside(S x, S low, S high) { return max(max(low - x, x - high), S(0)); }

// The smallest values seen, in order.
template <class S> struct Nearest {
  S squared[kNeighbors];

  __device__ void insert(S value) {
#pragma unroll
    for (int k = 0; k < kNeighbors; ++k) {
      const S smaller = min(value, squared[k]);
      value = max(value, squared[k]);
      squared[k] = smaller;
    }
  }
};

template <class S>
__device__ void search_box(const S* points, int64_t first, int64_t last, int64_t self, const S* point,
                           Nearest<S>& nearest) {
  for (int64_t j = first; j < last; ++j) {
    const S squared =
        squared_length(points[3 * j] - point[0], points[3 * j + 1] - point[1], points[3 * j + 2] - point[2]);
    if (j != self && squared < nearest.squared[kNeighbors - 1]) nearest.insert(squared);
  }
}

template <class S>
__global__ void __launch_bounds__(kBlock)
    nearest_kernel(const S* points, const int64_t* order, int64_t count, const S* boxes, S* result) {
  const int64_t i = int64_t(blockIdx.x) * kBlock + threadIdx.x;
  if (i >= count) return;
  const S point[3] = {points[3 * i], points[3 * i + 1], points[3 * i + 2]};
  Nearest<S> nearest;
  for (int k = 0; k < kNeighbors; ++k) nearest.squared[k] = static_cast<S>(INFINITY);

  // The point's own box first: it holds near ones, and most other boxes are then too far.
  const int64_t own = i / kBoxPoints, num_boxes = (count + kBoxPoints - 1) / kBoxPoints;
  search_box(points, own * kBoxPoints, min<int64_t>((own + 1) * kBoxPoints, count), i, point, nearest);
  for (int64_t box = 0; box < num_boxes; ++box) {
    if (box == own) continue;
    const S *low = boxes + 6 * box, *high = low + 3;
    const S squared = squared_length(outside(point[0], low[0], high[0]), outside(point[1], low[1], high[1]),
                                     outside(point[2], low[2], high[2]));
    if (squared >= nearest.squared[kNeighbors - 1]) continue;
    search_box(points, box * kBoxPoints, min<int64_t>((box + 1) * kBoxPoints, count), i, point, nearest);
  }

  const int found = static_cast<int>(min<int64_t>(kNeighbors, count - 1));
  S sum = 0;
#pragma unroll
  for (int k = 0; k < kNeighbors; ++k) sum += k < found ? nearest.squared[k] : S(0);
  result[order[i]] = found > 0 ? sum / S(found) : S(0);
}

}  // namespace

template <class S>
void morton_codes(const S* points, int64_t count, const S* low, const S* high, int64_t* codes, void* stream) {
  if (count == 0) return;
  morton_kernel<<<blocks_for(count, kBlock), kBlock, 0, static_cast<cudaStream_t>(stream)>>>(points, count, low, high,
                                                                                             codes);
  DSMOE_CHECK_LAUNCH("Morton codes");
}

template <class S>
void mean_squared_distances(const S* points, const int64_t* order, int64_t count, S* boxes, S* result, void* stream) {
  if (count == 0) return;
  const auto cuda_stream = static_cast<cudaStream_t>(stream);
  box_kernel<<<blocks_for(count, kBoxPoints), 32, 0, cuda_stream>>>(points, count, boxes);
  DSMOE_CHECK_LAUNCH("boxes of points");
  nearest_kernel<<<blocks_for(count, kBlock), kBlock, 0, cuda_stream>>>(points, order, count, boxes, result);
  DSMOE_CHECK_LAUNCH("the search for neighbours");
}

template void morton_codes<float>(const float*, int64_t, const float*, const float*, int64_t*, void*);
template void morton_codes<double>(const double*, int64_t, const double*, const double*, int64_t*, void*);
template void mean_squared_distances<float>(const float*, const int64_t*, int64_t, float*, float*, void*);
template void mean_squared_distances<double>(const double*, const int64_t*, int64_t, double*, double*, void*);

}  // namespace cuda
}  // namespace dsmoe

// Sums over the lanes of a warp and over the rows of a matrix, each in a fixed order.
#pragma once

#include "device.cuh"
#include "tuning.cuh"

namespace dsmoe {
namespace cuda {

// Sums kCount numbers over the lanes of a warp. In each step two lanes exchange partial sums, and each keeps half of
// the numbers. That takes fewer steps than kCount sums one by one. Afterwards values[0] is the sum of number `number`
// in the lanes where `holds` is set; each number has one such lane.
template <int kCount> class TransposedSum {
 public:
  __device__ explicit TransposedSum(int lane) : lane_(lane) {
    number = 0, holds = true;
    locate<kCount, kWarp / 2>();
  }

  template <class S> __device__ void operator()(S (&values)[kCount]) const { reduce<kCount, kWarp / 2>(values); }

  int number;
  bool holds;

 private:
  template <int kLeft, int kStep> __device__ void locate() {
    if constexpr (kStep > 0) {
      constexpr int kHalf = (kLeft + 1) / 2;
      locate<kHalf, kStep / 2>();
      if (lane_ & kStep) {
        if (kHalf + number < kLeft) {
          number += kHalf;
        } else {
          holds = false;
        }
      }
    }
  }

  template <int kLeft, int kStep, class S> __device__ void reduce(S (&values)[kCount]) const {
    if constexpr (kStep > 0) {
      constexpr int kHalf = (kLeft + 1) / 2;
      const bool upper = lane_ & kStep;
#pragma unroll
      for (int i = 0; i < kHalf; ++i) {
        if (kHalf + i < kLeft) {
          const S send = upper ? values[i] : values[kHalf + i];
          const S keep = upper ? values[kHalf + i] : values[i];
          values[i] = keep + __shfl_xor_sync(kAllLanes, send, kStep);
        } else {
          values[i] += __shfl_xor_sync(kAllLanes, values[i], kStep);
        }
      }
      reduce<kHalf, kStep / 2>(values);
    }
  }

  int lane_;
};

template <class S> __device__ S sum_lanes(S value) {
  for (int step = kWarp / 2; step > 0; step /= 2) value += __shfl_xor_sync(kAllLanes, value, step);
  return value;
}

inline __device__ int32_t max_over_lanes(int32_t value) {
  for (int step = kWarp / 2; step > 0; step /= 2) {
    const int32_t other = __shfl_xor_sync(kAllLanes, value, step);
    value = value > other ? value : other;
  }
  return value;
}

template <class S> struct ColumnSums {
  const S* rows;  // [count, columns]
  int64_t count;  // rows
  int columns;    // numbers a row
  S* sums;        // [columns] written
};

// sums[c] = sum_r rows[r, c], in double. A block sums one column.
template <class S> __global__ void sum_columns_kernel(const __grid_constant__ ColumnSums<S> matrix) {
  __shared__ double shared[kColumnBlock];
  double sum = 0;
  for (int64_t r = threadIdx.x; r < matrix.count; r += kColumnBlock) {
    sum += double(matrix.rows[r * matrix.columns + blockIdx.x]);
  }
  shared[threadIdx.x] = sum;
  for (int half = kColumnBlock / 2; half > 0; half /= 2) {
    __syncthreads();
    if (threadIdx.x < half) shared[threadIdx.x] += shared[threadIdx.x + half];
  }
  if (threadIdx.x == 0) matrix.sums[blockIdx.x] = static_cast<S>(shared[0]);
}

template <class S> void sum_columns(const S* rows, int64_t count, int columns, S* sums, cudaStream_t stream) {
  ColumnSums<S> matrix = {};
  matrix.rows = rows;
  matrix.count = count;
  matrix.columns = columns;
  matrix.sums = sums;
  sum_columns_kernel<<<columns, kColumnBlock, 0, stream>>>(matrix);
  DSMOE_CHECK_LAUNCH("sum_columns");
}

}  // namespace cuda
}  // namespace dsmoe

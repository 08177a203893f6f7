// Rows of floats, one for each Gaussian of a warp. They lie side by side in global memory. The whole warp copies them
// to and from shared memory, if each lane has its own row.
#pragma once

#include <cuda_pipeline.h>

#include "device.cuh"

namespace dsmoe {
namespace cuda {

// Where a float lies in shared memory, in the form that the instruction below takes.
struct SharedAddress {
  unsigned byte;
  __device__ explicit SharedAddress(const float* p) : byte(static_cast<unsigned>(__cvta_generic_to_shared(p))) {}
  __device__ SharedAddress operator+(int floats) const {
    SharedAddress sum = *this;
    sum.byte += floats * unsigned(sizeof(float));
    return sum;
  }
};

// Copies a T from global memory to shared memory. If the device can, the copy is asynchronous.
template <class T> __device__ void copy_async(SharedAddress to, const float* from) {
  static_assert(sizeof(T) == 4 || sizeof(T) == 16, "the instruction's sizes");
#if __CUDA_ARCH__ >= 800
  if constexpr (sizeof(T) == 16) {
    asm volatile("cp.async.cg.shared.global [%0], [%1], 16;" ::"r"(to.byte), "l"(from) : "memory");
  } else {
    asm volatile("cp.async.ca.shared.global [%0], [%1], 4;" ::"r"(to.byte), "l"(from) : "memory");
  }
#else
  *static_cast<T*>(__cvta_shared_to_generic(to.byte)) = *reinterpret_cast<const T*>(from);
#endif
}

// Waits for what the warp has copied.
inline __device__ void wait_for_copies() {
  __pipeline_commit();
  __pipeline_wait_prior(0);
  __syncwarp();
}

// kLength: numbers a row, or 0 if that is only known at run time. Rows of known length are copied four numbers at a
// time, so their array must begin at a multiple of 16 bytes. In shared memory rows are an odd number of words apart, or
// of vectors if they are read as such. So lanes that read the same place of their rows use different banks.
template <int kLength> class WarpRows {
 public:
  static constexpr bool kVectors = kLength % 4 == 0 && kLength > 0;  // a row is made of vectors
  static DSMOE_HD constexpr int stride(int length) { return kVectors ? (kLength / 4 | 1) * 4 : length | 1; }

  // shared: the warp's memory, [32, stride]. exist: how many of the rows there are.
  __device__ WarpRows(float* shared, int length, int exist, int lane)
      : shared_(shared), length_(kLength > 0 ? kLength : length), exist_(exist), lane_(lane) {}

  __device__ int exist() const { return exist_; }
  __device__ int lane() const { return lane_; }
  __device__ float* memory() const { return shared_; }
  __device__ float* own() const { return shared_ + lane_ * stride(length_); }

  // Begins to copy the rows that `wanted` marks. They are there after wait_for_copies().
  __device__ void load(const float* from, unsigned wanted) const {
    for_each_part<false>(
        wanted, from, SharedAddress(shared_),
        [](auto part, const float* global, SharedAddress shared) { copy_async<decltype(part)>(shared, global); });
  }

  // The lanes whose rows exist.
  __device__ unsigned all() const { return exist_ < kWarp ? (1u << exist_) - 1 : kAllLanes; }

  // Writes the rows that `wanted` marks, of those that exist, and touches no other.
  __device__ void store(float* to, unsigned wanted) const {
    __syncwarp();
    for_each_part<true>(wanted, to, shared_, [](auto part, float* global, const float* shared) {
      using Part = decltype(part);
      *reinterpret_cast<Part*>(global) = *reinterpret_cast<const Part*>(shared);
    });
  }

  // Copy the lane's row to registers, and back.
  __device__ void read(float (&row)[kLength > 0 ? kLength : 1]) const {
    if constexpr (kVectors) {
#pragma unroll
      for (int k = 0; k < kLength / 4; ++k) {
        const float4 four = reinterpret_cast<const float4*>(own())[k];
        row[4 * k] = four.x, row[4 * k + 1] = four.y, row[4 * k + 2] = four.z, row[4 * k + 3] = four.w;
      }
    } else {
#pragma unroll
      for (int k = 0; k < kLength; ++k) row[k] = own()[k];
    }
  }
  __device__ void write(const float (&row)[kLength > 0 ? kLength : 1]) const {
    if constexpr (kVectors) {
#pragma unroll
      for (int k = 0; k < kLength / 4; ++k) {
        reinterpret_cast<float4*>(own())[k] = make_float4(row[4 * k], row[4 * k + 1], row[4 * k + 2], row[4 * k + 3]);
      }
    } else {
#pragma unroll
      for (int k = 0; k < kLength; ++k) own()[k] = row[k];
    }
  }

 private:
  // Calls visit(value, global, shared) for all parts of the marked rows, in memory order. A part is a vector or a
  // single number. value: of the part's type. global, shared: where it lies. A part that reaches into the next row is
  // visited if either row is marked or, with kExact, number by number if only one is.
  template <bool kExact, class Global, class Shared, class Visit>
  __device__ void for_each_part(unsigned marked, Global global, Shared shared, Visit visit) const {
    if constexpr (kVectors) {
      // The lanes' places in their rows repeat after some steps.
      constexpr int kRowVectors = kLength / 4, kSteps = kRowVectors / (kRowVectors & -kRowVectors);
#pragma unroll
      for (int step = 0; step < kSteps; ++step) {
        const int row = (lane_ + step * kWarp) / kRowVectors, column = (lane_ + step * kWarp) % kRowVectors * 4;
        const unsigned marks = marked >> row;
        const auto from = global + (row * kLength + column);
        const auto to = shared + (row * stride(kLength) + column);
#pragma unroll
        for (int more = 0; more < kWarp; more += kSteps * kWarp / kRowVectors) {
          if (marks >> more & 1) visit(float4(), from + more * kLength, to + more * stride(kLength));
        }
      }
    } else if (kLength > 0 && exist_ == kWarp) {
      static_assert(kLength == 0 || stride(kLength) == kLength, "rows lie side by side in shared memory too");
      constexpr int kDivisor = kLength > 0 ? kLength : 1;
      const auto from = global + 4 * lane_;
      const auto to = shared + 4 * lane_;
#pragma unroll
      for (int step = 0; step < (kLength + 3) / 4; ++step) {
        const unsigned place = 4 * (lane_ + step * kWarp), row = place / kDivisor;
        if (place >= kWarp * kDivisor) continue;
        const unsigned reached = (place + 3) / kDivisor > row ? 3 : 1, hit = marked >> row & reached;
        if (hit == 0) continue;
        if (!kExact || hit == reached) {
          visit(float4(), from + 4 * kWarp * step, to + 4 * kWarp * step);
        } else {
#pragma unroll
          for (int k = 0; k < 4; ++k) {
            if (marked >> (place + k) / kDivisor & 1) {
              visit(float(), from + (4 * kWarp * step + k), to + (4 * kWarp * step + k));
            }
          }
        }
      }
    } else {
      int row = 0, column = lane_;
      while (column >= length_) column -= length_, ++row;
#pragma unroll 1
      while (row < kWarp) {
        if (marked >> row & 1)
          visit(float(), global + (row * length_ + column), shared + (row * stride(length_) + column));
        column += kWarp;
        while (column >= length_) column -= length_, ++row;
      }
    }
  }

  float* shared_;
  int length_, exist_, lane_;
};

}  // namespace cuda
}  // namespace dsmoe

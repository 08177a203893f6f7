// Where the sums over a warp's pixels go. Each Gaussian has a record of numbers: the moments of dL/dpower, then the
// gradients of its features. Every warp that meets the Gaussian has a term for each number.
//
//   RecordSink     adds terms to the records by atomics, in any order.
//   IntegerSink    adds them as integers, so that gradients are the same bits every time.
#pragma once

#include "integer_sums.cuh"

namespace dsmoe {
namespace cuda {

template <class S> struct RecordSink {
  S* records;  // [N, length] sums; zero before
  int length;  // numbers a record

  // Calls put(add), where add(k, term) adds to number `first` + k of the record of a Gaussian. numbers: those of a
  // record, a constant if the caller has one.
  template <class Put>
  __device__ __forceinline__ void to_record(int32_t gaussian, int numbers, int first, Put put) const {
    S* from_first = records + int64_t(gaussian) * numbers + first;
    put([from_first](int k, S term) { atomicAdd(from_first + k, term); });
  }
};

template <class S> struct IntegerSink {
  IntegerSums<S> sums;
  int length;  // numbers a record

  template <class Put> __device__ __forceinline__ void to_record(int32_t gaussian, int, int first, Put put) const {
    const SumExtent extent = sums.extents[gaussian];
    put([&](int k, S term) { sums.add(gaussian, extent, first + k, term); });
  }
};

}  // namespace cuda
}  // namespace dsmoe

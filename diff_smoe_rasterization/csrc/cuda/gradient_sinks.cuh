// Where the sums over a warp's pixels go. Each Gaussian has a record of numbers: the moments of dL/dpower, then the
// gradients of its features. Every warp that meets the Gaussian has a term for each number.
//
//   RecordSink     adds terms to the records by atomics, in any order. Where gradients must be the same bits every
//                  time, it writes the terms to slots instead, one slot for each warp and instance. slot_sums.cuh sums
//                  the slots in order.
//   OutgrownSink   gives the same bits where the instances outgrew their memory, so that no instance has a slot.
#pragma once

#include "slot_sums.cuh"
#include "tile_walk.cuh"

namespace dsmoe {
namespace cuda {

template <class S> struct RecordSink {
  S* records;      // [N, length] sums
  Slots<S> slots;  // which take the place of the records, where there are any
  int length;      // numbers a record

  static constexpr bool kOnlyOutgrown = false;

  // Whether the warps of this tile have terms for this sink.
  __device__ bool takes(const WarpTile<S>& tile) const { return slots.terms == nullptr || tile.source.listed; }

  // Calls put(add), where add(number, term) adds to the record of a Gaussian, which lies at `position` of the list.
  // numbers: those of a record, a constant where the caller has one.
  template <class Put>
  __device__ __forceinline__ void to_record(const WarpTile<S>& tile, int32_t gaussian, int32_t position, int numbers,
                                            Put put) const {
    if (slots.terms != nullptr) {
      const int64_t slot = int64_t(tile.source.slot(position)) * kSlotsPerInstance + tile.quarter;
      S* terms = slots.terms + slot * numbers;
      slots.written[slot] = 1;
      put([terms](int number, S term) { terms[number] = term; });
    } else {
      S* record = records + int64_t(gaussian) * numbers;
      put([record](int number, S term) { atomicAdd(record + number, term); });
    }
  }
};

// Sums that do not depend on the order of their terms, because they are sums of integers. A first walk finds the
// exponent of each sum's largest term; a second one adds the terms in units of 2^-term_bits of it.
template <class S> struct OutgrownSink {
  int32_t* exponents;        // [N, length] of each sum's largest term, as exponent_of has it; zero before
  unsigned long long* sums;  // [N, length] signed numbers; zero before
  int length;                // numbers a record
  int term_bits;             // few enough that the terms of all warps fit a sum
  bool measures;             // the first walk; else the second

  static constexpr bool kOnlyOutgrown = true;

  __device__ bool takes(const WarpTile<S>&) const { return true; }

  template <class Put>
  __device__ __forceinline__ void to_record(const WarpTile<S>&, int32_t gaussian, int32_t, int numbers, Put put) const {
    const int64_t record = int64_t(gaussian) * numbers;
    put([this, record](int number, S term) {
      const int64_t at = record + number;
      if (measures) {
        atomicMax(exponents + at, exponent_of(term));
      } else if (is_finite(term)) {
        const long long units = __double2ll_rn(ldexp(double(term), kBias + term_bits - exponents[at]));
        atomicAdd(sums + at, static_cast<unsigned long long>(units));
      }
    });
  }

  // A sum as a number. NaN where a term was NaN or infinite.
  __device__ S sum(int64_t at) const {
    if (exponents[at] == kNotFinite) return S(NAN);
    const auto units = static_cast<double>(static_cast<long long>(sums[at]));
    return static_cast<S>(ldexp(units, exponents[at] - kBias - term_bits));
  }

 private:
  static constexpr int kBias = 2048;          // above every exponent of a double
  static constexpr int kNotFinite = 1 << 20;  // above every exponent with its bias

  // The least e with |term| < 2^e, plus the bias: greater than 0.
  static __device__ int exponent_of(double term) {
    if (!is_finite(term)) return kNotFinite;
    int exponent = 0;
    frexp(term, &exponent);
    return term == 0 ? 0 : exponent + kBias;
  }
};

}  // namespace cuda
}  // namespace dsmoe

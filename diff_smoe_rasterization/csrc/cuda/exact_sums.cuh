// Sums of a few numbers for each Gaussian, in any order of their terms by atomics, or exactly: then they are the same
// bits in any order, if nothing bounds a term beforehand. For these a walk over the pixels finds the largest term of
// each sum, and a second walk adds the terms as integers. Their unit is a power of two, so far below the largest term
// that the sum of as many terms as there may be just fits 64 bits: a term of 2^-40 of the largest one still counts in
// an image of some megapixels.
#pragma once

#include <type_traits>

#include "dsmoe/passes/pass.h"
#include "exponents.cuh"
#include "tuning.cuh"

namespace dsmoe {
namespace cuda {

template <class S> struct AtomicSums {
  SumTargets<S> to;

  bool is_first_walk() const { return true; }
  __device__ void add(int number, int32_t gaussian, S term) const { atomicAdd(to.numbers[number] + gaussian, term); }
};

// A warp adds one term to each sum of a Gaussian that it meets.
template <class S> struct ExactSums {
  int64_t num_gaussians;     // N
  int32_t* exponents;        // [numbers, N] of the largest terms
  unsigned long long* sums;  // [numbers, N] signed, in units; null in the first walk
  int term_bits;             // log2 of the most terms that a sum can have

  static constexpr int32_t kNotFinite = INT32_MAX;

  bool is_first_walk() const { return sums == nullptr; }
  __device__ void add(int number, int32_t gaussian, S term) const {
    const int64_t at = number * num_gaussians + gaussian;
    if (sums == nullptr) {
      atomicMax(exponents + at, is_finite(term) ? exponent_of(term) : kNotFinite);
    } else if (term != S(0) && exponents[at] != kNotFinite) {
      const S units = rint(scaled_by_power(term, -unit(exponents[at])));
      atomicAdd(sums + at, static_cast<unsigned long long>(static_cast<long long>(units)));
    }
  }

  // A sum as a number; NaN if a term was not finite.
  __device__ S sum(int number, int64_t gaussian) const {
    const int64_t at = number * num_gaussians + gaussian;
    if (exponents[at] == kNotFinite) return S(NAN);
    const auto units = static_cast<double>(static_cast<long long>(sums[at]));
    return units == 0 ? S(0) : static_cast<S>(ldexp(units, unit(exponents[at])));
  }

 private:
  // The exponent of the unit: |term| < 2^exponent, and |sum| < 2^62 units.
  __device__ int unit(int32_t exponent) const { return exponent + term_bits - 62; }
};

template <class S>
__global__ void __launch_bounds__(kStoreBlock)
    store_exact_sums_kernel(const __grid_constant__ ExactSums<S> sums, const __grid_constant__ SumTargets<S> to) {
  const int64_t i = int64_t(blockIdx.x) * kStoreBlock + threadIdx.x;
  if (i >= sums.num_gaussians) return;
  for (int number = 0; number < to.count; ++number) to.numbers[number][i] = sums.sum(number, i);
}

// Calls walk(sums) twice, with ExactSums, and writes the sums that it has added up.
template <class S, class Walk>
void sum_exactly(const Frame<S>& frame, const SumTargets<S>& to, const Work& work, Walk walk) {
  ExactSums<S> sums = {};
  sums.num_gaussians = frame.inputs.num_gaussians;
  const int64_t size = sums.num_gaussians * to.count;
  const int64_t most_terms = num_tiles(frame.camera.width, frame.camera.height) * kWarpsPerTile;
  while (int64_t(1) << sums.term_bits < most_terms) ++sums.term_bits;
  const auto filled = [&](auto* memory, int byte) {
    memory = allocate<std::remove_pointer_t<decltype(memory)>>(*work.scratch, size);
    check(cudaMemsetAsync(memory, byte, size * sizeof(*memory), work.stream), "clearing sums");
    return memory;
  };
  constexpr int kVeryLow = 0x80;  // in every byte: a number far below every exponent
  sums.exponents = filled(sums.exponents, kVeryLow);
  walk(sums);
  sums.sums = filled(sums.sums, 0);
  walk(sums);
  store_exact_sums_kernel<S><<<blocks_for(sums.num_gaussians, kStoreBlock), kStoreBlock, 0, work.stream>>>(sums, to);
  DSMOE_CHECK_LAUNCH("store_exact_sums");
}

// Calls walk(sums) with AtomicSums, or as `sum_exactly` does if work.deterministic asks for it.
template <class S, class Walk>
void sum_terms(const Frame<S>& frame, const SumTargets<S>& to, const Work& work, Walk walk) {
  const size_t bytes = frame.inputs.num_gaussians * sizeof(S);
  if (bytes == 0) return;
  if (work.deterministic) return sum_exactly(frame, to, work, walk);
  for (int number = 0; number < to.count; ++number) {
    check(cudaMemsetAsync(to.numbers[number], 0, bytes, work.stream), "clearing sums");
  }
  walk(AtomicSums<S>{to});
}

}  // namespace cuda
}  // namespace dsmoe

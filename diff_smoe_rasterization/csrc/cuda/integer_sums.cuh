// Sums of integers in place of real numbers, for gradients that are the same bits every time: integers have the same
// sum in any order. A term is rounded to a whole number of units. The unit of a sum is a power of two, far below the
// most that the sum can be, so that the sum does not overflow. A term that is small even in these units leaves its rest
// to a second integer, so that a hardly visible Gaussian keeps its digits.
//
// The most that a sum can be, with the names of blend.h. A weight w is at most D, the pixel's denominator, so
// |w g'| <= |dL/df|. The pairs behind a pair weigh at most T (1 - alpha) together, so alpha / (1 - alpha) |R| is at
// most w max |u|, and
//
//   |alpha dL/dalpha| <= 2 max(1, lambda) (sum_f 2 |dL/df| max |c_f| + |dL/dW|)
//
// (2 |dL/dA| in a mode with tails, whose alpha image is A = W / D)
//
// with the largest gradient and the largest feature of the whole image. If alpha is clamped, dL/dpower is larger by
// o G / alpha. A moment has up to two factors of distance, which the footprint bounds; a sum has no more terms than the
// footprint has pixels.
#pragma once

#include "../dispatch.h"
#include "dsmoe/features.h"
#include "dsmoe/tiles.h"
#include "exponents.cuh"
#include "reduce.cuh"

namespace dsmoe {
namespace cuda {

// The most that a sum can be is this many units. Three bits are left for the sign and for rounding.
constexpr int kSumBits = 60;
// The rest of a term below the unit is counted in units of 2^-kRestBits: 2^24 rests of at most half a unit fit.
constexpr int kRestBits = 38;
// Terms of this many units or more have no rest that matters: the sums over a warp's pixels have 20 good bits in float.
// A double keeps every bit.
template <class S> constexpr S kNoRest = sizeof(S) == sizeof(float) ? S(1 << 21) : S(int64_t(1) << 53);

// What bounds the sums of one Gaussian, as exponents.
struct alignas(16) SumExtent {
  int16_t area;            // pixels of the footprint
  int16_t x, y;            // pixels from its centre
  int16_t steep;           // of the largest o G / alpha
  int16_t pull_x, pull_y;  // dpower/dmean
};

// Sums for each number of each Gaussian's record: the moments of dL/dpower, the gradients of the features and, if
// they are wanted, the sums of absolute gradients by the mean.
template <class S> struct IntegerSums {
  unsigned long long* sums;   // [N, length] signed; zero before
  unsigned long long* rests;  // [N, length] signed; zero before
  uint8_t* refused;           // [N, length] whether a term was NaN or infinite; zero before
  SumExtent* extents;         // [N]
  int32_t* exponents;         // [length] of the most that one pixel can add, without distances
  int num_features;           // F
  int length;                 // numbers a record

  // The exponent of the unit.
  __device__ int unit(const SumExtent& extent, int number) const {
    int most = exponents[number] + extent.area;
    if (number < kNumGateMoments) {
      constexpr unsigned kFactorsX = 0x184, kFactorsY = 0x910;  // two bits each: 1, x, y, x^2, x y, y^2
      most += extent.steep + static_cast<int>(kFactorsX >> 2 * number & 3) * extent.x +
              static_cast<int>(kFactorsY >> 2 * number & 3) * extent.y;
    } else if (number >= kNumGateMoments + num_features) {
      most += extent.steep + (number == kNumGateMoments + num_features ? extent.pull_x : extent.pull_y);
    }
    return most - kSumBits;
  }

  __device__ void add(int32_t gaussian, const SumExtent& extent, int number, S term) const {
    const int64_t at = int64_t(gaussian) * length + number;
    const S units = scaled_by_power(term, -unit(extent, number));
    if (!(abs(units) <= power_of_two(kSumBits + 2, S()))) {
      refused[at] = 1;
      return;
    }
    const S whole = rint(units);
    add_whole(sums + at, whole);
    if (abs(units) < kNoRest<S>) add_whole(rests + at, rint((units - whole) * power_of_two(kRestBits, S())));
  }

  // A sum as a number; NaN if a term was refused.
  __device__ S sum(int64_t gaussian, int number) const {
    const int64_t at = gaussian * length + number;
    if (refused[at]) return S(NAN);
    const auto value = [](unsigned long long number) { return static_cast<double>(static_cast<long long>(number)); };
    return static_cast<S>(
        ldexp(value(sums[at]) + ldexp(value(rests[at]), -kRestBits), unit(extents[gaussian], number)));
  }

 private:
  static __device__ void add_whole(unsigned long long* sum, S whole) {
    if (whole != S(0)) atomicAdd(sum, static_cast<unsigned long long>(static_cast<long long>(whole)));
  }
};

// What the bounds are made of.
template <class S> struct SumBounds {
  int64_t num_gaussians;         // N
  int width, height;             // of the image, pixels
  RasterConfig<S> config;        // the background is read
  SavedForward<S> saved;         // projected and features are read
  const int32_t* radii;          // [N] pixels; 0: the other arrays hold nothing for this Gaussian
  ImageGradients<S> dL_dimages;  // any may be null
  int32_t* gradients;            // [F + 1] exponents of the largest dL/dfeature and dL/dgate_sum
  int32_t* features;             // [feature_stride(F)] those of the largest features; both start below every exponent
};

// Each row of blocks goes through one image of gradients.
template <class S>
__global__ void __launch_bounds__(kStoreBlock) largest_gradients_kernel(const __grid_constant__ SumBounds<S> bounds) {
  const int num_features = bounds.config.num_features(), image = blockIdx.y;
  const int64_t pixels = int64_t(bounds.width) * bounds.height;
  const S* gradients = image == num_features ? bounds.dL_dimages.gate_sum
                                             : feature_image(bounds.config, bounds.dL_dimages, image, pixels);
  if (gradients == nullptr) return;
  S largest = S(0);
  for (int64_t i = int64_t(blockIdx.x) * kStoreBlock + threadIdx.x; i < pixels; i += int64_t(gridDim.x) * kStoreBlock) {
    const S size = abs(gradients[i]);
    if (is_finite(size)) largest = max(largest, size);
  }
  const int exponent = max_over_lanes(exponent_of(largest));
  if (threadIdx.x % kWarp == 0) atomicMax(bounds.gradients + image, exponent);
}

template <class S> __device__ SumExtent extent_of(const SumBounds<S>& bounds, const ProjectedGaussian<S>& gaussian) {
  const Sym2<S>& conic = gaussian.conic;
  // No pixel of the image is farther away than `farthest`, however long the ellipse is. A warp's square of pixels may
  // reach a little beyond either.
  const auto reach = [](S half_width, S mean, int size) {
    const S farthest = max(abs(mean), abs(S(size) - mean));
    return min(half_width, farthest) + S(kWarpTile);
  };
  const S x = reach(EllipseBand<S>({conic.yy, conic.xy, conic.xx}, gaussian.squared_reach).v_extent(), gaussian.mean.x,
                    bounds.width);
  const S y = reach(EllipseBand<S>(conic, gaussian.squared_reach).v_extent(), gaussian.mean.y, bounds.height);
  const S area = min(S(2) * x, S(bounds.width)) * min(S(2) * y, S(bounds.height));
  const auto exponent = [](S value) { return static_cast<int16_t>(exponent_of(value)); };
  return {exponent(area),
          exponent(x),
          exponent(y),
          max(int16_t(0), exponent(gaussian.opacity / S(kAlphaMax))),
          exponent(abs(conic.xx) * x + abs(conic.xy) * y),
          exponent(abs(conic.xy) * x + abs(conic.yy) * y)};
}

// Writes the extents of all Gaussians that were seen, and finds their largest features.
template <class S>
__global__ void __launch_bounds__(kStoreBlock)
    extents_kernel(const __grid_constant__ SumBounds<S> bounds, SumExtent* extents) {
  __shared__ int32_t shared[kFeatureChunk];
  const int stride = feature_stride(bounds.config.num_features());
  for (int first = 0; first < stride; first += kFeatureChunk) {
    if (threadIdx.x < kFeatureChunk) shared[threadIdx.x] = kNoExponent;
    __syncthreads();
    S largest[kFeatureChunk] = {};
    for (int64_t i = int64_t(blockIdx.x) * kStoreBlock + threadIdx.x; i < bounds.num_gaussians;
         i += int64_t(gridDim.x) * kStoreBlock) {
      if (bounds.radii[i] <= 0) continue;
      if (first == 0) extents[i] = extent_of(bounds, bounds.saved.projected[i]);
      struct alignas(16) Chunk {
        S values[kFeatureChunk];
      };
      const Chunk chunk = *reinterpret_cast<const Chunk*>(bounds.saved.features + i * stride + first);
      for (int f = 0; f < kFeatureChunk; ++f) largest[f] = max(largest[f], abs(chunk.values[f]));
    }
    for (int f = 0; f < kFeatureChunk; ++f) {
      const int exponent = max_over_lanes(exponent_of(largest[f]));
      if (threadIdx.x % kWarp == 0) atomicMax(shared + f, exponent);
    }
    __syncthreads();
    if (threadIdx.x < kFeatureChunk) atomicMax(bounds.features + first + threadIdx.x, shared[threadIdx.x]);
  }
}

// One block: from the largest gradients and features to the most that a pixel can add to each number.
template <class S>
__global__ void __launch_bounds__(kStoreBlock)
    sum_exponents_kernel(const __grid_constant__ SumBounds<S> bounds, const IntegerSums<S> sums) {
  const RasterConfig<S>& config = bounds.config;
  const int num_features = config.num_features();
  const auto gradient = [&](int image) { return max(kNoExponent, bounds.gradients[image]); };
  for (int number = threadIdx.x; number < sums.length; number += kStoreBlock) {
    if (number >= kNumGateMoments && number < kNumGateMoments + num_features) {
      sums.exponents[number] = gradient(number - kNumGateMoments) + 1;  // w may exceed D by its rounding
      continue;
    }
    int most = gradient(num_features) + has_tails(config.blend.mode);  // its alpha image is like a feature of 1
    for (int f = 0; f < num_features; ++f) {
      const S background = abs(feature_background(config, f));
      int feature = max(kNoExponent, bounds.features[f]);
      if (is_finite(background)) feature = max(feature, exponent_of(background));
      most = max(most, gradient(f) + feature + 1);
    }
    const S gate = config.blend.lambda();
    const int terms = 32 - __clz(num_features);  // log2 of num_features + 1, rounded up
    sums.exponents[number] = most + terms + 1 + (gate > S(1) && is_finite(gate) ? exponent_of(gate) : 0) + 1;
  }
}

template <class S> struct IntegerRecords {
  int64_t num_gaussians;  // N
  const int32_t* radii;   // [N] pixels; 0 if no record is wanted
  IntegerSums<S> sums;    // read
  S* records;             // [N, length] written if there is a radius
};

template <class S>
__global__ void __launch_bounds__(kStoreBlock)
    store_records_kernel(const __grid_constant__ IntegerRecords<S> arguments) {
  const int64_t at = int64_t(blockIdx.x) * kStoreBlock + threadIdx.x, gaussian = at / arguments.sums.length;
  if (gaussian >= arguments.num_gaussians || arguments.radii[gaussian] <= 0) return;
  arguments.records[at] = arguments.sums.sum(gaussian, static_cast<int>(at % arguments.sums.length));
}

// Zeroes the sums and finds their units.
template <class S>
IntegerSums<S> begin_integer_sums(const Frame<S>& frame, const Gradients<S>& gradients, const Work& work) {
  constexpr unsigned kBlocks = 512;  // a few for each multiprocessor: each ends with atomics to the same numbers
  const cudaStream_t stream = work.stream;
  const int num_features = frame.config.num_features(), stride = feature_stride(num_features);
  const int64_t count = frame.inputs.num_gaussians;
  Scratch& scratch = *work.scratch;
  const auto filled = [&](auto* numbers, int64_t size, int byte) {
    numbers = allocate<std::remove_pointer_t<decltype(numbers)>>(scratch, size);
    if (size > 0) check(cudaMemsetAsync(numbers, byte, size * sizeof(*numbers), stream), "clearing gradients");
    return numbers;
  };
  IntegerSums<S> sums = {};
  sums.num_features = num_features;
  sums.length = kNumGateMoments + num_features + (gradients.inputs.means2D_abs != nullptr ? kNumAbsoluteSums : 0);
  sums.sums = filled(sums.sums, 2 * count * sums.length, 0);
  sums.rests = sums.sums + count * sums.length;
  sums.refused = filled(sums.refused, count * sums.length, 0);
  sums.extents = allocate<SumExtent>(scratch, count);
  sums.exponents = allocate<int32_t>(scratch, sums.length);
  SumBounds<S> bounds = {};
  bounds.num_gaussians = count;
  bounds.width = frame.camera.width, bounds.height = frame.camera.height;
  bounds.config = frame.config;
  bounds.saved = frame.saved;
  bounds.radii = frame.images.radii;
  bounds.dL_dimages = gradients.images;
  constexpr int kVeryLow = 0x80;  // in every byte: a number far below kNoExponent
  bounds.gradients = filled(bounds.gradients, num_features + 1 + stride, kVeryLow);
  bounds.features = bounds.gradients + num_features + 1;
  const dim3 images(kBlocks, num_features + 1);
  largest_gradients_kernel<<<images, kStoreBlock, 0, stream>>>(bounds);
  DSMOE_CHECK_LAUNCH("largest_gradients");
  extents_kernel<<<kBlocks, kStoreBlock, 0, stream>>>(bounds, sums.extents);
  DSMOE_CHECK_LAUNCH("extents");
  sum_exponents_kernel<<<1, kStoreBlock, 0, stream>>>(bounds, sums);
  DSMOE_CHECK_LAUNCH("sum_exponents");
  return sums;
}

// Writes the sums to the records.
template <class S>
void store_integer_sums(const Frame<S>& frame, const IntegerSums<S>& sums, S* records, const Work& work) {
  const int64_t count = frame.inputs.num_gaussians;
  if (count == 0) return;
  const unsigned blocks = blocks_for(count * sums.length, kStoreBlock);
  store_records_kernel<<<blocks, kStoreBlock, 0, work.stream>>>(
      IntegerRecords<S>{count, frame.images.radii, sums, records});
  DSMOE_CHECK_LAUNCH("store_records");
}

}  // namespace cuda
}  // namespace dsmoe

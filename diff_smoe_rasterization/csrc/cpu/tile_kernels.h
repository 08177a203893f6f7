// The blend of one tile, its backward pass, and the sums that score Gaussians. These are compiled once per instruction
// set, and chosen at run time.
#pragma once

#include <cstdint>

#include "dsmoe/params.h"
#include "dsmoe/passes/contributions.h"
#include "dsmoe/passes/gate_map.h"
#include "dsmoe/passes/importance.h"

namespace dsmoe {
namespace cpu {

constexpr int kTilePixels = kTileSize * kTileSize;

// A tile and its list.
template <class S> struct Tile {
  const RasterConfig<S>& config;
  const SavedForward<S>& saved;
  int width, height;   // of the image, pixels
  int x, y;            // of the tile, tiles
  int64_t index;       // of the tile in the image
  int64_t begin, end;  // its instances
};

// Further inputs and outputs of a tile's backward pass.
template <class S> struct TileGradients {
  const ImageOutputs<S>& images;
  const ImageGradients<S>& dL_dimages;
  S* dL_dinstances;       // [I, record_size(F, absolute)] by slot; the tile's are written whole
  S* dL_dbackground;      // [tiles, C + 1] the shares of all tiles, zero before; or null
  bool absolute = false;  // records end with sums of absolute gradients by the mean
};

// Numbers that the backward pass of a tile writes for an instance.
constexpr int record_size(int num_features, bool absolute) {
  return kNumGateMoments + num_features + (absolute ? kNumAbsoluteSums : 0);
}

constexpr int kImportanceArrays = 8;  // numbers a pixel, in addition to its channels

// Numbers of scratch memory that one tile needs, for any of the kernels: for each pixel its features and at most six
// others, and for each feature the largest pack.
inline int64_t tile_scratch_size(int num_features) {
  return static_cast<int64_t>(kTilePixels) * (num_features + 6) + 16 * num_features;
}

// records: [I] the sums of a pass by slot; those of the tile are written whole. Null without sums.
template <class S, class Pass>
using PassKernel = int64_t (*)(const Tile<S>& tile, const Pass& pass, typename Pass::template Sums<S>* records,
                               S* scratch);

template <class... Passes> struct PassList {};
template <class S> using AllPasses = PassList<ContributionPass<S>, ImportancePass<S>, GateMapPass<S>>;

template <class S, class Pass> struct KernelOfPass { PassKernel<S, Pass> kernel; };
template <class S, class List> struct KernelsOfPasses;
template <class S, class... Passes> struct KernelsOfPasses<S, PassList<Passes...>> : KernelOfPass<S, Passes>... {};

// All return the number of (Gaussian, pixel) pairs whose exponent they evaluated. scratch: 64-byte aligned.
template <class S> struct TileKernels {
  int64_t (*forward)(const Tile<S>& tile, const ImageOutputs<S>& images, S* scratch);
  int64_t (*backward)(const Tile<S>& tile, const TileGradients<S>& gradients, S* scratch);
  KernelsOfPasses<S, AllPasses<S>> passes;

  template <class Pass> PassKernel<S, Pass> of_pass() const {
    return static_cast<const KernelOfPass<S, Pass>&>(passes).kernel;
  }
};

// Those of each instruction set that the compiler can build for. Double has none of AVX-512, nor much optimization
// (CMakeLists.txt): nobody trains in it, and it would take as long to compile as float.
extern const TileKernels<float> kBaselineFloat;
extern const TileKernels<double> kBaselineDouble;
#if defined(__x86_64__)
extern const TileKernels<float> kAvx2Float, kAvx512Float;
extern const TileKernels<double> kAvx2Double;
#endif

struct SimdLevel {
  const char* name;
  const TileKernels<float>& float_kernels;
  const TileKernels<double>& double_kernels;
};
constexpr SimdLevel kBaselineLevel = {"baseline", kBaselineFloat, kBaselineDouble};
#if defined(__x86_64__)
constexpr SimdLevel kAvx2Level = {"avx2", kAvx2Float, kAvx2Double};
constexpr SimdLevel kAvx512Level = {"avx512", kAvx512Float, kAvx2Double};
#endif

// The best level that this processor has, or the lower one that DSMOE_SIMD names; decided once.
const SimdLevel& current_simd_level();

template <class S> const TileKernels<S>& tile_kernels();
template <> inline const TileKernels<float>& tile_kernels() { return current_simd_level().float_kernels; }
template <> inline const TileKernels<double>& tile_kernels() { return current_simd_level().double_kernels; }

}  // namespace cpu
}  // namespace dsmoe

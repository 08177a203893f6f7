// The rasterizer's public C++ interface, CPU backend: no torch, no allocation of results, float and double.
//
//   SavedForward and ImageOutputs point to memory of the caller's, sized as params.h says, except `instances`, whose
//   size the first stage returns:
//
//     int64_t count = cpu::project(inputs, camera, config, saved, images);   // projected, features, offsets, radii
//     saved.instances = ... [count];
//     cpu::bin(inputs.num_gaussians, camera, config, saved, images.radii);   // tile lists, front to back
//     cpu::blend(camera, config, saved, images);                             // the images
//     cpu::backward(inputs, camera, config, saved, images, image_gradients, gradients);
//     cpu::contributions(inputs.num_gaussians, width, height, config, saved, pixel_weights, sums);  // of each Gaussian
//
// Results do not depend on config.num_threads, bit for bit.
#pragma once

#include <cstdint>

#include "dsmoe/params.h"
#include "dsmoe/tiles.h"

namespace dsmoe {

inline int64_t num_tiles(int width, int height) {
  const TileGrid grid(width, height);
  return static_cast<int64_t>(grid.columns) * grid.rows;
}

namespace cpu {

// Seconds of each stage, and the work the blend did, of the calls that were given this struct.
struct StageTimes {
  double project = 0, sort = 0, bin = 0, blend = 0;
  double blend_backward = 0, project_backward = 0;
  int64_t forward_pairs = 0, backward_pairs = 0;  // (Gaussian, pixel) pairs whose exponent was evaluated
};

// Throws std::overflow_error, naming the count, where the instances do not fit 32-bit slots.
template <class S>
int64_t project(const GaussianInputs<S>& inputs, const Camera<S>& camera, const RasterConfig<S>& config,
                const SavedForward<S>& saved, const ImageOutputs<S>& images, StageTimes* times = nullptr);

template <class S>
void bin(int64_t num_gaussians, const Camera<S>& camera, const RasterConfig<S>& config, const SavedForward<S>& saved,
         const int32_t* radii, StageTimes* times = nullptr);

template <class S>
void blend(const Camera<S>& camera, const RasterConfig<S>& config, const SavedForward<S>& saved,
           const ImageOutputs<S>& images, StageTimes* times = nullptr);

template <class S>
void backward(const GaussianInputs<S>& inputs, const Camera<S>& camera, const RasterConfig<S>& config,
              const SavedForward<S>& saved, const ImageOutputs<S>& images, const ImageGradients<S>& image_gradients,
              const GaussianGradients<S>& gradients, StageTimes* times = nullptr);

// Walks the tile lists once more, and sums what the pixels of each Gaussian say. pixel_weights: [H, W]. Of config it
// reads the mode, alpha_min, the background's gate and num_threads; of saved neither features nor images but
// last_contributor.
template <class S>
void contributions(int64_t num_gaussians, int width, int height, const RasterConfig<S>& config,
                   const SavedForward<S>& saved, const S* pixel_weights, const ContributionSums<S>& sums);

// Marks the Gaussians in front of the near plane. visible: [N].
template <class S> void mark_visible(int64_t num_gaussians, const S* means3D, const Camera<S>& camera, bool* visible);

// The first Gaussian with an attribute that is NaN or infinite, or -1.
template <class S> int64_t first_non_finite(const GaussianInputs<S>& inputs, int num_channels);

// The instruction set that the blend uses: "avx512", "avx2" or "baseline". DSMOE_SIMD=name asks for a lower one.
const char* simd_level();

}  // namespace cpu
}  // namespace dsmoe

// The rasterizer's public C++ interface, CUDA backend: no torch, float and double, every call asynchronous on the
// caller's stream. All pointers are device pointers, to memory of the caller's.
//
//     cuda::project(inputs, camera, config, saved, images, keys, stream);                     // footprints, colours
//     cuda::sort_by_depth(inputs.num_gaussians, keys, saved.order, scratch, stream);
//     saved.instances = ... [capacity, saved.instance_width]; saved.capacity = capacity;
//     cuda::bin(inputs.num_gaussians, camera, config, saved, images.radii, scratch, stream);  // tile lists
//     cuda::blend(inputs.num_gaussians, camera, config, saved, images, pairs, stream);        // the images
//     cuda::blend_backward(...); cuda::project_backward(...);                                 // the gradients
//     cuda::contributions(...);                                                               // scores of Gaussians
//
// A capacity that turns out too small costs time, not correctness: where the instances do not fit, the blend reads the
// depth order itself instead of the tile lists. So the host never has to wait, and a captured graph stays right when
// its inputs change.
//
// Errors are std::runtime_error: a launch that failed, and why.
#pragma once

#include <cstddef>
#include <cstdint>
#include <type_traits>

#include "dsmoe/params.h"

using cudaStream_t = struct CUstream_st*;  // as CUDA's own headers have it, which callers without CUDA lack

namespace dsmoe {
namespace cuda {

// A camera whose matrices stay in device memory.
template <class S> struct DeviceCamera {
  int width = 0, height = 0;
  S tan_fov_x = 0, tan_fov_y = 0;
  S near = S(0.2);
  const S* view = nullptr;        // [4, 4]
  const S* projection = nullptr;  // [4, 4]
  const S* position = nullptr;    // [3]
};

// Numbers between the rows of `features`: rows begin at multiples of four, so that they load as vectors.
DSMOE_HD constexpr int feature_stride(int num_features) { return (num_features + 3) / 4 * 4; }

// Lists longer than this are walked in segments by the backward pass of float and three features, the rest whole.
constexpr int kSegmentLength = 512;
constexpr int kSegmentFeatures = 3;
constexpr int kSegmentRow = kTileSize * kTileSize * (1 + kSegmentFeatures);  // numbers
DSMOE_HD constexpr int64_t num_segment_rows(int64_t capacity) { return capacity / kSegmentLength + 1; }
DSMOE_HD constexpr int64_t num_queue_entries(int64_t capacity) { return 1 + 4 * num_segment_rows(capacity); }

// What the forward pass leaves for the backward pass; rows of culled Gaussians hold anything.
template <class S> struct SavedForward {
  ProjectedGaussian<S>* projected = nullptr;  // [N]
  S* features = nullptr;                      // [N, feature_stride(F)]
  int32_t* order = nullptr;                   // [N] Gaussians, nearest first; culled ones last, Gaussian i as ~i
  int64_t* tile_offsets = nullptr;            // [tiles + 1] first instance of each tile
  int64_t* num_instances = nullptr;           // [1] how many there are; those beyond the capacity are not listed
  int32_t* instances = nullptr;               // [capacity, instance_width] Gaussian (and slot) by tile, front to back
  int64_t capacity = 0;
  int instance_width = 1;            // 2: with slots, for gradients that are bitwise reproducible
  int64_t* slot_ranges = nullptr;    // [N, 2] each Gaussian's slots, begin and end; null without slots
  S* segments = nullptr;             // [num_segment_rows(capacity), kSegmentRow] long lists' states on the way, or null
  int32_t* segment_queue = nullptr;  // [num_queue_entries(capacity), 2] which segments some pixel has reached, or null
  S* final_transmittance = nullptr;
  S* gate_sum = nullptr;
  int32_t* last_contributor = nullptr;  // [H, W] how many entries of the list the numerator has seen
};

// Memory for the duration of one call, or null where there is none left; the caller frees it in the stream's order.
class Scratch {
 public:
  virtual void* allocate(size_t bytes) = 0;

 protected:
  ~Scratch() = default;
};

// The bits of a positive float, read as an integer, are in the order of the float.
template <class S> using DepthBits = std::conditional_t<sizeof(S) == 4, uint32_t, uint64_t>;

// What the depth sort sorts.
template <class S> struct DepthKeys {
  DepthBits<S>* depths = nullptr;  // [N] the greatest number for culled Gaussians; null: no depth order is wanted
  int32_t* gaussians = nullptr;    // [N] 0, 1, 2, ...; ~i for a culled Gaussian i
};

// Whether the mode needs saved.order by depth. Where not, project gets saved.order itself as keys.gaussians, and
// culled ones keep their places.
bool needs_depth_order(BlendMode mode);

// Fills saved.projected, saved.features, images.radii and keys.
template <class S>
void project(const GaussianInputs<S>& inputs, const DeviceCamera<S>& camera, const RasterConfig<S>& config,
             const SavedForward<S>& saved, const ImageOutputs<S>& images, const DepthKeys<S>& keys,
             cudaStream_t stream);

// Fills order [N].
template <class S>
void sort_by_depth(int64_t num_gaussians, const DepthKeys<S>& keys, int32_t* order, Scratch& scratch,
                   cudaStream_t stream);

// Fills saved.num_instances alone, for a caller that wants exactly as much memory as is needed.
template <class S>
void count_instances(int64_t num_gaussians, const DeviceCamera<S>& camera, const RasterConfig<S>& config,
                     const SavedForward<S>& saved, const int32_t* radii, Scratch& scratch, cudaStream_t stream);

// Fills saved.num_instances, instances, tile_offsets and slot_ranges, and empties segment_queue.
template <class S>
void bin(int64_t num_gaussians, const DeviceCamera<S>& camera, const RasterConfig<S>& config,
         const SavedForward<S>& saved, const int32_t* radii, Scratch& scratch, cudaStream_t stream);

// pairs: where not null, the number of (Gaussian, pixel) pairs that were evaluated is added to it.
template <class S>
void blend(int64_t num_gaussians, const DeviceCamera<S>& camera, const RasterConfig<S>& config,
           const SavedForward<S>& saved, const ImageOutputs<S>& images, unsigned long long* pairs, cudaStream_t stream);

// From image gradients to one record per Gaussian: the sums over its pixels, [N, kNumGateMoments + F], which must be
// zero before. slots: [capacity, kSlotsPerInstance, kNumGateMoments + F], also zero, which take the place of the
// records where the instances fit; or null. dL_dbackground: [C + 1], or null. pairs: as above.
template <class S>
void blend_backward(int64_t num_gaussians, const DeviceCamera<S>& camera, const RasterConfig<S>& config,
                    const SavedForward<S>& saved, const ImageOutputs<S>& images,
                    const ImageGradients<S>& image_gradients, S* dL_dgaussians, S* slots, S* dL_dbackground,
                    Scratch& scratch, unsigned long long* pairs, cudaStream_t stream);
constexpr int kSlotsPerInstance = 4;  // one for each quarter of a tile

// From the records to the gradients of every input.
template <class S>
void project_backward(const GaussianInputs<S>& inputs, const DeviceCamera<S>& camera, const RasterConfig<S>& config,
                      const SavedForward<S>& saved, const int32_t* radii, const S* dL_dgaussians, const S* slots,
                      const GaussianGradients<S>& gradients, Scratch& scratch, cudaStream_t stream);

// Walks the tile lists once more, and sums what the pixels of each Gaussian say, by atomics: the sums of real numbers
// may differ in their last digits from call to call. pixel_weights: [H, W]. Of config it reads the mode, alpha_min and
// the background's gate; of saved neither features nor images but last_contributor; of images the radii.
template <class S>
void contributions(int64_t num_gaussians, int width, int height, const RasterConfig<S>& config,
                   const SavedForward<S>& saved, const ImageOutputs<S>& images, const S* pixel_weights,
                   const ContributionSums<S>& sums, cudaStream_t stream);

// Marks the Gaussians in front of the near plane. visible: [N].
template <class S>
void mark_visible(int64_t num_gaussians, const S* means3D, const S* view, S near, bool* visible, cudaStream_t stream);

}  // namespace cuda
}  // namespace dsmoe

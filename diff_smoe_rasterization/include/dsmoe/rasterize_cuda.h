// The rasterizer's public C++ interface, CUDA backend: no torch, float and double, every call asynchronous on the
// caller's stream. All pointers are device pointers, to memory of the caller's.
//
//     cuda::Frame<float> frame;                   // fill inputs, camera, config and images
//     cuda::StreamMemory memory(stream);          // or an Allocator of your own
//     cuda::forward(frame, {stream}, memory);     // the images, and what the backward pass needs
//     cuda::backward(frame, gradients, {stream}, memory);
//
// To project on one device and blend on another, call the two halves, as in rasterize.h: `project_footprints`,
// `blend_footprints`, `blend_footprints_backward`, `project_footprints_backward`.
//
// The stages that all these run, in their order, are declared below and can be called one by one.
//
// A capacity that turns out too small costs time, not correctness: if the instances do not fit, the blend reads the
// depth order itself instead of the tile lists. So the host never has to wait, and a captured graph stays right when
// its inputs change.
//
// A launch that failed is a std::runtime_error that says why. Null pointers and numbers out of range are a
// std::invalid_argument, which names them and what would be right. Of the stages only `contributions`, `importance`,
// `gate_map`, `mark_visible` and those of batches look.
#pragma once

#include <cstddef>
#include <cstdint>
#include <vector>

#include "dsmoe/allocator.h"
#include "dsmoe/depth_bits.h"
#include "dsmoe/features.h"
#include "dsmoe/params.h"
#include "dsmoe/passes/contributions.h"
#include "dsmoe/passes/gate_map.h"

using cudaStream_t = struct CUstream_st*;  // as in CUDA's own headers, which a caller need not have

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
  Lens<S> lens;                   // as Camera has it, on the host
  Shutter shutter = Shutter::kGlobal;
  const S* view_end = nullptr;  // [4, 4] with a rolling shutter; else it is not read
};

// Numbers between the rows of `features`: rows begin at multiples of four, so that they load as vectors.
DSMOE_HD constexpr int feature_stride(int num_features) { return (num_features + 3) / 4 * 4; }

// The backward pass of float and kFastFeatures features walks lists longer than this in segments. All others it walks
// whole, and all lists if Run::deterministic is set: a segment begins with another rounding of T than a whole walk
// has there, and lists that do not fit their memory have no segments.
constexpr int kSegmentLength = 512;
constexpr int kSegmentRow = kTileSize * kTileSize * (1 + kFastFeatures);  // numbers
DSMOE_HD constexpr int64_t num_segment_rows(int64_t capacity) { return capacity / kSegmentLength + 1; }
DSMOE_HD constexpr int64_t num_queue_entries(int64_t capacity) { return 1 + 4 * num_segment_rows(capacity); }

// What the forward pass leaves for the backward pass; rows of culled Gaussians hold anything.
template <class S> struct SavedForward {
  ProjectedGaussian<S>* projected = nullptr;  // [N]
  S* features = nullptr;                      // [N, feature_stride(F)]
  int32_t* order = nullptr;                   // [N] Gaussians, nearest first; ~i is for a culled Gaussian i
  int64_t* num_ordered = nullptr;             // [1] entries of order; culled Gaussians have none in a depth order
  int64_t* tile_offsets = nullptr;            // [tiles + 1] first instance of each tile
  int32_t* tile_order = nullptr;              // [tiles] those with the longest lists first
  int64_t* num_instances = nullptr;           // [1] room that the lists need; if they have less, none is listed
  int32_t* instances = nullptr;               // [capacity] Gaussians by tile, front to back
  int64_t capacity = 0;              // 0: no lists are kept. Each pass makes them, for some rows of tiles at a time
  TileBand band;                     // the rows of tiles that tile_offsets and instances are of
  S* segments = nullptr;             // [num_segment_rows(capacity), kSegmentRow] long lists' states on the way, or null
  int32_t* segment_queue = nullptr;  // [num_queue_entries(capacity), 2] which segments some pixel has reached, or null
  S* final_transmittance = nullptr;  // [H, W] T_{N+1}; negative in wide pixels
  S* gate_sum = nullptr;             // [H, W] W; the caller's alpha image but in a mode with tails
  S* tails = nullptr;                // [H, W] B, in a mode with tails
  S* sums = nullptr;                 // [2, H, W] gate_sum and tails, in a mode with tails
  int32_t* last_contributor = nullptr;  // [H, W] how many entries of the list the numerator has seen
};

// The numbers that decide how long those arrays are.
struct SavedSizes {
  int64_t num_gaussians = 0;  // N
  int64_t num_features = 0;   // F; -1: not known
  int64_t tiles = 0;          // of the image
  int64_t pixels = 0;         // H W
  int64_t capacity = -1;      // of `instances`; -1: not known yet
  bool segments = false;      // the backward pass walks long lists in segments
  bool tails = false;         // the mode has them
};

// Calls visit(name, pointer, number of elements or -1) for each array; set_sums makes the others. All code that
// allocates, checks or passes on these arrays uses this list and its order. tile_offsets has num_ordered and
// num_instances behind it.
template <class S, class Visit> void for_each_array(SavedForward<S>& saved, const SavedSizes& sizes, Visit visit) {
  const bool known = sizes.capacity >= 0;
  const int64_t stride = sizes.num_features < 0 ? -1 : feature_stride(static_cast<int>(sizes.num_features));
  visit("projected", saved.projected, sizes.num_gaussians);
  visit("features", saved.features, stride < 0 ? -1 : sizes.num_gaussians * stride);
  visit("order", saved.order, sizes.num_gaussians);
  visit("tile_offsets", saved.tile_offsets, sizes.tiles + 3);
  visit("tile_order", saved.tile_order, sizes.tiles);
  visit("final_transmittance", saved.final_transmittance, sizes.pixels);
  visit("last_contributor", saved.last_contributor, sizes.pixels);
  visit("sums", saved.sums, sizes.tails ? 2 * sizes.pixels : 0);
  visit("instances", saved.instances, sizes.capacity);
  visit("segments", saved.segments, !sizes.segments ? 0 : known ? num_segment_rows(sizes.capacity) * kSegmentRow : -1);
  visit("segment_queue", saved.segment_queue, !sizes.segments ? 0 : known ? 2 * num_queue_entries(sizes.capacity) : -1);
}

// Sets the fields that are not arrays of their own. Call it when the arrays have their memory.
template <class S> void complete(SavedForward<S>& saved, const SavedSizes& sizes) {
  saved.num_ordered = saved.tile_offsets + sizes.tiles + 1;
  saved.num_instances = saved.num_ordered + 1;
  saved.capacity = sizes.capacity;
}

using dsmoe::Gradients;

// One rendering. All pointers are to memory of the device.
template <class S> using Frame = RenderingFrame<S, DeviceCamera<S>, SavedForward<S>>;

// How a pass runs.
struct Run {
  cudaStream_t stream = nullptr;
  bool deterministic = false;   // backward: gradients are equal bit for bit from run to run, whatever was rendered
                                // before; slower
  bool for_backward = true;     // false: what only makes a backward pass faster is left out
  StageTimes* times = nullptr;  // is added to, or null; the pass then waits for its kernels
};

// Renders frame.inputs to frame.images and fills frame.saved. A call waits for the number of instances (a) the first
// time for an image size, a mode and about so many Gaussians, (b) with `times`, (c) if the instances that it expects,
// with some room, exceed config.most_instances. So does every pass over a rendering with more instances than that.
template <class S> void forward(Frame<S>& frame, const Run& run, Allocator& memory);

// Writes gradients.inputs. `frame` is as `forward` left it.
template <class S>
void backward(const Frame<S>& frame, const Gradients<S>& gradients, const Run& run, Allocator& memory);

// How many tile instances a rendering of this size, blend mode (as a number) and about so many Gaussians had at most
// lately, as far as the current device has counted; -1 if nothing is known. Does not wait. A captured graph whose
// lists have less room is slow.
int64_t recent_instances(int64_t width, int64_t height, int64_t blend_mode, int64_t num_gaussians);

// Fills frame.images.radii as `forward` does, and nothing else.
template <class S> void radii(const Frame<S>& frame, const Run& run, Allocator& memory);

// Fills frame.saved.projected, frame.saved.features and frame.images.radii: the footprints. The caller allocates them.
template <class S> void project_footprints(const Frame<S>& frame, const Run& run, Allocator& memory);

// Renders the footprints that the caller has put there, and fills the rest of frame.saved and frame.images. Of
// frame.inputs it reads the number of Gaussians, of the camera the image's size. Footprints of equal depth are blended
// in their order. It waits and throws as `forward` does.
template <class S> void blend_footprints(Frame<S>& frame, const Run& run, Allocator& memory);

// Writes footprints.records, zeros if no pixel saw the footprint, and of gradients.inputs the background. `frame` is
// as `blend_footprints` left it.
template <class S>
void blend_footprints_backward(const Frame<S>& frame, const Gradients<S>& gradients,
                               const FootprintGradients<S>& footprints, const Run& run, Allocator& memory);

// Writes gradients, but for the background's, from those by the footprints that `project_footprints` filled; a
// footprint of radius 0 hands back zeros. Of frame.saved it reads the features.
template <class S>
void project_footprints_backward(const Frame<S>& frame, const FootprintGradients<S>& footprints,
                                 const GaussianGradients<S>& gradients, const Run& run, Allocator& memory);

// The sizes of what `forward` keeps. The capacity is not known yet.
template <class S> SavedSizes saved_sizes(const Frame<S>& frame, const Run& run) {
  SavedSizes sizes;
  sizes.num_gaussians = frame.inputs.num_gaussians;
  sizes.num_features = frame.config.num_features();
  sizes.tiles = num_tiles(frame.camera.width, frame.camera.height);
  sizes.pixels = static_cast<int64_t>(frame.camera.width) * frame.camera.height;
  sizes.segments =
      run.for_backward && !run.deterministic && sizeof(S) == sizeof(float) && sizes.num_features == kFastFeatures;
  sizes.tails = has_tails(frame.config.blend.mode);
  return sizes;
}

// Memory of the current device, from the pool of the stream, which must outlive the object. What is kept lasts as long
// as the object.
class StreamMemory final : public Allocator {
 public:
  explicit StreamMemory(cudaStream_t stream) : stream_(stream) {}
  StreamMemory(const StreamMemory&) = delete;
  StreamMemory& operator=(const StreamMemory&) = delete;
  ~StreamMemory();

  void* allocate(size_t bytes) override;
  void* keep(int index, const SavedArray& array) override;
  void release() override;

 private:
  cudaStream_t stream_;
  std::vector<void*> scratch_, kept_;
};

// Whether the mode needs saved.order to be the depth order. If it does not, `project` fills saved.order, if there is
// any, with 0, 1, 2, ..., and culled Gaussians keep their places.
bool needs_depth_order(BlendMode mode);

// How a stage runs.
struct Work {
  cudaStream_t stream = nullptr;
  Scratch* scratch = nullptr;           // for memory between its kernels
  unsigned long long* pairs = nullptr;  // in device memory; (Gaussian, pixel) pairs evaluated are added to it; or null
  bool deterministic = false;  // sums of `contributions` and `importance` are equal bit for bit from run to run
};

// Fills frame.saved.projected, frame.saved.features, frame.images.radii and depths. depths: [N] what the depth sort
// sorts, the greatest number for culled Gaussians; null if no depth order is wanted.
template <class S> void project(const Frame<S>& frame, DepthBits<S>* depths, const Work& work);

// Fills only frame.images.radii, if there are at most kMostHeldFeatures features.
constexpr int kMostHeldFeatures = 8;
template <class S> void project_radii(const Frame<S>& frame, const Work& work);

// Fills depths from the footprints, as `project` does.
template <class S> void key_footprints(const Frame<S>& frame, DepthBits<S>* depths, const Work& work);

// Fills frame.saved.order and frame.saved.num_ordered.
template <class S> void sort_by_depth(const Frame<S>& frame, const DepthBits<S>* depths, const Work& work);

// Fills only frame.saved.num_instances, for a caller that wants as much memory as is needed: with the number of
// instances or, if that is more, of entries in the lists of macro tiles (csrc/cuda/macro_lists.cu). work.scratch is
// needed.
template <class S> void count_instances(const Frame<S>& frame, const Work& work);

// Fills saved.num_instances, instances, tile_offsets and tile_order of the frame, and empties segment_queue.
template <class S> void bin(const Frame<S>& frame, const Work& work);

// Fills frame.images but the radii, and what saved has for each pixel. This pass and those below make the lists, band
// by band, if frame.saved.capacity is 0. In a mode with tails saved.sums is the caller's, and set_sums makes
// gate_sum and tails of it.
template <class S> void blend(const Frame<S>& frame, const Work& work);

// What goes through both stages of a backward pass.
template <class S> struct BackwardPass {
  Gradients<S> gradients;         // given by the images, wanted by the inputs
  bool deterministic = false;     // the records are equal bit for bit from run to run
  S* dL_dgaussians = nullptr;     // [N, kNumGateMoments + F] a Gaussian's record: the sums over its pixels; zero before
  bool by_footprints = false;     // the records are those of FootprintGradients: `finish_records` has been there
  const S* dL_ddepths = nullptr;  // [N] as FootprintGradients has them, or null
};
static_assert(kNumGateGradients == kNumGateMoments, "records keep their length");

// From image gradients to the records, and to the gradients by the background and by means2D_abs.
template <class S> void blend_backward(const Frame<S>& frame, const BackwardPass<S>& pass, const Work& work);

// Makes gradients by the footprints of the records, in place.
template <class S> void finish_records(const Frame<S>& frame, const BackwardPass<S>& pass, const Work& work);

// From the records to the gradients of every other input.
template <class S> void project_backward(const Frame<S>& frame, const BackwardPass<S>& pass, const Work& work);

// Walks the tile lists once more, and sums what the pixels of each Gaussian say, by atomics: the sums of real numbers
// may differ in their last digits from call to call, unless work.deterministic is set. Then it walks twice, and takes
// 36 bytes more for each Gaussian. Of the frame it reads the number of Gaussians, the image's size, of config the
// blend's rules and most_instances, of images the radii, and of saved all but features, segments, sums, gate_sum and
// tails. work.scratch is needed, here and in the next two.
template <class S> void contributions(const Frame<S>& frame, const ContributionMap<S>& map, const Work& work);

// Walks the tile lists once more, and sums what each Gaussian is worth to the image, by atomics as `contributions`.
// `frame` is as `forward` left it; of its images the radii are read, and through saved the gate sum.
template <class S> void importance(const Frame<S>& frame, const ImportanceMap<S>& map, const Work& work);

// Walks the tile lists once more, and finds in each pixel the Gaussian with the greatest gate. It reads of the frame
// what `contributions` does.
template <class S> void gate_map(const Frame<S>& frame, const GateMap& map, const Work& work);

// The first half for the views of a batch, as in rasterize.h. A row behind num_rows is neither written nor read.
using ViewBatch = dsmoe::ViewBatch<DeviceCamera<float>>;
void count_rows(const ViewBatch& batch, const Work& work);
void project_rows(const ViewBatch& batch, const Work& work);
void project_rows_backward(const ViewBatch& batch, const GaussianGradients<float>& gradients, const Work& work);

// Marks the Gaussians in front of the near plane, with a rolling shutter of either pose. Of the frame it reads means3D
// and the camera. visible: [N].
template <class S> void mark_visible(const Frame<S>& frame, bool* visible, const Work& work);

}  // namespace cuda
}  // namespace dsmoe

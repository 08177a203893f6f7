// The rasterizer's public C++ interface, CPU backend: no torch, float and double.
//
//     cpu::Frame<float> frame;                    // fill inputs, camera, config and images
//     cpu::Heap heap;                             // or an Allocator of your own
//     cpu::forward(frame, heap);                  // the images, and what the backward pass needs
//     cpu::backward(frame, gradients);            // from gradients by the images to gradients by the inputs
//
// To project on one device and blend on another, call the two halves:
//
//     cpu::project(frame);                        // the footprints: saved.projected, saved.features and images.radii
//     cpu::blend_footprints(other, heap);         // the images of some footprints, of several frames maybe
//     cpu::blend_footprints_backward(other, image_gradients, footprint_gradients);
//     cpu::project_backward(frame, footprint_gradients, gradients);
//
// The stages that all these run are declared below in their order. They can be called one by one. Then the caller
// allocates what `saved` points to.
//
// Null pointers and numbers out of range are a std::invalid_argument, which names them and what would be right. The
// stages `count_instances`, `bin` and `blend` do not look.
//
// Results do not depend on config.num_threads, bit for bit.
#pragma once

#include <cstdint>
#include <vector>

#include "dsmoe/allocator.h"
#include "dsmoe/params.h"
#include "dsmoe/passes/contributions.h"
#include "dsmoe/passes/gate_map.h"

namespace dsmoe {
namespace cpu {

using dsmoe::Gradients;

// One rendering. All pointers are to memory of the host.
template <class S> using Frame = RenderingFrame<S, Camera<S>, SavedForward<S>>;

// Renders frame.inputs to frame.images and fills frame.saved. times: is added to, or null.
// If there are more than config.most_instances, no lists are kept, and each pass makes them band by band.
// Throws std::bad_alloc, and what `bin` throws.
template <class S> void forward(Frame<S>& frame, Allocator& memory, StageTimes* times = nullptr);

// Writes gradients.inputs. `frame` is as `forward` left it.
template <class S> void backward(const Frame<S>& frame, const Gradients<S>& gradients, StageTimes* times = nullptr);

// Renders the footprints that the caller has put into frame.saved.projected, frame.saved.features and
// frame.images.radii, and fills the rest of frame.saved and frame.images. Of frame.inputs it reads the number of
// Gaussians, of the camera the image's size. Footprints of equal depth are blended in their order. Throws as `forward`.
template <class S> void blend_footprints(Frame<S>& frame, Allocator& memory, StageTimes* times = nullptr);

// Writes footprints.records, zeros if no pixel saw the footprint, and of gradients.inputs the background. `frame` is
// as `blend_footprints` left it.
template <class S>
void blend_footprints_backward(const Frame<S>& frame, const Gradients<S>& gradients,
                               const FootprintGradients<S>& footprints, StageTimes* times = nullptr);

// Writes gradients, but for the background's, from those by the footprints that `project` filled; a footprint of
// radius 0 hands back zeros. Of frame.saved it reads the features.
template <class S>
void project_backward(const Frame<S>& frame, const FootprintGradients<S>& footprints,
                      const GaussianGradients<S>& gradients, StageTimes* times = nullptr);

// Fills frame.images.radii as `forward` does, and nothing else.
template <class S> void radii(const Frame<S>& frame, Scratch& scratch);

// The first half for the views of a batch. A caller counts the rows, allocates them, and has them filled.
using ViewBatch = dsmoe::ViewBatch<Camera<float>>;

// Fills radii and offsets of each view.
void count_rows(const ViewBatch& batch);

// Fills gates and features of each view, and corrects its radii: kCulledInRow.
void project_rows(const ViewBatch& batch);

// Writes gradients, sums over the views in their order, and means2D of each view, from the records. gradients: those
// by means3D, opacities, scales, rotations, dc and shs.
void project_rows_backward(const ViewBatch& batch, const GaussianGradients<float>& gradients);

// The sizes of what `forward` keeps. How many instances there are is not known yet.
template <class S> SavedSizes saved_sizes(const Frame<S>& frame) {
  SavedSizes sizes;
  sizes.num_gaussians = frame.inputs.num_gaussians;
  sizes.num_features = frame.config.num_features();
  sizes.tiles = num_tiles(frame.camera.width, frame.camera.height);
  sizes.pixels = static_cast<int64_t>(frame.camera.width) * frame.camera.height;
  sizes.tails = has_tails(frame.config.blend.mode);
  return sizes;
}

// Memory of the host. Everything lasts as long as the object.
class Heap final : public Allocator {
 public:
  Heap() = default;
  Heap(const Heap&) = delete;
  Heap& operator=(const Heap&) = delete;
  ~Heap();

  void* allocate(size_t bytes) override;
  void* keep(int index, const SavedArray& array) override;
  void release() override;

 private:
  std::vector<void*> blocks_;
};

// Fills what frame.saved has for each Gaussian, and frame.images.radii. Returns how many instances there are; 0 if
// saved.instance_offsets is null, because they are not counted then.
template <class S> int64_t project(const Frame<S>& frame, StageTimes* times = nullptr);

// Fills saved.instance_offsets from the footprints. Returns what `project` does.
template <class S> int64_t count_instances(const Frame<S>& frame, StageTimes* times = nullptr);

// Fills saved.tile_offsets and saved.instances: the tile lists, front to back. Throws std::overflow_error, naming the
// count, if the instances do not fit 32-bit slots.
template <class S> void bin(const Frame<S>& frame, StageTimes* times = nullptr);

// Fills frame.images but the radii, and what saved has for each pixel.
// In a mode with tails saved.sums is the caller's, and set_sums makes gate_sum and tails of it.
template <class S> void blend(const Frame<S>& frame, StageTimes* times = nullptr);

// Walks the tile lists once more, and sums what the pixels of each Gaussian say. Of the frame it reads the number of
// Gaussians and the image's size; of config the blend's rules, num_threads and most_instances; of saved all
// but features, sums, gate_sum and tails; and of images the radii, if no lists are kept.
template <class S> void contributions(const Frame<S>& frame, const ContributionMap<S>& map);

// Walks the tile lists once more, and sums what each Gaussian is worth to the image. `frame` is as `forward` left it;
// of its images the gate sum is read, through saved, and the radii if no lists are kept.
template <class S> void importance(const Frame<S>& frame, const ImportanceMap<S>& map);

// Walks the tile lists once more, and finds in each pixel the Gaussian with the greatest gate. It reads of the frame
// what `contributions` does.
template <class S> void gate_map(const Frame<S>& frame, const GateMap& map);

// Marks the Gaussians in front of the near plane, with a rolling shutter of either pose. Of the frame it reads means3D
// and the camera. visible: [N].
template <class S> void mark_visible(const Frame<S>& frame, bool* visible);

// The instruction set that the blend uses: "avx512", "avx2" or "baseline". DSMOE_SIMD=name asks for a lower one.
const char* simd_level();

}  // namespace cpu
}  // namespace dsmoe

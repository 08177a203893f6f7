// Torch tensors as the CUDA backend's structs of pointers, and torch's allocator as its scratch memory.
#pragma once

#include <vector>

#include "dsmoe/rasterize_cuda.h"
#include "tensors.h"

namespace dsmoe {
namespace binding {

template <class S> cuda::DeviceCamera<S> device_camera(const Inputs& inputs, const Options& options) {
  cuda::DeviceCamera<S> out;
  out.width = static_cast<int>(options.image_width);
  out.height = static_cast<int>(options.image_height);
  out.tan_fov_x = static_cast<S>(options.tanfovx);
  out.tan_fov_y = static_cast<S>(options.tanfovy);
  out.near = static_cast<float>(options.near);
  out.view = data<S>(inputs[kViewMatrix]);
  out.projection = data<S>(inputs[kProjMatrix]);
  out.position = data<S>(inputs[kCampos]);
  return out;
}

template <class S> cuda::SavedForward<S> saved_on_device(const Outputs& outputs, const Options& options) {
  cuda::SavedForward<S> out;
  out.projected = reinterpret_cast<ProjectedGaussian<S>*>(mutable_data<S>(outputs[kProjected]));
  out.features = mutable_data<S>(outputs[kFeatures]);
  out.order = mutable_data<int32_t>(outputs[kOrder]);
  out.tile_offsets = mutable_data<int64_t>(outputs[kTileOffsets]);
  out.num_instances = out.tile_offsets + outputs[kTileOffsets].numel() - 1;
  if (outputs[kInstances].defined()) {
    out.instances = mutable_data<int32_t>(outputs[kInstances]);
    out.capacity = outputs[kInstances].size(0);
  }
  if (outputs[kSegments].defined() && outputs[kSegments].numel() > 0) {
    out.segments = mutable_data<S>(outputs[kSegments]);
    out.segment_queue = mutable_data<int32_t>(outputs[kSegmentQueue]);
  }
  if (options.deterministic) {
    out.instance_width = 2;
    out.slot_ranges = mutable_data<int64_t>(outputs[kInstanceOffsets]);
  }
  out.final_transmittance = mutable_data<S>(outputs[kFinalTransmittance]);
  out.gate_sum = mutable_data<S>(outputs[kGateSum]);
  out.last_contributor = mutable_data<int32_t>(outputs[kLastContributor]);
  return out;
}

// Freed with the object: torch's allocator hands the memory on in the order of the stream.
class TensorScratch final : public cuda::Scratch {
 public:
  explicit TensorScratch(const at::Tensor& like) : options_(like.options().dtype(at::kByte)) {}

  void* allocate(size_t bytes) override {
    tensors_.push_back(at::empty({static_cast<int64_t>(bytes)}, options_));
    return tensors_.back().data_ptr();
  }

 private:
  at::TensorOptions options_;
  std::vector<at::Tensor> tensors_;
};

}  // namespace binding
}  // namespace dsmoe

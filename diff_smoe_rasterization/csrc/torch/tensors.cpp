#include "tensors.h"

#include <algorithm>
#include <utility>

#include "dsmoe/rasterize_cuda.h"

namespace dsmoe {
namespace binding {

Inputs contiguous(Inputs inputs) {
  for (at::Tensor& tensor : inputs) {
    if (tensor.defined()) tensor = tensor.contiguous();
  }
  return inputs;
}

std::array<OutputSpec, kNumOutputs> output_specs(const Inputs& inputs, const Options& options) {
  const int64_t count = num_gaussians(inputs), channels = num_channels(inputs);
  const int64_t height = options.image_height, width = options.image_width;
  const int64_t tiles = num_tiles(static_cast<int>(width), static_cast<int>(height));
  const at::ScalarType real = inputs[kMeans3D].scalar_type();
  const std::vector<int64_t> image = {1, height, width}, absent = {0};
  const int64_t num_features = channels + options.depth + options.inverse_depth;
  const bool cuda = inputs[kMeans3D].is_cuda();

  std::array<OutputSpec, kNumOutputs> specs;
  specs[kColor] = {{channels, height, width}, real};
  specs[kRadii] = {{count}, at::kInt};
  specs[kGateSum] = {image, real};
  specs[kDepth] = {options.depth ? image : absent, real};
  specs[kInverseDepth] = {options.inverse_depth ? image : absent, real};
  specs[kProjected] = {{count, kProjectedGaussianSize}, real};
  if (cuda) {
    specs[kFeatures] = {{count, cuda::feature_stride(static_cast<int>(num_features))}, real};
    specs[kInstanceOffsets] = {options.deterministic ? std::vector<int64_t>{count, 2} : absent, at::kLong};
    specs[kTileOffsets] = {{tiles + 2}, at::kLong};
    specs[kInstances] = {{-1, options.deterministic ? 2 : 1}, at::kInt};
    specs[kOrder] = {{count}, at::kInt};
    const bool segments = real == at::kFloat && num_features == cuda::kSegmentFeatures;
    specs[kSegments] = {segments ? std::vector<int64_t>{-1, cuda::kSegmentRow} : absent, real};
    specs[kSegmentQueue] = {segments ? std::vector<int64_t>{-1, 2} : absent, at::kInt};
  } else {
    specs[kFeatures] = {{count, num_features}, real};
    specs[kInstanceOffsets] = {{count + 1}, at::kLong};
    specs[kTileOffsets] = {{tiles + 1}, at::kLong};
    specs[kInstances] = {{-1, 2}, at::kInt};
    specs[kOrder] = {absent, at::kInt};
    specs[kSegments] = {absent, real};
    specs[kSegmentQueue] = {absent, at::kInt};
  }
  specs[kFinalTransmittance] = {{height, width}, real};
  specs[kLastContributor] = {{height, width}, at::kInt};
  return specs;
}

Outputs allocate_outputs(const Inputs& inputs, const Options& options) {
  const auto specs = output_specs(inputs, options);
  Outputs outputs;
  for (int i = 0; i < kNumOutputs; ++i) {
    const auto& shape = specs[i].shape;
    if (std::find(shape.begin(), shape.end(), -1) != shape.end()) continue;  // the caller will know
    outputs[i] = at::empty(shape, inputs[kMeans3D].options().dtype(specs[i].type));
  }
  return outputs;
}

Inputs allocate_gradients(const Inputs& inputs, const InputMask& wanted) {
  Inputs gradients;
  for (int i = 0; i < kNumInputs; ++i) {
    if (wanted[i]) gradients[i] = at::empty(inputs[i].sizes(), inputs[i].options());
  }
  return gradients;
}

}  // namespace binding
}  // namespace dsmoe

// The arguments of the ops as C++ values, and torch tensors as the core's structs of pointers. What every backend of
// the binding shares; a backend adds the calls into its part of the core (forward_cpu.cpp, backward_cpu.cpp).
#pragma once

#include <ATen/ATen.h>
#include <c10/util/Optional.h>

#include <algorithm>
#include <array>
#include <vector>

#include "dsmoe/rasterize.h"

namespace dsmoe {
namespace binding {

using OptionalTensor = c10::optional<at::Tensor>;  // std::optional in newer torch

// The tensors that a rendering depends on, in the order of the ops' arguments. N Gaussians, C channels.
enum Input : int {
  kMeans3D,         // [N, 3]
  kMeans2D,         // [N, 3] or absent; its value is not read, it receives a gradient
  kOpacities,       // [N] or [N, 1]
  kDc,              // [N, 1, 3] or absent
  kShs,             // [N, K, 3] or absent
  kColorsPrecomp,   // [N, C] or absent
  kScales,          // [N, 3] or absent
  kRotations,       // [N, 4] or absent
  kCov3DPrecomp,    // [N, 6] or absent
  kBackground,      // [C]
  kViewMatrix,      // [4, 4]
  kProjMatrix,      // [4, 4]
  kCampos,          // [3]
  kBackgroundGate,  // one element, or absent
  kNumInputs
};
constexpr const char* kInputNames[kNumInputs] = {
    "means3D",   "means2D",       "opacities", "dc",         "shs",        "colors_precomp", "scales",
    "rotations", "cov3D_precomp", "bg",        "viewmatrix", "projmatrix", "campos",         "background_gate"};

// The tensors that a rendering makes, in the order of the op's results: images first, then what backward needs again.
enum Output : int {
  kColor,               // [C, H, W]
  kRadii,               // [N] int32
  kGateSum,             // [1, H, W] the denominator; the alpha image
  kDepth,               // [1, H, W], or [0] where it was not asked for
  kInverseDepth,        // [1, H, W], or [0]
  kProjected,           // [N, 8] ProjectedGaussian
  kFeatures,            // CPU: [N, F]; CUDA: [N, feature_stride(F)]
  kInstanceOffsets,     // int64; CPU: [N + 1]; CUDA: [N, 2] slot ranges where deterministic, else [0]
  kTileOffsets,         // int64; CPU: [tiles + 1]; CUDA: [tiles + 2], the last one counts all instances
  kInstances,           // int32; CPU: [I, 2] TileInstance; CUDA: [capacity, 1 or 2]
  kFinalTransmittance,  // [H, W]
  kLastContributor,     // [H, W] int32
  kOrder,               // CUDA: [N] int32 Gaussians by depth, culled ones as ~index; CPU: [0]
  kSegments,            // CUDA: [rows, kSegmentRow] where the backward pass walks segments, else [0]
  kSegmentQueue,        // CUDA: [entries, 2] int32 where there are segments, else [0]
  kNumOutputs
};
constexpr const char* kOutputNames[kNumOutputs] = {"color",
                                                   "radii",
                                                   "gate_sum",
                                                   "depth",
                                                   "inverse_depth",
                                                   "projected",
                                                   "features",
                                                   "instance_offsets",
                                                   "tile_offsets",
                                                   "instances",
                                                   "final_transmittance",
                                                   "last_contributor",
                                                   "order",
                                                   "segments",
                                                   "segment_queue"};

// The images that loss gradients arrive at, in the order of the backward op's arguments.
enum ImageGradient : int {
  kColorGradient,
  kGateSumGradient,
  kDepthGradient,
  kInverseDepthGradient,
  kNumImageGradients
};
constexpr Output kImageOfGradient[kNumImageGradients] = {kColor, kGateSum, kDepth, kInverseDepth};
constexpr const char* kImageGradientNames[kNumImageGradients] = {"dL_dcolor", "dL_dgate_sum", "dL_ddepth",
                                                                 "dL_dinverse_depth"};

using Inputs = std::array<at::Tensor, kNumInputs>;  // an absent input is an undefined tensor
using Outputs = std::array<at::Tensor, kNumOutputs>;
using ImageGradientTensors = std::array<at::Tensor, kNumImageGradients>;
using InputMask = std::array<bool, kNumInputs>;

// The plain numbers of GaussianRasterizationSettings.
struct Options {
  int64_t image_height, image_width;
  double tanfovx, tanfovy, scale_modifier, near, alpha_min, fixed_background_gate;
  int64_t sh_degree, blend_mode;
  bool antialiasing, depth, inverse_depth, deterministic, debug, clamp_color;
};

inline int64_t num_gaussians(const Inputs& inputs) { return inputs[kMeans3D].size(0); }

inline int64_t num_channels(const Inputs& inputs) {
  return inputs[kColorsPrecomp].defined() ? inputs[kColorsPrecomp].size(1) : 3;
}

// Dense copies of the tensors that are not dense already.
Inputs contiguous(Inputs inputs);

// What a backend keeps for its backward pass is its own affair: the images have one shape, the rest differs.
struct OutputSpec {
  std::vector<int64_t> shape;  // -1: any
  at::ScalarType type;
};
std::array<OutputSpec, kNumOutputs> output_specs(const Inputs& inputs, const Options& options);

// All outputs but the instances, whose number is not known yet; nothing is filled.
Outputs allocate_outputs(const Inputs& inputs, const Options& options);

// A gradient for each input that wants one, nothing filled; the others stay undefined.
Inputs allocate_gradients(const Inputs& inputs, const InputMask& wanted);

template <class S> const S* data(const at::Tensor& tensor) { return tensor.defined() ? tensor.data_ptr<S>() : nullptr; }

template <class S> S* mutable_data(const at::Tensor& tensor) {
  return tensor.defined() && tensor.numel() > 0 ? tensor.data_ptr<S>() : nullptr;
}

template <class S> GaussianInputs<S> gaussian_inputs(const Inputs& inputs, const Options& options) {
  GaussianInputs<S> out;
  out.num_gaussians = num_gaussians(inputs);
  out.means3D = data<S>(inputs[kMeans3D]);
  out.opacities = data<S>(inputs[kOpacities]);
  out.scales = data<S>(inputs[kScales]);
  out.rotations = data<S>(inputs[kRotations]);
  out.cov3D_precomp = data<S>(inputs[kCov3DPrecomp]);
  out.colors_precomp = data<S>(inputs[kColorsPrecomp]);
  out.dc = data<S>(inputs[kDc]);
  out.shs = data<S>(inputs[kShs]);
  out.num_sh = inputs[kShs].defined() ? static_cast<int>(inputs[kShs].size(1)) : 0;
  out.sh_degree = static_cast<int>(options.sh_degree);
  return out;
}

// Reads the camera's tensors, which must lie in host memory.
template <class S> Camera<S> camera(const Inputs& inputs, const Options& options) {
  Camera<S> out;
  out.width = static_cast<int>(options.image_width);
  out.height = static_cast<int>(options.image_height);
  out.tan_fov_x = static_cast<S>(options.tanfovx);
  out.tan_fov_y = static_cast<S>(options.tanfovy);
  std::copy_n(data<S>(inputs[kViewMatrix]), 16, out.view);
  std::copy_n(data<S>(inputs[kProjMatrix]), 16, out.projection);
  std::copy_n(data<S>(inputs[kCampos]), 3, out.position);
  out.near = static_cast<float>(options.near);  // thresholds are float32 values in every scalar type
  return out;
}

// What decides which pairs count and how they are blended; background_gate may be undefined.
template <class S> void set_blend(RasterConfig<S>& out, const at::Tensor& background_gate, const Options& options) {
  out.mode = static_cast<BlendMode>(options.blend_mode);
  out.background_gate = static_cast<S>(options.fixed_background_gate);
  out.background_gate_at = data<S>(background_gate);
  out.alpha_min = static_cast<float>(options.alpha_min);
}

template <class S> RasterConfig<S> raster_config(const Inputs& inputs, const Options& options) {
  RasterConfig<S> out;
  set_blend(out, inputs[kBackgroundGate], options);
  out.num_channels = static_cast<int>(num_channels(inputs));
  out.background = data<S>(inputs[kBackground]);
  out.scale_modifier = static_cast<S>(options.scale_modifier);
  out.antialiasing = options.antialiasing;
  out.depth = options.depth;
  out.inverse_depth = options.inverse_depth;
  out.clamp_color = options.clamp_color;
  return out;
}

template <class S> SavedForward<S> saved_forward(const Outputs& outputs) {
  static_assert(sizeof(ProjectedGaussian<S>) == kProjectedGaussianSize * sizeof(S), "a row of `projected`");
  static_assert(sizeof(TileInstance) == 2 * sizeof(int32_t), "a row of `instances`");
  SavedForward<S> out;
  out.projected = reinterpret_cast<ProjectedGaussian<S>*>(mutable_data<S>(outputs[kProjected]));
  out.features = mutable_data<S>(outputs[kFeatures]);
  out.instance_offsets = mutable_data<int64_t>(outputs[kInstanceOffsets]);
  out.tile_offsets = mutable_data<int64_t>(outputs[kTileOffsets]);
  out.instances = reinterpret_cast<TileInstance*>(mutable_data<int32_t>(outputs[kInstances]));
  out.final_transmittance = mutable_data<S>(outputs[kFinalTransmittance]);
  out.gate_sum = mutable_data<S>(outputs[kGateSum]);
  out.last_contributor = mutable_data<int32_t>(outputs[kLastContributor]);
  return out;
}

template <class S> ImageOutputs<S> image_outputs(const Outputs& outputs) {
  ImageOutputs<S> out;
  out.color = mutable_data<S>(outputs[kColor]);
  out.depth = mutable_data<S>(outputs[kDepth]);
  out.inverse_depth = mutable_data<S>(outputs[kInverseDepth]);
  out.radii = mutable_data<int32_t>(outputs[kRadii]);
  return out;
}

template <class S> ImageGradients<S> image_gradients(const ImageGradientTensors& tensors) {
  ImageGradients<S> out;
  out.color = data<S>(tensors[kColorGradient]);
  out.gate_sum = data<S>(tensors[kGateSumGradient]);
  out.depth = data<S>(tensors[kDepthGradient]);
  out.inverse_depth = data<S>(tensors[kInverseDepthGradient]);
  return out;
}

// Those of the camera and of the background are left out: the core returns each in one piece.
template <class S> GaussianGradients<S> gaussian_gradients(const Inputs& gradients) {
  GaussianGradients<S> out;
  out.means3D = mutable_data<S>(gradients[kMeans3D]);
  out.means2D = mutable_data<S>(gradients[kMeans2D]);
  out.opacities = mutable_data<S>(gradients[kOpacities]);
  out.scales = mutable_data<S>(gradients[kScales]);
  out.rotations = mutable_data<S>(gradients[kRotations]);
  out.cov3D_precomp = mutable_data<S>(gradients[kCov3DPrecomp]);
  out.colors_precomp = mutable_data<S>(gradients[kColorsPrecomp]);
  out.dc = mutable_data<S>(gradients[kDc]);
  out.shs = mutable_data<S>(gradients[kShs]);
  return out;
}

// A gradient that the core returns in one piece, and the inputs whose gradients are its parts, in their order.
struct JointGradient {
  struct Part {
    Input input;
    int64_t size;
  };
  std::vector<Part> parts;
  at::Tensor whole;  // undefined where none of the parts is wanted

  JointGradient(std::vector<Part> parts, const Inputs& gradients, const at::Tensor& like) : parts(std::move(parts)) {
    int64_t size = 0;
    bool wanted = false;
    for (const auto& part : this->parts) size += part.size, wanted |= gradients[part.input].defined();
    if (wanted) whole = at::empty({size}, like.options());
  }

  void store(const Inputs& gradients) const {
    int64_t begin = 0;
    for (const auto& [input, size] : parts) {
      if (gradients[input].defined()) {
        gradients[input].copy_(whole.narrow(0, begin, size).view(gradients[input].sizes()));
      }
      begin += size;
    }
  }
};

inline JointGradient camera_joint(const Inputs& gradients, const at::Tensor& like) {
  return {{{kViewMatrix, 16}, {kProjMatrix, 16}, {kCampos, 3}}, gradients, like};
}
inline JointGradient background_joint(const Inputs& inputs, const Inputs& gradients) {
  return {{{kBackground, num_channels(inputs)}, {kBackgroundGate, 1}}, gradients, inputs[kMeans3D]};
}

}  // namespace binding
}  // namespace dsmoe

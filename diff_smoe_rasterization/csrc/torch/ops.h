// The signatures of the ops, once for all backends: schema.cpp says them to torch; a backend registers
// `rasterize<&forward>` and its like under its dispatch key.
#pragma once

#include <algorithm>
#include <string>
#include <tuple>
#include <vector>

#include "checks.h"
#include "tensors.h"

namespace dsmoe {
namespace binding {

// What the forward pass alone is told: what it refuses, and whether a backward pass may follow.
struct ForwardOptions {
  bool strict, prefiltered, for_backward;
};

using ForwardFunction = Outputs (*)(const Inputs&, const Options&, ForwardOptions);
using BackwardFunction = void (*)(const Inputs&, const Options&, const Outputs&, const ImageGradientTensors&,
                                  const Inputs& gradients);

template <ForwardFunction kForward>
auto rasterize(const at::Tensor& means3D, const OptionalTensor& means2D, const at::Tensor& opacities,
               const OptionalTensor& dc, const OptionalTensor& shs, const OptionalTensor& colors_precomp,
               const OptionalTensor& scales, const OptionalTensor& rotations, const OptionalTensor& cov3D_precomp,
               const at::Tensor& bg, const at::Tensor& viewmatrix, const at::Tensor& projmatrix,
               const at::Tensor& campos, const OptionalTensor& background_gate, int64_t image_height,
               int64_t image_width, double tanfovx, double tanfovy, double scale_modifier, double near,
               double alpha_min, double fixed_background_gate, int64_t sh_degree, int64_t blend_mode, bool antialiasing,
               bool depth, bool inverse_depth, bool deterministic, bool debug, bool clamp_color, bool strict,
               bool prefiltered, bool for_backward) {
  const auto given = [](const OptionalTensor& tensor) { return tensor.has_value() ? *tensor : at::Tensor(); };
  // clang-format off
  const Inputs inputs = {
      means3D, given(means2D), opacities, given(dc), given(shs), given(colors_precomp), given(scales),
      given(rotations), given(cov3D_precomp), bg, viewmatrix, projmatrix, campos,
      given(background_gate)};
  // clang-format on
  const Options options = {image_height,  image_width,           tanfovx,   tanfovy,    scale_modifier, near,
                           alpha_min,     fixed_background_gate, sh_degree, blend_mode, antialiasing,   depth,
                           inverse_depth, deterministic,         debug,     clamp_color};
  check_arguments(inputs, options);
  if (debug) {
    for (int i = kBackground; i <= kBackgroundGate; ++i)
      refuse_nan(std::string("rasterize: ") + kInputNames[i], inputs[i]);
  }
  const Outputs outputs = kForward(contiguous(inputs), options, {strict, prefiltered, for_backward});
  if (debug) {
    for (Output image : kImageOfGradient) refuse_nan(std::string("rasterize: ") + kOutputNames[image], outputs[image]);
  }
  return std::tuple_cat(outputs);
}

template <BackwardFunction kBackward>
std::vector<at::Tensor> rasterize_backward(const OptionalTensor& dL_dcolor, const OptionalTensor& dL_dgate_sum,
                                           const OptionalTensor& dL_ddepth, const OptionalTensor& dL_dinverse_depth,
                                           at::TensorList present_inputs, InputMask present, at::TensorList output_list,
                                           int64_t image_height, int64_t image_width, double tanfovx, double tanfovy,
                                           double scale_modifier, double near, double alpha_min,
                                           double fixed_background_gate, int64_t sh_degree, int64_t blend_mode,
                                           bool antialiasing, bool depth, bool inverse_depth, bool deterministic,
                                           bool debug, bool clamp_color, InputMask wanted) {
  const auto dense = [](const OptionalTensor& tensor) {
    return tensor.has_value() ? tensor->contiguous() : at::Tensor();
  };
  const ImageGradientTensors image_gradients = {dense(dL_dcolor), dense(dL_dgate_sum), dense(dL_ddepth),
                                                dense(dL_dinverse_depth)};
  const auto check_length = [](const char* name, size_t length, size_t expected) {
    TORCH_CHECK_VALUE(length == expected, "rasterize_backward: ", name, " has length ", length, "; it must be ",
                      expected);
  };
  check_length("inputs", present_inputs.size(), std::count(present.begin(), present.end(), true));
  check_length("outputs", output_list.size(), kNumOutputs);
  for (Input i : {kMeans3D, kOpacities, kBackground, kViewMatrix, kProjMatrix, kCampos}) {
    TORCH_CHECK_VALUE(present[i], "rasterize_backward: ", kInputNames[i], " is absent; it must be given");
  }
  Inputs inputs;
  auto next = present_inputs.begin();
  for (int i = 0; i < kNumInputs; ++i) {
    if (present[i]) inputs[i] = *next++;
  }
  Outputs outputs;
  std::copy(output_list.begin(), output_list.end(), outputs.begin());
  const Options options = {image_height,  image_width,           tanfovx,   tanfovy,    scale_modifier, near,
                           alpha_min,     fixed_background_gate, sh_degree, blend_mode, antialiasing,   depth,
                           inverse_depth, deterministic,         debug,     clamp_color};
  check_backward_arguments(inputs, options, outputs, image_gradients, wanted);
  if (debug) {
    for (int i = 0; i < kNumImageGradients; ++i) {
      refuse_nan(std::string("rasterize_backward: ") + kImageGradientNames[i], image_gradients[i]);
    }
  }
  inputs = contiguous(inputs);
  const Inputs gradients = allocate_gradients(inputs, wanted);
  kBackward(inputs, options, outputs, image_gradients, gradients);

  std::vector<at::Tensor> result;
  for (int i = 0; i < kNumInputs; ++i) {
    if (!wanted[i]) continue;
    if (debug) refuse_nan(std::string("rasterize_backward: the gradient of ") + kInputNames[i], gradients[i]);
    result.push_back(gradients[i]);
  }
  return result;
}

}  // namespace binding
}  // namespace dsmoe

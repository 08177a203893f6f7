#include "checks.h"

#include <climits>
#include <cmath>
#include <sstream>
#include <vector>

#include "../refuse.h"

namespace dsmoe {
namespace binding {
namespace {

void check_shape(const char* function, Input input, const Inputs& inputs, const Shape& shape) {
  if (inputs[input].defined()) check_shape(function, kInputNames[input], inputs[input], shape);
}

void check_background_gate(const char* function, const at::Tensor& gate) {
  TORCH_CHECK_VALUE(!gate.defined() || gate.numel() == 1, function, ": background_gate has shape ", gate.sizes(),
                    "; it must have one element");
}

void check_shapes(const char* function, const Inputs& inputs) {
  check_shape(function, kMeans3D, inputs, {"N", 3});
  const int64_t count = num_gaussians(inputs);
  const at::Tensor& opacities = inputs[kOpacities];
  TORCH_CHECK_VALUE(matches(opacities, {count}) || matches(opacities, {count, 1}), function, ": opacities has shape ",
                    opacities.sizes(), "; it must be [", count, ", 1] or [", count, "]");
  check_shape(function, kMeans2D, inputs, {count, 3});
  check_shape(function, kMeans2DAbs, inputs, {count, 2});
  check_shape(function, kDc, inputs, {count, 1, 3});
  check_shape(function, kShs, inputs, {count, "K", 3});
  check_shape(function, kColorsPrecomp, inputs, {count, "C"});
  TORCH_CHECK_VALUE(num_channels(inputs) > 0, function, ": colors_precomp has shape ", inputs[kColorsPrecomp].sizes(),
                    "; a colour has one channel or more");
  check_shape(function, kScales, inputs, {count, 3});
  check_shape(function, kRotations, inputs, {count, 4});
  check_shape(function, kCov3DPrecomp, inputs, {count, 6});
  check_shape(function, kBackground, inputs, {num_channels(inputs)});
  check_shape(function, kViewMatrix, inputs, {4, 4});
  check_shape(function, kProjMatrix, inputs, {4, 4});
  check_shape(function, kCampos, inputs, {3});
  check_background_gate(function, inputs[kBackgroundGate]);
}

void check_options(const char* function, const Options& options) {
  const int64_t height = options.image_height, width = options.image_width;
  TORCH_CHECK_VALUE(height > 0 && width > 0, function, ": image_height x image_width is ", height, " x ", width,
                    "; both must be positive");
  TORCH_CHECK_VALUE(height <= INT_MAX / width, function, ": image_height x image_width is ", height, " x ", width,
                    "; an image may have ", INT_MAX, " pixels");
  const auto check_positive = [&](const char* name, double value) {
    TORCH_CHECK_VALUE(std::isfinite(value) && value > 0, function, ": ", name, " is ", value,
                      "; it must be positive and finite");
  };
  check_positive("tanfovx", options.tanfovx);
  check_positive("tanfovy", options.tanfovy);
}

// What the core refuses of Gaussians, asked here where there are none: their arrays are null to it, given or not.
void check_without_gaussians(const char* function, const Inputs& inputs, const Options& options) {
  const float element = 0;
  const auto array = [&](Input input) { return inputs[input].defined() ? &element : nullptr; };
  GaussianInputs<float> given;
  given.scales = array(kScales), given.rotations = array(kRotations), given.cov3D_precomp = array(kCov3DPrecomp);
  given.dc = array(kDc), given.shs = array(kShs), given.colors_precomp = array(kColorsPrecomp);
  given.num_sh = given.shs ? to_int(inputs[kShs].size(1)) : 0;
  given.sh_degree = to_int(options.sh_degree);
  try {
    refuse_given(function, given, static_cast<int>(num_channels(inputs)));
  } catch (const std::invalid_argument& error) {
    TORCH_CHECK_VALUE(false, error.what());
  }
}

}  // namespace

void check_arguments(const char* function, const Inputs& inputs, const Options& options) {
  check_real(function, "means3D", inputs[kMeans3D]);
  for (int i = 0; i < kNumInputs; ++i) {
    if (!inputs[i].defined()) continue;
    check_like(function, kInputNames[i], inputs[i], "means3D", inputs[kMeans3D]);
    refuse_tangent(function, inputs[i]);
  }
  check_options(function, options);
  check_shapes(function, inputs);
  if (num_gaussians(inputs) == 0) check_without_gaussians(function, inputs, options);
}

void check_backward_arguments(const char* function, const Inputs& inputs, const Options& options, const Images& images,
                              const Images& image_gradients, const InputMask& wanted) {
  check_arguments(function, inputs, options);
  const at::Tensor& like = inputs[kMeans3D];
  for (int i = 0; i < kNumImages; ++i) {
    const auto shape = image_shape(static_cast<Image>(i), image_sizes(inputs), options);
    check_result(function, kImageNames[i], images[i], shape, i == kRadii ? at::kInt : like.scalar_type(),
                 like.device());
    if (!image_gradients[i].defined()) continue;
    refuse_tangent(function, image_gradients[i]);
    const std::string name = std::string("dL_d") + kImageNames[i];
    check_like(function, name.c_str(), image_gradients[i], "means3D", like);
    check_shape(function, name.c_str(), image_gradients[i], {shape.begin(), shape.end()});
  }
  for (int i = 0; i < kNumInputs; ++i) {
    TORCH_CHECK_VALUE(!wanted[i] || inputs[i].defined(), function, ": the gradient of ", kInputNames[i],
                      " is wanted, but that input is absent");
  }
}

void check_footprints(const char* function, const Footprints& of, const Options& options) {
  check_options(function, options);
  check_real(function, "gates", of.gates);
  check_shape(function, "gates", of.gates, {"N", kProjectedGaussianSize});
  const int64_t count = of.gates.size(0), extra = num_further_features(options);
  check_like(function, "bg", of.background, "gates", of.gates);
  check_shape(function, "bg", of.background, {"C"});
  TORCH_CHECK_VALUE(of.background.numel() > 0, function, ": bg has shape ", of.background.sizes(),
                    "; a colour has one channel or more");
  check_like(function, "features", of.features, "gates", of.gates);
  check_shape(function, "features", of.features, {count, of.background.numel() + extra});
  check_shape(function, "radii", of.radii, {count});
  TORCH_CHECK_TYPE(of.radii.scalar_type() == at::kInt && of.radii.device() == of.gates.device(), function,
                   ": radii is ", dtype_name(of.radii.scalar_type()), " on ", of.radii.device(), "; it must be ",
                   dtype_name(at::kInt), " on ", of.gates.device());
  if (of.background_gate.defined()) {
    check_like(function, "background_gate", of.background_gate, "gates", of.gates);
    check_background_gate(function, of.background_gate);
  }
  for (const at::Tensor& tensor : {of.gates, of.features, of.background}) refuse_tangent(function, tensor);
}

void check_blend_backward_arguments(const char* function, const Images& images, const Images& image_gradients,
                                    const ImageSizes& sizes, const at::Tensor& like, const Options& options) {
  for (Image image : kDifferentiable) {
    const auto shape = image_shape(image, sizes, options);
    check_result(function, kImageNames[image], images[image], shape, like.scalar_type(), like.device());
    if (!image_gradients[image].defined()) continue;
    const std::string name = std::string("dL_d") + kImageNames[image];
    check_like(function, name.c_str(), image_gradients[image], "gates", like);
    check_shape(function, name.c_str(), image_gradients[image], {shape.begin(), shape.end()});
  }
}

void check_footprint_gradients(const char* function, const at::Tensor& records, const at::Tensor& dL_ddepths,
                               const at::Tensor& features, const at::Tensor& radii, const Inputs& inputs,
                               const Options& options) {
  const at::Tensor& like = inputs[kMeans3D];
  const int64_t count = num_gaussians(inputs);
  const int64_t num_features = num_channels(inputs) + num_further_features(options);
  check_like(function, "records", records, "means3D", like);
  check_shape(function, "records", records, {count, kNumGateGradients + num_features});
  check_like(function, "features", features, "means3D", like);
  check_shape(function, "features", features, {count, num_features});
  check_result(function, "radii", radii, {count}, at::kInt, like.device());
  if (!dL_ddepths.defined()) return;
  check_like(function, "dL_ddepths", dL_ddepths, "means3D", like);
  check_shape(function, "dL_ddepths", dL_ddepths, {count});
}

void check_contribution_arguments(const char* function, const at::Tensor& pixel_weights, const at::Tensor& radii,
                                  const Saved& saved, const at::Tensor& background_gate, const Options& options) {
  check_options(function, options);
  check_result(function, "radii", radii, {radii.numel()}, at::kInt, radii.device());
  TORCH_CHECK_VALUE(!saved.empty(), function, ": saved has length 0; it must be what rasterize returned");
  check_real(function, "saved[0]", saved[0]);
  check_like(function, "pixel_weights", pixel_weights, "means3D", saved[0]);
  check_shape(function, "pixel_weights", pixel_weights, {options.image_height, options.image_width});
  if (background_gate.defined()) check_like(function, "background_gate", background_gate, "means3D", saved[0]);
  check_background_gate(function, background_gate);
}

void check_importance_images(const ImportanceImages& images, const at::Tensor& like, const Options& options) {
  const char* function = "importance";
  const auto check_image = [&](const char* name, const at::Tensor& image, const Shape& shape) {
    check_like(function, name, image, "means3D", like);
    check_shape(function, name, image, shape);
  };
  check_image("share_weights", images.share_weights, {options.image_height, options.image_width});
  check_image("color", images.color, {"C", options.image_height, options.image_width});
  check_image("gate_sum", images.gate_sum, {1, options.image_height, options.image_width});
  check_image("bg", images.background, {images.color.size(0)});
}

void check_result(const char* function, const char* name, const at::Tensor& tensor, const std::vector<int64_t>& shape,
                  at::ScalarType type, at::Device device) {
  check_shape(function, name, tensor, {shape.begin(), shape.end()});
  TORCH_CHECK_TYPE(tensor.scalar_type() == type && tensor.is_contiguous() && tensor.device() == device, function, ": ",
                   name, " must be as rasterize returned it: dense ", dtype_name(type), " on ", device);
}

void check_positions(const at::Tensor& positions, const at::Tensor& viewmatrix) {
  check_real("markVisible", "positions", positions);
  check_shape("markVisible", "positions", positions, {"N", 3});
  check_like("markVisible", "viewmatrix", viewmatrix, "positions", positions);
  check_shape("markVisible", "viewmatrix", viewmatrix, {4, 4});
}

void refuse_non_finite(const char* function, const Inputs& inputs) {
  at::Tensor finite = at::ones({num_gaussians(inputs)}, inputs[kMeans3D].options().dtype(at::kBool));
  const auto is_read = [&](int i) { return i != kMeans2D && inputs[i].defined() && inputs[i].numel() > 0; };
  const auto is_sound = [](int i, const at::Tensor& values) {
    return i == kOpacities ? values.abs().le(kMaxOpacity) : at::isfinite(values);
  };
  for (int i = kMeans3D; i <= kCov3DPrecomp; ++i) {
    if (is_read(i)) finite = finite.logical_and(is_sound(i, inputs[i]).reshape({finite.size(0), -1}).all(1));
  }
  const at::Tensor indices = at::logical_not(finite).nonzero();
  if (indices.numel() == 0) return;
  const int64_t index = indices[0][0].item<int64_t>();
  for (int i = kMeans3D; i <= kCov3DPrecomp; ++i) {
    TORCH_CHECK_VALUE(!is_read(i) || is_sound(i, inputs[i][index]).all().item<bool>(), function, ": ", kInputNames[i],
                      "[", index, "] is not finite", i == kOpacities ? " or above 1e20" : "", " (strict=True)");
  }
}

void refuse_culled(const char* function, const Inputs& inputs, const at::Tensor& visible) {
  const at::Tensor culled = at::logical_not(visible).logical_and(at::isfinite(inputs[kMeans3D]).all(1)).nonzero();
  if (culled.numel() == 0) return;
  const int64_t index = culled[0][0].item<int64_t>();
  TORCH_CHECK_VALUE(false, function, ": prefiltered is set, but means3D[", index, "] is not beyond the near plane");
}

void refuse_nan(const std::string& what, const at::Tensor& tensor) {
  if (!tensor.defined() || tensor.numel() == 0) return;
  const at::Tensor indices = at::isnan(tensor).nonzero();
  if (indices.size(0) == 0) return;
  std::ostringstream index;
  for (int64_t i = 0; i < indices.size(1); ++i) index << (i == 0 ? "" : ", ") << indices[0][i].item<int64_t>();
  TORCH_CHECK(false, what, "[", index.str(), "] is NaN; so are ", indices.size(0), " of its ", tensor.numel(),
              " values (debug=True)");
}

}  // namespace binding
}  // namespace dsmoe

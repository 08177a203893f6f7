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

void check_background_gate(const char* function, const Tensor& gate) {
  DSMOE_CHECK_VALUE(!gate.defined() || gate.numel() == 1, function, ": background_gate has shape ", gate.sizes(),
                    "; it must have one element");
}

void check_shapes(const char* function, const Inputs& inputs) {
  check_shape(function, kMeans3D, inputs, {"N", 3});
  const int64_t count = num_gaussians(inputs);
  const Tensor& opacities = inputs[kOpacities];
  DSMOE_CHECK_VALUE(matches(opacities, {count}) || matches(opacities, {count, 1}), function, ": opacities has shape ",
                    opacities.sizes(), "; it must be [", count, ", 1] or [", count, "]");
  check_shape(function, kMeans2D, inputs, {count, 3});
  check_shape(function, kMeans2DAbs, inputs, {count, 2});
  check_shape(function, kDc, inputs, {count, 1, 3});
  check_shape(function, kShs, inputs, {count, "K", 3});
  check_shape(function, kColorsPrecomp, inputs, {count, "C"});
  DSMOE_CHECK_VALUE(num_channels(inputs) > 0, function, ": colors_precomp has shape ", inputs[kColorsPrecomp].sizes(),
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
  DSMOE_CHECK_VALUE(height > 0 && width > 0, function, ": image_height x image_width is ", height, " x ", width,
                    "; both must be positive");
  DSMOE_CHECK_VALUE(height <= INT_MAX / width, function, ": image_height x image_width is ", height, " x ", width,
                    "; an image may have ", INT_MAX, " pixels");
  const auto check_positive = [&](const char* name, double value) {
    DSMOE_CHECK_VALUE(std::isfinite(value) && value > 0, function, ": ", name, " is ", value,
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
    DSMOE_CHECK_VALUE(false, error.what());
  }
}

}  // namespace

void check_arguments(const char* function, const Inputs& inputs, const Options& options) {
  check_real(function, "means3D", inputs[kMeans3D]);
  const bool tangents = forward_mode_is_open();
  for (int i = 0; i < kNumInputs; ++i) {
    if (!inputs[i].defined()) continue;
    check_like(function, kInputNames[i], inputs[i], "means3D", inputs[kMeans3D]);
    if (tangents) refuse_tangent(function, inputs[i]);
  }
  check_options(function, options);
  check_shapes(function, inputs);
  if (num_gaussians(inputs) == 0) check_without_gaussians(function, inputs, options);
}

void check_backward_arguments(const char* function, const Inputs& inputs, const Options& options, const Images& images,
                              const Images& image_gradients, const InputMask& wanted) {
  check_arguments(function, inputs, options);
  const Tensor& like = inputs[kMeans3D];
  const bool tangents = forward_mode_is_open();
  for (int i = 0; i < kNumImages; ++i) {
    const auto shape = image_shape(static_cast<Image>(i), image_sizes(inputs), options);
    check_result(function, kImageNames[i], images[i], shape, i == kRadii ? kInt : like.scalar_type(), like.device());
    if (!image_gradients[i].defined()) continue;
    if (tangents) refuse_tangent(function, image_gradients[i]);
    const std::string name = std::string("dL_d") + kImageNames[i];
    check_like(function, name.c_str(), image_gradients[i], "means3D", like);
    check_shape(function, name.c_str(), image_gradients[i], {shape.begin(), shape.end()});
  }
  for (int i = 0; i < kNumInputs; ++i) {
    DSMOE_CHECK_VALUE(!wanted[i] || inputs[i].defined(), function, ": the gradient of ", kInputNames[i],
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
  DSMOE_CHECK_VALUE(of.background.numel() > 0, function, ": bg has shape ", of.background.sizes(),
                    "; a colour has one channel or more");
  check_like(function, "features", of.features, "gates", of.gates);
  check_shape(function, "features", of.features, {count, of.background.numel() + extra});
  check_shape(function, "radii", of.radii, {count});
  DSMOE_CHECK_TYPE(of.radii.scalar_type() == kInt && of.radii.device() == of.gates.device(), function, ": radii is ",
                   dtype_name(of.radii.scalar_type()), " on ", of.radii.device(), "; it must be ", dtype_name(kInt),
                   " on ", of.gates.device());
  if (of.background_gate.defined()) {
    check_like(function, "background_gate", of.background_gate, "gates", of.gates);
    check_background_gate(function, of.background_gate);
  }
  for (const Tensor& tensor : {of.gates, of.features, of.background}) refuse_tangent(function, tensor);
}

void check_blend_backward_arguments(const char* function, const Images& images, const Images& image_gradients,
                                    const ImageSizes& sizes, const Tensor& like, const Options& options) {
  for (Image image : kDifferentiable) {
    const auto shape = image_shape(image, sizes, options);
    check_result(function, kImageNames[image], images[image], shape, like.scalar_type(), like.device());
    if (!image_gradients[image].defined()) continue;
    const std::string name = std::string("dL_d") + kImageNames[image];
    check_like(function, name.c_str(), image_gradients[image], "gates", like);
    check_shape(function, name.c_str(), image_gradients[image], {shape.begin(), shape.end()});
  }
}

void check_footprint_gradients(const char* function, const Tensor& records, const Tensor& dL_ddepths,
                               const Tensor& features, const Tensor& radii, const Inputs& inputs,
                               const Options& options) {
  const Tensor& like = inputs[kMeans3D];
  const int64_t count = num_gaussians(inputs);
  const int64_t num_features = num_channels(inputs) + num_further_features(options);
  check_like(function, "records", records, "means3D", like);
  check_shape(function, "records", records, {count, kNumGateGradients + num_features});
  check_like(function, "features", features, "means3D", like);
  check_shape(function, "features", features, {count, num_features});
  check_result(function, "radii", radii, {count}, kInt, like.device());
  if (!dL_ddepths.defined()) return;
  check_like(function, "dL_ddepths", dL_ddepths, "means3D", like);
  check_shape(function, "dL_ddepths", dL_ddepths, {count});
}

void check_contribution_arguments(const char* function, const Tensor& pixel_weights, const Tensor& radii,
                                  const Saved& saved, const Tensor& background_gate, const Options& options) {
  check_options(function, options);
  check_result(function, "radii", radii, {radii.numel()}, kInt, radii.device());
  DSMOE_CHECK_VALUE(!saved.empty(), function, ": saved has length 0; it must be what rasterize returned");
  check_real(function, "saved[0]", saved[0]);
  if (pixel_weights.defined()) {
    check_like(function, "pixel_weights", pixel_weights, "means3D", saved[0]);
    check_shape(function, "pixel_weights", pixel_weights, {options.image_height, options.image_width});
  }
  if (background_gate.defined()) check_like(function, "background_gate", background_gate, "means3D", saved[0]);
  check_background_gate(function, background_gate);
}

void check_importance_images(const ImportanceImages& images, const Tensor& like, const Options& options) {
  const char* function = "importance";
  const auto check_image = [&](const char* name, const Tensor& image, const Shape& shape) {
    check_like(function, name, image, "means3D", like);
    check_shape(function, name, image, shape);
  };
  check_image("share_weights", images.share_weights, {options.image_height, options.image_width});
  check_image("color", images.color, {"C", options.image_height, options.image_width});
  check_image("gate_sum", images.gate_sum, {1, options.image_height, options.image_width});
  check_image("bg", images.background, {images.color.size(0)});
}

void check_result(const char* function, const char* name, const Tensor& tensor, const std::vector<int64_t>& shape,
                  ScalarType type, Device device) {
  check_shape(function, name, tensor, {shape.begin(), shape.end()});
  DSMOE_CHECK_TYPE(tensor.scalar_type() == type && tensor.is_contiguous() && tensor.device() == device, function, ": ",
                   name, " must be as rasterize returned it: dense ", dtype_name(type), " on ", device);
}

void check_positions(const Tensor& positions, const Tensor& viewmatrix) {
  check_real("markVisible", "positions", positions);
  check_shape("markVisible", "positions", positions, {"N", 3});
  check_like("markVisible", "viewmatrix", viewmatrix, "positions", positions);
  check_shape("markVisible", "viewmatrix", viewmatrix, {4, 4});
}

void refuse_non_finite(const char* function, const Inputs& inputs) {
  const auto is_read = [&](int i) { return i != kMeans2D && inputs[i].defined() && inputs[i].numel() > 0; };
  const auto is_sound = [&](int i) {  // [N]
    const Tensor values = inputs[i].view({num_gaussians(inputs), -1});
    return all_of(i == kOpacities ? abs_at_most(values, kMaxOpacity) : isfinite(values), 1);
  };
  Tensor sound;
  for (int i = kMeans3D; i <= kCov3DPrecomp; ++i) {
    if (is_read(i)) sound = sound.defined() ? logical_and(sound, is_sound(i)) : is_sound(i);
  }
  if (!sound.defined()) return;
  const Tensor indices = to_cpu(nonzero(logical_not(sound)));
  if (indices.numel() == 0) return;
  const int64_t index = indices.data_ptr<int64_t>()[0];
  for (int i = kMeans3D; i <= kCov3DPrecomp; ++i) {
    DSMOE_CHECK_VALUE(!is_read(i) || to_cpu(is_sound(i)).data_ptr<bool>()[index], function, ": ", kInputNames[i], "[",
                      index, "] is not finite", i == kOpacities ? " or above 1e20" : "", " (strict=True)");
  }
}

void refuse_culled(const char* function, const Inputs& inputs, const Tensor& visible) {
  const Tensor finite = all_of(isfinite(inputs[kMeans3D]), 1);
  const Tensor culled = to_cpu(nonzero(logical_and(logical_not(visible), finite)));
  DSMOE_CHECK_VALUE(culled.numel() == 0, function, ": prefiltered is set, but means3D[", culled.data_ptr<int64_t>()[0],
                    "] is not beyond the near plane");
}

void refuse_nan(const std::string& what, const Tensor& tensor) {
  if (!tensor.defined() || tensor.numel() == 0) return;
  const Tensor indices = to_cpu(nonzero(isnan(tensor)));  // a row for each
  if (indices.size(0) == 0) return;
  std::ostringstream index;
  for (int64_t i = 0; i < indices.size(1); ++i) index << (i == 0 ? "" : ", ") << indices.data_ptr<int64_t>()[i];
  DSMOE_CHECK(false, what, "[", index.str(), "] is NaN; so are ", indices.size(0), " of its ", tensor.numel(),
              " values (debug=True)");
}

}  // namespace binding
}  // namespace dsmoe

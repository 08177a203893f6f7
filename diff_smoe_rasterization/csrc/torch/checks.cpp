#include "checks.h"

#include <climits>
#include <sstream>
#include <string>

#include "../refuse.h"

namespace dsmoe {
namespace binding {
namespace {

struct InputRule {
  bool is_required;
  Shape shape;
};
#define DSMOE_RULE(enumerator, schema, name, ...) {std::string_view(schema) == "Tensor", {__VA_ARGS__}},
const InputRule kInputRules[] = {DSMOE_INPUTS(DSMOE_RULE)};
#undef DSMOE_RULE

// The shape that an input must have, once means3D and colors_precomp have theirs.
Shape input_shape(int i, const Inputs& inputs) {
  const Tensor& given = inputs[i];
  Shape shape = kInputRules[i].shape;
  for (Size& size : shape) {
    if (size.is("N") && i != kMeans3D) size = num_gaussians(inputs);
    if (size.is("C") && i != kColorsPrecomp) size = num_channels(inputs);
  }
  if (i == kOpacities && given.defined() && matches(given, {num_gaussians(inputs)})) shape.pop_back();
  return shape;
}

// One element in any number of dimensions; may be absent.
void check_background_gate(const Expect& expect, const Tensor& gate) {
  if (gate.defined()) expect("background_gate", gate, gate.numel() == 1 ? shape_of(gate.sizes()) : Shape{1});
}

// Before images of that size are allocated.
void check_image_size(const char* function, const Options& options) {
  const int64_t width = options.image_width, height = options.image_height;
  as_op(function, [&] { refuse_image_size(function, width, height); });
  DSMOE_CHECK_VALUE(height <= INT_MAX / width, function, ": image_width x image_height is ", width, " x ", height,
                    "; an image may have ", INT_MAX, " pixels");
}

}  // namespace

Expect check_arguments(const char* function, const Inputs& inputs, const Options& options) {
  check_image_size(function, options);
  const Expect expect(function, "means3D", inputs[kMeans3D]);
  for (int i = 0; i < kNumInputs; ++i) {
    if (i == kBackgroundGate) {
      check_background_gate(expect, inputs[i]);
    } else if (inputs[i].defined() || kInputRules[i].is_required) {
      expect(kInputNames[i], inputs[i], input_shape(i, inputs));
    }
  }
  if (num_gaussians(inputs) == 0) {  // then the core cannot know which of the arrays are given
    const int channels = static_cast<int>(num_channels(inputs));
    as_op(function, [&] { refuse_given(function, gaussian_inputs<float>(inputs, options), channels); });
  }
  return expect;
}

void check_images(const Expect& expect, const Images& images, const Images& image_gradients, const ImageSizes& sizes,
                  const Options& options) {
  for (Image image : kDifferentiable) {
    const Shape shape = shape_of(image_shape(image, sizes, options));
    expect.dense(kImageNames[image], images[image], shape);
    const Tensor& gradient = image_gradients[image];
    if (gradient.defined()) expect(std::string("dL_d") + kImageNames[image], gradient, shape);
  }
}

Expect check_footprints(const char* function, const Footprints& of, const Options& options) {
  check_image_size(function, options);
  const Expect expect(function, "gates", of.gates);
  expect("gates", of.gates, {"N", kProjectedGaussianSize});
  const int64_t count = of.gates.size(0);
  expect("bg", of.background, {"C"});
  expect("features", of.features, {count, of.background.numel() + num_further_features(options)});
  expect("radii", of.radii, {count}, kInt);
  check_background_gate(expect, of.background_gate);
  return expect;
}

Expect check_saved(const char* function, const Tensor& radii, const Saved& saved, const Tensor& background_gate,
                   const Options& options) {
  check_image_size(function, options);
  DSMOE_CHECK_VALUE(!saved.empty(), function, ": saved has length 0; it must be what rasterize returned");
  const Expect expect(function, "means3D", saved[0]);
  expect.dense("radii", radii, {"N"}, kInt);
  check_background_gate(expect, background_gate);
  return expect;
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
  const int64_t index = sound.defined() ? first_set(logical_not(sound)) : -1;
  for (int i = kMeans3D; index >= 0 && i <= kCov3DPrecomp; ++i) {
    DSMOE_CHECK_VALUE(!is_read(i) || to_cpu(is_sound(i)).data_ptr<bool>()[index], function, ": ", kInputNames[i], "[",
                      index, "] is not finite", i == kOpacities ? " or above 1e20" : "", " (strict=True)");
  }
}

void refuse_culled(const char* function, const Inputs& inputs, const Tensor& visible) {
  const int64_t index = first_set(logical_and(logical_not(visible), all_of(isfinite(inputs[kMeans3D]), 1)));
  DSMOE_CHECK_VALUE(index < 0, function, ": prefiltered is set, but means3D[", index, "] is not beyond the near plane");
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

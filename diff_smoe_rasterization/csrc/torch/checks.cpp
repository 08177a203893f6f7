#include "checks.h"

#include <climits>
#include <sstream>
#include <string>
#include <utility>

#include "../refuse.h"

namespace dsmoe {
namespace binding {
namespace {

std::string to_string(const Shape& shape) {
  std::ostringstream out;
  const char* before = "[";
  for (const Size& size : shape) {
    out << std::exchange(before, ", ");
    size.letter != nullptr ? out << size.letter : out << size.size;
  }
  out << (shape.empty() ? "[]" : "]");
  return out.str();
}

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

std::string dtype_name(ScalarType type) {
  constexpr std::pair<ScalarType, const char*> kNames[] = {
      {kHalf, "float16"}, {kBFloat16, "bfloat16"}, {kFloat, "float32"}, {kDouble, "float64"},
      {kByte, "uint8"},   {kInt, "int32"},         {kLong, "int64"},    {kBool, "bool"}};
  for (const auto& [known, name] : kNames) {
    if (type == known) return name;
  }
  return toString(type);
}

bool matches(const Tensor& tensor, const Shape& shape) {
  if (tensor.dim() != static_cast<int64_t>(shape.size())) return false;
  for (size_t i = 0; i < shape.size(); ++i) {
    if (shape[i].letter == nullptr && tensor.size(i) != shape[i].size) return false;
  }
  return true;
}

std::string item_name(const char* list, size_t i) { return std::string(list) + "[" + std::to_string(i) + "]"; }

void check_length(const char* function, const char* list, size_t length, size_t expected) {
  DSMOE_CHECK_VALUE(length == expected, function, ": ", list, " has length ", length, "; it must be ", expected);
}

int64_t first_set(const Tensor& flags) {
  const Tensor indices = to_cpu(nonzero(flags));
  return indices.numel() == 0 ? -1 : indices.data_ptr<int64_t>()[0];
}

Expect::Expect(const char* function, const char* like_name, const Tensor& like)
    : function(function), like_name_(like_name), like_(like), tangents_(forward_mode_is_open()) {
  DSMOE_CHECK_VALUE(like.defined(), function, ": ", like_name, " is absent; it must be given");
  const ScalarType type = like.scalar_type();
  DSMOE_CHECK_TYPE(type == kFloat || type == kDouble, function, ": ", like_name, " is ", dtype_name(type),
                   "; it must be float32 or float64: cast it, for instance with ", like_name, ".float()");
}

void Expect::check_kind(std::string_view name, const Tensor& tensor, ScalarType type) const {
  const ScalarType expected = type == kAsLike ? like_.scalar_type() : type;
  DSMOE_CHECK_VALUE(tensor.defined(), function, ": ", name, " is absent; it must be given");
  DSMOE_CHECK_TYPE(tensor.scalar_type() == expected, function, ": ", name, " is ", dtype_name(tensor.scalar_type()),
                   "; it must be ", dtype_name(expected),
                   type == kAsLike ? std::string(", as ") + like_name_ + " is" : "");
  DSMOE_CHECK_TYPE(tensor.device() == like_.device(), function, ": ", name, " is on ", tensor.device(),
                   "; it must be on ", like_.device(), ", as ", like_name_, " is");
  DSMOE_CHECK_NOT_IMPLEMENTED(!tangents_ || !has_tangent(tensor), function,
                              ": forward-mode derivatives (torch.func.jvp, jacfwd, dual tensors) are not implemented; "
                              "take those of backward mode (torch.autograd.grad)");
}

void Expect::check_dense(std::string_view name, const Tensor& tensor) const {
  DSMOE_CHECK_VALUE(tensor.is_contiguous(), function, ": ", name, " is not contiguous; it must be");
}

void Expect::operator()(std::string_view name, const Tensor& tensor, const Shape& shape, ScalarType type) const {
  check_kind(name, tensor, type);
  DSMOE_CHECK_VALUE(matches(tensor, shape), function, ": ", name, " has shape ", tensor.sizes(), "; it must be ",
                    to_string(shape));
}

void Expect::dense(std::string_view name, const Tensor& tensor, const Shape& shape, ScalarType type) const {
  (*this)(name, tensor, shape, type);
  check_dense(name, tensor);
}

void Expect::dense_alike(const char* list, const Tensors& tensors, const Tensors& parameters) const {
  check_length(function, list, tensors.size(), parameters.size());
  for (size_t i = 0; i < tensors.size(); ++i) {
    const std::string name = item_name(list, i);
    check_kind(name, tensors[i], kAsLike);
    DSMOE_CHECK_VALUE(tensors[i].sizes() == parameters[i].sizes(), function, ": ", name, " has shape ",
                      tensors[i].sizes(), "; it must be ", parameters[i].sizes());
    check_dense(name, tensors[i]);
  }
}

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
  const bool has_end = inputs[kViewMatrixEnd].defined();
  DSMOE_CHECK_VALUE(has_end == (options.rolling_shutter != 0), function, ": viewmatrix_end is ",
                    has_end ? "given" : "absent", ", but rolling_shutter is ", options.rolling_shutter,
                    has_end ? "; it must be absent" : "; it must be given");
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
  int64_t columns = of.background.numel() + num_further_features(options);
  const int64_t filled_up = (columns + 3) / 4 * 4;
  if (of.features.dim() == 2 && of.features.size(1) == filled_up) columns = filled_up;
  expect("features", of.features, {count, columns});
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

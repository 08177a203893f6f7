// The arguments of the ops as C++ values, and torch tensors as the core's structs of pointers.
#pragma once

#include <algorithm>
#include <array>
#include <limits>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

#include "dsmoe/rasterize.h"
#include "fields.h"
#include "process.h"
#include "tensor.h"

namespace dsmoe {
namespace binding {

#define DSMOE_ENUMERATOR(enumerator, ...) enumerator,
#define DSMOE_NAME_OF_INPUT(enumerator, schema, name, ...) #name,
#define DSMOE_NAME_OF_IMAGE(enumerator, name) #name,

// The tensors that a rendering depends on, in the order of the ops' arguments.
enum Input : int { DSMOE_INPUTS(DSMOE_ENUMERATOR) kNumInputs };
constexpr const char* kInputNames[] = {DSMOE_INPUTS(DSMOE_NAME_OF_INPUT)};

// The tensors that a rendering makes for its caller, in the order of the op's results.
enum Image : int { DSMOE_IMAGES(DSMOE_ENUMERATOR) kNumImages };
constexpr const char* kImageNames[] = {DSMOE_IMAGES(DSMOE_NAME_OF_IMAGE)};

// The images that loss gradients arrive at, in the order of the backward op's arguments.
constexpr std::array kDifferentiable = {kColor, kGateSum, DSMOE_FEATURE_IMAGES(DSMOE_ENUMERATOR)};
static_assert(kDifferentiable.size() == kNumImages - 1, "all images but the radii");
static_assert(kDifferentiable.size() == 2 + kMostFurtherFeatures,
              "params.h: kMostFurtherFeatures counts DSMOE_FEATURE_IMAGES");

#undef DSMOE_ENUMERATOR
#undef DSMOE_NAME_OF_INPUT
#undef DSMOE_NAME_OF_IMAGE

// Calls body(image, field) for each image on request; field(struct) is the member that has its name.
template <class Body> void for_each_feature_image(const Body& body) {
#define DSMOE_CALL(enumerator, name) \
  body(                              \
      enumerator, [](auto& of) -> auto& { return of.name; });
  DSMOE_FEATURE_IMAGES(DSMOE_CALL)
#undef DSMOE_CALL
}

using Inputs = std::array<Tensor, kNumInputs>;  // an absent input is an undefined tensor
using Images = std::array<Tensor, kNumImages>;  // also their gradients, undefined if there is none
using Saved = Tensors;                          // the arrays of SavedForward, in the order of for_each_array
using InputMask = std::array<bool, kNumInputs>;

// The other arguments: numbers and flags.
struct Options {
#define DSMOE_MEMBER(type, schema, name) type name = {};
  DSMOE_OPTIONS(DSMOE_MEMBER)
#undef DSMOE_MEMBER
};

// How many features are behind the colour's channels.
inline int64_t num_further_features(const Options& options) {
  int64_t count = 0;
  for_each_feature_image([&](Image, auto field) { count += field(options); });
  return count;
}

template <class S> void ask_for_features(RasterConfig<S>& config, const Options& options) {
  for_each_feature_image([&](Image, auto field) { field(config) = field(options); });
}

inline int64_t num_gaussians(const Inputs& inputs) { return inputs[kMeans3D].size(0); }

inline int64_t num_channels(const Inputs& inputs) {
  return inputs[kColorsPrecomp].defined() ? inputs[kColorsPrecomp].size(1) : 3;
}

// Dense copies of the tensors that are not dense already.
Inputs contiguous(Inputs inputs);

// What the shapes of images depend on besides the options.
struct ImageSizes {
  int64_t num_gaussians, num_channels;
};
inline ImageSizes image_sizes(const Inputs& inputs) { return {num_gaussians(inputs), num_channels(inputs)}; }

// The shape of an image; of the radii too.
std::vector<int64_t> image_shape(Image image, const ImageSizes& sizes, const Options& options);

// All images, nothing filled. like: a tensor of their type and device.
Images allocate_images(const Tensor& like, const ImageSizes& sizes, const Options& options);

// A gradient for each input that wants one, nothing filled; the others stay undefined.
Inputs allocate_gradients(const Inputs& inputs, const InputMask& wanted);

ScalarType scalar_type(NumberType type);

// What one of the saved arrays looks like as a tensor: [rows] numbers, or [rows, columns].
std::vector<int64_t> saved_shape(const SavedArray& array);

// Torch's allocator, behind the core's interface.
class TensorMemory final : public Allocator {
 public:
  explicit TensorMemory(const Tensor& like) : like_(like) {}

  void* allocate(size_t bytes) override {
    scratch_.push_back(empty({static_cast<int64_t>(bytes)}, like_, kByte));
    return scratch_.back().data_ptr();
  }

  void* keep(int index, const SavedArray& array) override {
    if (saved_.size() <= static_cast<size_t>(index)) saved_.resize(index + 1);
    saved_[index] = Tensor();  // freed before the new one, if an array is asked for again
    saved_[index] = empty(saved_shape(array), like_, scalar_type(array.type));
    return saved_[index].data_ptr();
  }

  void release() override { scratch_.clear(); }

  // Puts a tensor that is there already among the saved ones.
  void give(int index, const Tensor& tensor) {
    if (saved_.size() <= static_cast<size_t>(index)) saved_.resize(index + 1);
    saved_[index] = tensor;
  }

  Saved take_saved() { return std::move(saved_); }

 private:
  const Tensor like_;
  Saved saved_, scratch_;
};

template <class S> const S* data(const Tensor& tensor) { return tensor.defined() ? tensor.data_ptr<S>() : nullptr; }

template <class S> S* mutable_data(const Tensor& tensor) {
  return tensor.defined() && tensor.numel() > 0 ? tensor.data_ptr<S>() : nullptr;
}

// A number that the core checks: one that fits no int must not become one that does.
inline int to_int(int64_t value) {
  using Limits = std::numeric_limits<int>;
  return static_cast<int>(std::clamp<int64_t>(value, Limits::min(), Limits::max()));
}

template <class S> GaussianInputs<S> gaussian_inputs(const Inputs& inputs, const Options& options) {
  GaussianInputs<S> out;
  out.num_gaussians = num_gaussians(inputs);
  static const S none = 0;
  const auto array = [&](Input i) {  // not null if it is given, be it without elements
    return out.num_gaussians == 0 && inputs[i].defined() ? &none : data<S>(inputs[i]);
  };
  out.means3D = array(kMeans3D);
  out.opacities = array(kOpacities);
  out.scales = array(kScales);
  out.rotations = array(kRotations);
  out.cov3D_precomp = array(kCov3DPrecomp);
  out.colors_precomp = array(kColorsPrecomp);
  out.dc = array(kDc);
  out.shs = array(kShs);
  out.num_sh = inputs[kShs].defined() ? to_int(inputs[kShs].size(1)) : 0;
  out.sh_degree = to_int(options.sh_degree);
  return out;
}

// What decides which pairs count and how they are blended.
template <class S> RasterConfig<S> blend_config(const Tensor& background_gate, const Options& options) {
  RasterConfig<S> out;
  out.blend.mode = static_cast<BlendMode>(to_int(options.blend_mode));
  out.blend.background_gate = static_cast<S>(options.fixed_background_gate);
  out.blend.background_gate_at = data<S>(background_gate);
  out.blend.alpha_min = static_cast<float>(options.alpha_min);  // thresholds are float32 values in every scalar type
  out.blend.faint_below = static_cast<float>(options.faint_below);
  out.most_instances = most_instances();
  return out;
}

template <class S> RasterConfig<S> raster_config(const Inputs& inputs, const Options& options) {
  RasterConfig<S> out = blend_config<S>(inputs[kBackgroundGate], options);
  out.num_channels = static_cast<int>(num_channels(inputs));
  out.background = data<S>(inputs[kBackground]);
  out.scale_modifier = static_cast<S>(options.scale_modifier);
  out.low_pass = static_cast<S>(options.low_pass);
  out.antialiasing = options.antialiasing;
  ask_for_features(out, options);
  out.clamp_color = options.clamp_color;
  return out;
}

// The same, of a rendering of footprints.
template <class S>
RasterConfig<S> footprint_config(const Tensor& background, const Tensor& background_gate, const Options& options) {
  RasterConfig<S> out = blend_config<S>(background_gate, options);
  out.num_channels = static_cast<int>(background.numel());
  out.background = data<S>(background);
  ask_for_features(out, options);
  return out;
}

// Of a camera of either backend, all but its tensors.
template <class Camera> void set_image(Camera& camera, const Options& options) {
  camera.width = static_cast<int>(options.image_width);
  camera.height = static_cast<int>(options.image_height);
  camera.tan_fov_x = static_cast<decltype(camera.tan_fov_x)>(options.tanfovx);
  camera.tan_fov_y = static_cast<decltype(camera.tan_fov_y)>(options.tanfovy);
  camera.near = static_cast<float>(options.near);
}

template <class S> ImageOutputs<S> image_outputs(const Images& images) {
  ImageOutputs<S> out;
  out.color = mutable_data<S>(images[kColor]);
  for_each_feature_image([&](Image image, auto field) { field(out) = mutable_data<S>(images[image]); });
  out.radii = mutable_data<int32_t>(images[kRadii]);
  out.gate_sum = mutable_data<S>(images[kGateSum]);
  return out;
}

template <class S> ImageGradients<S> image_gradients(const Images& gradients) {
  ImageGradients<S> out;
  out.color = data<S>(gradients[kColor]);
  out.gate_sum = data<S>(gradients[kGateSum]);
  for_each_feature_image([&](Image image, auto field) { field(out) = data<S>(gradients[image]); });
  return out;
}

// Those of the camera and of the background are left out: the core returns each in one piece.
template <class S> GaussianGradients<S> gaussian_gradients(const Inputs& gradients) {
  GaussianGradients<S> out;
  out.means3D = mutable_data<S>(gradients[kMeans3D]);
  out.means2D = mutable_data<S>(gradients[kMeans2D]);
  out.means2D_abs = mutable_data<S>(gradients[kMeans2DAbs]);
  out.opacities = mutable_data<S>(gradients[kOpacities]);
  out.scales = mutable_data<S>(gradients[kScales]);
  out.rotations = mutable_data<S>(gradients[kRotations]);
  out.cov3D_precomp = mutable_data<S>(gradients[kCov3DPrecomp]);
  out.colors_precomp = mutable_data<S>(gradients[kColorsPrecomp]);
  out.dc = mutable_data<S>(gradients[kDc]);
  out.shs = mutable_data<S>(gradients[kShs]);
  return out;
}

// Numbers of a view in the ops on batches, whose last ones are those of its lens.
constexpr int kMostLensNumbers = 2 + kMostDistortion, kNumbersOfImage = 7 + kMostLensNumbers;

// The lens of the options, whose focal lengths are in the tangents, as those of a pinhole are.
template <class S> Lens<S> lens_of(const Options& options) {
  LensCalibration of;
  of.model = static_cast<LensModel>(to_int(options.camera_model));
  if (of.model == LensModel::kPinhole && options.lens.empty()) return {};
  constexpr size_t kPrincipal = 2;
  if (options.lens.size() < kPrincipal) {
    throw std::invalid_argument("lens_of: lens has length " + std::to_string(options.lens.size()) +
                                "; it must hold the principal point and the distortion");
  }
  of.width = static_cast<int>(options.image_width), of.height = static_cast<int>(options.image_height);
  of.fx = of.width / (2 * options.tanfovx), of.fy = of.height / (2 * options.tanfovy);
  of.cx = options.lens[0], of.cy = options.lens[1];
  of.distortion.assign(options.lens.begin() + kPrincipal, options.lens.end());
  return dsmoe::lens_of(of).as<S>();
}

// Everything of a rendering but its camera's tensors and what it saved.
template <class S, class Frame> void fill_frame(Frame& frame, const Inputs& inputs, const Options& options) {
  frame.inputs = gaussian_inputs<S>(inputs, options);
  frame.config = raster_config<S>(inputs, options);
  set_image(frame.camera, options);
  frame.camera.lens = lens_of<S>(options);
  frame.camera.shutter = static_cast<Shutter>(to_int(options.rolling_shutter));
}

// A gradient that the core returns in one piece, and the inputs whose gradients are its parts, in their order.
struct JointGradient {
  struct Part {
    Input input;
    int64_t size;
  };
  std::vector<Part> parts;
  Tensor whole;  // undefined if none of the parts is wanted

  JointGradient(std::vector<Part> parts, const Inputs& gradients, const Tensor& like) : parts(std::move(parts)) {
    int64_t size = 0;
    bool wanted = false;
    for (const auto& part : this->parts) size += part.size, wanted |= gradients[part.input].defined();
    if (wanted) whole = empty({size}, like);
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

// Fills out.inputs, calls `backward`, and stores the gradients that it returned in one piece. seen_only: as in
// params.h.
template <class S, class Gradients, class Backward>
void with_input_gradients(const Inputs& inputs, const Inputs& gradients, bool seen_only, Gradients& out,
                          Backward backward) {
  const Tensor& like = inputs[kMeans3D];
  const JointGradient camera({{kViewMatrix, 16}, {kProjMatrix, 16}, {kCampos, 3}, {kViewMatrixEnd, 16}}, gradients,
                             like);
  const JointGradient background({{kBackground, num_channels(inputs)}, {kBackgroundGate, 1}}, gradients, like);
  out.inputs = gaussian_gradients<S>(gradients);
  out.inputs.camera = reinterpret_cast<CameraGradient<S>*>(mutable_data<S>(camera.whole));
  out.inputs.background = mutable_data<S>(background.whole);
  out.inputs.seen_only = seen_only;
  backward();
  camera.store(gradients);
  background.store(gradients);
}

}  // namespace binding
}  // namespace dsmoe

// dsmoe/torch.h: the op `rasterize` with its arguments by name, and its gradient for C++. Python has its own autograd
// formula over the same ops (autograd.py), which torch.compile sees through.
#include <torch/csrc/autograd/custom_function.h>

#include <algorithm>
#include <string_view>

#include "call_op.h"
#include "checks.h"
#include "dsmoe/camera.h"
#include "dsmoe/torch.h"
#include "tensors.h"

namespace dsmoe {
namespace {

using binding::Inputs;
using binding::kNumImages;
using binding::kNumInputs;
using torch::autograd::AutogradContext;
using torch::autograd::variable_list;

// The settings, with what the op takes under a name of the settings but as something else.
struct Given : GaussianRasterizationSettings {
  using Settings = GaussianRasterizationSettings;
  Given(const Settings& settings, const RasterizeArguments& arguments);

  int64_t blend_mode = 0;
  double fixed_background_gate = 0, faint_below = 0;
  at::Tensor background_gate;
  int64_t camera_model = 0, rolling_shutter = 0;
  std::vector<double> lens;
  bool depth = false, inverse_depth = false, for_backward = false;

 private:
  void resolve_blend();
  void resolve_lens();
};

// For messages alone.
std::string output_names() {
  std::string names = "alpha";
  binding::for_each_feature_image([&](binding::Image image, auto) { (names += ", ") += binding::kImageNames[image]; });
  return names;
}

std::string mode_names() {
  std::string names;
  BlendModes::for_each([&](auto mode) { (names += names.empty() ? "" : ", ") += Blend<decltype(mode)::value>::kName; });
  return names;
}

Given::Given(const Settings& settings, const RasterizeArguments& arguments) : Settings(settings) {
  resolve_blend();
  resolve_lens();
  for (const std::string& name : arguments.outputs) {
    bool known = name == "alpha";
    binding::for_each_feature_image([&](binding::Image image, auto field) {
      if (name == binding::kImageNames[image]) field(*this) = known = true;
    });
    TORCH_CHECK_VALUE(known, "rasterize: outputs holds '", name, "'; it may hold ", output_names());
  }
}

void Given::resolve_blend() {
  blend_mode = -1;
  bool learns_gate = false;
  BlendModes::for_each([&](auto mode) {
    using Policy = Blend<decltype(mode)::value>;
    if (Settings::blend_mode != Policy::kName) return;
    blend_mode = static_cast<int64_t>(mode());
    learns_gate = Policy::kLearnsGate;
    fixed_background_gate = Policy::background_gate(0.0);
    faint_below = Settings::faint_below.value_or(Policy::kFaintBelow);
  });
  TORCH_CHECK_VALUE(blend_mode >= 0, "rasterize: blend_mode is '", Settings::blend_mode, "'; it must be one of ",
                    mode_names());
  const std::optional<BackgroundGate>& gate = Settings::background_gate;
  const bool is_one = gate && !gate->tensor.defined() && gate->number == 1;
  if (!gate || (!learns_gate && fixed_background_gate == 1 && is_one)) return;
  TORCH_CHECK_VALUE(learns_gate, "rasterize: background_gate is given, but blend_mode is '", Settings::blend_mode,
                    "'; only 'smoe' and 'smoe_eq7' know it");
  if (gate->tensor.defined()) {
    background_gate = gate->tensor;
    return;
  }
  fixed_background_gate = gate->number;
  if (is_one && Settings::blend_mode == Blend<BlendMode::kSmoeEq7>::kName) {
    blend_mode = static_cast<int64_t>(BlendMode::kAlpha);
  }
}

// The place of a setting's value among its names.
template <size_t kCount>
int64_t number_of(const char* setting, const std::string& value, const char* const (&names)[kCount]) {
  std::string all;
  for (size_t i = 0; i < kCount; ++i) {
    if (value == names[i]) return static_cast<int64_t>(i);
    all += (i == 0 ? "" : ", ") + std::string(names[i]);
  }
  TORCH_CHECK_VALUE(false, "rasterize: ", setting, " is '", value, "'; it must be one of ", all);
}

void Given::resolve_lens() {
  camera_model = number_of("camera_model", Settings::camera_model, kLensNames);
  rolling_shutter = number_of("rolling_shutter", Settings::rolling_shutter, kShutterNames);
  if (camera_model == 0 && rolling_shutter != 0 && distortion.empty()) {
    TORCH_CHECK_VALUE(principal_point, "rasterize: principal_point is absent, but rolling_shutter is '",
                      Settings::rolling_shutter, "', with which projmatrix is not read; it must be given");
    camera_model = static_cast<int64_t>(LensModel::kOpencv);
  }
  if (camera_model == 0) {
    TORCH_CHECK_VALUE(distortion.empty() && !principal_point,
                      "rasterize: ", distortion.empty() ? "principal_point" : "distortion",
                      " is given, but camera_model is 'pinhole'; it must be absent");
    return;
  }
  const std::array<double, 2> centre = {static_cast<double>(image_width) / 2, static_cast<double>(image_height) / 2};
  const auto principal = principal_point.value_or(centre);
  lens.assign(principal.begin(), principal.end());
  lens.insert(lens.end(), distortion.begin(), distortion.end());
}

// The op's tensors in their order; absent ones are undefined.
Inputs gather(const at::Tensor& means3D, const at::Tensor& opacities, const Given& given,
              const RasterizeArguments& arguments) {
  struct : RasterizeArguments {
    at::Tensor means3D, opacities, bg, viewmatrix, projmatrix, campos, viewmatrix_end, background_gate;
  } all;
  static_cast<RasterizeArguments&>(all) = arguments;
  all.means3D = means3D, all.opacities = opacities, all.bg = given.bg, all.viewmatrix = given.viewmatrix;
  all.viewmatrix_end = given.viewmatrix_end, all.projmatrix = given.projmatrix, all.campos = given.campos,
  all.background_gate = given.background_gate;
  Inputs inputs;
  const auto add = [&](int index, std::string_view schema, const at::Tensor& tensor) {
    const bool may_be_absent = schema == "Tensor?" && tensor.defined() && tensor.numel() == 0;
    if (!may_be_absent || (means3D.numel() == 0 && tensor.dim() != 1)) inputs[index] = tensor;
  };
#define DSMOE_ADD(enumerator, schema, name, ...) add(binding::enumerator, schema, all.name);
  DSMOE_INPUTS(DSMOE_ADD)
#undef DSMOE_ADD
  return inputs;
}

// The op's other arguments in their order.
std::vector<c10::IValue> gather_options(const Given& given) {
  std::vector<c10::IValue> options;
#define DSMOE_ADD(type, schema, name) options.emplace_back(static_cast<type>(given.name));
  DSMOE_OPTIONS(DSMOE_ADD)
#undef DSMOE_ADD
  return options;
}

// What autograd takes: the tensors that are present, and what says how the op is called with them.
struct Call {
  variable_list tensors;
  c10::List<bool> present;  // kNumInputs
  std::vector<c10::IValue> options;
  variable_list* saved = nullptr;  // where what the backend saves goes too, or null
};

// The images, and behind them what the backend saves.
variable_list call_rasterize(const Call& call) {
  static const c10::OperatorHandle op = binding::find_op("rasterize");
  torch::jit::Stack stack;
  auto next = call.tensors.begin();
  for (const bool present : call.present) stack.push_back(present ? c10::IValue(*next++) : c10::IValue());
  stack.insert(stack.end(), call.options.begin(), call.options.end());
  binding::call_boxed(op, stack);
  variable_list results;
  for (int i = 0; i < kNumImages; ++i) results.push_back(stack[i].toTensor());
  const variable_list saved = stack[kNumImages].toTensorVector();
  if (call.saved != nullptr) *call.saved = saved;
  results.insert(results.end(), saved.begin(), saved.end());
  return results;
}

struct Rasterize : torch::autograd::Function<Rasterize> {
  // tensors: the call's, if autograd sees them.
  static variable_list forward(AutogradContext* context, at::TensorList tensors, const Call& call) {
    variable_list results = call_rasterize(call), kept = tensors.vec();
    kept.insert(kept.end(), results.begin(), results.end());
    context->save_for_backward(std::move(kept));
    context->saved_data["present"] = call.present;
    context->saved_data["options"] = c10::ivalue::Tuple::create(call.options);
    context->set_materialize_grads(false);
    context->mark_non_differentiable({results[binding::kRadii]});
    results.resize(kNumImages);
    return results;
  }

  static variable_list backward(AutogradContext* context, variable_list image_gradients) {
    static const c10::OperatorHandle op = binding::find_op("rasterize_backward");
    TORCH_CHECK(!at::GradMode::is_enabled(), "rasterize: second derivatives are not implemented; leave out ",
                "create_graph");
    const variable_list kept = context->get_saved_variables();
    const c10::List<bool> present = context->saved_data["present"].toBoolList();
    c10::List<bool> wanted;
    size_t count = 0;  // of the tensors
    for (const bool here : present) wanted.push_back(here && context->needs_input_grad(count++));
    const auto images = kept.begin() + static_cast<int64_t>(count), saved = images + kNumImages;

    torch::jit::Stack stack;
    for (binding::Image image : binding::kDifferentiable) {
      const at::Tensor& gradient = image_gradients[image];
      stack.push_back(gradient.defined() ? c10::IValue(gradient) : c10::IValue());
    }
    torch::jit::push(stack, variable_list(kept.begin(), images), present, variable_list(images, saved),
                     variable_list(saved, kept.end()));
    for (const c10::IValue& option : context->saved_data["options"].toTupleRef().elements()) stack.push_back(option);
    stack.emplace_back(wanted);
    binding::call_boxed(op, stack);

    const variable_list results = stack[0].toTensorVector();
    auto next = results.begin();
    variable_list gradients;
    for (int i = 0; i < kNumInputs; ++i) {
      if (present[i]) gradients.push_back(wanted[i] ? *next++ : at::Tensor());
    }
    gradients.emplace_back();  // by the call
    return gradients;
  }
};

}  // namespace

// What the ops of scores take besides maps.
struct Splats::Saved {
  at::Tensor color, radii, gate_sum, background;
  c10::IValue background_gate;  // a tensor, or none
  variable_list arrays;
  std::vector<c10::IValue> options;
};

namespace {

// splats: filled, or null.
Rendering render(const at::Tensor& means3D, const at::Tensor& opacities, const GaussianRasterizationSettings& settings,
                 const RasterizeArguments& arguments, Splats::Saved* splats) {
  Given given(settings, arguments);
  Call call;
  const Inputs inputs = gather(means3D, opacities, given, arguments);
  for (const at::Tensor& tensor : inputs) {
    call.present.push_back(tensor.defined());
    if (tensor.defined()) call.tensors.push_back(tensor);
  }
  given.for_backward = at::GradMode::is_enabled() && std::any_of(call.tensors.begin(), call.tensors.end(),
                                                                 [](const auto& t) { return t.requires_grad(); });
  call.options = gather_options(given);
  if (splats != nullptr) call.saved = &splats->arrays;
  const variable_list images =
      given.for_backward ? Rasterize::apply(at::TensorList(call.tensors), call) : call_rasterize(call);
  if (splats != nullptr) {
    splats->color = images[binding::kColor].detach(), splats->gate_sum = images[binding::kGateSum].detach();
    splats->radii = images[binding::kRadii];
    // Copies: an optimizer may change these before anybody asks for sums.
    splats->background = inputs[binding::kBackground].detach().clone();
    const at::Tensor& gate = inputs[binding::kBackgroundGate];
    if (gate.defined()) splats->background_gate = gate.detach().clone();
    splats->options = call.options;
  }
  const auto& wanted = arguments.outputs;
  const bool alpha = std::find(wanted.begin(), wanted.end(), "alpha") != wanted.end();
  const auto if_asked = [&](bool asked, binding::Image image) { return asked ? images[image] : at::Tensor(); };
  return {images[binding::kColor], images[binding::kRadii], if_asked(alpha, binding::kGateSum),
          if_asked(given.depth, binding::kDepth), if_asked(given.inverse_depth, binding::kInverseDepth)};
}

const Splats::Saved& saved_of(const Splats& splats, const char* function) {
  TORCH_CHECK_VALUE(splats.saved, function, ": these Splats are of no rendering; rasterize_with_splats makes them");
  return *splats.saved;
}

// Calls an op with maps or images, then what every op of scores takes.
torch::jit::Stack score(const char* name, torch::jit::Stack stack, const Splats::Saved& saved) {
  torch::jit::push(stack, saved.radii, saved.arrays, saved.background_gate);
  stack.insert(stack.end(), saved.options.begin(), saved.options.end());
  binding::call_boxed(binding::find_op(name), stack);
  return stack;
}

}  // namespace

Rendering rasterize(const at::Tensor& means3D, const at::Tensor& opacities,
                    const GaussianRasterizationSettings& settings, const RasterizeArguments& arguments) {
  return render(means3D, opacities, settings, arguments, nullptr);
}

std::pair<Rendering, Splats> rasterize_with_splats(const at::Tensor& means3D, const at::Tensor& opacities,
                                                   const GaussianRasterizationSettings& settings,
                                                   const RasterizeArguments& arguments) {
  const auto saved = std::make_shared<Splats::Saved>();
  return {render(means3D, opacities, settings, arguments, saved.get()), Splats{saved}};
}

Contributions Splats::contributions(const at::Tensor& pixel_weights) const {
  TORCH_CHECK_VALUE(pixel_weights.defined(), "contributions: pixel_weights is undefined; it must be given");
  const auto sums = score("contributions", {pixel_weights.detach()}, saved_of(*this, "contributions"));
  return {sums[0].toTensor(), sums[1].toTensor(), sums[2].toTensor(), sums[3].toTensor()};
}

Importance Splats::importance(const at::Tensor& pixel_weights, const at::Tensor& share_weights) const {
  const Saved& own = saved_of(*this, "importance");
  const at::Tensor weights = pixel_weights.defined() ? pixel_weights.detach() : at::ones_like(own.gate_sum[0]);
  const at::Tensor of_shares = share_weights.defined() ? share_weights.detach() : weights;
  const auto sums = score("importance", {weights, of_shares, own.color, own.gate_sum, own.background}, own);
  return {sums[0].toTensor(), sums[1].toTensor(), sums[2].toTensor()};
}

std::tuple<at::Tensor, at::Tensor, at::Tensor> Splats::gate_map() const {
  const Saved& own = saved_of(*this, "gate_map");
  const auto maps = score("gate_map", {own.gate_sum}, own);
  return {maps[0].toTensor(), maps[1].toTensor(), maps[2].toTensor()};
}

// From a calibrated pinhole camera to the settings of a rendering, as camera.py does it for Python. The matrices are
// those of `pinhole_camera` (camera.h). Here tensors make them, through which gradients reach K, R and t.
GaussianRasterizationSettings settings_from_camera(const at::Tensor& K, const at::Tensor& R, const at::Tensor& t,
                                                   int64_t width, int64_t height, const at::Tensor& bg,
                                                   int64_t sh_degree, double scale_modifier) {
  const char* function = "settings_from_camera";
  TORCH_CHECK_VALUE(binding::matches(K, {3, 3}) && binding::matches(R, {3, 3}) && binding::matches(t, {3}), function,
                    ": K, R and t have shapes ", K.sizes(), ", ", R.sizes(), " and ", t.sizes(),
                    "; they must be [3, 3], [3, 3] and [3]");
  const at::Tensor intrinsics = K.to(at::kDouble), rotation = R.to(at::kDouble), translation = t.to(at::kDouble);
  const double fx = intrinsics[0][0].item<double>(), fy = intrinsics[1][1].item<double>();
  const at::Tensor pinhole = intrinsics.clone();
  pinhole[0][1].fill_(0), pinhole[1][0].fill_(0), pinhole[2].copy_(at::eye(3, intrinsics.options())[2]);
  TORCH_CHECK_VALUE(fx > 0 && fy > 0 && at::equal(intrinsics, pinhole), function, ": K is ", intrinsics,
                    "; it must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] with fx and fy above 0");
  const at::Tensor identity = at::eye(3, rotation.options());
  const double error = (rotation.mm(rotation.t()) - identity).abs().max().item<double>();
  TORCH_CHECK_VALUE(error < 1e-3 && at::det(rotation).item<double>() > 0, function, ": R must be a rotation");

  const at::Tensor last = identity.new_zeros({1, 4});
  last[0][3].fill_(1);
  const at::Tensor view = at::cat({at::cat({rotation, translation.unsqueeze(1)}, 1), last}, 0);
  const at::Tensor size = identity.new_ones({2, 1}), centre = identity.new_zeros({1, 3});
  size[0].fill_(static_cast<double>(width));
  size[1].fill_(static_cast<double>(height));
  centre[0][2].fill_(1);
  const at::Tensor image = 2 * intrinsics.narrow(0, 0, 2) / size - centre;
  const at::Tensor lower = identity.new_zeros({2, 4});
  lower[0][2].fill_(kClipFar / (kClipFar - kClipNear));
  lower[0][3].fill_(-kClipNear * kClipFar / (kClipFar - kClipNear));
  lower[1][2].fill_(1);
  const at::Tensor clip = at::cat({at::cat({image, identity.new_zeros({2, 1})}, 1), lower}, 0);

  const auto place = [&](const at::Tensor& matrix) { return matrix.contiguous().to(bg.device(), bg.scalar_type()); };
  GaussianRasterizationSettings settings;
  settings.image_height = height, settings.image_width = width;
  settings.tanfovx = static_cast<double>(width) / (2 * fx), settings.tanfovy = static_cast<double>(height) / (2 * fy);
  settings.bg = bg;
  settings.scale_modifier = scale_modifier;
  settings.viewmatrix = place(view.t());
  settings.projmatrix = place(clip.mm(view).t());
  settings.sh_degree = sh_degree;
  settings.campos = place(-rotation.t().mv(translation));
  return settings;
}

}  // namespace dsmoe

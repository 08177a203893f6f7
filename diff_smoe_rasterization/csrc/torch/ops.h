// The ops, once for all backends: from torch's stack of arguments to C++ values, checks, and the results back. Their
// functions are boxed, so that no list of arguments is written here: fields.h has the only one. A Backend renders:
// ops_cpu.cpp and ops_cuda.cpp.
#pragma once

#include <ATen/Dispatch.h>
#include <ATen/core/dispatch/Dispatcher.h>  // OperatorHandle
#include <ATen/core/stack.h>
#include <torch/library.h>

#include <algorithm>
#include <stdexcept>
#include <string>
#include <tuple>
#include <vector>

#include "checks.h"
#include "tensors.h"

namespace dsmoe {
namespace binding {

// Reads the arguments of an op in their order.
class Arguments {
 public:
  Arguments(const c10::OperatorHandle& op, torch::jit::Stack& stack)
      : stack_(stack), begin_(stack.size() - op.schema().arguments().size()), next_(begin_) {}

  void read(at::Tensor& value) {  // undefined where it is None
    const c10::IValue& argument = next();
    value = argument.isNone() ? at::Tensor() : argument.toTensor();
  }
  void read(int64_t& value) { value = next().toInt(); }
  void read(double& value) { value = next().toDouble(); }
  void read(bool& value) { value = next().toBool(); }
  void read(std::vector<at::Tensor>& value) { value = next().toTensorVector(); }
  void read(std::vector<bool>& value) {
    for (const bool flag : next().toBoolList()) value.push_back(flag);
  }
  void read(Inputs& value) {
    for (at::Tensor& tensor : value) read(tensor);
  }
  void read(Options& value) {
#define DSMOE_READ(type, schema, name) read(value.name);
    DSMOE_OPTIONS(DSMOE_READ)
#undef DSMOE_READ
  }

  template <class T> T read() {
    T value = {};
    read(value);
    return value;
  }

  // Takes the arguments from the stack, which makes place for the results.
  template <class... Results> void give_back(Results&&... results) {
    stack_.resize(begin_);
    torch::jit::push(stack_, std::forward<Results>(results)...);
  }

  // The same of the images and what was saved.
  void give_back_images(const Images& images, bool with_radii, Saved saved) {
    stack_.resize(begin_);
    for (int i = 0; i < kNumImages; ++i) {
      if (i != kRadii || with_radii) stack_.emplace_back(images[i]);
    }
    stack_.emplace_back(std::move(saved));
  }

 private:
  const c10::IValue& next() { return stack_[next_++]; }

  torch::jit::Stack& stack_;
  size_t begin_, next_;
};

// Calls body(S()) with the type of `like`. What the core refuses is a ValueError, which names the op in place of the
// core's function, if that is named. What does not fit is a RuntimeError in Python; the core's own exception would be
// an OverflowError.
template <class Body> void dispatch(const char* function, const at::Tensor& like, Body body) {
  try {
    AT_DISPATCH_FLOATING_TYPES(like.scalar_type(), "diff_smoe_rasterization", [&] { body(scalar_t()); });
  } catch (const std::invalid_argument& error) {
    const std::string message = error.what();
    const size_t colon = message.find(": ");
    TORCH_CHECK_VALUE(false, function, colon == std::string::npos ? ": " + message : message.substr(colon));
  } catch (const std::overflow_error& error) {
    TORCH_CHECK(false, error.what());
  }
}

// What an op that projects asks of the values of its arguments. Returns them dense.
template <class Backend> Inputs checked(const char* function, const Inputs& inputs, const Options& options) {
  if (options.debug) {
    for (int i = kBackground; i <= kBackgroundGate; ++i) {
      refuse_nan(std::string(function) + ": " + kInputNames[i], inputs[i]);
    }
  }
  const Inputs dense = contiguous(inputs);
  if (options.strict) refuse_non_finite(function, dense);
  if (options.prefiltered) {
    refuse_culled(function, dense, Backend::visible(function, dense[kMeans3D], dense[kViewMatrix], options.near));
  }
  return dense;
}

// A call of `rasterize`, `radii` or `project`: its arguments, checked, and the device that they are on.
template <class Backend> struct RenderingCall {
  RenderingCall(const char* function, const c10::OperatorHandle& op, torch::jit::Stack& stack)
      : function(function),
        arguments(op, stack),
        given(arguments.read<Inputs>()),
        options(arguments.read<Options>()),
        guard(checked_device()),
        inputs(checked<Backend>(function, given, options)) {}

  // Calls body(S()).
  template <class Body> void run(Body body) const { dispatch(function, inputs[kMeans3D], body); }

  const char* const function;
  Arguments arguments;
  const Inputs given;
  const Options options;
  const typename Backend::Guard guard;
  const Inputs inputs;  // dense

 private:
  at::Device checked_device() const {
    check_arguments(function, given, options);
    return given[kMeans3D].device();
  }
};

template <class Backend> void rasterize(const c10::OperatorHandle& op, torch::jit::Stack* stack) {
  RenderingCall<Backend> call("rasterize", op, *stack);
  const Inputs& inputs = call.inputs;
  const Options& options = call.options;
  const Images images = allocate_images(inputs[kMeans3D], image_sizes(inputs), options);
  TensorMemory memory(inputs[kMeans3D]);
  call.run([&](auto zero) { Backend::template forward<decltype(zero)>(inputs, options, images, memory); });
  if (options.debug) {
    for (Image image : kDifferentiable) refuse_nan(std::string("rasterize: ") + kImageNames[image], images[image]);
  }
  call.arguments.give_back_images(images, /*with_radii=*/true, memory.take_saved());
}

template <class Backend> void radii(const c10::OperatorHandle& op, torch::jit::Stack* stack) {
  RenderingCall<Backend> call("radii", op, *stack);
  const Inputs& inputs = call.inputs;
  const Options& options = call.options;
  Images images;
  images[kRadii] = at::empty({num_gaussians(inputs)}, inputs[kMeans3D].options().dtype(at::kInt));
  TensorMemory memory(inputs[kMeans3D]);
  call.run([&](auto zero) { Backend::template radii<decltype(zero)>(inputs, options, images, memory); });
  call.arguments.give_back(images[kRadii]);
}

inline void check_length(const char* function, const char* name, size_t length, size_t expected) {
  TORCH_CHECK_VALUE(length == expected, function, ": ", name, " has length ", length, "; it must be ", expected);
}

// Reads the gradients by the images, and makes them dense.
inline Images read_image_gradients(Arguments& arguments) {
  Images gradients;
  for (Image image : kDifferentiable) {
    arguments.read(gradients[image]);
    if (gradients[image].defined()) gradients[image] = gradients[image].contiguous();
  }
  return gradients;
}

// Reads the inputs to their places: a list of those that are present, and which these are.
inline Inputs read_present(const char* function, Arguments& arguments) {
  const auto list = arguments.read<std::vector<at::Tensor>>();
  const auto present = arguments.read<std::vector<bool>>();
  check_length(function, "present", present.size(), kNumInputs);
  check_length(function, "inputs", list.size(), std::count(present.begin(), present.end(), true));
  for (Input i : {kMeans3D, kOpacities, kBackground, kViewMatrix, kProjMatrix, kCampos}) {
    TORCH_CHECK_VALUE(present[i], function, ": ", kInputNames[i], " is absent; it must be given");
  }
  Inputs inputs;
  auto next = list.begin();
  for (int i = 0; i < kNumInputs; ++i) {
    if (present[i]) inputs[i] = *next++;
  }
  return inputs;
}

// Reads of which inputs the gradients are wanted.
inline InputMask read_wanted(const char* function, Arguments& arguments) {
  const auto list = arguments.read<std::vector<bool>>();
  check_length(function, "wanted", list.size(), kNumInputs);
  InputMask wanted;
  std::copy(list.begin(), list.end(), wanted.begin());
  return wanted;
}

// The gradients that the caller has memory for, spread over the inputs that want one.
inline Inputs given_gradients(const char* function, const Inputs& inputs, const InputMask& wanted,
                              const std::vector<at::Tensor>& list) {
  check_length(function, "gradients", list.size(), std::count(wanted.begin(), wanted.end(), true));
  Inputs gradients;
  auto next = list.begin();
  for (int i = 0; i < kNumInputs; ++i) {
    if (!wanted[i]) continue;
    const std::string name = std::string("the gradient of ") + kInputNames[i];
    check_same_shape(function, name.c_str(), *next, kInputNames[i], inputs[i]);
    check_like(function, name.c_str(), *next, "means3D", inputs[kMeans3D]);
    check_contiguous(function, name.c_str(), *next);
    gradients[i] = *next++;
  }
  return gradients;
}

// kSeen: into the caller's memory, and only rows of Gaussians that were seen.
template <class Backend, bool kSeen> void rasterize_backward(const c10::OperatorHandle& op, torch::jit::Stack* stack) {
  const char* function = kSeen ? "rasterize_backward_seen" : "rasterize_backward";
  Arguments arguments(op, *stack);
  const Images image_gradients = read_image_gradients(arguments);
  const Inputs given = read_present(function, arguments);
  const auto image_list = arguments.read<std::vector<at::Tensor>>();
  const auto saved = arguments.read<Saved>();
  const auto options = arguments.read<Options>();
  const InputMask wanted = read_wanted(function, arguments);
  check_length(function, "images", image_list.size(), kNumImages);
  Images images;
  std::copy(image_list.begin(), image_list.end(), images.begin());

  check_backward_arguments(function, given, options, images, image_gradients, wanted);
  const typename Backend::Guard guard(given[kMeans3D].device());
  if (options.debug) {
    for (Image image : kDifferentiable) {
      refuse_nan(std::string(function) + ": dL_d" + kImageNames[image], image_gradients[image]);
    }
  }
  const Inputs inputs = contiguous(given);
  Inputs gradients;
  if constexpr (kSeen) {
    gradients = given_gradients(function, given, wanted, arguments.read<std::vector<at::Tensor>>());
  } else {
    gradients = allocate_gradients(inputs, wanted);
  }
  dispatch(function, inputs[kMeans3D], [&](auto zero) {
    Backend::template backward<decltype(zero)>(inputs, options, images, saved, image_gradients, gradients, kSeen);
  });
  if constexpr (kSeen) {
    for (const at::Tensor& gradient : gradients) {
      if (gradient.defined()) gradient.unsafeGetTensorImpl()->bump_version();
    }
    return arguments.give_back();
  }
  std::vector<at::Tensor> results;
  for (int i = 0; i < kNumInputs; ++i) {
    if (!wanted[i]) continue;
    if (options.debug) refuse_nan(std::string(function) + ": the gradient of " + kInputNames[i], gradients[i]);
    results.push_back(gradients[i]);
  }
  arguments.give_back(std::move(results));
}

// Rows of `columns` numbers, dense and vector-aligned; those behind the tensor's own hold anything.
inline at::Tensor padded(const at::Tensor& rows, int64_t columns) {
  const bool fits = rows.size(1) == columns && rows.is_contiguous();
  if (fits && reinterpret_cast<uintptr_t>(rows.data_ptr()) % 16 == 0) return rows;
  const at::Tensor out = at::empty({rows.size(0), columns}, rows.options());
  out.narrow(1, 0, rows.size(1)).copy_(rows);
  return out;
}

template <class Backend> void project(const c10::OperatorHandle& op, torch::jit::Stack* stack) {
  RenderingCall<Backend> call("project", op, *stack);
  const Inputs& inputs = call.inputs;
  const at::TensorOptions like = inputs[kMeans3D].options();
  const int64_t count = num_gaussians(inputs);
  const int64_t num_features = num_channels(inputs) + num_further_features(call.options);
  const at::Tensor gates = at::empty({count, kProjectedGaussianSize}, like);
  const at::Tensor features = at::empty({count, Backend::feature_columns(num_features)}, like);
  Images images;
  images[kRadii] = at::empty({count}, like.dtype(at::kInt));
  TensorMemory memory(gates);
  call.run([&](auto zero) {
    Backend::template project<decltype(zero)>(inputs, call.options, images, gates, features, memory);
  });
  call.arguments.give_back(gates, features.narrow(1, 0, num_features), images[kRadii]);
}

template <class Backend> void blend(const c10::OperatorHandle& op, torch::jit::Stack* stack) {
  Arguments arguments(op, *stack);
  Footprints of;
  for (auto* tensor : {&of.gates, &of.features, &of.radii, &of.background, &of.background_gate}) {
    arguments.read(*tensor);
  }
  const auto options = arguments.read<Options>();
  check_footprints("blend", of, options);
  const typename Backend::Guard guard(of.gates.device());
  of.gates = padded(of.gates, kProjectedGaussianSize);
  of.features = padded(of.features, Backend::feature_columns(of.features.size(1)));
  of.radii = of.radii.contiguous(), of.background = of.background.contiguous();
  const ImageSizes sizes = {of.gates.size(0), of.background.numel()};
  Images images = allocate_images(of.gates, sizes, options);
  images[kRadii] = of.radii;
  TensorMemory memory(of.gates);
  memory.give(0, of.gates), memory.give(1, of.features.view(-1));
  dispatch("blend", of.gates, [&](auto zero) { Backend::template blend<decltype(zero)>(of, options, images, memory); });
  arguments.give_back_images(images, /*with_radii=*/false, memory.take_saved());
}

template <class Backend> void blend_backward(const c10::OperatorHandle& op, torch::jit::Stack* stack) {
  const char* function = "blend_backward";
  Arguments arguments(op, *stack);
  const Images image_gradients = read_image_gradients(arguments);
  const auto image_list = arguments.read<std::vector<at::Tensor>>();
  const auto saved = arguments.read<Saved>();
  Footprints of;
  for (auto* tensor : {&of.radii, &of.background, &of.background_gate}) arguments.read(*tensor);
  const auto options = arguments.read<Options>();
  const auto wants_background = arguments.read<bool>();
  check_length(function, "images", image_list.size(), kDifferentiable.size());
  TORCH_CHECK_VALUE(saved.size() > 1, function, ": saved has length ", saved.size(),
                    "; it must be what blend returned");
  const int64_t num_features = of.background.numel() + num_further_features(options);
  const int64_t columns = Backend::feature_columns(num_features);
  of.gates = saved[0], of.features = saved[1];
  if (of.gates.dim() == 2 && of.features.numel() == of.gates.size(0) * columns) {
    of.features = of.features.view({of.gates.size(0), columns}).narrow(1, 0, num_features);
  }
  check_footprints(function, of, options);
  const ImageSizes sizes = {of.gates.size(0), of.background.numel()};
  Images images;
  for (size_t i = 0; i < image_list.size(); ++i) images[kDifferentiable[i]] = image_list[i];
  check_blend_backward_arguments(function, images, image_gradients, sizes, of.gates, options);
  const typename Backend::Guard guard(of.gates.device());
  images[kRadii] = of.radii = of.radii.contiguous();
  of.background = of.background.contiguous();
  const at::Tensor records = at::empty({sizes.num_gaussians, kNumGateGradients + num_features}, of.gates.options());
  const at::Tensor background = at::empty({wants_background ? sizes.num_channels + 1 : 0}, of.gates.options());
  dispatch(function, of.gates, [&](auto zero) {
    Backend::template blend_backward<decltype(zero)>(of, options, images, saved, image_gradients, records, background);
  });
  const int64_t channels = wants_background ? sizes.num_channels : 0;
  arguments.give_back(records, background.narrow(0, 0, channels).clone(),
                      background.narrow(0, channels, wants_background ? 1 : 0).clone());
}

template <class Backend> void project_backward(const c10::OperatorHandle& op, torch::jit::Stack* stack) {
  const char* function = "project_backward";
  Arguments arguments(op, *stack);
  const auto records = arguments.read<at::Tensor>().contiguous();
  at::Tensor dL_ddepths = arguments.read<at::Tensor>();
  const Inputs given = read_present(function, arguments);
  at::Tensor features = arguments.read<at::Tensor>();
  const auto radii = arguments.read<at::Tensor>();
  const auto options = arguments.read<Options>();
  const InputMask wanted = read_wanted(function, arguments);
  check_arguments(function, given, options);
  check_footprint_gradients(function, records, dL_ddepths, features, radii, given, options);
  for (int i = 0; i < kNumInputs; ++i) {
    TORCH_CHECK_VALUE(
        !wanted[i] || (given[i].defined() && i != kBackground && i != kBackgroundGate && i != kMeans2DAbs), function,
        ": the gradient of ", kInputNames[i], " is wanted, but no footprint depends on it");
  }
  const typename Backend::Guard guard(given[kMeans3D].device());
  features = padded(features, Backend::feature_columns(features.size(1)));
  if (dL_ddepths.defined()) dL_ddepths = dL_ddepths.contiguous();
  const Inputs inputs = contiguous(given), gradients = allocate_gradients(inputs, wanted);
  dispatch(function, records, [&](auto zero) {
    Backend::template project_backward<decltype(zero)>(inputs, options, features, radii, records, dL_ddepths,
                                                       gradients);
  });
  std::vector<at::Tensor> results;
  for (int i = 0; i < kNumInputs; ++i) {
    if (wanted[i]) results.push_back(gradients[i]);
  }
  arguments.give_back(std::move(results));
}

template <class Backend> void contributions(const c10::OperatorHandle& op, torch::jit::Stack* stack) {
  Arguments arguments(op, *stack);
  const auto pixel_weights = arguments.read<at::Tensor>();
  const auto radii = arguments.read<at::Tensor>();
  const auto saved = arguments.read<Saved>();
  const auto background_gate = arguments.read<at::Tensor>();
  const auto options = arguments.read<Options>();
  check_contribution_arguments("contributions", pixel_weights, radii, saved, background_gate, options);
  const typename Backend::Guard guard(radii.device());
  const auto real = [&] { return at::empty({radii.numel()}, pixel_weights.options()); };
  const at::Tensor weights = real(), pixels = at::empty_like(radii), blend_weights = real(), distances = real();
  const at::Tensor map = pixel_weights.contiguous();
  dispatch("contributions", map, [&](auto zero) {
    using S = decltype(zero);
    ContributionSums<S> sums;
    sums.pixel_weights = mutable_data<S>(weights);
    sums.pixels = mutable_data<int32_t>(pixels);
    sums.blend_weights = mutable_data<S>(blend_weights);
    sums.distances = mutable_data<S>(distances);
    Backend::template contributions<S>(map, radii, saved, blend_config<S>(background_gate, options), options, sums);
  });
  arguments.give_back(weights, pixels, blend_weights, distances);
}

template <class Backend> void importance(const c10::OperatorHandle& op, torch::jit::Stack* stack) {
  Arguments arguments(op, *stack);
  const auto pixel_weights = arguments.read<at::Tensor>();
  ImportanceImages images;
  for (auto* image : {&images.share_weights, &images.color, &images.gate_sum, &images.background})
    arguments.read(*image);
  const auto radii = arguments.read<at::Tensor>();
  const auto saved = arguments.read<Saved>();
  const auto background_gate = arguments.read<at::Tensor>();
  const auto options = arguments.read<Options>();
  check_contribution_arguments("importance", pixel_weights, radii, saved, background_gate, options);
  check_importance_images(images, saved[0], options);
  const typename Backend::Guard guard(radii.device());
  const auto sums = [&] { return at::empty({radii.numel()}, pixel_weights.options()); };
  const at::Tensor shares = sums(), squared_shares = sums(), removal_costs = sums();
  const at::Tensor weights = pixel_weights.contiguous();
  for (auto* image : {&images.share_weights, &images.color, &images.gate_sum, &images.background}) {
    *image = image->contiguous();
  }
  dispatch("importance", weights, [&](auto zero) {
    using S = decltype(zero);
    RasterConfig<S> config = blend_config<S>(background_gate, options);
    config.num_channels = static_cast<int>(images.color.size(0));
    config.background = data<S>(images.background);
    ask_for_features(config, options);
    ImportanceMap<S> map;
    map.color = data<S>(images.color);
    map.pixel_weights = data<S>(weights);
    map.share_weights = data<S>(images.share_weights);
    map.sums.shares = mutable_data<S>(shares);
    map.sums.squared_shares = mutable_data<S>(squared_shares);
    map.sums.removal_costs = mutable_data<S>(removal_costs);
    Backend::template importance<S>(images.gate_sum, radii, saved, config, options, map);
  });
  arguments.give_back(shares, squared_shares, removal_costs);
}

template <class Backend>
at::Tensor pack_footprints(const at::Tensor& gates, const at::Tensor& features, const at::Tensor& radii,
                           const at::Tensor& visible) {
  const char* function = "pack_footprints";
  TORCH_CHECK_TYPE(gates.scalar_type() == at::kFloat, function, ": gates is ", dtype_name(gates.scalar_type()),
                   "; it must be float32");
  check_shape(function, "gates", gates, {"N", kProjectedGaussianSize});
  check_like(function, "features", features, "gates", gates);
  check_shape(function, "features", features, {gates.size(0), "F"});
  check_result(function, "radii", radii, {gates.size(0)}, at::kInt, gates.device());
  check_result(function, "visible", visible, {visible.numel()}, at::kLong, gates.device());
  const typename Backend::Guard guard(gates.device());
  return Backend::pack_footprints(gates, features, radii, visible);
}

template <class Backend>
at::Tensor mark_visible(const at::Tensor& positions, const at::Tensor& viewmatrix, double near) {
  const typename Backend::Guard guard(positions.device());
  check_positions(positions, viewmatrix);
  return Backend::visible("mark_visible", positions.contiguous(), viewmatrix.contiguous(), near);
}

template <class Backend> void register_ops(torch::Library& m) {
  m.impl("rasterize", torch::CppFunction::makeFromBoxedFunction<&rasterize<Backend>>());
  m.impl("rasterize_backward", torch::CppFunction::makeFromBoxedFunction<&rasterize_backward<Backend, false>>());
  m.impl("rasterize_backward_seen", torch::CppFunction::makeFromBoxedFunction<&rasterize_backward<Backend, true>>());
  m.impl("project", torch::CppFunction::makeFromBoxedFunction<&project<Backend>>());
  m.impl("project_backward", torch::CppFunction::makeFromBoxedFunction<&project_backward<Backend>>());
  m.impl("blend", torch::CppFunction::makeFromBoxedFunction<&blend<Backend>>());
  m.impl("blend_backward", torch::CppFunction::makeFromBoxedFunction<&blend_backward<Backend>>());
  m.impl("radii", torch::CppFunction::makeFromBoxedFunction<&radii<Backend>>());
  m.impl("contributions", torch::CppFunction::makeFromBoxedFunction<&contributions<Backend>>());
  m.impl("importance", torch::CppFunction::makeFromBoxedFunction<&importance<Backend>>());
  m.impl("pack_footprints", &pack_footprints<Backend>);
  m.impl("mark_visible", &mark_visible<Backend>);
}

}  // namespace binding
}  // namespace dsmoe

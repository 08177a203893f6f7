// The ops, once for all backends: from torch's stack of arguments to C++ values, checks, and the results back. Their
// functions are boxed, so that no list of arguments is written here: fields.h has the only one. A Backend renders:
// ops_cpu.cpp and ops_cuda.cpp.
#pragma once

#include <algorithm>
#include <iterator>
#include <string>
#include <string_view>
#include <vector>

#include "op.h"

namespace dsmoe {
namespace binding {

// A call of `rasterize`, `radii` or `project`: its arguments, checked, and the device that they are on.
template <class Backend> struct RenderingCall {
  RenderingCall(const char* function, Arguments& arguments)
      : function(function),
        given(read_inputs(arguments)),
        options(read_options(arguments)),
        guard(checked_device()),
        inputs(checked<Backend>(function, given, options)) {}

  // Calls body(S()).
  template <class Body> void run(Body body) const { dispatch(function, inputs[kMeans3D], body); }

  const char* const function;
  const Inputs given;
  const Options options;
  const typename Backend::Guard guard;
  const Inputs inputs;  // dense

 private:
  Device checked_device() const {
    check_arguments(function, given, options);
    return given[kMeans3D].device();
  }
};

template <class Backend> void rasterize(Arguments& arguments) {
  RenderingCall<Backend> call("rasterize", arguments);
  const Inputs& inputs = call.inputs;
  const Options& options = call.options;
  Images images = allocate_images(inputs[kMeans3D], image_sizes(inputs), options);
  TensorMemory memory(inputs[kMeans3D]);
  call.run([&](auto zero) { Backend::template forward<decltype(zero)>(inputs, options, images, memory); });
  if (options.debug) {
    for (Image image : kDifferentiable) refuse_nan(std::string("rasterize: ") + kImageNames[image], images[image]);
  }
  arguments.give_back_with_list(Tensors(std::make_move_iterator(images.begin()), std::make_move_iterator(images.end())),
                                memory.take_saved());
}

template <class Backend> void radii(Arguments& arguments) {
  RenderingCall<Backend> call("radii", arguments);
  const Inputs& inputs = call.inputs;
  const Options& options = call.options;
  Images images;
  images[kRadii] = empty({num_gaussians(inputs)}, inputs[kMeans3D], kInt);
  TensorMemory memory(inputs[kMeans3D]);
  call.run([&](auto zero) { Backend::template radii<decltype(zero)>(inputs, options, images, memory); });
  arguments.give_back(images[kRadii]);
}

// Reads the gradients by the images, and makes them dense.
inline Images read_image_gradients(Arguments& arguments) {
  Images gradients;
  for (Image image : kDifferentiable) {
    arguments.read_optional(gradients[image]);
    if (gradients[image].defined()) gradients[image] = gradients[image].contiguous();
  }
  return gradients;
}

// The inputs of a backward op: a list of those that are present, and which these are.
struct PresentInputs {
  explicit PresentInputs(Arguments& arguments)
      : list(arguments.read<Tensors>()), present(arguments.read<std::vector<bool>>()) {}

  // Each at its place.
  Inputs spread(const char* function) const {
    check_length(function, "present", present.size(), kNumInputs);
    check_length(function, "inputs", list.size(), std::count(present.begin(), present.end(), true));
    Inputs inputs;
    auto next = list.begin();
    for (int i = 0; i < kNumInputs; ++i) {
      if (present[i]) inputs[i] = *next++;
    }
    return inputs;
  }

  Tensors list;
  std::vector<bool> present;
};

// Of which inputs the gradients are wanted.
inline InputMask to_mask(const char* function, const std::vector<bool>& list) {
  check_length(function, "wanted", list.size(), kNumInputs);
  InputMask wanted;
  std::copy(list.begin(), list.end(), wanted.begin());
  return wanted;
}

// The gradients that the caller has memory for, spread over the inputs that want one.
inline Inputs given_gradients(const Expect& expect, const Inputs& inputs, const InputMask& wanted,
                              const Tensors& list) {
  check_length(expect.function, "gradients", list.size(), std::count(wanted.begin(), wanted.end(), true));
  Inputs gradients;
  auto next = list.begin();
  for (int i = 0; i < kNumInputs; ++i) {
    if (!wanted[i]) continue;
    expect.dense(std::string("the gradient of ") + kInputNames[i], *next, shape_of(inputs[i].sizes()));
    gradients[i] = *next++;
  }
  return gradients;
}

// kSeen: into the caller's memory, and only rows of Gaussians that were seen.
template <class Backend, bool kSeen> void rasterize_backward(Arguments& arguments) {
  const char* function = kSeen ? "rasterize_backward_seen" : "rasterize_backward";
  const Images image_gradients = read_image_gradients(arguments);
  const PresentInputs present(arguments);
  const auto image_list = arguments.read<Tensors>();
  const Saved saved = read_saved(arguments);
  const auto options = read_options(arguments);
  const auto wanted_list = arguments.read<std::vector<bool>>();
  const auto written = kSeen ? arguments.read<Tensors>() : Tensors();
  const Inputs given = present.spread(function);
  const InputMask wanted = to_mask(function, wanted_list);
  check_length(function, "images", image_list.size(), kNumImages);
  Images images;
  std::copy(image_list.begin(), image_list.end(), images.begin());

  const Expect expect = check_arguments(function, given, options);
  check_images(expect, images, image_gradients, image_sizes(given), options);
  expect.dense("radii", images[kRadii], {num_gaussians(given)}, kInt);
  for (int i = 0; i < kNumInputs; ++i) {
    DSMOE_CHECK_VALUE(!wanted[i] || given[i].defined(), function, ": the gradient of ", kInputNames[i],
                      " is wanted, but that input is absent");
  }
  const typename Backend::Guard guard(given[kMeans3D].device());
  if (options.debug) {
    for (Image image : kDifferentiable) {
      refuse_nan(std::string(function) + ": dL_d" + kImageNames[image], image_gradients[image]);
    }
  }
  const Inputs inputs = contiguous(given);
  Inputs gradients;
  if constexpr (kSeen) {
    gradients = given_gradients(expect, given, wanted, written);
  } else {
    gradients = allocate_gradients(inputs, wanted);
  }
  dispatch(function, inputs[kMeans3D], [&](auto zero) {
    Backend::template backward<decltype(zero)>(expect, inputs, options, images, saved, image_gradients, gradients,
                                               kSeen);
  });
  if constexpr (kSeen) {
    note_change(written);
    return arguments.give_back();
  }
  Tensors results;
  for (int i = 0; i < kNumInputs; ++i) {
    if (!wanted[i]) continue;
    if (options.debug) refuse_nan(std::string(function) + ": the gradient of " + kInputNames[i], gradients[i]);
    results.push_back(gradients[i]);
  }
  arguments.give_back(std::move(results));
}

// Rows of `columns` numbers, dense and vector-aligned; those behind the tensor's own hold anything.
inline Tensor padded(const Tensor& rows, int64_t columns) {
  const bool fits = rows.size(1) == columns && rows.is_contiguous();
  if (fits && reinterpret_cast<uintptr_t>(rows.data_ptr()) % 16 == 0) return rows;
  const Tensor out = empty({rows.size(0), columns}, rows);
  out.narrow(1, 0, rows.size(1)).copy_(rows);
  return out;
}

template <class Backend> void project(Arguments& arguments) {
  RenderingCall<Backend> call("project", arguments);
  const Inputs& inputs = call.inputs;
  const Tensor& like = inputs[kMeans3D];
  const int64_t count = num_gaussians(inputs);
  const int64_t num_features = num_channels(inputs) + num_further_features(call.options);
  const Tensor gates = empty({count, kProjectedGaussianSize}, like);
  const Tensor features = empty({count, Backend::feature_columns(num_features)}, like);
  Images images;
  images[kRadii] = empty({count}, like, kInt);
  TensorMemory memory(gates);
  call.run([&](auto zero) {
    Backend::template project<decltype(zero)>(inputs, call.options, images, gates, features, memory);
  });
  arguments.give_back(gates, features.narrow(1, 0, num_features), images[kRadii]);
}

template <class Backend> void blend(Arguments& arguments) {
  Footprints of;
  for (auto* tensor : {&of.gates, &of.features, &of.radii, &of.background}) arguments.read(*tensor);
  arguments.read_optional(of.background_gate);
  const auto options = read_options(arguments);
  check_footprints("blend", of, options);
  const typename Backend::Guard guard(of.gates.device());
  of.gates = padded(of.gates, kProjectedGaussianSize);
  const int64_t num_features = of.background.numel() + num_further_features(options);
  const int64_t columns = Backend::feature_columns(num_features);
  const bool filled_up = of.features.size(1) == columns;
  of.features = padded(filled_up ? of.features : of.features.narrow(1, 0, num_features), columns);
  of.radii = of.radii.contiguous(), of.background = of.background.contiguous();
  const ImageSizes sizes = {of.gates.size(0), of.background.numel()};
  Images images = allocate_images(of.gates, sizes, options);
  images[kRadii] = of.radii;
  TensorMemory memory(of.gates);
  memory.give(0, of.gates), memory.give(1, of.features.view({-1}));
  dispatch("blend", of.gates, [&](auto zero) { Backend::template blend<decltype(zero)>(of, options, images, memory); });
  Tensors results;
  for (const Image image : kDifferentiable) results.push_back(std::move(images[image]));
  arguments.give_back_with_list(results, memory.take_saved());
}

template <class Backend> void blend_backward(Arguments& arguments) {
  const char* function = "blend_backward";
  const Images image_gradients = read_image_gradients(arguments);
  const auto image_list = arguments.read<Tensors>();
  const Saved saved = read_saved(arguments);
  Footprints of;
  for (auto* tensor : {&of.radii, &of.background}) arguments.read(*tensor);
  arguments.read_optional(of.background_gate);
  const auto options = read_options(arguments);
  const auto wants_background = arguments.read<bool>();
  check_length(function, "images", image_list.size(), kDifferentiable.size());
  DSMOE_CHECK_VALUE(saved.size() > 1, function, ": saved has length ", saved.size(),
                    "; it must be what blend returned");
  const int64_t num_features = of.background.numel() + num_further_features(options);
  const int64_t columns = Backend::feature_columns(num_features);
  of.gates = saved[0], of.features = saved[1];
  if (of.gates.dim() == 2 && of.features.numel() == of.gates.size(0) * columns) {
    of.features = of.features.view({of.gates.size(0), columns}).narrow(1, 0, num_features);
  }
  const Expect expect = check_footprints(function, of, options);
  const ImageSizes sizes = {of.gates.size(0), of.background.numel()};
  Images images;
  for (size_t i = 0; i < image_list.size(); ++i) images[kDifferentiable[i]] = image_list[i];
  check_images(expect, images, image_gradients, sizes, options);
  const typename Backend::Guard guard(of.gates.device());
  images[kRadii] = of.radii = of.radii.contiguous();
  of.background = of.background.contiguous();
  const Tensor records = empty({sizes.num_gaussians, kNumGateGradients + num_features}, of.gates);
  const Tensor background = empty({wants_background ? sizes.num_channels + 1 : 0}, of.gates);
  dispatch(function, of.gates, [&](auto zero) {
    Backend::template blend_backward<decltype(zero)>(expect, of, options, images, saved, image_gradients, records,
                                                     background);
  });
  const int64_t channels = wants_background ? sizes.num_channels : 0;
  arguments.give_back(records, background.narrow(0, 0, channels).clone(),
                      background.narrow(0, channels, wants_background ? 1 : 0).clone());
}

template <class Backend> void project_backward(Arguments& arguments) {
  const char* function = "project_backward";
  const auto given_records = arguments.read<Tensor>();
  Tensor dL_ddepths = read_optional(arguments);
  const PresentInputs present(arguments);
  auto features = arguments.read<Tensor>();
  const auto radii = arguments.read<Tensor>();
  const auto options = read_options(arguments);
  const auto wanted_list = arguments.read<std::vector<bool>>();
  const Inputs given = present.spread(function);
  const InputMask wanted = to_mask(function, wanted_list);
  const Tensor records = given_records.contiguous();
  const Expect expect = check_arguments(function, given, options);
  const int64_t count = num_gaussians(given), num_features = num_channels(given) + num_further_features(options);
  expect("records", records, {count, kNumGateGradients + num_features});
  expect("features", features, {count, num_features});
  expect.dense("radii", radii, {count}, kInt);
  if (dL_ddepths.defined()) expect("dL_ddepths", dL_ddepths, {count});
  for (int i = 0; i < kNumInputs; ++i) {
    DSMOE_CHECK_VALUE(
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
  Tensors results;
  for (int i = 0; i < kNumInputs; ++i) {
    if (wanted[i]) results.push_back(gradients[i]);
  }
  arguments.give_back(std::move(results));
}

template <class Backend> void mark_visible(Arguments& arguments) {
  const auto positions = arguments.read<Tensor>(), viewmatrix = arguments.read<Tensor>();
  const auto near = arguments.read<double>();
  const auto camera_model = arguments.read<int64_t>();
  Tensor viewmatrix_end = read_optional(arguments);
  const Expect expect("markVisible", "positions", positions);
  expect("positions", positions, {"N", 3});
  expect("viewmatrix", viewmatrix, {4, 4});
  if (viewmatrix_end.defined()) expect("viewmatrix_end", viewmatrix_end, {4, 4});
  const typename Backend::Guard guard(positions.device());
  if (viewmatrix_end.defined()) viewmatrix_end = viewmatrix_end.contiguous();
  arguments.give_back(Backend::visible("mark_visible", positions.contiguous(), viewmatrix.contiguous(), viewmatrix_end,
                                       near, camera_model));
}

template <class Backend> void register_ops(Library& m) {
  implement<&rasterize<Backend>>(m, "rasterize");
  implement<&rasterize_backward<Backend, false>>(m, "rasterize_backward");
  implement<&rasterize_backward<Backend, true>>(m, "rasterize_backward_seen");
  implement<&project<Backend>>(m, "project");
  implement<&project_backward<Backend>>(m, "project_backward");
  implement<&blend<Backend>>(m, "blend");
  implement<&blend_backward<Backend>>(m, "blend_backward");
  implement<&radii<Backend>>(m, "radii");
  implement<&mark_visible<Backend>>(m, "mark_visible");
}

}  // namespace binding
}  // namespace dsmoe

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
    refuse_culled(function, dense,
                  Backend::visible(function, dense[kMeans3D], dense[kViewMatrix], options.near, options.camera_model));
  }
  return dense;
}

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

// The arguments of an op on a batch of views: its first view's, and all cameras.
struct BatchArguments {
  explicit BatchArguments(Arguments& arguments)
      : inputs(read_inputs(arguments)),
        options(read_options(arguments)),
        cameras(arguments.read<Tensors>()),
        images(arguments.read<std::vector<double>>()) {}

  int64_t num_views() const { return static_cast<int64_t>(images.size()) / kNumbersOfImage; }

  // Checks all tensors, with the cameras that are given twice. Returns their device.
  Device checked_device(const char* function) {
    DSMOE_CHECK_VALUE(images.size() == kNumbersOfImage * cameras.size() / kTensorsOfCamera && !images.empty() &&
                          cameras.size() % kTensorsOfCamera == 0,
                      function, ": cameras and images have lengths ", cameras.size(), " and ", images.size(),
                      "; they must have ", kTensorsOfCamera, " tensors and ", kNumbersOfImage, " numbers a view");
    check_arguments(function, inputs, options);
    const auto type = inputs[kMeans3D].scalar_type();
    DSMOE_CHECK_TYPE(type == kFloat, function, ": means3D is ", dtype_name(type), "; it must be float32");
    for (int64_t v = 0; v < num_views(); ++v) {
      take_view(function, v);
      check_arguments(function, inputs, options);
    }
    return inputs[kMeans3D].device();
  }

  // The batch as the core has it; no rows yet. Tensors that are not dense are copied.
  template <class Backend> typename Backend::ViewBatch batch(const char* function) {
    typename Backend::ViewBatch batch;
    for (int64_t v = 0; v < num_views(); ++v) {
      take_view(function, v);
      inputs = checked<Backend>(function, inputs, options);
      kept.insert(kept.end(), inputs.begin() + kViewMatrix, inputs.begin() + kViewMatrix + kTensorsOfCamera);
      as_op(function, [&] {
        const auto frame = Backend::template frame_of_gaussians<float>(inputs, options, Images());
        batch.inputs = frame.inputs, batch.config = frame.config;
        batch.views.emplace_back().camera = frame.camera;
      });
    }
    return batch;
  }

  // The same with the rows of each view. features and what else the op takes of them: a tensor for each view.
  template <class Backend>
  typename Backend::ViewBatch with_rows(const char* function, const Tensor& radii, const Tensor& offsets,
                                        const Tensors& features) {
    auto batch = this->batch<Backend>(function);
    const Expect expect(function, "means3D", inputs[kMeans3D]);
    const int64_t count = num_gaussians(inputs);
    expect.dense("radii", radii, {num_views(), count}, kInt);
    expect.dense("offsets", offsets, {num_views(), num_view_blocks(count) + 1}, kInt);
    check_length(function, "features", features.size(), batch.views.size());
    for (size_t v = 0; v < features.size(); ++v) {
      expect.dense(item_name("features", v), features[v], {"M", kRowFeatures});
      batch.views[v].num_rows = features[v].size(0);
      batch.views[v].features = mutable_data<float>(features[v]);
    }
    set_counts(batch, radii, offsets);
    return batch;
  }

  // Points each view to its rows of both tensors.
  template <class Batch> void set_counts(Batch& batch, const Tensor& radii, const Tensor& offsets) const {
    const int64_t count = num_gaussians(inputs);
    for (size_t v = 0; v < batch.views.size(); ++v) {
      batch.views[v].radii = radii.data_ptr<int32_t>() + v * count;
      batch.views[v].offsets = offsets.data_ptr<int32_t>() + v * (num_view_blocks(count) + 1);
    }
  }

  // Puts the camera and the image of a view among the arguments.
  void take_view(const char* function, int64_t v) {
    std::copy_n(cameras.begin() + v * kTensorsOfCamera, kTensorsOfCamera, inputs.begin() + kViewMatrix);
    const double* image = images.data() + v * kNumbersOfImage;
    options.image_width = static_cast<int64_t>(image[0]), options.image_height = static_cast<int64_t>(image[1]);
    options.tanfovx = image[2], options.tanfovy = image[3];
    options.camera_model = static_cast<int64_t>(image[4]);
    DSMOE_CHECK_VALUE(image[5] >= 0 && image[5] <= kMostLensNumbers, function, ": images says that a lens has ",
                      image[5], " numbers; it must have 0 to ", kMostLensNumbers);
    options.lens.assign(image + 6, image + 6 + static_cast<int>(image[5]));
  }

  static constexpr size_t kTensorsOfCamera = 3;
  Inputs inputs;
  Options options;
  Tensors cameras;
  std::vector<double> images;
  Tensors kept;  // what the batch points to
};
static_assert(kProjMatrix == kViewMatrix + 1 && kCampos == kViewMatrix + 2, "a camera's tensors lie side by side");

template <class Backend> void count_rows(Arguments& arguments) {
  const char* function = "count_rows";
  BatchArguments given(arguments);
  const typename Backend::Guard guard(given.checked_device(function));
  auto batch = given.batch<Backend>(function);
  const Tensor& like = given.inputs[kMeans3D];
  const int64_t count = num_gaussians(given.inputs);
  const Tensor radii = empty({given.num_views(), count}, like, kInt);
  const Tensor offsets = empty({given.num_views(), num_view_blocks(count) + 1}, like, kInt);
  given.set_counts(batch, radii, offsets);
  as_op(function, [&] { Backend::count_rows(batch); });
  arguments.give_back(radii, offsets);
}

template <class Backend> void project_rows(Arguments& arguments) {
  const char* function = "project_rows";
  BatchArguments given(arguments);
  const auto radii = arguments.read<Tensor>(), offsets = arguments.read<Tensor>();
  const auto gates = arguments.read<Tensors>(), features = arguments.read<Tensors>();
  const typename Backend::Guard guard(given.checked_device(function));
  auto batch = given.with_rows<Backend>(function, radii, offsets, features);
  const Expect expect(function, "means3D", given.inputs[kMeans3D]);
  check_length(function, "gates", gates.size(), batch.views.size());
  for (size_t v = 0; v < gates.size(); ++v) {
    expect.dense(item_name("gates", v), gates[v], {batch.views[v].num_rows, kProjectedGaussianSize});
    batch.views[v].gates = mutable_data<float>(gates[v]);
  }
  as_op(function, [&] { Backend::project_rows(batch); });
  note_change({radii}), note_change(gates), note_change(features);
  arguments.give_back();
}

template <class Backend> void project_rows_backward(Arguments& arguments) {
  const char* function = "project_rows_backward";
  BatchArguments given(arguments);
  const auto radii = arguments.read<Tensor>(), offsets = arguments.read<Tensor>();
  const auto features = arguments.read<Tensors>(), records = arguments.read<Tensors>();
  const typename Backend::Guard guard(given.checked_device(function));
  auto batch = given.with_rows<Backend>(function, radii, offsets, features);
  const Tensor& like = given.inputs[kMeans3D];
  const Expect expect(function, "means3D", like);
  check_length(function, "records", records.size(), batch.views.size());
  const int64_t count = num_gaussians(given.inputs);
  const Tensor means2D = empty({given.num_views(), count, 3}, like);
  Tensors dense;
  for (size_t v = 0; v < records.size(); ++v) {
    expect(item_name("records", v), records[v], {batch.views[v].num_rows, kNumGateGradients + 3});
    dense.push_back(records[v].contiguous());
    batch.views[v].records = data<float>(dense.back());
    batch.views[v].means2D = count > 0 ? means2D.data_ptr<float>() + v * 3 * count : nullptr;
  }
  InputMask wanted = {};
  for (const Input input : {kMeans3D, kOpacities, kDc, kShs, kScales, kRotations}) {
    wanted[input] = given.inputs[input].defined();
  }
  const Inputs gradients = allocate_gradients(given.inputs, wanted);
  as_op(function, [&] { Backend::project_rows_backward(batch, gaussian_gradients<float>(gradients)); });
  Tensors results;
  for (int i = 0; i < kNumInputs; ++i) {
    if (wanted[i]) results.push_back(gradients[i]);
  }
  arguments.give_back_with_list({means2D}, std::move(results));
}

template <class Backend>
Tensor mark_visible(const Tensor& positions, const Tensor& viewmatrix, double near, int64_t camera_model) {
  const Expect expect("markVisible", "positions", positions);
  expect("positions", positions, {"N", 3});
  expect("viewmatrix", viewmatrix, {4, 4});
  const typename Backend::Guard guard(positions.device());
  return Backend::visible("mark_visible", positions.contiguous(), viewmatrix.contiguous(), near, camera_model);
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
  implement<&count_rows<Backend>>(m, "count_rows");
  implement<&project_rows<Backend>>(m, "project_rows");
  implement<&project_rows_backward<Backend>>(m, "project_rows_backward");
  implement<&with_arguments<&mark_visible<Backend>>>(m, "mark_visible");
}

}  // namespace binding
}  // namespace dsmoe

// The trainers' ops as torch calls them, once for all backends. training_schema.cpp has their signatures. A backend
// registers `adam<Backend>` and the others under its dispatch key. training_ops_cpu.cpp and training_ops_cuda.cpp
// define the Backends.
#pragma once

#include <ATen/ATen.h>
#include <ATen/Dispatch.h>
#include <c10/core/DeviceGuard.h>
#include <c10/util/Optional.h>

#include <climits>
#include <string>
#include <tuple>
#include <vector>

#include "check_tensor.h"
#include "dsmoe/adam_tensors.h"
#include "dsmoe/gather.h"
#include "dsmoe/gaussian_adam.h"
#include "dsmoe/gaussians.h"
#include "dsmoe/image_loss.h"
#include "dsmoe/lazy_adam.h"

namespace dsmoe {
namespace binding {

// Autograd must notice where a tensor was changed in place after it was saved.
inline void note_change(at::TensorList tensors) {
  for (const at::Tensor& tensor : tensors) tensor.unsafeGetTensorImpl()->bump_version();
}

inline std::string item_name(const char* list, size_t i) { return std::string(list) + "[" + std::to_string(i) + "]"; }

// A list that must have a dense tensor for each parameter, of its shape, type and device.
inline void check_like_parameters(const char* function, const char* list, at::TensorList tensors,
                                  at::TensorList parameters) {
  TORCH_CHECK_VALUE(tensors.size() == parameters.size(), function, ": ", list, " has length ", tensors.size(),
                    "; it must be ", parameters.size());
  for (size_t i = 0; i < tensors.size(); ++i) {
    const std::string name = item_name(list, i);
    check_same_shape(function, name.c_str(), tensors[i], item_name("parameters", i).c_str(), parameters[i]);
    check_like(function, name.c_str(), tensors[i], "parameters[0]", parameters[0]);
    check_contiguous(function, name.c_str(), tensors[i]);
  }
}

// Radii [N], or another number of each row.
inline void check_row_numbers(const char* function, const char* name, const at::Tensor& numbers,
                              const at::Tensor& like) {
  check_shape(function, name, numbers, {like.size(0)});
  check_type(function, name, numbers, at::kInt);
  check_device(function, name, numbers, "its parameters", like);
  check_contiguous(function, name, numbers);
}

template <class Backend>
void adam(at::TensorList parameters, at::TensorList gradients, at::TensorList moments, at::TensorList squares,
          at::ArrayRef<double> rates, at::ArrayRef<double> root_scales, double beta1, double beta2, double epsilon,
          const OptionalTensor& visible) {
  const char* function = "adam";
  const size_t count = parameters.size();
  for (size_t length : {gradients.size(), moments.size(), squares.size(), rates.size(), root_scales.size()}) {
    TORCH_CHECK_VALUE(length == count, function, ": lists of ", count, " and of ", length,
                      " items are given; all must have the length of parameters");
  }
  if (count == 0) return;
  const at::Tensor& first = parameters[0];
  check_real(function, "parameters[0]", first);
  check_like_parameters(function, "parameters", parameters, parameters);
  check_like_parameters(function, "moments", moments, parameters);
  check_like_parameters(function, "squares", squares, parameters);
  const c10::DeviceGuard guard(first.device());

  at::Tensor flags;
  if (visible.has_value()) {
    flags = visible->contiguous();
    check_type(function, "visible", flags, at::kBool);
    check_shape(function, "visible", flags, {"N"});
    check_device(function, "visible", flags, "parameters[0]", first);
  }

  std::vector<at::Tensor> dense_gradients;
  for (size_t i = 0; i < count; ++i) {
    const std::string name = item_name("gradients", i), parameter = item_name("parameters", i);
    check_same_shape(function, name.c_str(), gradients[i], parameter.c_str(), parameters[i]);
    check_like(function, name.c_str(), gradients[i], "parameters[0]", first);
    TORCH_CHECK_VALUE(!flags.defined() || (parameters[i].dim() > 0 && parameters[i].size(0) == flags.size(0)), function,
                      ": ", parameter, " has shape ", parameters[i].sizes(), "; visible has ",
                      flags.defined() ? flags.size(0) : 0, " rows, and so must every parameter");
    dense_gradients.push_back(gradients[i].contiguous());
  }

  AT_DISPATCH_FLOATING_TYPES(first.scalar_type(), "adam", [&] {
    const auto constants = adam_constants<scalar_t>(beta1, beta2, epsilon);
    std::vector<AdamTensor<scalar_t>> tensors;
    for (size_t i = 0; i < count; ++i) {
      const int64_t size = parameters[i].numel();
      const int64_t rows = flags.defined() ? flags.size(0) : size;
      tensors.push_back({parameters[i].data_ptr<scalar_t>(),
                         dense_gradients[i].data_ptr<scalar_t>(),
                         moments[i].data_ptr<scalar_t>(),
                         squares[i].data_ptr<scalar_t>(),
                         size,
                         rows > 0 && size > 0 ? size / rows : 1,
                         {static_cast<scalar_t>(rates[i]), static_cast<scalar_t>(root_scales[i])}});
    }
    Backend::adam(tensors, AdamStep<scalar_t>{constants, flags.defined() ? flags.data_ptr<bool>() : nullptr});
  });
  for (at::TensorList list : {parameters, moments, squares}) note_change(list);
}

template <class Backend>
void lazy_adam_catch_up(at::TensorList parameters, at::TensorList moments, at::TensorList squares,
                        at::TensorList gradients, const at::Tensor& marks, const at::Tensor& rates, int64_t steps,
                        double beta1, double beta2, double epsilon, const OptionalTensor& radii) {
  const char* function = "lazy_adam_catch_up";
  const auto count = static_cast<int64_t>(parameters.size());
  TORCH_CHECK_VALUE(0 < count && count <= kLazyAdamMaxTensors, function, ": ", count,
                    " parameters are given; it must be 1 to ", kLazyAdamMaxTensors);
  const at::Tensor& first = parameters[0];
  check_real(function, "parameters[0]", first);
  check_like_parameters(function, "parameters", parameters, parameters);
  check_like_parameters(function, "moments", moments, parameters);
  check_like_parameters(function, "squares", squares, parameters);
  check_like_parameters(function, "gradients", gradients, parameters);
  for (const at::Tensor& parameter : parameters) {
    TORCH_CHECK_VALUE(parameter.dim() > 0 && parameter.size(0) == first.size(0), function, ": a parameter has shape ",
                      parameter.sizes(), "; all must have the rows of the first, ", first.sizes());
  }
  check_row_numbers(function, "marks", marks, first);
  if (radii.has_value()) check_row_numbers(function, "radii", *radii, first);
  check_shape(function, "rates", rates, {"capacity", count, 2});
  check_like(function, "rates", rates, "parameters[0]", first);
  check_contiguous(function, "rates", rates);
  TORCH_CHECK_VALUE(0 <= steps && steps <= rates.size(0), function, ": steps is ", steps, "; rates has ", rates.size(0),
                    " of them");
  const c10::DeviceGuard guard(first.device());
  AT_DISPATCH_FLOATING_TYPES(first.scalar_type(), "lazy_adam_catch_up", [&] {
    LazyAdam<scalar_t> adam = {};
    adam.num_tensors = static_cast<int>(count);
    adam.num_rows = first.size(0);
    for (int64_t i = 0; i < count; ++i) {
      adam.tensors[i] = {parameters[i].data_ptr<scalar_t>(), moments[i].data_ptr<scalar_t>(),
                         squares[i].data_ptr<scalar_t>(), gradients[i].data_ptr<scalar_t>(),
                         static_cast<int>(parameters[i].numel() / std::max<int64_t>(1, adam.num_rows))};
    }
    adam.marks = marks.data_ptr<int32_t>();
    adam.radii = radii.has_value() ? radii->data_ptr<int32_t>() : nullptr;
    adam.rates = reinterpret_cast<const AdamRates<scalar_t>*>(rates.data_ptr<scalar_t>());
    adam.steps = static_cast<int32_t>(steps);
    adam.constants = adam_constants<scalar_t>(beta1, beta2, epsilon);
    Backend::catch_up(adam);
  });
  for (at::TensorList list : {parameters, moments, squares}) note_change(list);
  note_change({marks});
}

template <class Backend>
void lazy_adam_step(const at::Tensor& marks, const at::Tensor& rates, int64_t steps, at::ArrayRef<double> new_rates,
                    at::ArrayRef<double> root_scales, const at::Tensor& radii) {
  const char* function = "lazy_adam_step";
  const auto count = static_cast<int64_t>(new_rates.size());
  TORCH_CHECK_VALUE(0 < count && count <= kLazyAdamMaxTensors && root_scales.size() == new_rates.size(), function, ": ",
                    count, " new_rates and ", root_scales.size(),
                    " root_scales are given; it must be equally many, 1 to ", kLazyAdamMaxTensors);
  check_real(function, "rates", rates);
  check_shape(function, "rates", rates, {"capacity", count, 2});
  check_contiguous(function, "rates", rates);
  check_shape(function, "marks", marks, {"N"});
  check_row_numbers(function, "marks", marks, marks);
  check_row_numbers(function, "radii", radii, marks);
  check_device(function, "rates", rates, "marks", marks);
  TORCH_CHECK_VALUE(0 <= steps && steps < rates.size(0), function, ": steps is ", steps, "; rates has room for ",
                    rates.size(0));
  const c10::DeviceGuard guard(marks.device());
  AT_DISPATCH_FLOATING_TYPES(rates.scalar_type(), "lazy_adam_step", [&] {
    LazyAdamStep<scalar_t> step = {};
    step.num_rows = marks.size(0);
    step.marks = marks.data_ptr<int32_t>();
    step.radii = radii.data_ptr<int32_t>();
    step.rates = reinterpret_cast<AdamRates<scalar_t>*>(rates.data_ptr<scalar_t>()) + steps * count;
    for (int64_t i = 0; i < count; ++i) {
      step.new_rates[i] = {static_cast<scalar_t>(new_rates[i]), static_cast<scalar_t>(root_scales[i])};
    }
    step.num_tensors = static_cast<int>(count);
    step.steps = static_cast<int32_t>(steps);
    Backend::note_step(step);
  });
  note_change({marks, rates});
}

template <class Backend>
void gaussian_adam(at::TensorList raw, at::TensorList values, at::TensorList dL_dvalues, at::TensorList moments,
                   at::TensorList squares, const at::Tensor& radii, at::ArrayRef<double> rates,
                   at::ArrayRef<double> root_scales, double beta1, double beta2, double epsilon) {
  const char* function = "gaussian_adam";
  constexpr Activation kActivations[] = {Activation::kNone, Activation::kSigmoid, Activation::kExp,
                                         Activation::kUnitQuaternion};
  constexpr int64_t kSizes[] = {3, 1, 3, 4};
  TORCH_CHECK_VALUE(
      raw.size() == kGaussianAdamTensors && rates.size() == raw.size() && root_scales.size() == raw.size(), function,
      ": raw, rates and root_scales must have ", kGaussianAdamTensors, " items each");
  check_real(function, "raw[0]", raw[0]);
  for (size_t i = 0; i < raw.size(); ++i) {
    check_shape(function, item_name("raw", i).c_str(), raw[i], {raw[0].size(0), kSizes[i]});
  }
  check_like_parameters(function, "raw", raw, raw);
  check_like_parameters(function, "values", values, raw.slice(1));
  check_like_parameters(function, "dL_dvalues", dL_dvalues, raw);
  check_like_parameters(function, "moments", moments, raw);
  check_like_parameters(function, "squares", squares, raw);
  check_row_numbers(function, "radii", radii, raw[0]);
  const c10::DeviceGuard guard(raw[0].device());
  AT_DISPATCH_FLOATING_TYPES(raw[0].scalar_type(), "gaussian_adam", [&] {
    GaussianAdam<scalar_t> adam = {};
    adam.num_gaussians = raw[0].size(0);
    adam.radii = radii.data_ptr<int32_t>();
    adam.constants = adam_constants<scalar_t>(beta1, beta2, epsilon);
    for (size_t i = 0; i < raw.size(); ++i) {
      adam.tensors[i] = {raw[i].data_ptr<scalar_t>(),
                         i > 0 ? values[i - 1].data_ptr<scalar_t>() : nullptr,
                         dL_dvalues[i].data_ptr<scalar_t>(),
                         moments[i].data_ptr<scalar_t>(),
                         squares[i].data_ptr<scalar_t>(),
                         static_cast<int>(kSizes[i]),
                         kActivations[i],
                         {static_cast<scalar_t>(rates[i]), static_cast<scalar_t>(root_scales[i])}};
      for (const at::Tensor* tensor : {&raw[i], &values[i > 0 ? i - 1 : 0], &dL_dvalues[i], &moments[i], &squares[i]}) {
        TORCH_CHECK_VALUE(i < 3 || reinterpret_cast<uintptr_t>(tensor->data_ptr()) % (4 * sizeof(scalar_t)) == 0,
                          function, ": rotations must begin at a multiple of a quaternion's size");
      }
    }
    Backend::step_gaussians(adam);
  });
  for (at::TensorList list : {raw, values, moments, squares}) note_change(list);
}

// Indices of rows that a tensor does not have. On a GPU the host waits for the smallest and the largest one.
inline void check_rows(const char* function, const at::Tensor& rows, const at::Tensor& of) {
  if (rows.numel() == 0 || of.dim() == 0) return;
  const auto [smallest, largest] = at::aminmax(rows);
  const at::Tensor ends = at::stack({smallest, largest}).cpu();
  const auto first = ends[0].item<int64_t>(), last = ends[1].item<int64_t>();
  TORCH_CHECK_INDEX(0 <= first && last < of.size(0), function, ": rows has indices from ", first, " to ", last,
                    "; the tensors have ", of.size(0), " rows");
}

template <class Backend> std::vector<at::Tensor> gather_rows(at::TensorList tensors, const at::Tensor& rows) {
  const char* function = "gather_rows";
  if (tensors.empty()) return {};
  check_real(function, "tensors[0]", tensors[0]);
  check_shape(function, "rows", rows, {"M"});
  check_type(function, "rows", rows, at::kLong);
  check_device(function, "rows", rows, "tensors[0]", tensors[0]);
  const c10::DeviceGuard guard(rows.device());
  const at::Tensor list = rows.contiguous();
  check_rows(function, list, tensors[0]);
  std::vector<at::Tensor> dense, results;
  for (size_t i = 0; i < tensors.size(); ++i) {
    const std::string name = item_name("tensors", i);
    check_like(function, name.c_str(), tensors[i], "tensors[0]", tensors[0]);
    TORCH_CHECK_VALUE(tensors[i].dim() > 0, function, ": ", name, " has no rows");
    std::vector<int64_t> shape = tensors[i].sizes().vec();
    shape[0] = list.size(0);
    dense.push_back(tensors[i].contiguous());
    results.push_back(at::empty(shape, tensors[i].options()));
  }
  AT_DISPATCH_FLOATING_TYPES(tensors[0].scalar_type(), "gather_rows", [&] {
    std::vector<GatherTensor<scalar_t>> all;
    for (size_t i = 0; i < dense.size(); ++i) {
      const int64_t size = list.size(0) > 0 ? results[i].numel() / list.size(0) : 0;
      all.push_back({dense[i].data_ptr<scalar_t>(), results[i].data_ptr<scalar_t>(), static_cast<int>(size)});
    }
    Backend::gather_rows(all, GatherRows{list.data_ptr<int64_t>(), list.size(0)});
  });
  return results;
}

// The loss and, if it is wanted, its gradient by the image; an empty tensor otherwise.
template <class Backend>
std::tuple<at::Tensor, at::Tensor> image_loss(const at::Tensor& image, const at::Tensor& target, double l1_weight,
                                              double ssim_weight, double offset, int64_t margin, bool with_gradient) {
  const char* function = "image_loss";
  check_real(function, "image", image);
  refuse_tangent(function, image);
  refuse_tangent(function, target);
  check_same_shape(function, "target", target, "image", image);
  check_device(function, "target", target, "image", image);
  TORCH_CHECK_VALUE(image.dim() >= 2 && image.numel() > 0, function, ": image has shape ", image.sizes(),
                    "; it must be [..., H, W] with at least one pixel");
  const int64_t height = image.size(-2), width = image.size(-1);
  TORCH_CHECK_VALUE(height <= INT_MAX && width <= INT_MAX, function, ": image has shape ", image.sizes(),
                    "; its sides may have ", INT_MAX, " pixels");
  TORCH_CHECK_VALUE(margin >= 0 && height > 2 * margin && width > 2 * margin, function, ": image has shape ",
                    image.sizes(), "; with a margin of ", margin, " its sides must be at least ", 2 * margin + 1);
  const bool bytes = target.scalar_type() == at::kByte;
  TORCH_CHECK_TYPE(bytes || target.scalar_type() == image.scalar_type(), function, ": target is ",
                   dtype_name(target.scalar_type()), "; it must be ", dtype_name(image.scalar_type()),
                   ", as image is, or uint8");
  const c10::DeviceGuard guard(image.device());
  const at::Tensor x = image.contiguous(), y = target.contiguous();
  const int64_t planes = x.numel() / (height * width);
  const at::Tensor loss = at::empty({}, x.options());
  const at::Tensor gradient = at::empty(with_gradient ? x.sizes() : at::IntArrayRef({0}), x.options());
  const at::Tensor derivatives = at::empty({with_gradient ? 3 * x.numel() : 0}, x.options());
  AT_DISPATCH_FLOATING_TYPES(x.scalar_type(), "image_loss", [&] {
    ImageLoss<scalar_t> arguments = {};
    arguments.image = x.data_ptr<scalar_t>();
    arguments.target = bytes ? nullptr : y.data_ptr<scalar_t>();
    arguments.target_bytes = bytes ? y.data_ptr<uint8_t>() : nullptr;
    arguments.planes = planes;
    arguments.height = static_cast<int>(height), arguments.width = static_cast<int>(width);
    arguments.margin = static_cast<int>(margin);
    arguments.l1_weight = l1_weight, arguments.ssim_weight = ssim_weight, arguments.offset = offset;
    const at::Tensor sums =
        at::empty({Backend::template num_image_loss_sums<scalar_t>(arguments)}, x.options().dtype(at::kDouble));
    arguments.sums = sums.data_ptr<double>();
    arguments.loss = loss.data_ptr<scalar_t>();
    arguments.gradient = with_gradient ? gradient.data_ptr<scalar_t>() : nullptr;
    arguments.derivatives = with_gradient ? derivatives.data_ptr<scalar_t>() : nullptr;
    Backend::image_loss(arguments);
  });
  return {loss, gradient};
}

// Opacities [N, 1], scales [N, 3] and rotations [N, 4] of the Gaussians.
using GaussianTensors = std::tuple<at::Tensor, at::Tensor, at::Tensor>;

inline GaussianTensors checked(const char* function, const at::Tensor& opacities, const at::Tensor& scales,
                               const at::Tensor& rotations) {
  check_real(function, "opacities", opacities);
  for (const at::Tensor* tensor : {&opacities, &scales, &rotations}) refuse_tangent(function, *tensor);
  check_like(function, "scales", scales, "opacities", opacities);
  check_like(function, "rotations", rotations, "opacities", opacities);
  check_shape(function, "opacities", opacities, {"N", 1});
  check_shape(function, "scales", scales, {opacities.size(0), 3});
  check_shape(function, "rotations", rotations, {opacities.size(0), 4});
  return {opacities.contiguous(), scales.contiguous(), rotations.contiguous()};
}

inline GaussianTensors empty_like(const GaussianTensors& tensors) {
  return {at::empty_like(std::get<0>(tensors)), at::empty_like(std::get<1>(tensors)),
          at::empty_like(std::get<2>(tensors))};
}

template <class S> GaussianParameters<S> pointers(const GaussianTensors& tensors) {
  const auto pointer = [](const at::Tensor& tensor) -> S* {
    return tensor.defined() ? tensor.data_ptr<std::remove_const_t<S>>() : nullptr;
  };
  return {pointer(std::get<0>(tensors)), pointer(std::get<1>(tensors)), pointer(std::get<2>(tensors))};
}

template <class Backend>
GaussianTensors activate(const at::Tensor& opacities, const at::Tensor& scales, const at::Tensor& rotations) {
  const GaussianTensors raw = checked("activate", opacities, scales, rotations);
  const c10::DeviceGuard guard(opacities.device());
  const GaussianTensors values = empty_like(raw);
  AT_DISPATCH_FLOATING_TYPES(opacities.scalar_type(), "activate", [&] {
    Backend::for_each_gaussian(Activate<scalar_t>{pointers<const scalar_t>(raw), pointers<scalar_t>(values)},
                               opacities.size(0));
  });
  return values;
}

// raw: the arguments of `activate`, values: its results, dL_d...: the gradients by these, where there are any.
template <class Backend>
GaussianTensors activate_backward(at::TensorList raw, at::TensorList values, const OptionalTensor& dL_dopacities,
                                  const OptionalTensor& dL_dscales, const OptionalTensor& dL_drotations) {
  const char* function = "activate_backward";
  TORCH_CHECK_VALUE(raw.size() == 3 && values.size() == 3, function, ": raw and values must have 3 tensors each");
  const GaussianTensors raw_tensors = checked(function, raw[0], raw[1], raw[2]);
  const GaussianTensors value_tensors = checked(function, values[0], values[1], values[2]);
  check_same_shape(function, "values", values[0], "raw", raw[0]);
  check_like(function, "values", values[0], "raw", raw[0]);
  const c10::DeviceGuard guard(raw[0].device());
  const auto dense = [&](const char* name, const OptionalTensor& gradient, const at::Tensor& value) {
    if (!gradient.has_value()) return at::Tensor();
    refuse_tangent(function, *gradient);
    check_same_shape(function, name, *gradient, "its value", value);
    check_like(function, name, *gradient, "raw", raw[0]);
    return gradient->contiguous();
  };
  const GaussianTensors gradients = {dense("dL_dopacities", dL_dopacities, values[0]),
                                     dense("dL_dscales", dL_dscales, values[1]),
                                     dense("dL_drotations", dL_drotations, values[2])};
  const GaussianTensors results = empty_like(raw_tensors);
  AT_DISPATCH_FLOATING_TYPES(raw[0].scalar_type(), "activate_backward", [&] {
    ActivateBackward<scalar_t> pass = {};
    pass.raw = pointers<const scalar_t>(raw_tensors);
    pass.values = pointers<const scalar_t>(value_tensors);
    pass.dL_dvalues = pointers<const scalar_t>(gradients);
    pass.dL_draw = pointers<scalar_t>(results);
    Backend::for_each_gaussian(pass, raw[0].size(0));
  });
  return results;
}

template <class Backend>
void add_view(const at::Tensor& dL_dmeans2D, const at::Tensor& radii, const at::Tensor& gradient_sum,
              const at::Tensor& view_count) {
  const char* function = "add_view";
  check_real(function, "dL_dmeans2D", dL_dmeans2D);
  check_shape(function, "radii", radii, {"N"});
  check_type(function, "radii", radii, at::kInt);
  check_shape(function, "dL_dmeans2D", dL_dmeans2D, {radii.size(0), 3});
  check_device(function, "radii", radii, "dL_dmeans2D", dL_dmeans2D);
  for (const at::Tensor* statistic : {&gradient_sum, &view_count}) {
    const char* name = statistic == &gradient_sum ? "gradient_sum" : "view_count";
    check_shape(function, name, *statistic, {radii.size(0)});
    check_like(function, name, *statistic, "dL_dmeans2D", dL_dmeans2D);
    check_contiguous(function, name, *statistic);
  }
  const c10::DeviceGuard guard(radii.device());
  const at::Tensor gradients = dL_dmeans2D.contiguous(), dense_radii = radii.contiguous();
  AT_DISPATCH_FLOATING_TYPES(gradients.scalar_type(), "add_view", [&] {
    AddView<scalar_t> pass = {};
    pass.dL_dmeans2D = gradients.data_ptr<scalar_t>();
    pass.radii = dense_radii.data_ptr<int32_t>();
    pass.gradient_sum = gradient_sum.data_ptr<scalar_t>();
    pass.view_count = view_count.data_ptr<scalar_t>();
    Backend::for_each_gaussian(pass, radii.size(0));
  });
  note_change({gradient_sum, view_count});
}

// Of `mean_squared_neighbour_distances`, whose implementations share no more.
inline void check_points(const at::Tensor& points) {
  check_real("mean_squared_neighbour_distances", "points", points);
  check_shape("mean_squared_neighbour_distances", "points", points, {"N", 3});
}

}  // namespace binding
}  // namespace dsmoe

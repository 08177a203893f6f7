// The trainers' ops as torch calls them, once for all backends. training_schema.cpp has their signatures. A backend
// registers `adam<Backend>` and the others under its dispatch key. training_ops_cpu.cpp and training_ops_cuda.cpp
// define the Backends.
#pragma once

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

inline std::string item_name(const char* list, size_t i) { return std::string(list) + "[" + std::to_string(i) + "]"; }

// A list that must have a dense tensor for each parameter, of its shape, type and device.
inline void check_like_parameters(const char* function, const char* list, const Tensors& tensors,
                                  const Tensors& parameters) {
  DSMOE_CHECK_VALUE(tensors.size() == parameters.size(), function, ": ", list, " has length ", tensors.size(),
                    "; it must be ", parameters.size());
  for (size_t i = 0; i < tensors.size(); ++i) {
    const std::string name = item_name(list, i);
    check_same_shape(function, name.c_str(), tensors[i], item_name("parameters", i).c_str(), parameters[i]);
    check_like(function, name.c_str(), tensors[i], "parameters[0]", parameters[0]);
    check_contiguous(function, name.c_str(), tensors[i]);
  }
}

// Radii [N], or another number of each row.
inline void check_row_numbers(const char* function, const char* name, const Tensor& numbers, const Tensor& like) {
  check_shape(function, name, numbers, {like.size(0)});
  check_type(function, name, numbers, kInt);
  check_device(function, name, numbers, "its parameters", like);
  check_contiguous(function, name, numbers);
}

template <class Backend>
void adam(const Tensors& parameters, const Tensors& gradients, const Tensors& moments, const Tensors& squares,
          const std::vector<double>& rates, const std::vector<double>& root_scales, double beta1, double beta2,
          double epsilon, const OptionalTensor& visible) {
  const char* function = "adam";
  const size_t count = parameters.size();
  for (size_t length : {gradients.size(), moments.size(), squares.size(), rates.size(), root_scales.size()}) {
    DSMOE_CHECK_VALUE(length == count, function, ": lists of ", count, " and of ", length,
                      " items are given; all must have the length of parameters");
  }
  if (count == 0) return;
  const Tensor& first = parameters[0];
  check_real(function, "parameters[0]", first);
  check_like_parameters(function, "parameters", parameters, parameters);
  check_like_parameters(function, "moments", moments, parameters);
  check_like_parameters(function, "squares", squares, parameters);
  const DeviceGuard guard(first.device());

  Tensor flags;
  if (visible.has_value()) {
    flags = visible->contiguous();
    check_type(function, "visible", flags, kBool);
    check_shape(function, "visible", flags, {"N"});
    check_device(function, "visible", flags, "parameters[0]", first);
  }

  Tensors dense_gradients;
  for (size_t i = 0; i < count; ++i) {
    const std::string name = item_name("gradients", i), parameter = item_name("parameters", i);
    check_same_shape(function, name.c_str(), gradients[i], parameter.c_str(), parameters[i]);
    check_like(function, name.c_str(), gradients[i], "parameters[0]", first);
    DSMOE_CHECK_VALUE(!flags.defined() || (parameters[i].dim() > 0 && parameters[i].size(0) == flags.size(0)), function,
                      ": ", parameter, " has shape ", parameters[i].sizes(), "; visible has ",
                      flags.defined() ? flags.size(0) : 0, " rows, and so must every parameter");
    dense_gradients.push_back(gradients[i].contiguous());
  }

  dispatch_real(first, [&](auto zero) {
    using scalar_t = decltype(zero);
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
  for (const Tensors* list : {&parameters, &moments, &squares}) note_change(*list);
}

template <class Backend>
void lazy_adam_catch_up(const Tensors& parameters, const Tensors& moments, const Tensors& squares,
                        const Tensors& gradients, const Tensor& marks, const Tensor& rates, int64_t steps, double beta1,
                        double beta2, double epsilon, const OptionalTensor& radii) {
  const char* function = "lazy_adam_catch_up";
  const auto count = static_cast<int64_t>(parameters.size());
  DSMOE_CHECK_VALUE(0 < count && count <= kLazyAdamMaxTensors, function, ": ", count,
                    " parameters are given; it must be 1 to ", kLazyAdamMaxTensors);
  const Tensor& first = parameters[0];
  check_real(function, "parameters[0]", first);
  check_like_parameters(function, "parameters", parameters, parameters);
  check_like_parameters(function, "moments", moments, parameters);
  check_like_parameters(function, "squares", squares, parameters);
  check_like_parameters(function, "gradients", gradients, parameters);
  for (const Tensor& parameter : parameters) {
    DSMOE_CHECK_VALUE(parameter.dim() > 0 && parameter.size(0) == first.size(0), function, ": a parameter has shape ",
                      parameter.sizes(), "; all must have the rows of the first, ", first.sizes());
  }
  check_row_numbers(function, "marks", marks, first);
  if (radii.has_value()) check_row_numbers(function, "radii", *radii, first);
  check_shape(function, "rates", rates, {"capacity", count, 2});
  check_like(function, "rates", rates, "parameters[0]", first);
  check_contiguous(function, "rates", rates);
  DSMOE_CHECK_VALUE(0 <= steps && steps <= rates.size(0), function, ": steps is ", steps, "; rates has ", rates.size(0),
                    " of them");
  const DeviceGuard guard(first.device());
  dispatch_real(first, [&](auto zero) {
    using scalar_t = decltype(zero);
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
  for (const Tensors* list : {&parameters, &moments, &squares}) note_change(*list);
  note_change({marks});
}

template <class Backend>
void lazy_adam_step(const Tensor& marks, const Tensor& rates, int64_t steps, const std::vector<double>& new_rates,
                    const std::vector<double>& root_scales, const Tensor& radii) {
  const char* function = "lazy_adam_step";
  const auto count = static_cast<int64_t>(new_rates.size());
  DSMOE_CHECK_VALUE(0 < count && count <= kLazyAdamMaxTensors && root_scales.size() == new_rates.size(), function, ": ",
                    count, " new_rates and ", root_scales.size(),
                    " root_scales are given; it must be equally many, 1 to ", kLazyAdamMaxTensors);
  check_real(function, "rates", rates);
  check_shape(function, "rates", rates, {"capacity", count, 2});
  check_contiguous(function, "rates", rates);
  check_shape(function, "marks", marks, {"N"});
  check_row_numbers(function, "marks", marks, marks);
  check_row_numbers(function, "radii", radii, marks);
  check_device(function, "rates", rates, "marks", marks);
  DSMOE_CHECK_VALUE(0 <= steps && steps < rates.size(0), function, ": steps is ", steps, "; rates has room for ",
                    rates.size(0));
  const DeviceGuard guard(marks.device());
  dispatch_real(rates, [&](auto zero) {
    using scalar_t = decltype(zero);
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
void gaussian_adam(const Tensors& raw, const Tensors& values, const Tensors& dL_dvalues, const Tensors& moments,
                   const Tensors& squares, const Tensor& radii, const std::vector<double>& rates,
                   const std::vector<double>& root_scales, double beta1, double beta2, double epsilon) {
  const char* function = "gaussian_adam";
  constexpr Activation kActivations[] = {Activation::kNone, Activation::kSigmoid, Activation::kExp,
                                         Activation::kUnitQuaternion};
  constexpr int64_t kSizes[] = {3, 1, 3, 4};
  DSMOE_CHECK_VALUE(
      raw.size() == kGaussianAdamTensors && rates.size() == raw.size() && root_scales.size() == raw.size(), function,
      ": raw, rates and root_scales must have ", kGaussianAdamTensors, " items each");
  check_real(function, "raw[0]", raw[0]);
  for (size_t i = 0; i < raw.size(); ++i) {
    check_shape(function, item_name("raw", i).c_str(), raw[i], {raw[0].size(0), kSizes[i]});
  }
  check_like_parameters(function, "raw", raw, raw);
  check_like_parameters(function, "values", values, Tensors(raw.begin() + 1, raw.end()));
  check_like_parameters(function, "dL_dvalues", dL_dvalues, raw);
  check_like_parameters(function, "moments", moments, raw);
  check_like_parameters(function, "squares", squares, raw);
  check_row_numbers(function, "radii", radii, raw[0]);
  const DeviceGuard guard(raw[0].device());
  dispatch_real(raw[0], [&](auto zero) {
    using scalar_t = decltype(zero);
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
      for (const Tensor* tensor : {&raw[i], &values[i > 0 ? i - 1 : 0], &dL_dvalues[i], &moments[i], &squares[i]}) {
        DSMOE_CHECK_VALUE(i < 3 || reinterpret_cast<uintptr_t>(tensor->data_ptr()) % (4 * sizeof(scalar_t)) == 0,
                          function, ": rotations must begin at a multiple of a quaternion's size");
      }
    }
    Backend::step_gaussians(adam);
  });
  for (const Tensors* list : {&raw, &values, &moments, &squares}) note_change(*list);
}

// Indices of rows that a tensor does not have. On a GPU the host waits for the smallest and the largest one.
inline void check_rows(const char* function, const Tensor& rows, const Tensor& of) {
  if (rows.numel() == 0 || of.dim() == 0) return;
  const Tensor ends = empty({2}, rows);
  ends.narrow(0, 0, 1).copy_(smallest(rows)), ends.narrow(0, 1, 1).copy_(largest(rows));
  const Tensor here = to_cpu(ends);
  const int64_t first = here.data_ptr<int64_t>()[0], last = here.data_ptr<int64_t>()[1];
  DSMOE_CHECK_INDEX(0 <= first && last < of.size(0), function, ": rows has indices from ", first, " to ", last,
                    "; the tensors have ", of.size(0), " rows");
}

template <class Backend> Tensors gather_rows(const Tensors& tensors, const Tensor& rows) {
  const char* function = "gather_rows";
  if (tensors.empty()) return {};
  check_real(function, "tensors[0]", tensors[0]);
  check_shape(function, "rows", rows, {"M"});
  check_type(function, "rows", rows, kLong);
  check_device(function, "rows", rows, "tensors[0]", tensors[0]);
  const DeviceGuard guard(rows.device());
  const Tensor list = rows.contiguous();
  check_rows(function, list, tensors[0]);
  Tensors dense, results;
  for (size_t i = 0; i < tensors.size(); ++i) {
    const std::string name = item_name("tensors", i);
    check_like(function, name.c_str(), tensors[i], "tensors[0]", tensors[0]);
    DSMOE_CHECK_VALUE(tensors[i].dim() > 0, function, ": ", name, " has no rows");
    std::vector<int64_t> shape = tensors[i].sizes().vec();
    shape[0] = list.size(0);
    dense.push_back(tensors[i].contiguous());
    results.push_back(empty(shape, tensors[i]));
  }
  dispatch_real(tensors[0], [&](auto zero) {
    using scalar_t = decltype(zero);
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
std::tuple<Tensor, Tensor> image_loss(const Tensor& image, const Tensor& target, double l1_weight, double ssim_weight,
                                      double offset, int64_t margin, bool with_gradient) {
  const char* function = "image_loss";
  check_real(function, "image", image);
  refuse_tangent(function, image);
  refuse_tangent(function, target);
  check_same_shape(function, "target", target, "image", image);
  check_device(function, "target", target, "image", image);
  DSMOE_CHECK_VALUE(image.dim() >= 2 && image.numel() > 0, function, ": image has shape ", image.sizes(),
                    "; it must be [..., H, W] with at least one pixel");
  const int64_t height = image.size(image.dim() - 2), width = image.size(image.dim() - 1);
  DSMOE_CHECK_VALUE(height <= INT_MAX && width <= INT_MAX, function, ": image has shape ", image.sizes(),
                    "; its sides may have ", INT_MAX, " pixels");
  DSMOE_CHECK_VALUE(margin >= 0 && height > 2 * margin && width > 2 * margin, function, ": image has shape ",
                    image.sizes(), "; with a margin of ", margin, " its sides must be at least ", 2 * margin + 1);
  const bool bytes = target.scalar_type() == kByte;
  DSMOE_CHECK_TYPE(bytes || target.scalar_type() == image.scalar_type(), function, ": target is ",
                   dtype_name(target.scalar_type()), "; it must be ", dtype_name(image.scalar_type()),
                   ", as image is, or uint8");
  const DeviceGuard guard(image.device());
  const Tensor x = image.contiguous(), y = target.contiguous();
  const int64_t planes = x.numel() / (height * width);
  const Tensor loss = empty(std::vector<int64_t>(), x);
  const Tensor gradient = with_gradient ? empty_like(x) : empty({0}, x);
  const Tensor derivatives = empty({with_gradient ? 3 * x.numel() : 0}, x);
  dispatch_real(x, [&](auto zero) {
    using scalar_t = decltype(zero);
    ImageLoss<scalar_t> arguments = {};
    arguments.image = x.data_ptr<scalar_t>();
    arguments.target = bytes ? nullptr : y.data_ptr<scalar_t>();
    arguments.target_bytes = bytes ? y.data_ptr<uint8_t>() : nullptr;
    arguments.planes = planes;
    arguments.height = static_cast<int>(height), arguments.width = static_cast<int>(width);
    arguments.margin = static_cast<int>(margin);
    arguments.l1_weight = l1_weight, arguments.ssim_weight = ssim_weight, arguments.offset = offset;
    const Tensor sums = empty({Backend::template num_image_loss_sums<scalar_t>(arguments)}, x, kDouble);
    arguments.sums = sums.data_ptr<double>();
    arguments.loss = loss.data_ptr<scalar_t>();
    arguments.gradient = with_gradient ? gradient.data_ptr<scalar_t>() : nullptr;
    arguments.derivatives = with_gradient ? derivatives.data_ptr<scalar_t>() : nullptr;
    Backend::image_loss(arguments);
  });
  return {loss, gradient};
}

// Opacities [N, 1], scales [N, 3] and rotations [N, 4] of the Gaussians.
using GaussianTensors = std::tuple<Tensor, Tensor, Tensor>;

inline GaussianTensors checked(const char* function, const Tensor& opacities, const Tensor& scales,
                               const Tensor& rotations) {
  check_real(function, "opacities", opacities);
  for (const Tensor* tensor : {&opacities, &scales, &rotations}) refuse_tangent(function, *tensor);
  check_like(function, "scales", scales, "opacities", opacities);
  check_like(function, "rotations", rotations, "opacities", opacities);
  check_shape(function, "opacities", opacities, {"N", 1});
  check_shape(function, "scales", scales, {opacities.size(0), 3});
  check_shape(function, "rotations", rotations, {opacities.size(0), 4});
  return {opacities.contiguous(), scales.contiguous(), rotations.contiguous()};
}

inline GaussianTensors empty_like(const GaussianTensors& tensors) {
  return {empty_like(std::get<0>(tensors)), empty_like(std::get<1>(tensors)), empty_like(std::get<2>(tensors))};
}

template <class S> GaussianParameters<S> pointers(const GaussianTensors& tensors) {
  const auto pointer = [](const Tensor& tensor) -> S* {
    return tensor.defined() ? tensor.data_ptr<std::remove_const_t<S>>() : nullptr;
  };
  return {pointer(std::get<0>(tensors)), pointer(std::get<1>(tensors)), pointer(std::get<2>(tensors))};
}

template <class Backend>
GaussianTensors activate(const Tensor& opacities, const Tensor& scales, const Tensor& rotations) {
  const GaussianTensors raw = checked("activate", opacities, scales, rotations);
  const DeviceGuard guard(opacities.device());
  const GaussianTensors values = empty_like(raw);
  dispatch_real(opacities, [&](auto zero) {
    using scalar_t = decltype(zero);
    Backend::for_each_gaussian(Activate<scalar_t>{pointers<const scalar_t>(raw), pointers<scalar_t>(values)},
                               opacities.size(0));
  });
  return values;
}

// raw: the arguments of `activate`, values: its results, dL_d...: the gradients by these, where there are any.
template <class Backend>
GaussianTensors activate_backward(const Tensors& raw, const Tensors& values, const OptionalTensor& dL_dopacities,
                                  const OptionalTensor& dL_dscales, const OptionalTensor& dL_drotations) {
  const char* function = "activate_backward";
  DSMOE_CHECK_VALUE(raw.size() == 3 && values.size() == 3, function, ": raw and values must have 3 tensors each");
  const GaussianTensors raw_tensors = checked(function, raw[0], raw[1], raw[2]);
  const GaussianTensors value_tensors = checked(function, values[0], values[1], values[2]);
  check_same_shape(function, "values", values[0], "raw", raw[0]);
  check_like(function, "values", values[0], "raw", raw[0]);
  const DeviceGuard guard(raw[0].device());
  const auto dense = [&](const char* name, const OptionalTensor& gradient, const Tensor& value) {
    if (!gradient.has_value()) return Tensor();
    refuse_tangent(function, *gradient);
    check_same_shape(function, name, *gradient, "its value", value);
    check_like(function, name, *gradient, "raw", raw[0]);
    return gradient->contiguous();
  };
  const GaussianTensors gradients = {dense("dL_dopacities", dL_dopacities, values[0]),
                                     dense("dL_dscales", dL_dscales, values[1]),
                                     dense("dL_drotations", dL_drotations, values[2])};
  const GaussianTensors results = empty_like(raw_tensors);
  dispatch_real(raw[0], [&](auto zero) {
    using scalar_t = decltype(zero);
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
void add_view(const Tensor& dL_dmeans2D, const Tensor& radii, const Tensor& gradient_sum, const Tensor& view_count) {
  const char* function = "add_view";
  check_real(function, "dL_dmeans2D", dL_dmeans2D);
  check_shape(function, "radii", radii, {"N"});
  check_type(function, "radii", radii, kInt);
  check_shape(function, "dL_dmeans2D", dL_dmeans2D, {radii.size(0), 3});
  check_device(function, "radii", radii, "dL_dmeans2D", dL_dmeans2D);
  for (const Tensor* statistic : {&gradient_sum, &view_count}) {
    const char* name = statistic == &gradient_sum ? "gradient_sum" : "view_count";
    check_shape(function, name, *statistic, {radii.size(0)});
    check_like(function, name, *statistic, "dL_dmeans2D", dL_dmeans2D);
    check_contiguous(function, name, *statistic);
  }
  const DeviceGuard guard(radii.device());
  const Tensor gradients = dL_dmeans2D.contiguous(), dense_radii = radii.contiguous();
  dispatch_real(gradients, [&](auto zero) {
    using scalar_t = decltype(zero);
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
inline void check_points(const Tensor& points) {
  check_real("mean_squared_neighbour_distances", "points", points);
  check_shape("mean_squared_neighbour_distances", "points", points, {"N", 3});
}

template <class Backend> void register_training_ops(Library& m) {
  implement<&with_arguments<&adam<Backend>>>(m, "adam");
  implement<&with_arguments<&lazy_adam_catch_up<Backend>>>(m, "lazy_adam_catch_up");
  implement<&with_arguments<&lazy_adam_step<Backend>>>(m, "lazy_adam_step");
  implement<&with_arguments<&gaussian_adam<Backend>>>(m, "gaussian_adam");
  implement<&with_arguments<&gather_rows<Backend>>>(m, "gather_rows");
  implement<&with_arguments<&image_loss<Backend>>>(m, "image_loss");
  implement<&with_arguments<&activate<Backend>>>(m, "activate");
  implement<&with_arguments<&activate_backward<Backend>>>(m, "activate_backward");
  implement<&with_arguments<&add_view<Backend>>>(m, "add_view");
  implement<&with_arguments<&Backend::mean_squared_neighbour_distances>>(m, "mean_squared_neighbour_distances");
}

}  // namespace binding
}  // namespace dsmoe

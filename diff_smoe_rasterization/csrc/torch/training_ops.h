// The trainers' ops as torch calls them, once for all backends. schema.cpp has their signatures. A backend
// registers `adam<Backend>` and the others under its dispatch key. ops_cpu.cpp and ops_cuda.cpp
// define the Backends.
#pragma once

#include <algorithm>
#include <climits>
#include <string>
#include <tuple>
#include <vector>

#include "checks.h"
#include "dsmoe/training/adam.h"
#include "dsmoe/training/gather.h"
#include "dsmoe/training/gaussians.h"
#include "dsmoe/training/image_loss.h"

namespace dsmoe {
namespace binding {

template <class Backend>
void adam(const Tensors& parameters, const Tensors& gradients, const Tensors& moments, const Tensors& squares,
          const std::vector<double>& rates, const std::vector<double>& root_scales, double beta1, double beta2,
          double epsilon, const OptionalTensor& visible) {
  const char* function = "adam";
  const size_t count = parameters.size();
  check_length(function, "gradients", gradients.size(), count);
  check_length(function, "rates", rates.size(), count);
  check_length(function, "root_scales", root_scales.size(), count);
  if (count == 0) return;
  const Tensor& first = parameters[0];
  const Expect expect(function, "parameters[0]", first);
  expect.dense_alike("parameters", parameters, parameters);
  expect.dense_alike("moments", moments, parameters);
  expect.dense_alike("squares", squares, parameters);
  const DeviceGuard guard(first.device());

  Tensor flags;
  if (visible.has_value()) {
    expect("visible", *visible, {"N"}, kBool);
    flags = visible->contiguous();
  }

  Tensors dense_gradients;
  for (size_t i = 0; i < count; ++i) {
    DSMOE_CHECK_VALUE(!flags.defined() || (parameters[i].dim() > 0 && parameters[i].size(0) == flags.size(0)), function,
                      ": ", item_name("parameters", i), " has shape ", parameters[i].sizes(), "; visible has ",
                      flags.defined() ? flags.size(0) : 0, " rows, and so must every parameter");
    expect(item_name("gradients", i), gradients[i], shape_of(parameters[i].sizes()));
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

// Numbers that the device holds; null if there are none.
template <class S> const S* given_numbers(const OptionalTensor& numbers) {
  return numbers.has_value() ? numbers->data_ptr<S>() : nullptr;
}

template <class Backend>
void lazy_adam_catch_up(const Tensors& parameters, const Tensors& moments, const Tensors& squares,
                        const Tensors& gradients, const Tensor& marks, const Tensor& rates, int64_t steps, double beta1,
                        double beta2, double epsilon, const OptionalTensor& radii, const OptionalTensor& given_steps) {
  const char* function = "lazy_adam_catch_up";
  const auto count = static_cast<int64_t>(parameters.size());
  DSMOE_CHECK_VALUE(0 < count && count <= kLazyAdamMaxTensors, function, ": ", count,
                    " parameters are given; it must be 1 to ", kLazyAdamMaxTensors);
  const Tensor& first = parameters[0];
  const Expect expect(function, "parameters[0]", first);
  expect.dense_alike("parameters", parameters, parameters);
  expect.dense_alike("moments", moments, parameters);
  expect.dense_alike("squares", squares, parameters);
  expect.dense_alike("gradients", gradients, parameters);
  for (const Tensor& parameter : parameters) {
    DSMOE_CHECK_VALUE(parameter.dim() > 0 && parameter.size(0) == first.size(0), function, ": a parameter has shape ",
                      parameter.sizes(), "; all must have the rows of the first, ", first.sizes());
  }
  expect.dense("marks", marks, {first.size(0)}, kInt);
  if (radii.has_value()) expect.dense("radii", *radii, {first.size(0)}, kInt);
  expect.dense("rates", rates, {"capacity", count, 2});
  if (given_steps.has_value()) expect.dense("given_steps", *given_steps, {1});
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
    adam.given_steps = given_numbers<scalar_t>(given_steps);
    adam.constants = adam_constants<scalar_t>(beta1, beta2, epsilon);
    Backend::catch_up(adam);
  });
  for (const Tensors* list : {&parameters, &moments, &squares}) note_change(*list);
  note_change({marks});
}

template <class Backend>
void lazy_adam_step(const Tensor& marks, const Tensor& rates, int64_t steps, const std::vector<double>& new_rates,
                    const std::vector<double>& root_scales, const Tensor& radii, const OptionalTensor& given_steps,
                    const OptionalTensor& given_rates) {
  const char* function = "lazy_adam_step";
  const auto count = static_cast<int64_t>(new_rates.size());
  DSMOE_CHECK_VALUE(0 < count && count <= kLazyAdamMaxTensors && root_scales.size() == new_rates.size(), function, ": ",
                    count, " new_rates and ", root_scales.size(),
                    " root_scales are given; it must be equally many, 1 to ", kLazyAdamMaxTensors);
  const Expect expect(function, "rates", rates);
  expect.dense("rates", rates, {"capacity", count, 2});
  expect.dense("marks", marks, {"N"}, kInt);
  expect.dense("radii", radii, {marks.size(0)}, kInt);
  if (given_steps.has_value()) expect.dense("given_steps", *given_steps, {1});
  if (given_rates.has_value()) expect.dense("given_rates", *given_rates, {count, 2});
  DSMOE_CHECK_VALUE(0 <= steps && steps < rates.size(0), function, ": steps is ", steps, "; rates has room for ",
                    rates.size(0));
  const DeviceGuard guard(marks.device());
  dispatch_real(rates, [&](auto zero) {
    using scalar_t = decltype(zero);
    LazyAdamStep<scalar_t> step = {};
    step.num_rows = marks.size(0);
    step.marks = marks.data_ptr<int32_t>();
    step.radii = radii.data_ptr<int32_t>();
    step.rates = reinterpret_cast<AdamRates<scalar_t>*>(rates.data_ptr<scalar_t>());
    for (int64_t i = 0; i < count; ++i) {
      step.new_rates[i] = {static_cast<scalar_t>(new_rates[i]), static_cast<scalar_t>(root_scales[i])};
    }
    step.num_tensors = static_cast<int>(count);
    step.steps = static_cast<int32_t>(steps);
    step.given_steps = given_numbers<scalar_t>(given_steps);
    step.given_rates = reinterpret_cast<const AdamRates<scalar_t>*>(given_numbers<scalar_t>(given_rates));
    Backend::note_step(step);
  });
  note_change({marks, rates});
}

template <class Backend>
void gaussian_adam(const Tensors& raw, const Tensors& values, const Tensors& dL_dvalues, const Tensors& moments,
                   const Tensors& squares, const Tensor& radii, const std::vector<double>& rates,
                   const std::vector<double>& root_scales, double beta1, double beta2, double epsilon,
                   const OptionalTensor& given_rates) {
  const char* function = "gaussian_adam";
  constexpr Activation kActivations[] = {Activation::kNone, Activation::kSigmoid, Activation::kExp,
                                         Activation::kUnitQuaternion};
  constexpr int64_t kSizes[] = {3, 1, 3, 4};
  DSMOE_CHECK_VALUE(
      raw.size() == kGaussianAdamTensors && rates.size() == raw.size() && root_scales.size() == raw.size(), function,
      ": raw, rates and root_scales must have ", kGaussianAdamTensors, " items each");
  const Expect expect(function, "raw[0]", raw[0]);
  expect.dense("raw[0]", raw[0], {"N", kSizes[0]});
  const int64_t count = raw[0].size(0);
  for (size_t i = 1; i < raw.size(); ++i) expect.dense(item_name("raw", i), raw[i], {count, kSizes[i]});
  expect.dense_alike("values", values, Tensors(raw.begin() + 1, raw.end()));
  expect.dense_alike("dL_dvalues", dL_dvalues, raw);
  expect.dense_alike("moments", moments, raw);
  expect.dense_alike("squares", squares, raw);
  expect.dense("radii", radii, {count}, kInt);
  if (given_rates.has_value()) expect.dense("given_rates", *given_rates, {kGaussianAdamTensors, 2});
  const DeviceGuard guard(raw[0].device());
  dispatch_real(raw[0], [&](auto zero) {
    using scalar_t = decltype(zero);
    GaussianAdam<scalar_t> adam = {};
    adam.num_gaussians = count;
    adam.radii = radii.data_ptr<int32_t>();
    adam.given_rates = reinterpret_cast<const AdamRates<scalar_t>*>(given_numbers<scalar_t>(given_rates));
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
  const Expect expect(function, "tensors[0]", tensors[0]);
  expect("rows", rows, {"M"}, kLong);
  const DeviceGuard guard(rows.device());
  const Tensor list = rows.contiguous();
  check_rows(function, list, tensors[0]);
  Tensors dense, results;
  for (size_t i = 0; i < tensors.size(); ++i) {
    expect(item_name("tensors", i), tensors[i], shape_of(tensors[i].sizes()));
    DSMOE_CHECK_VALUE(tensors[i].dim() > 0, function, ": ", item_name("tensors", i), " has no rows");
    DSMOE_CHECK_VALUE(tensors[i].size(0) == tensors[0].size(0), function, ": ", item_name("tensors", i), " has ",
                      tensors[i].size(0), " rows; it must have ", tensors[0].size(0), ", as tensors[0] has");
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
std::tuple<Tensor, Tensor> image_loss(const Tensor& image, const Tensor& target, double l1_weight, double l2_weight,
                                      double ssim_weight, double offset, int64_t margin, bool with_gradient) {
  const char* function = "image_loss";
  const Expect expect(function, "image", image);
  expect("image", image, shape_of(image.sizes()));
  DSMOE_CHECK_VALUE(image.dim() >= 2 && image.numel() > 0, function, ": image has shape ", image.sizes(),
                    "; it must be [..., H, W] with at least one pixel");
  const int64_t height = image.size(image.dim() - 2), width = image.size(image.dim() - 1);
  DSMOE_CHECK_VALUE(height <= INT_MAX && width <= INT_MAX, function, ": image has shape ", image.sizes(),
                    "; its sides may have ", INT_MAX, " pixels");
  DSMOE_CHECK_VALUE(0 <= margin && margin <= INT_MAX, function, ": margin is ", margin, "; it must be 0 to ", INT_MAX);
  DSMOE_CHECK_VALUE(height > 2 * margin && width > 2 * margin, function, ": image has shape ", image.sizes(),
                    "; with a margin of ", margin, " its sides must be at least ", 2 * margin + 1);
  const bool bytes = target.defined() && target.scalar_type() == kByte;
  expect("target", target, shape_of(image.sizes()), bytes ? kByte : kAsLike);
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
    arguments.l1_weight = l1_weight, arguments.l2_weight = l2_weight;
    arguments.ssim_weight = ssim_weight, arguments.offset = offset;
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
  const Expect expect(function, "opacities", opacities);
  expect("opacities", opacities, {"N", 1});
  expect("scales", scales, {opacities.size(0), 3});
  expect("rotations", rotations, {opacities.size(0), 4});
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

// raw: the arguments of `activate`, values: its results, dL_d...: the gradients by these, if there are any.
template <class Backend>
GaussianTensors activate_backward(const Tensors& raw, const Tensors& values, const OptionalTensor& dL_dopacities,
                                  const OptionalTensor& dL_dscales, const OptionalTensor& dL_drotations) {
  const char* function = "activate_backward";
  DSMOE_CHECK_VALUE(raw.size() == 3 && values.size() == 3, function, ": raw and values must have 3 tensors each");
  const GaussianTensors raw_tensors = checked(function, raw[0], raw[1], raw[2]);
  const GaussianTensors value_tensors = checked(function, values[0], values[1], values[2]);
  const Expect expect(function, "raw[0]", raw[0]);
  expect("values[0]", values[0], shape_of(raw[0].sizes()));
  const DeviceGuard guard(raw[0].device());
  const auto dense = [&](const char* name, const OptionalTensor& gradient, const Tensor& value) {
    if (!gradient.has_value()) return Tensor();
    expect(name, *gradient, shape_of(value.sizes()));
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
  const Expect expect("add_view", "dL_dmeans2D", dL_dmeans2D);
  expect("radii", radii, {"N"}, kInt);
  expect("dL_dmeans2D", dL_dmeans2D, {radii.size(0), 3});
  expect.dense("gradient_sum", gradient_sum, {radii.size(0)});
  expect.dense("view_count", view_count, {radii.size(0)});
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

template <class Backend>
void gate_adam(const Tensor& logarithm, const Tensor& moment, const Tensor& square, const Tensor& gate,
               const Tensor& gradient, double rate, double root_scale, double beta1, double beta2, double epsilon,
               double bound, double limit) {
  const Expect expect("gate_adam", "logarithm", logarithm);
  expect.dense("logarithm", logarithm, {1});
  expect.dense("moment", moment, {1});
  expect.dense("square", square, {1});
  expect.dense("gate", gate, {1});
  expect.dense("gradient", gradient, {1});
  const DeviceGuard guard(logarithm.device());
  dispatch_real(logarithm, [&](auto zero) {
    using scalar_t = decltype(zero);
    GateStep<scalar_t> pass = {};
    pass.logarithm = logarithm.data_ptr<scalar_t>();
    pass.moment = moment.data_ptr<scalar_t>();
    pass.square = square.data_ptr<scalar_t>();
    pass.gate = gate.data_ptr<scalar_t>();
    pass.gradient = gradient.data_ptr<scalar_t>();
    pass.bound = static_cast<scalar_t>(bound);
    pass.limit = static_cast<scalar_t>(limit);
    pass.constants = adam_constants<scalar_t>(beta1, beta2, epsilon);
    pass.rates = {static_cast<scalar_t>(rate), static_cast<scalar_t>(root_scale)};
    Backend::for_each_gaussian(pass, 1);
  });
  note_change({logarithm, moment, square, gate});
}

template <class Backend>
void set_inputs(const Tensors& to, const Tensors& source, const Tensor& numbers,
                const std::vector<double>& new_numbers) {
  const char* function = "set_inputs";
  using Limits = StepInputs<float>;
  const Expect expect(function, "numbers", numbers);
  check_length(function, "source", source.size(), to.size());
  DSMOE_CHECK_VALUE(to.size() <= Limits::kMostArrays, function, ": to has length ", to.size(), "; it must be at most ",
                    Limits::kMostArrays);
  DSMOE_CHECK_VALUE(new_numbers.size() <= Limits::kMostNumbers, function, ": new_numbers has length ",
                    new_numbers.size(), "; it must be at most ", Limits::kMostNumbers);
  expect.dense("numbers", numbers, {static_cast<int64_t>(new_numbers.size())});
  for (size_t i = 0; i < to.size(); ++i) {
    const auto type = source[i].scalar_type();
    DSMOE_CHECK_TYPE(type == kByte || type == kInt || type == kFloat || type == kDouble, function, ": ",
                     item_name("source", i), " is ", dtype_name(type), "; it must be uint8, int32, float32 or float64");
    expect.dense(item_name("source", i), source[i], shape_of(source[i].sizes()), type);
    expect.dense(item_name("to", i), to[i], shape_of(source[i].sizes()), type);
  }
  const DeviceGuard guard(numbers.device());
  dispatch_real(numbers, [&](auto zero) {
    using scalar_t = decltype(zero);
    StepInputs<scalar_t> pass = {};
    pass.numbers = numbers.data_ptr<scalar_t>();
    pass.num_numbers = static_cast<int>(new_numbers.size());
    std::copy(new_numbers.begin(), new_numbers.end(), pass.new_numbers);
    int64_t end = 0;
    for (size_t i = 0; i < to.size(); ++i) {
      const auto type = source[i].scalar_type();
      const auto* from = static_cast<const unsigned char*>(source[i].data_ptr());
      auto* into = static_cast<unsigned char*>(to[i].data_ptr());
      const int64_t bytes = source[i].numel() * (type == kByte ? 1 : type == kDouble ? 8 : 4);
      const auto places = reinterpret_cast<uintptr_t>(from) | reinterpret_cast<uintptr_t>(into);
      end += StepInputs<scalar_t>::num_pieces(bytes);
      pass.arrays[i] = {from, into, bytes, end, places % sizeof(typename StepInputs<scalar_t>::Piece) == 0};
    }
    pass.num_arrays = static_cast<int>(to.size());
    Backend::for_each_gaussian(pass, pass.count());
  });
  note_change(to);
  note_change({numbers});
}

// Of `mean_squared_neighbour_distances`, whose implementations share no more.
inline void check_points(const Tensor& points) {
  const Expect expect("distCUDA2", "points", points);
  expect("points", points, {"N", 3});
  const int64_t index = first_set(logical_not(all_of(isfinite(points), 1)));
  DSMOE_CHECK_VALUE(index < 0, expect.function, ": points[", index, "] is not finite");
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
  implement<&with_arguments<&gate_adam<Backend>>>(m, "gate_adam");
  implement<&with_arguments<&set_inputs<Backend>>>(m, "set_inputs");
  implement<&with_arguments<&Backend::mean_squared_neighbour_distances>>(m, "mean_squared_neighbour_distances");
}

}  // namespace binding
}  // namespace dsmoe

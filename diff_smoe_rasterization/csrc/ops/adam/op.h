// The ops of Adam: dense, lazy, and with the activations around it.
#pragma once

#include <algorithm>
#include <string>
#include <vector>

#include "dsmoe/training/adam.h"
#include "dsmoe/training/gaussians.h"
#include "torch/op.h"

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
    const AdamStep<scalar_t> step = {constants, flags.defined() ? flags.data_ptr<bool>() : nullptr};
    DSMOE_ON(Backend, adam, tensors, step);
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
    DSMOE_ON(Backend, catch_up, adam);
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
    if constexpr (Backend::kOnHost) {
      cpu::note_step(step);
    } else {
      cuda::note_step(step, Backend::where());
    }
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
    DSMOE_ON(Backend, step_gaussians, adam);
  });
  for (const Tensors* list : {&raw, &values, &moments, &squares}) note_change(*list);
}

template <class Backend, class Ops> void adam_ops(Ops& ops) {
  // One step of Adam in place. rates and root_scales: a number per parameter, see dsmoe/training/adam.h. visible [N]:
  // rows of every parameter that are stepped.
  ops.template add<&adam<Backend>>(
      "adam(Tensor(a!)[] parameters, Tensor[] gradients, Tensor(b!)[] moments, Tensor(c!)[] squares, float[] rates, "
      "float[] root_scales, float beta1, float beta2, float epsilon, Tensor? visible) -> ()");
  // Brings rows of parameters [N, ...] up to date: all, or those whose radii [N] are above 0. See
  // dsmoe/training/adam.h. marks [N] int32; rates [capacity, tensors, 2], of which `steps` are written. given_steps
  // [1]: on the device, in place of `steps`.
  ops.template add<&lazy_adam_catch_up<Backend>>(
      "lazy_adam_catch_up(Tensor(a!)[] parameters, Tensor(b!)[] moments, Tensor(c!)[] squares, Tensor[] gradients, "
      "Tensor(d!) marks, Tensor rates, int steps, float beta1, float beta2, float epsilon, Tensor? radii, Tensor? "
      "given_steps=None) -> ()");
  // Writes rates[steps], and marks the rows whose radii are above 0. given_steps [1], given_rates [tensors, 2]: on the
  // device, in place of the numbers.
  ops.template add<&lazy_adam_step<Backend>>(
      "lazy_adam_step(Tensor(a!) marks, Tensor(b!) rates, int steps, float[] new_rates, float[] root_scales, Tensor "
      "radii, Tensor? given_steps=None, Tensor? given_rates=None) -> ()");
  // One step of Adam, in place, on raw means, opacities, scales and rotations. Gradients are by the activated values,
  // and are read in rows whose radii [N] are above 0. values: the last three activated; written anew. given_rates [4,
  // 2]: on the device, in place of the numbers.
  ops.template add<&gaussian_adam<Backend>>(
      "gaussian_adam(Tensor(a!)[] raw, Tensor(b!)[] values, Tensor[] dL_dvalues, Tensor(c!)[] moments, Tensor(d!)[] "
      "squares, Tensor radii, float[] rates, float[] root_scales, float beta1, float beta2, float epsilon, Tensor? "
      "given_rates=None) -> ()");
}

}  // namespace binding
}  // namespace dsmoe

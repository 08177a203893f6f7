// The ops that are one pass over all Gaussians, or over numbers of a step.
#pragma once

#include <algorithm>
#include <string>
#include <tuple>
#include <vector>

#include "cpu/parallel.h"
#include "dsmoe/training/gaussians.h"
#include "torch/op.h"

namespace dsmoe {
namespace binding {

template <class Backend, class Pass> void for_each_gaussian(const Pass& pass, int64_t count) {
  if constexpr (Backend::kOnHost) {
    constexpr int64_t kChunk = 1 << 14;  // Gaussians a thread takes at a time
    cpu::parallel_for(Backend::where(), count, kChunk, [&](int64_t begin, int64_t end) {
      for (int64_t i = begin; i < end; ++i) pass(i);
    });
  } else {
    cuda::for_each_gaussian(pass, count, Backend::where());
  }
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
    for_each_gaussian<Backend>(Activate<scalar_t>{pointers<const scalar_t>(raw), pointers<scalar_t>(values)},
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
    for_each_gaussian<Backend>(pass, raw[0].size(0));
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
    for_each_gaussian<Backend>(pass, radii.size(0));
  });
  note_change({gradient_sum, view_count});
}

template <class Backend>
Tensor pixel_reach(const Tensor& radii, const Tensor& opacities, const Tensor& squared_reaches) {
  const Expect expect("pixel_reach", "opacities", opacities);
  expect("radii", radii, {"N"}, kInt);
  expect("opacities", opacities, {radii.size(0)});
  expect("squared_reaches", squared_reaches, {radii.size(0)});
  const DeviceGuard guard(radii.device());
  const Tensor dense[] = {radii.contiguous(), opacities.contiguous(), squared_reaches.contiguous()};
  const Tensor reach = empty({radii.size(0)}, opacities);
  dispatch_real(opacities, [&](auto zero) {
    using scalar_t = decltype(zero);
    PixelReach<scalar_t> pass = {};
    pass.radii = dense[0].data_ptr<int32_t>();
    pass.opacities = dense[1].data_ptr<scalar_t>();
    pass.squared_reaches = dense[2].data_ptr<scalar_t>();
    pass.reach = reach.data_ptr<scalar_t>();
    for_each_gaussian<Backend>(pass, radii.size(0));
  });
  return reach;
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
    for_each_gaussian<Backend>(pass, 1);
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
    for_each_gaussian<Backend>(pass, pass.count());
  });
  note_change(to);
  note_change({numbers});
}

template <class Backend, class Ops> void gaussians_ops(Ops& ops) {
  // Sigmoid of the opacities [N, 1], exp of the scales [N, 3], normalised rotations [N, 4].
  ops.template add<&activate<Backend>>(
      "activate(Tensor opacities, Tensor scales, Tensor rotations) -> (Tensor, Tensor, Tensor)");
  // Gradients by the arguments of `activate`, which are `raw`, from those by its results, which are `values`.
  ops.template add<&activate_backward<Backend>>(
      "activate_backward(Tensor[] raw, Tensor[] values, Tensor? dL_dopacities, Tensor? dL_dscales, Tensor? "
      "dL_drotations) -> (Tensor, Tensor, Tensor)");
  // For densification: adds |dL_dmeans2D[:, :2]| and 1 where radii > 0. All [N] but dL_dmeans2D [N, 3].
  ops.template add<&add_view<Backend>>(
      "add_view(Tensor dL_dmeans2D, Tensor radii, Tensor(a!) gradient_sum, Tensor(b!) view_count) -> ()");
  // Pixels from a footprint's centre within which any mode feels it. All [N].
  ops.template add<&pixel_reach<Backend>>(
      "pixel_reach(Tensor radii, Tensor opacities, Tensor squared_reaches) -> Tensor");
  // One step of Adam on p, and gate = bound + exp(p). All tensors [1]; gradient: by the gate. limit: of |p|.
  ops.template add<&gate_adam<Backend>>(
      "gate_adam(Tensor(a!) logarithm, Tensor(b!) moment, Tensor(c!) square, Tensor(d!) gate, Tensor gradient, "
      "float rate, float root_scale, float beta1, float beta2, float epsilon, float bound, float limit) -> ()");
  // What a step that repeats reads anew each time, in one launch: copies tensors, dense and of any type, and writes
  // numbers. to, from: at most 8; numbers [n]: at most 32.
  ops.template add<&set_inputs<Backend>>(
      "set_inputs(Tensor(a!)[] to, Tensor[] source, Tensor(b!) numbers, float[] new_numbers) -> ()");
}

}  // namespace binding
}  // namespace dsmoe

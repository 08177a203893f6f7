// What the ops need of PyTorch, in two forms of the same names. tensor_aten.h takes LibTorch's C++ classes, of any
// release that the ops are compiled against. tensor_stable.h (DSMOE_STABLE_ABI) takes the C functions of LibTorch's
// stable ABI, so that one binary works with every release from 2.11 on. The ops are written once, against this:
//
//   Tensor            defined, dim, size, sizes, stride, numel, is_contiguous, contiguous, data_ptr, scalar_type,
//                     device, narrow, view, copy_, clone; a copy is another reference
//   Sizes, ScalarType (kFloat, kInt, ...), Device
//   empty, empty_like new tensors of the type and device of another
//   isfinite, ...     the few functions of tensors that checks and searches take
//   DeviceGuard, num_threads, forward_mode_is_open, note_change, has_tangent
//   DSMOE_CHECK...    errors that are ValueError, TypeError, ... in Python
//   Library, Arguments, implement   registration of an op, and its arguments
#pragma once

#ifdef DSMOE_STABLE_ABI
#include "tensor_stable.h"
#else
#include "tensor_aten.h"
#endif

#include <cstdint>
#include <tuple>
#include <type_traits>
#include <utility>
#include <vector>

namespace dsmoe {
namespace binding {

// Calls body(S()) with the type of a tensor that is known to be float32 or float64.
template <class Body> void dispatch_real(const Tensor& like, const Body& body) {
  if (like.scalar_type() == kDouble) {
    body(double());
  } else {
    body(float());
  }
}

// A function that takes the arguments of an op and returns its result, as the body of that op.
template <auto kFunction, class Result, class... Values>
void call_with_arguments(Result (*)(Values...), Arguments& arguments) {
  // Braces: the arguments are read in their order.
  std::tuple<std::decay_t<Values>...> values{arguments.read<std::decay_t<Values>>()...};
  if constexpr (std::is_void_v<Result>) {
    std::apply(kFunction, values);
    arguments.give_back();
  } else {
    give_back_result(arguments, std::apply(kFunction, values));
  }
}

template <class Result> void give_back_result(Arguments& arguments, Result&& result) {
  arguments.give_back(std::forward<Result>(result));
}
template <class... Results> void give_back_result(Arguments& arguments, std::tuple<Results...>&& results) {
  std::apply([&](auto&... each) { arguments.give_back(std::move(each)...); }, results);
}

template <auto kFunction> void with_arguments(Arguments& arguments) {
  call_with_arguments<kFunction>(kFunction, arguments);
}

}  // namespace binding
}  // namespace dsmoe

// The names of tensor.h by LibTorch's C++ classes.
#pragma once

// Not ATen/ATen.h, which takes seconds to compile.
#include <ATen/Parallel.h>
#include <ATen/core/Tensor.h>
#include <ATen/core/dispatch/Dispatcher.h>  // OperatorHandle
#include <ATen/core/stack.h>
#include <ATen/ops/all.h>
#include <ATen/ops/amax.h>
#include <ATen/ops/amin.h>
#include <ATen/ops/argsort.h>
#include <ATen/ops/empty.h>
#include <ATen/ops/empty_like.h>
#include <ATen/ops/index_select.h>
#include <ATen/ops/isfinite.h>
#include <ATen/ops/isnan.h>
#include <ATen/ops/logical_and.h>
#include <ATen/ops/logical_not.h>
#include <ATen/ops/nonzero.h>
#include <c10/core/DeviceGuard.h>
#include <torch/library.h>

#include <utility>
#include <vector>

#define DSMOE_CHECK TORCH_CHECK
#define DSMOE_CHECK_VALUE TORCH_CHECK_VALUE
#define DSMOE_CHECK_TYPE TORCH_CHECK_TYPE
#define DSMOE_CHECK_INDEX TORCH_CHECK_INDEX
#define DSMOE_CHECK_NOT_IMPLEMENTED TORCH_CHECK_NOT_IMPLEMENTED

#define DSMOE_LIBRARY(m) TORCH_LIBRARY(diff_smoe_rasterization, m)
#define DSMOE_LIBRARY_FRAGMENT(m) TORCH_LIBRARY_FRAGMENT(diff_smoe_rasterization, m)
#define DSMOE_LIBRARY_IMPL(key, m) TORCH_LIBRARY_IMPL(diff_smoe_rasterization, key, m)

namespace dsmoe {
namespace binding {

using at::Device;
using at::ScalarType;
using at::Tensor;
using DeviceGuard = c10::DeviceGuard;
using Library = torch::Library;
using OptionalTensor = c10::optional<at::Tensor>;  // std::optional in newer torch
using Sizes = at::IntArrayRef;
using Tensors = std::vector<at::Tensor>;

using at::kBFloat16;
using at::kBool;
using at::kByte;
using at::kDouble;
using at::kFloat;
using at::kHalf;
using at::kInt;
using at::kLong;

using at::empty_like;
inline Tensor empty(Sizes sizes, const Tensor& like) { return at::empty(sizes, like.options()); }
inline Tensor empty(Sizes sizes, const Tensor& like, ScalarType type) {
  return at::empty(sizes, like.options().dtype(type));
}

using at::argsort;
using at::index_select;
using at::isfinite;
using at::isnan;
using at::logical_and;
using at::logical_not;
using at::nonzero;
inline Tensor all_of(const Tensor& flags, int64_t dim) { return at::all(flags, dim); }
inline Tensor largest(const Tensor& tensor) { return at::amax(tensor, 0); }
inline Tensor smallest(const Tensor& tensor) { return at::amin(tensor, 0); }
inline Tensor abs_at_most(const Tensor& tensor, float limit) { return tensor.abs().le(limit); }
inline Tensor to_cpu(const Tensor& tensor) { return tensor.cpu().contiguous(); }

inline int num_threads() { return at::get_num_threads(); }

// Autograd must notice if a tensor was changed in place after it was saved.
inline void note_change(const Tensors& tensors) {
  for (const Tensor& tensor : tensors) tensor.unsafeGetTensorImpl()->bump_version();
}

// Whether a tensor may carry a derivative of forward mode; if it is cheap to know.
inline bool forward_mode_is_open() { return true; }

// Whether the tensor carries a derivative of forward mode.
inline bool has_tangent(const Tensor& tensor) { return tensor.defined() && tensor._fw_grad(0).defined(); }

// Reads the arguments of an op in their order, from torch's stack, and puts the results there.
class Arguments {
 public:
  Arguments(const c10::OperatorHandle& op, torch::jit::Stack& stack)
      : stack_(stack), begin_(stack.size() - op.schema().arguments().size()), next_(begin_) {}

  void read(OptionalTensor& value) { value = next().toOptional<Tensor>(); }
  void read(Tensor& value) {  // undefined if it is None
    const c10::IValue& argument = next();
    value = argument.isNone() ? Tensor() : argument.toTensor();
  }
  void read_optional(Tensor& value) { read(value); }
  void read(int64_t& value) { value = next().toInt(); }
  void read(double& value) { value = next().toDouble(); }
  void read(bool& value) { value = next().toBool(); }
  void read(Tensors& value) { value = next().toTensorVector(); }
  void read(std::vector<double>& value) { value = next().toDoubleVector(); }
  void read(std::vector<bool>& value) {
    for (const bool flag : next().toBoolList()) value.push_back(flag);
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

  // The same of tensors, and of a list behind them.
  void give_back_with_list(const Tensors& tensors, Tensors list) {
    stack_.resize(begin_);
    for (const Tensor& tensor : tensors) stack_.emplace_back(tensor);
    stack_.emplace_back(std::move(list));
  }

 private:
  const c10::IValue& next() { return stack_[next_++]; }

  torch::jit::Stack& stack_;
  size_t begin_, next_;
};

template <void (*kBody)(Arguments&)> void boxed(const c10::OperatorHandle& op, torch::jit::Stack* stack) {
  Arguments arguments(op, *stack);
  kBody(arguments);
}

template <void (*kBody)(Arguments&)> void implement(Library& library, const char* name) {
  library.impl(name, torch::CppFunction::makeFromBoxedFunction<&boxed<kBody>>());
}

}  // namespace binding
}  // namespace dsmoe

// The names of tensor.h by LibTorch's stable ABI of 2.11: torch::stable::Tensor and its functions, which are
// headers over C functions. By hand is what they lack (DEVELOPING.md, "Wheels"), and what a call would lose by them: an
// op of theirs goes through the dispatcher. No other C++ class of LibTorch is named here.
#pragma once

#include <torch/csrc/stable/accelerator.h>
#include <torch/csrc/stable/library.h>
#include <torch/csrc/stable/ops.h>
#include <torch/csrc/stable/tensor.h>

#include <array>
#include <cstdint>
#include <optional>
#include <ostream>
#include <sstream>
#include <string>
#include <utility>
#include <vector>

#define DSMOE_RAISE_UNLESS(kind, condition, ...) \
  if (!(condition)) ::dsmoe::binding::raise(::dsmoe::binding::kind, ::dsmoe::binding::message_of(__VA_ARGS__))
#define DSMOE_CHECK(...) DSMOE_RAISE_UNLESS(ErrorKind::kRuntime, __VA_ARGS__)
#define DSMOE_CHECK_VALUE(...) DSMOE_RAISE_UNLESS(ErrorKind::kValue, __VA_ARGS__)
#define DSMOE_CHECK_TYPE(...) DSMOE_RAISE_UNLESS(ErrorKind::kType, __VA_ARGS__)
#define DSMOE_CHECK_INDEX(...) DSMOE_RAISE_UNLESS(ErrorKind::kIndex, __VA_ARGS__)
#define DSMOE_CHECK_NOT_IMPLEMENTED(...) DSMOE_RAISE_UNLESS(ErrorKind::kNotImplemented, __VA_ARGS__)

#define DSMOE_LIBRARY(m) STABLE_TORCH_LIBRARY(diff_smoe_rasterization, m)
#define DSMOE_LIBRARY_FRAGMENT(m) STABLE_TORCH_LIBRARY_FRAGMENT(diff_smoe_rasterization, m)
#define DSMOE_LIBRARY_IMPL(key, m) STABLE_TORCH_LIBRARY_IMPL(diff_smoe_rasterization, key, m)

namespace dsmoe {
namespace binding {

// What an op asks of Python if the stable ABI has no form of it. The functions are found in the Python that loads
// the ops.

enum class ErrorKind { kRuntime, kValue, kType, kIndex, kNotImplemented, kOutOfMemory };

// Throws what PyTorch turns into a Python error of that kind. Needs no GIL.
[[noreturn]] void raise(ErrorKind kind, const std::string& message);

// Whether torch.autograd.forward_ad has a level open.
bool forward_mode_is_open();

using Device = torch::stable::Device;
using Library = torch::stable::detail::StableLibrary;
using ScalarType = torch::headeronly::ScalarType;
using Sizes = torch::headeronly::IntHeaderOnlyArrayRef;
using StableTensor = torch::stable::Tensor;

constexpr ScalarType kByte = ScalarType::Byte, kInt = ScalarType::Int, kLong = ScalarType::Long,
                     kBool = ScalarType::Bool, kHalf = ScalarType::Half, kBFloat16 = ScalarType::BFloat16,
                     kFloat = ScalarType::Float, kDouble = ScalarType::Double;

inline bool operator==(const Sizes& a, const Sizes& b) { return a.equals(b); }
std::ostream& operator<<(std::ostream& out, const Sizes& sizes);
std::ostream& operator<<(std::ostream& out, const Device& device);

template <class... Parts> std::string message_of(const Parts&... parts) {
  std::ostringstream out;
  (out << ... << parts);
  return out.str();
}

// LibTorch's class with the functions that at::Tensor has as members.
class Tensor : public StableTensor {
 public:
  Tensor() : StableTensor(undefined()) {}
  Tensor(StableTensor tensor) : StableTensor(std::move(tensor)) {}

  ScalarType scalar_type() const;
  using StableTensor::data_ptr;
  template <class S> S* data_ptr() const { return static_cast<S*>(data_ptr()); }

  Tensor contiguous() const { return is_contiguous() ? *this : clone(); }
  Tensor clone() const;  // dense
  Tensor narrow(int64_t dim, int64_t begin, int64_t size) const {
    StableTensor tensor = *this;
    return torch::stable::narrow(tensor, dim, begin, size);
  }
  Tensor view(Sizes sizes) const { return torch::stable::view(*this, sizes); }
  void copy_(const Tensor& from) const { TORCH_ERROR_CODE_CHECK(aoti_torch_copy_(get(), from.get(), false)); }

 private:
  static const StableTensor& undefined() {  // one for all: LibTorch's constructor allocates another
    static const StableTensor none;
    return none;
  }
};
using OptionalTensor = std::optional<Tensor>;
using Tensors = std::vector<Tensor>;

Tensor empty(Sizes sizes, const Tensor& like);
Tensor empty(Sizes sizes, const Tensor& like, ScalarType type);
inline Tensor empty_like(const Tensor& like) { return empty(like.sizes(), like); }

template <class T> StableIValue to_value(const T& value) { return torch::stable::detail::from(value); }
inline StableIValue to_value(const Tensor& tensor) {
  return torch::stable::detail::from(static_cast<const StableTensor&>(tensor));
}
inline StableIValue to_value(const Tensors& tensors) {
  return torch::stable::detail::from(std::vector<StableTensor>(tensors.begin(), tensors.end()));
}

// Calls an op of PyTorch by the name and the arguments of its schema. Returns its first result.
template <class... Values> Tensor call(const char* name, const char* overload, const Values&... values) {
  std::array<StableIValue, sizeof...(Values) + 2> stack = {to_value(values)...};  // more than any of them returns
  TORCH_ERROR_CODE_CHECK(torch_call_dispatcher(name, overload, stack.data(), TORCH_ABI_VERSION));
  return torch::stable::detail::to<StableTensor>(stack[0]);
}

inline Tensor isfinite(const Tensor& tensor) { return call("aten::isfinite", "", tensor); }
inline Tensor isnan(const Tensor& tensor) { return call("aten::isnan", "", tensor); }
inline Tensor logical_and(const Tensor& a, const Tensor& b) { return call("aten::logical_and", "", a, b); }
inline Tensor logical_not(const Tensor& flags) { return call("aten::logical_not", "", flags); }
inline Tensor nonzero(const Tensor& flags) { return call("aten::nonzero", "", flags); }
inline Tensor all_of(const Tensor& flags, int64_t dim) { return call("aten::all", "dim", flags, dim, false); }
inline Tensor largest(const Tensor& tensor) { return torch::stable::amax(tensor, 0); }
inline Tensor smallest(const Tensor& tensor) { return call("aten::amin", "", tensor, std::vector<int64_t>{0}, false); }
inline Tensor argsort(const Tensor& keys) { return call("aten::argsort", "", keys, int64_t{-1}, false); }
inline Tensor index_select(const Tensor& tensor, int64_t dim, const Tensor& indices) {
  return call("aten::index_select", "", tensor, dim, indices);
}
inline Tensor abs_at_most(const Tensor& tensor, float limit) {  // a number is not an argument that the stable ABI has
  return call("aten::le", "Tensor", call("aten::abs", "", tensor), Tensor(torch::stable::full({}, limit, kFloat)));
}
inline Tensor to_cpu(const Tensor& tensor) {
  return Tensor(torch::stable::to(tensor, Device(torch::headeronly::DeviceType::CPU))).contiguous();
}

inline int num_threads() { return static_cast<int>(torch::stable::get_num_threads()); }

// Makes the device of a tensor current; on the CPU there is nothing to do.
class DeviceGuard {
 public:
  explicit DeviceGuard(const Device& device) {
    if (device.is_cuda()) guard_.emplace(device.index());
  }

 private:
  std::optional<torch::stable::accelerator::DeviceGuard> guard_;
};

// Autograd must notice if a tensor was changed in place after it was saved.
void note_change(const Tensors& tensors);

// Whether the tensor carries a derivative of forward mode.
bool has_tangent(const Tensor& tensor);

// Reads the arguments of an op in their order, and owns them from then on. All must be read before anything is thrown.
class Arguments {
 public:
  explicit Arguments(StableIValue* stack) : stack_(stack) {}

  template <class T> void read(T& value) { value = take<T>(); }
  void read(Tensor& value) { value = take<StableTensor>(); }
  void read(OptionalTensor& value) { value = take<std::optional<StableTensor>>(); }
  void read(Tensors& value) {
    for (StableTensor& tensor : take<std::vector<StableTensor>>()) value.emplace_back(std::move(tensor));
  }
  void read_optional(Tensor& value) {  // undefined if it is None
    std::optional<StableTensor> tensor = take<std::optional<StableTensor>>();
    value = tensor ? Tensor(*std::move(tensor)) : Tensor();
  }
  template <class T> T read() {
    T value = {};
    read(value);
    return value;
  }

  template <class... Results> void give_back(const Results&... results) {
    size_t next = 0;
    ((stack_[next++] = to_value(results)), ...);
  }

  // The same of tensors, and of a list behind them.
  void give_back_with_list(const Tensors& tensors, const Tensors& list) {
    size_t next = 0;
    for (const Tensor& tensor : tensors) stack_[next++] = to_value(tensor);
    stack_[next] = to_value(list);
  }

 private:
  template <class T> T take() { return torch::stable::detail::to<T>(stack_[next_++]); }

  StableIValue* stack_;
  size_t next_ = 0;
};

template <void (*kBody)(Arguments&)> void boxed(StableIValue* stack, uint64_t, uint64_t) {
  Arguments arguments(stack);
  kBody(arguments);
}

template <void (*kBody)(Arguments&)> void implement(Library& library, const char* name) {
  library.impl(name, &boxed<kBody>);
}

}  // namespace binding
}  // namespace dsmoe

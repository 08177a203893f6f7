// The names of tensor.h by the C functions of LibTorch's stable ABI, those of 2.11.
//
// What that ABI has no form of is done by Python (python_errors.h): the types of errors other than RuntimeError, and
// whether there are derivatives of forward mode. No C++ class of LibTorch is named here.
#pragma once

#include <torch/csrc/stable/library.h>

#include <array>
#include <cstdint>
#include <initializer_list>
#include <memory>
#include <optional>
#include <ostream>
#include <sstream>
#include <string>
#include <utility>
#include <vector>

#include "python_errors.h"

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

template <class... Parts> std::string message_of(const Parts&... parts) {
  std::ostringstream out;
  (out << ... << parts);
  return out.str();
}

// Raises RuntimeError where a function of LibTorch failed.
void check_call(AOTITorchError error, const char* function);

using ScalarType = torch::headeronly::ScalarType;
constexpr ScalarType kByte = ScalarType::Byte, kInt = ScalarType::Int, kLong = ScalarType::Long,
                     kBool = ScalarType::Bool, kHalf = ScalarType::Half, kBFloat16 = ScalarType::BFloat16,
                     kFloat = ScalarType::Float, kDouble = ScalarType::Double;

// LibTorch's numbers of a type and a device may change between releases: both are asked for at run time.
class Device {
 public:
  Device(int32_t type, int32_t index) : type_(type), index_(index) {}
  int32_t type() const { return type_; }
  int32_t index() const { return index_; }
  friend bool operator==(const Device& a, const Device& b) { return a.type_ == b.type_ && a.index_ == b.index_; }
  friend std::ostream& operator<<(std::ostream& out, const Device& device);

 private:
  int32_t type_, index_;
};

// A shape that lies elsewhere.
class Sizes {
 public:
  Sizes(const int64_t* begin, size_t count) : begin_(begin), count_(count) {}
  Sizes(const std::vector<int64_t>& sizes) : Sizes(sizes.data(), sizes.size()) {}
  Sizes(const std::initializer_list<int64_t>& sizes) : Sizes(sizes.begin(), sizes.size()) {}
  const int64_t* begin() const { return begin_; }
  const int64_t* end() const { return begin_ + count_; }
  size_t size() const { return count_; }
  const int64_t* data() const { return begin_; }
  std::vector<int64_t> vec() const { return {begin(), end()}; }
  friend bool operator==(const Sizes& a, const Sizes& b);
  friend std::ostream& operator<<(std::ostream& out, const Sizes& sizes);

 private:
  const int64_t* begin_;
  size_t count_;
};

class Tensor {
 public:
  Tensor() = default;                     // undefined
  explicit Tensor(AtenTensorHandle own);  // takes the handle; undefined where that tensor is
  AtenTensorHandle get() const { return owner_->handle; }
  AtenTensorHandle new_handle() const;  // another one, which the caller owns
  AtenTensorHandle release();           // the same, where this is the last reference; undefined from then on

  bool defined() const { return owner_ != nullptr; }
  int64_t dim() const;
  int64_t size(int64_t dim) const;
  Sizes sizes() const;
  int64_t stride(int64_t dim) const;
  int64_t numel() const;
  bool is_contiguous() const;
  ScalarType scalar_type() const;
  Device device() const;
  void* data_ptr() const;
  template <class S> S* data_ptr() const { return static_cast<S*>(data_ptr()); }

  Tensor contiguous() const;
  Tensor clone() const;
  Tensor narrow(int64_t dim, int64_t begin, int64_t size) const;
  Tensor view(Sizes sizes) const;  // of a contiguous tensor; one size may be -1
  void copy_(const Tensor& from) const;

 private:
  struct Owner {
    explicit Owner(AtenTensorHandle handle) : handle(handle) {}
    ~Owner() {
      if (handle != nullptr) aoti_torch_delete_tensor_object(handle);
    }
    Owner(const Owner&) = delete;
    Owner& operator=(const Owner&) = delete;
    AtenTensorHandle handle;
  };
  std::shared_ptr<Owner> owner_;
};
using OptionalTensor = std::optional<Tensor>;
using Tensors = std::vector<Tensor>;

Tensor empty(Sizes sizes, const Tensor& like);
Tensor empty(Sizes sizes, const Tensor& like, ScalarType type);
inline Tensor empty_like(const Tensor& like) { return empty(like.sizes(), like); }

// What libtorch takes over.
inline StableIValue to_value(const Tensor& tensor) { return torch::stable::detail::from(tensor.new_handle()); }
inline StableIValue to_value(Tensor&& tensor) { return torch::stable::detail::from(tensor.release()); }
inline StableIValue to_value(int64_t value) { return torch::stable::detail::from(value); }
inline StableIValue to_value(bool value) { return torch::stable::detail::from(value); }
StableIValue to_value(Tensors tensors);
StableIValue to_value(const std::vector<int64_t>& numbers);

// Calls an op of PyTorch by the name and the arguments of its schema. Returns its first result.
template <class... Values> Tensor call(const char* name, const char* overload, const Values&... values) {
  std::array<StableIValue, sizeof...(Values) + 2> stack = {to_value(values)...};  // more than any of them returns
  check_call(torch_call_dispatcher(name, overload, stack.data(), TORCH_ABI_VERSION), name);
  return Tensor(torch::stable::detail::to<AtenTensorHandle>(stack[0]));
}

inline Tensor isfinite(const Tensor& tensor) { return call("aten::isfinite", "", tensor); }
inline Tensor isnan(const Tensor& tensor) { return call("aten::isnan", "", tensor); }
inline Tensor logical_and(const Tensor& a, const Tensor& b) { return call("aten::logical_and", "", a, b); }
inline Tensor logical_not(const Tensor& flags) { return call("aten::logical_not", "", flags); }
inline Tensor nonzero(const Tensor& flags) { return call("aten::nonzero", "", flags); }
inline Tensor all_of(const Tensor& flags, int64_t dim) { return call("aten::all", "dim", flags, dim, false); }
inline Tensor largest(const Tensor& tensor) { return call("aten::amax", "", tensor, std::vector<int64_t>{0}, false); }
inline Tensor smallest(const Tensor& tensor) { return call("aten::amin", "", tensor, std::vector<int64_t>{0}, false); }
inline Tensor argsort(const Tensor& keys) { return call("aten::argsort", "", keys, int64_t{-1}, false); }
inline Tensor index_select(const Tensor& tensor, int64_t dim, const Tensor& indices) {
  return call("aten::index_select", "", tensor, dim, indices);
}
Tensor abs_at_most(const Tensor& tensor, float limit);
Tensor to_cpu(const Tensor& tensor);

int num_threads();

// Makes the device of a tensor current; on the CPU there is nothing to do.
class DeviceGuard {
 public:
  explicit DeviceGuard(const Device& device);
  ~DeviceGuard();
  DeviceGuard(const DeviceGuard&) = delete;
  DeviceGuard& operator=(const DeviceGuard&) = delete;

 private:
  DeviceGuardHandle handle_ = nullptr;
};

// Autograd must notice where a tensor was changed in place after it was saved.
void note_change(const Tensors& tensors);

// Whether the tensor carries a derivative of forward mode.
bool has_tangent(const Tensor& tensor);

// Reads the arguments of an op in their order, and owns them from then on. All must be read before anything is thrown.
class Arguments {
 public:
  explicit Arguments(StableIValue* stack) : stack_(stack) {}

  void read(Tensor& value) { value = Tensor(take<AtenTensorHandle>()); }
  void read(OptionalTensor& value) {
    Tensor tensor;
    read_optional(tensor);
    if (tensor.defined()) value = std::move(tensor);
  }
  void read_optional(Tensor& value) {  // undefined where it is None
    const std::unique_ptr<StableIValue> argument(take<StableIValue*>());
    value = argument ? Tensor(torch::stable::detail::to<AtenTensorHandle>(*argument)) : Tensor();
  }
  void read(int64_t& value) { value = take<int64_t>(); }
  void read(double& value) { value = take<double>(); }
  void read(bool& value) { value = take<bool>(); }
  void read(Tensors& value) {
    for (const StableIValue item : take_list()) value.emplace_back(torch::stable::detail::to<AtenTensorHandle>(item));
  }
  void read(std::vector<double>& value) {
    for (const StableIValue item : take_list()) value.push_back(torch::stable::detail::to<double>(item));
  }
  void read(std::vector<bool>& value) {
    for (const StableIValue item : take_list()) value.push_back(torch::stable::detail::to<bool>(item));
  }
  template <class T> T read() {
    T value = {};
    read(value);
    return value;
  }

  template <class... Results> void give_back(Results&&... results) {
    size_t next = 0;
    ((stack_[next++] = to_value(std::forward<Results>(results))), ...);
  }

  // The same of tensors, and of a list behind them.
  void give_back_with_list(Tensors tensors, Tensors list) {
    size_t next = 0;
    for (Tensor& tensor : tensors) stack_[next++] = to_value(std::move(tensor));
    stack_[next] = to_value(std::move(list));
  }

 private:
  template <class T> T take() { return torch::stable::detail::to<T>(stack_[next_++]); }
  std::vector<StableIValue> take_list();

  StableIValue* stack_;
  size_t next_ = 0;
};

using Library = torch::stable::detail::StableLibrary;

template <void (*kBody)(Arguments&)> void boxed(StableIValue* stack, uint64_t, uint64_t) {
  Arguments arguments(stack);
  kBody(arguments);
}

template <void (*kBody)(Arguments&)> void implement(Library& library, const char* name) {
  library.impl(name, &boxed<kBody>);
}

}  // namespace binding
}  // namespace dsmoe

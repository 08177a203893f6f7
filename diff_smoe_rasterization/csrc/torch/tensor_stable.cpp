#include "tensor_stable.h"

#include <algorithm>
#include <cstring>

namespace dsmoe {
namespace binding {
namespace {

// The strides of a dense tensor.
class DenseStrides {
 public:
  explicit DenseStrides(const Sizes& sizes) {
    if (sizes.size() > few_.size()) many_.resize(sizes.size());
    int64_t* const strides = many_.empty() ? few_.data() : many_.data();
    int64_t stride = 1;
    for (size_t i = sizes.size(); i-- > 0;) {
      strides[i] = stride;
      stride *= std::max<int64_t>(sizes.data()[i], 1);
    }
  }
  const int64_t* data() const { return many_.empty() ? few_.data() : many_.data(); }

 private:
  std::array<int64_t, 4> few_;  // what tensors usually have
  std::vector<int64_t> many_;
};

int32_t number_of(ScalarType type) { return torch::stable::detail::to<int32_t>(torch::stable::detail::from(type)); }

Tensor new_tensor(const Sizes& sizes, int32_t type, const Device& device) {
  const DenseStrides strides(sizes);
  AtenTensorHandle handle = nullptr;
  if (aoti_torch_empty_strided(static_cast<int64_t>(sizes.size()), sizes.data(), strides.data(), type, device.type(),
                               device.index(), &handle) != TORCH_SUCCESS) {
    // The reason does not come through. Sizes are never negative here, so memory is all that can be missing.
    raise(ErrorKind::kOutOfMemory, message_of("out of memory: a tensor of shape ", sizes, " was refused on ", device));
  }
  return Tensor(handle);
}

int32_t type_number(const Tensor& tensor) {
  int32_t type;
  check_call(aoti_torch_get_dtype(tensor.get(), &type), "dtype");
  return type;
}

// Gradients are not recorded meanwhile.
class NoGrad {
 public:
  NoGrad() : before_(aoti_torch_grad_mode_is_enabled()) { aoti_torch_grad_mode_set_enabled(false); }
  ~NoGrad() { aoti_torch_grad_mode_set_enabled(before_); }
  NoGrad(const NoGrad&) = delete;
  NoGrad& operator=(const NoGrad&) = delete;

 private:
  const bool before_;
};

}  // namespace

void check_call(AOTITorchError error, const char* function) {
  if (error != TORCH_SUCCESS) raise(ErrorKind::kRuntime, message_of("PyTorch's ", function, " failed"));
}

std::ostream& operator<<(std::ostream& out, const Device& device) {
  if (device.type_ == aoti_torch_device_type_cpu()) return out << "cpu";
  if (device.type_ == aoti_torch_device_type_meta()) return out << "meta";
  if (device.type_ == aoti_torch_device_type_cuda()) return out << "cuda:" << device.index_;
  return out << "device " << device.index_ << " of type " << device.type_;
}

bool operator==(const Sizes& a, const Sizes& b) { return std::equal(a.begin(), a.end(), b.begin(), b.end()); }

std::ostream& operator<<(std::ostream& out, const Sizes& sizes) {
  out << "[";
  for (size_t i = 0; i < sizes.size(); ++i) out << (i == 0 ? "" : ", ") << sizes.data()[i];
  return out << "]";
}

Tensor::Tensor(AtenTensorHandle own) : owner_(std::make_shared<Owner>(own)) {
  bool is_defined = false;
  check_call(aoti_torch_is_defined(own, &is_defined), "is_defined");
  if (!is_defined) owner_ = nullptr;
}

AtenTensorHandle Tensor::new_handle() const {
  AtenTensorHandle handle = nullptr;
  if (defined()) {
    check_call(aoti_torch_new_tensor_handle(get(), &handle), "new_tensor_handle");
  } else {
    check_call(aoti_torch_new_uninitialized_tensor(&handle), "new_uninitialized_tensor");
  }
  return handle;
}

AtenTensorHandle Tensor::release() {
  if (owner_.use_count() != 1) return new_handle();
  return std::exchange(std::exchange(owner_, nullptr)->handle, nullptr);
}

int64_t Tensor::dim() const {
  int64_t dim;
  check_call(aoti_torch_get_dim(get(), &dim), "dim");
  return dim;
}

Sizes Tensor::sizes() const {
  int64_t* sizes;
  check_call(aoti_torch_get_sizes(get(), &sizes), "sizes");
  return {sizes, static_cast<size_t>(dim())};
}

int64_t Tensor::size(int64_t dim) const {
  int64_t size;
  check_call(aoti_torch_get_size(get(), dim, &size), "size");
  return size;
}

int64_t Tensor::stride(int64_t dim) const {
  int64_t stride;
  check_call(aoti_torch_get_stride(get(), dim, &stride), "stride");
  return stride;
}

int64_t Tensor::numel() const {
  int64_t count;
  check_call(aoti_torch_get_numel(get(), &count), "numel");
  return count;
}

bool Tensor::is_contiguous() const {
  bool is_contiguous;
  check_call(aoti_torch_is_contiguous(get(), &is_contiguous), "is_contiguous");
  return is_contiguous;
}

ScalarType Tensor::scalar_type() const {
  const int32_t type = type_number(*this);
  if (type == aoti_torch_dtype_float32()) return kFloat;
  return torch::stable::detail::to<ScalarType>(torch::stable::detail::from(type));
}

Device Tensor::device() const {
  int32_t type, index;
  check_call(aoti_torch_get_device_type(get(), &type), "device");
  check_call(aoti_torch_get_device_index(get(), &index), "device");
  return {type, index};
}

void* Tensor::data_ptr() const {
  void* data;
  check_call(aoti_torch_get_data_ptr(get(), &data), "data_ptr");
  return data;
}

Tensor Tensor::contiguous() const { return is_contiguous() ? *this : clone(); }

Tensor Tensor::clone() const {
  const Tensor copy = empty_like(*this);
  copy.copy_(*this);
  return copy;
}

Tensor Tensor::narrow(int64_t dim, int64_t begin, int64_t size) const {
  return call("aten::narrow", "", *this, dim, begin, size);
}

Tensor Tensor::view(Sizes sizes) const { return call("aten::view", "", *this, sizes.vec()); }

void Tensor::copy_(const Tensor& from) const { check_call(aoti_torch_copy_(get(), from.get(), false), "copy_"); }

Tensor empty(Sizes sizes, const Tensor& like) { return new_tensor(sizes, type_number(like), like.device()); }

Tensor empty(Sizes sizes, const Tensor& like, ScalarType type) {
  return new_tensor(sizes, number_of(type), like.device());
}

StableIValue to_value(Tensors tensors) {
  StableListHandle list;
  check_call(torch_new_list_reserve_size(tensors.size(), &list), "list");
  for (Tensor& tensor : tensors) check_call(torch_list_push_back(list, to_value(std::move(tensor))), "list");
  return torch::stable::detail::from(list);
}

StableIValue to_value(const std::vector<int64_t>& numbers) {
  StableListHandle list;
  check_call(torch_new_list_reserve_size(numbers.size(), &list), "list");
  for (const int64_t number : numbers) check_call(torch_list_push_back(list, to_value(number)), "list");
  return torch::stable::detail::from(list);
}

std::vector<StableIValue> Arguments::take_list() {
  const auto list = take<StableListHandle>();
  size_t size;
  check_call(torch_list_size(list, &size), "list");
  std::vector<StableIValue> items(size);
  for (size_t i = 0; i < size; ++i) check_call(torch_list_get_item(list, i, &items[i]), "list");
  check_call(torch_delete_list(list), "list");
  return items;
}

Tensor abs_at_most(const Tensor& tensor, float limit) {
  // A number is no argument that the stable ABI has; a tensor of no dimension is.
  const Tensor bound = new_tensor(std::vector<int64_t>(), number_of(kFloat), {aoti_torch_device_type_cpu(), 0});
  *bound.data_ptr<float>() = limit;
  return call("aten::le", "Tensor", call("aten::abs", "", tensor), bound);
}

Tensor to_cpu(const Tensor& tensor) {
  const Tensor copy = new_tensor(tensor.sizes(), type_number(tensor), {aoti_torch_device_type_cpu(), 0});
  copy.copy_(tensor);
  return copy;
}

int num_threads() {
  uint32_t count;
  check_call(torch_get_num_threads(&count), "get_num_threads");
  return static_cast<int>(count);
}

DeviceGuard::DeviceGuard(const Device& device) {
  if (device.type() != aoti_torch_device_type_cuda()) return;
  check_call(aoti_torch_create_device_guard(device.index(), &handle_), "DeviceGuard");
}

DeviceGuard::~DeviceGuard() {
  if (handle_ != nullptr) aoti_torch_delete_device_guard(handle_);
}

// The stable ABI has no version counter. An operation in place counts; this one leaves the tensor as it is.
void note_change(const Tensors& tensors) {
  const NoGrad guard;  // a leaf may not be changed in place otherwise
  for (const Tensor& tensor : tensors) call("aten::transpose_", "", tensor, int64_t{0}, int64_t{0});
}

bool has_tangent(const Tensor& tensor) {
  if (!tensor.defined() || !forward_mode_is_open()) return false;
  std::array<StableIValue, 3> stack = {to_value(tensor), to_value(int64_t{0})};
  check_call(torch_call_dispatcher("aten::_unpack_dual", "", stack.data(), TORCH_ABI_VERSION), "_unpack_dual");
  const Tensor primal(torch::stable::detail::to<AtenTensorHandle>(stack[0]));
  return Tensor(torch::stable::detail::to<AtenTensorHandle>(stack[1])).defined();
}

}  // namespace binding
}  // namespace dsmoe

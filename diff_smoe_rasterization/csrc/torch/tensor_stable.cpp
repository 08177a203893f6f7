#include "tensor_stable.h"

#include <algorithm>

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
      stride *= std::max<int64_t>(sizes[i], 1);
    }
  }
  const int64_t* data() const { return many_.empty() ? few_.data() : many_.data(); }

 private:
  std::array<int64_t, 4> few_;  // what tensors usually have
  std::vector<int64_t> many_;
};

// LibTorch's number of a tensor's type.
int32_t type_number(const Tensor& tensor) {
  int32_t type;
  TORCH_ERROR_CODE_CHECK(aoti_torch_get_dtype(tensor.get(), &type));
  return type;
}

Tensor new_tensor(const Sizes& sizes, const Tensor& like, int32_t type) {
  int32_t device, index;
  TORCH_ERROR_CODE_CHECK(aoti_torch_get_device_type(like.get(), &device));
  TORCH_ERROR_CODE_CHECK(aoti_torch_get_device_index(like.get(), &index));
  AtenTensorHandle handle = nullptr;
  const DenseStrides strides(sizes);
  if (aoti_torch_empty_strided(static_cast<int64_t>(sizes.size()), sizes.data(), strides.data(), type, device, index,
                               &handle) != TORCH_SUCCESS) {
    // The reason does not come through. Sizes are never negative here, so memory is all that can be missing.
    DSMOE_RAISE_UNLESS(ErrorKind::kOutOfMemory, false, "out of memory: a tensor of shape ", sizes, " was refused on ",
                       like.device());
  }
  return StableTensor(handle);
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

std::ostream& operator<<(std::ostream& out, const Sizes& sizes) {
  out << "[";
  for (size_t i = 0; i < sizes.size(); ++i) out << (i == 0 ? "" : ", ") << sizes[i];
  return out << "]";
}

std::ostream& operator<<(std::ostream& out, const Device& device) {
  if (device.is_cpu()) return out << "cpu";
  if (device.is_cuda()) return out << "cuda:" << device.index();
  if (device.type() == torch::headeronly::DeviceType::Meta) return out << "meta";
  return out << "device " << device.index() << " of type " << static_cast<int>(device.type());
}

ScalarType Tensor::scalar_type() const {
  static const int32_t float32 = aoti_torch_dtype_float32();  // LibTorch compares with each type that it knows
  return type_number(*this) == float32 ? kFloat : StableTensor::scalar_type();
}

Tensor Tensor::clone() const {
  const Tensor copy = empty_like(*this);
  copy.copy_(*this);
  return copy;
}

Tensor empty(Sizes sizes, const Tensor& like) { return new_tensor(sizes, like, type_number(like)); }

Tensor empty(Sizes sizes, const Tensor& like, ScalarType type) {
  return new_tensor(sizes, like, torch::stable::detail::to<int32_t>(torch::stable::detail::from(type)));
}

// The stable ABI has no version counter. An operation in place counts; this one leaves the tensor as it is.
void note_change(const Tensors& tensors) {
  const NoGrad guard;  // a leaf may not be changed in place otherwise
  for (const Tensor& tensor : tensors) call("aten::transpose_", "", tensor, int64_t{0}, int64_t{0});
}

bool has_tangent(const Tensor& tensor) {
  if (!tensor.defined() || !forward_mode_is_open()) return false;
  std::array<StableIValue, 3> stack = {to_value(tensor), to_value(int64_t{0})};
  TORCH_ERROR_CODE_CHECK(torch_call_dispatcher("aten::_unpack_dual", "", stack.data(), TORCH_ABI_VERSION));
  const StableTensor primal = torch::stable::detail::to<StableTensor>(stack[0]);
  return torch::stable::detail::to<StableTensor>(stack[1]).defined();
}

}  // namespace binding
}  // namespace dsmoe

#include "check_tensor.h"

#include <sstream>

namespace dsmoe {
namespace binding {
namespace {

std::string to_string(const Shape& shape) {
  std::ostringstream out;
  for (size_t i = 0; i < shape.size(); ++i) {
    out << (i == 0 ? "[" : ", ");
    if (shape[i].letter != nullptr) {
      out << shape[i].letter;
    } else {
      out << shape[i].size;
    }
  }
  out << "]";
  return out.str();
}

}  // namespace

std::string dtype_name(ScalarType type) {
  switch (type) {
    case kHalf:
      return "float16";
    case kBFloat16:
      return "bfloat16";
    case kFloat:
      return "float32";
    case kDouble:
      return "float64";
    case kByte:
      return "uint8";
    case kInt:
      return "int32";
    case kLong:
      return "int64";
    case kBool:
      return "bool";
    default:
      return toString(type);
  }
}

bool matches(const Tensor& tensor, const Shape& shape) {
  if (tensor.dim() != static_cast<int64_t>(shape.size())) return false;
  for (size_t i = 0; i < shape.size(); ++i) {
    if (shape[i].letter == nullptr && tensor.size(i) != shape[i].size) return false;
  }
  return true;
}

void check_shape(const char* function, const char* name, const Tensor& tensor, const Shape& shape) {
  DSMOE_CHECK_VALUE(matches(tensor, shape), function, ": ", name, " has shape ", tensor.sizes(), "; it must be ",
                    to_string(shape));
}

void check_same_shape(const char* function, const char* name, const Tensor& tensor, const char* other_name,
                      const Tensor& other) {
  DSMOE_CHECK_VALUE(tensor.sizes() == other.sizes(), function, ": ", name, " has shape ", tensor.sizes(),
                    "; it must be ", other.sizes(), ", as ", other_name, " is");
}

void check_real(const char* function, const char* name, const Tensor& tensor) {
  const ScalarType type = tensor.scalar_type();
  DSMOE_CHECK_TYPE(type == kFloat || type == kDouble, function, ": ", name, " is ", dtype_name(type),
                   "; it must be float32 or float64: cast it, for instance with ", name, ".float()");
}

void check_type(const char* function, const char* name, const Tensor& tensor, ScalarType type) {
  DSMOE_CHECK_TYPE(tensor.scalar_type() == type, function, ": ", name, " is ", dtype_name(tensor.scalar_type()),
                   "; it must be ", dtype_name(type));
}

void check_device(const char* function, const char* name, const Tensor& tensor, const char* other_name,
                  const Tensor& other) {
  DSMOE_CHECK_TYPE(tensor.device() == other.device(), function, ": ", name, " is on ", tensor.device(),
                   "; it must be on ", other.device(), ", as ", other_name, " is");
}

void check_like(const char* function, const char* name, const Tensor& tensor, const char* other_name,
                const Tensor& other) {
  DSMOE_CHECK_TYPE(tensor.scalar_type() == other.scalar_type(), function, ": ", name, " is ",
                   dtype_name(tensor.scalar_type()), "; it must be ", dtype_name(other.scalar_type()), ", as ",
                   other_name, " is");
  check_device(function, name, tensor, other_name, other);
}

void check_contiguous(const char* function, const char* name, const Tensor& tensor) {
  DSMOE_CHECK_VALUE(tensor.is_contiguous(), function, ": ", name, " is not contiguous; it must be");
}

void refuse_tangent(const char* function, const Tensor& tensor) {
  DSMOE_CHECK_NOT_IMPLEMENTED(!has_tangent(tensor), function,
                              ": forward-mode derivatives (torch.func.jvp, jacfwd, dual tensors) are not implemented; "
                              "take those of backward mode (torch.autograd.grad)");
}

}  // namespace binding
}  // namespace dsmoe

#include "check_tensor.h"

#include <sstream>
#include <utility>

namespace dsmoe {
namespace binding {
namespace {

std::string to_string(const Shape& shape) {
  std::ostringstream out;
  const char* before = "[";
  for (const Size& size : shape) {
    out << std::exchange(before, ", ");
    size.letter != nullptr ? out << size.letter : out << size.size;
  }
  out << (shape.empty() ? "[]" : "]");
  return out.str();
}

}  // namespace

std::string dtype_name(ScalarType type) {
  constexpr std::pair<ScalarType, const char*> kNames[] = {
      {kHalf, "float16"}, {kBFloat16, "bfloat16"}, {kFloat, "float32"}, {kDouble, "float64"},
      {kByte, "uint8"},   {kInt, "int32"},         {kLong, "int64"},    {kBool, "bool"}};
  for (const auto& [known, name] : kNames) {
    if (type == known) return name;
  }
  return toString(type);
}

bool matches(const Tensor& tensor, const Shape& shape) {
  if (tensor.dim() != static_cast<int64_t>(shape.size())) return false;
  for (size_t i = 0; i < shape.size(); ++i) {
    if (shape[i].letter == nullptr && tensor.size(i) != shape[i].size) return false;
  }
  return true;
}

std::string item_name(const char* list, size_t i) { return std::string(list) + "[" + std::to_string(i) + "]"; }

void check_length(const char* function, const char* list, size_t length, size_t expected) {
  DSMOE_CHECK_VALUE(length == expected, function, ": ", list, " has length ", length, "; it must be ", expected);
}

int64_t first_set(const Tensor& flags) {
  const Tensor indices = to_cpu(nonzero(flags));
  return indices.numel() == 0 ? -1 : indices.data_ptr<int64_t>()[0];
}

Expect::Expect(const char* function, const char* like_name, const Tensor& like)
    : function(function), like_name_(like_name), like_(like), tangents_(forward_mode_is_open()) {
  DSMOE_CHECK_VALUE(like.defined(), function, ": ", like_name, " is absent; it must be given");
  const ScalarType type = like.scalar_type();
  DSMOE_CHECK_TYPE(type == kFloat || type == kDouble, function, ": ", like_name, " is ", dtype_name(type),
                   "; it must be float32 or float64: cast it, for instance with ", like_name, ".float()");
}

void Expect::check_kind(std::string_view name, const Tensor& tensor, ScalarType type) const {
  const ScalarType expected = type == kAsLike ? like_.scalar_type() : type;
  DSMOE_CHECK_VALUE(tensor.defined(), function, ": ", name, " is absent; it must be given");
  DSMOE_CHECK_TYPE(tensor.scalar_type() == expected, function, ": ", name, " is ", dtype_name(tensor.scalar_type()),
                   "; it must be ", dtype_name(expected),
                   type == kAsLike ? std::string(", as ") + like_name_ + " is" : "");
  DSMOE_CHECK_TYPE(tensor.device() == like_.device(), function, ": ", name, " is on ", tensor.device(),
                   "; it must be on ", like_.device(), ", as ", like_name_, " is");
  DSMOE_CHECK_NOT_IMPLEMENTED(!tangents_ || !has_tangent(tensor), function,
                              ": forward-mode derivatives (torch.func.jvp, jacfwd, dual tensors) are not implemented; "
                              "take those of backward mode (torch.autograd.grad)");
}

void Expect::check_dense(std::string_view name, const Tensor& tensor) const {
  DSMOE_CHECK_VALUE(tensor.is_contiguous(), function, ": ", name, " is not contiguous; it must be");
}

void Expect::operator()(std::string_view name, const Tensor& tensor, const Shape& shape, ScalarType type) const {
  check_kind(name, tensor, type);
  DSMOE_CHECK_VALUE(matches(tensor, shape), function, ": ", name, " has shape ", tensor.sizes(), "; it must be ",
                    to_string(shape));
}

void Expect::dense(std::string_view name, const Tensor& tensor, const Shape& shape, ScalarType type) const {
  (*this)(name, tensor, shape, type);
  check_dense(name, tensor);
}

void Expect::dense_alike(const char* list, const Tensors& tensors, const Tensors& parameters) const {
  check_length(function, list, tensors.size(), parameters.size());
  for (size_t i = 0; i < tensors.size(); ++i) {
    const std::string name = item_name(list, i);
    check_kind(name, tensors[i], kAsLike);
    DSMOE_CHECK_VALUE(tensors[i].sizes() == parameters[i].sizes(), function, ": ", name, " has shape ",
                      tensors[i].sizes(), "; it must be ", parameters[i].sizes());
    check_dense(name, tensors[i]);
  }
}

}  // namespace binding
}  // namespace dsmoe

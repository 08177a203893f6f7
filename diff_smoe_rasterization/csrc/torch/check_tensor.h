// What every op asks of a tensor. All messages have one form: "function: name is this; it must be that". ValueError is
// for shapes, TypeError for types and devices.
#pragma once

#include <ATen/ATen.h>

#include <string>
#include <vector>

namespace dsmoe {
namespace binding {

using OptionalTensor = c10::optional<at::Tensor>;  // std::optional in newer torch

// "float32", as Python calls it.
std::string dtype_name(at::ScalarType type);

// One size of an expected shape: a number, or a letter (or -1) for any.
struct Size {
  Size(int64_t size) : size(size), letter(size < 0 ? "any" : nullptr) {}
  Size(const char* letter) : size(-1), letter(letter) {}
  int64_t size;
  const char* letter;
};
using Shape = std::vector<Size>;

bool matches(const at::Tensor& tensor, const Shape& shape);

void check_shape(const char* function, const char* name, const at::Tensor& tensor, const Shape& shape);
void check_same_shape(const char* function, const char* name, const at::Tensor& tensor, const char* other_name,
                      const at::Tensor& other);

// float32 or float64.
void check_real(const char* function, const char* name, const at::Tensor& tensor);
void check_type(const char* function, const char* name, const at::Tensor& tensor, at::ScalarType type);
void check_device(const char* function, const char* name, const at::Tensor& tensor, const char* other_name,
                  const at::Tensor& other);

// Type and device of another.
void check_like(const char* function, const char* name, const at::Tensor& tensor, const char* other_name,
                const at::Tensor& other);

// A tensor that is written in place.
void check_contiguous(const char* function, const char* name, const at::Tensor& tensor);

// NotImplementedError where the tensor carries a tangent, which the ops would drop. Absent tensors do not.
void refuse_tangent(const char* function, const at::Tensor& tensor);

}  // namespace binding
}  // namespace dsmoe

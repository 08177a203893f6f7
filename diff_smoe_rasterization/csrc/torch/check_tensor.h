// What every op asks of a tensor. All messages have one form: "function: name is this; it must be that". ValueError is
// for shapes, TypeError for types and devices.
#pragma once

#include <string>
#include <vector>

#include "tensor.h"

namespace dsmoe {
namespace binding {

// "float32", as Python calls it.
std::string dtype_name(ScalarType type);

// One size of an expected shape: a number, or a letter (or -1) for any.
struct Size {
  Size(int64_t size) : size(size), letter(size < 0 ? "any" : nullptr) {}
  Size(const char* letter) : size(-1), letter(letter) {}
  int64_t size;
  const char* letter;
};
using Shape = std::vector<Size>;

bool matches(const Tensor& tensor, const Shape& shape);

void check_shape(const char* function, const char* name, const Tensor& tensor, const Shape& shape);
void check_same_shape(const char* function, const char* name, const Tensor& tensor, const char* other_name,
                      const Tensor& other);

// float32 or float64.
void check_real(const char* function, const char* name, const Tensor& tensor);
void check_type(const char* function, const char* name, const Tensor& tensor, ScalarType type);
void check_device(const char* function, const char* name, const Tensor& tensor, const char* other_name,
                  const Tensor& other);

// Type and device of another.
void check_like(const char* function, const char* name, const Tensor& tensor, const char* other_name,
                const Tensor& other);

// A tensor that is written in place.
void check_contiguous(const char* function, const char* name, const Tensor& tensor);

// NotImplementedError where the tensor carries a tangent, which the ops would drop. Absent tensors do not.
void refuse_tangent(const char* function, const Tensor& tensor);

}  // namespace binding
}  // namespace dsmoe

// What every op asks of its tensors. All messages have one form: "function: name is this; it must be that". ValueError
// is for shapes, TypeError for types and devices.
#pragma once

#include <string>
#include <string_view>
#include <vector>

#include "tensor.h"

namespace dsmoe {
namespace binding {

// "float32", as Python calls it.
std::string dtype_name(ScalarType type);

// "moments[2]".
std::string item_name(const char* list, size_t i);

// One size of an expected shape: a number, or a letter (or -1) for any.
struct Size {
  Size(int64_t size) : size(size), letter(size < 0 ? "any" : nullptr) {}
  Size(const char* letter) : size(-1), letter(letter) {}
  bool is(std::string_view other) const { return letter != nullptr && other == letter; }
  int64_t size;
  const char* letter;
};
using Shape = std::vector<Size>;

inline Shape shape_of(const Sizes& sizes) { return {sizes.begin(), sizes.end()}; }

bool matches(const Tensor& tensor, const Shape& shape);

void check_length(const char* function, const char* list, size_t length, size_t expected);

// The first row of flags [N] that is set, -1 where none is. Waits for the device.
int64_t first_set(const Tensor& flags);

constexpr ScalarType kAsLike = ScalarType::Undefined;

// What holds for all tensors of one call of an op: they are of the type and on the device of one of them, `like`, and
// none carries a tangent, which the ops would drop (NotImplementedError).
class Expect {
 public:
  // function: the op that errors name. like: float32 or float64; like_name: its name.
  Expect(const char* function, const char* like_name, const Tensor& like);

  void operator()(std::string_view name, const Tensor& tensor, const Shape& shape, ScalarType type = kAsLike) const;

  // The same of a tensor that is read or written where it lies.
  void dense(std::string_view name, const Tensor& tensor, const Shape& shape, ScalarType type = kAsLike) const;

  // The same of a list that has a tensor of each parameter's shape.
  void dense_alike(const char* list, const Tensors& tensors, const Tensors& parameters) const;

  const char* const function;

 private:
  void check_kind(std::string_view name, const Tensor& tensor, ScalarType type) const;
  void check_dense(std::string_view name, const Tensor& tensor) const;

  const char* const like_name_;
  const Tensor& like_;
  const bool tangents_;  // whether a tensor may carry one
};

}  // namespace binding
}  // namespace dsmoe

// What the ops refuse: absent tensors, shapes, types and devices, and on request what tensors hold. Values of numbers
// are the core's (refuse.h). All messages have one form: "function: name is this; it must be that". They are ValueError
// for shapes and values, TypeError for types and devices.
#pragma once

#include <cstring>
#include <stdexcept>
#include <string>
#include <string_view>
#include <type_traits>
#include <vector>

#include "tensor.h"
#include "tensors.h"

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

// The first row of flags [N] that is set, -1 if none is. Waits for the device.
int64_t first_set(const Tensor& flags);

constexpr ScalarType kAsLike = ScalarType::Undefined;

// Checks of the tensors of one call of an op. All are of the type and on the device of one of them, `like`. None
// carries a tangent, which the ops would drop (NotImplementedError).
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

// What the core refuses in `body` is a ValueError, which names the op in place of the core's function. What does not
// fit is a RuntimeError in Python; the core's own exception would be an OverflowError.
template <class Body> void as_op(const char* function, const Body& body) {
  try {
    body();
  } catch (const std::invalid_argument& error) {
    const std::string message = error.what();
    const size_t colon = message.find(": ");
    DSMOE_CHECK_VALUE(false, function, colon == std::string::npos ? ": " + message : message.substr(colon));
  } catch (const std::overflow_error& error) {
    DSMOE_CHECK(false, error.what());
  }
}

// Tensors and numbers of one rendering, before any memory is read.
Expect check_arguments(const char* function, const Inputs& inputs, const Options& options);

// Images that a rendering returned, and the gradients by them.
void check_images(const Expect& expect, const Images& images, const Images& image_gradients, const ImageSizes& sizes,
                  const Options& options);

// What the op `blend` takes of the Gaussians, and the background.
struct Footprints {
  Tensor gates, features, radii;       // [N, 8], [N, F] and [N]
  Tensor background, background_gate;  // [C], and one element or undefined
};
Expect check_footprints(const char* function, const Footprints& of, const Options& options);

// What every op takes that goes over what a rendering saved.
Expect check_saved(const char* function, const Tensor& radii, const Saved& saved, const Tensor& background_gate,
                   const Options& options);

// Checks the tensors that a rendering saved, and points to them. sizes: what is -1 in them is not checked.
template <class SavedForward, class Sizes>
void unpack_saved(const Expect& expect, const Saved& tensors, SavedForward& saved, const Sizes& sizes) {
  size_t count = 0;
  for_each_array(saved, sizes, [&](const char*, auto*&, int64_t) { ++count; });
  check_length(expect.function, "saved", tensors.size(), count);
  size_t next = 0;
  for_each_array(saved, sizes, [&](const char* name, auto*& pointer, int64_t rows) {
    const SavedArray array = saved_array(name, pointer, rows);
    const Tensor& tensor = tensors[next++];
    expect.dense(name, tensor, shape_of(saved_shape(array)), scalar_type(array.type));
    pointer = static_cast<std::remove_reference_t<decltype(pointer)>>(tensor.data_ptr());
  });
}

// The numbers that the saved array of that name has, 0 if there is no such tensor.
template <class SavedForward> int64_t saved_length(const Saved& tensors, SavedForward saved, const char* wanted) {
  size_t next = 0;
  int64_t length = 0;
  for_each_array(saved, {}, [&](const char* name, auto*&, int64_t) {
    const size_t index = next++;
    if (std::strcmp(name, wanted) == 0 && index < tensors.size()) length = tensors[index].numel();
  });
  return length;
}

// Under `strict`: raises for the first Gaussian that has an attribute that is not finite. Waits for the device.
void refuse_non_finite(const char* function, const Inputs& inputs);

// Under `prefiltered`: raises for a Gaussian that is not visible [N], unless its position is not finite.
void refuse_culled(const char* function, const Inputs& inputs, const Tensor& visible);

// Under `debug`: raises if a tensor holds NaN, naming it and the index. `what` begins with the function's name.
void refuse_nan(const std::string& what, const Tensor& tensor);

}  // namespace binding
}  // namespace dsmoe

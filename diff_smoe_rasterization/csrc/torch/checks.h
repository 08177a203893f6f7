// What the ops refuse: absent tensors, shapes, types and devices, and on request what tensors hold. Values of numbers
// are the core's (refuse.h). Errors name the function, the argument, what it is and what it must be. They are
// ValueError for shapes and values, TypeError for types and devices.
#pragma once

#include <cstring>
#include <stdexcept>
#include <string>
#include <type_traits>

#include "check_tensor.h"
#include "tensors.h"

namespace dsmoe {
namespace binding {

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

// The numbers that the saved array of that name has, 0 where there is no such tensor.
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

// Under `debug`: raises where a tensor holds NaN, naming it and the index. `what` begins with the function's name.
void refuse_nan(const std::string& what, const Tensor& tensor);

}  // namespace binding
}  // namespace dsmoe

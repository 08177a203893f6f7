// What the ops refuse besides what the core does (refuse.h). Errors name the function, the argument, what it is and
// what it must be. They are ValueError for shapes and values, TypeError for types and devices. Python does not repeat
// these checks.
#pragma once

#include <cstring>
#include <string>
#include <type_traits>
#include <vector>

#include "check_tensor.h"
#include "tensors.h"

namespace dsmoe {
namespace binding {

// Tensors and numbers of one rendering, before any memory is read.
void check_arguments(const char* function, const Inputs& inputs, const Options& options);

// The backward op's own arguments, since it can be called directly.
void check_backward_arguments(const char* function, const Inputs& inputs, const Options& options, const Images& images,
                              const Images& image_gradients, const InputMask& wanted);

// What the op `blend` takes of the Gaussians, and the background.
struct Footprints {
  Tensor gates, features, radii;       // [N, 8], [N, F] and [N]
  Tensor background, background_gate;  // [C], and one element or undefined
};
void check_footprints(const char* function, const Footprints& of, const Options& options);

// The backward ops' own arguments.
void check_blend_backward_arguments(const char* function, const Images& images, const Images& image_gradients,
                                    const ImageSizes& sizes, const Tensor& like, const Options& options);
void check_footprint_gradients(const char* function, const Tensor& records, const Tensor& dL_ddepths,
                               const Tensor& features, const Tensor& radii, const Inputs& inputs,
                               const Options& options);

// Those of an op that goes over what a rendering saved.
void check_contribution_arguments(const char* function, const Tensor& pixel_weights, const Tensor& radii,
                                  const Saved& saved, const Tensor& background_gate, const Options& options);

// The tensors of the op `importance` besides those of `contributions`.
struct ImportanceImages {
  Tensor share_weights;    // [H, W]
  Tensor color, gate_sum;  // [C, H, W] and [1, H, W]
  Tensor background;       // [C]
};
void check_importance_images(const ImportanceImages& images, const Tensor& like, const Options& options);

// A tensor that a rendering returned: its shape, type and device must be as they were. shape: -1 stands for any size.
void check_result(const char* function, const char* name, const Tensor& tensor, const std::vector<int64_t>& shape,
                  ScalarType type, Device device);

// Checks the tensors that a rendering saved, and points to them. sizes: what is -1 in them is not checked.
template <class SavedForward, class Sizes>
void unpack_saved(const char* function, const Saved& tensors, SavedForward& saved, const Sizes& sizes, Device device) {
  size_t count = 0;
  for_each_array(saved, sizes, [&](const char*, auto*&, int64_t) { ++count; });
  DSMOE_CHECK_VALUE(tensors.size() == count, function, ": saved has length ", tensors.size(), "; it must be ", count);
  size_t next = 0;
  for_each_array(saved, sizes, [&](const char* name, auto*& pointer, int64_t rows) {
    const SavedArray array = saved_array(name, pointer, rows);
    const Tensor& tensor = tensors[next++];
    check_result(function, name, tensor, saved_shape(array), scalar_type(array.type), device);
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

void check_positions(const Tensor& positions, const Tensor& viewmatrix);

// Under `strict`: raises for the first Gaussian that has an attribute that is not finite. Waits for the device.
void refuse_non_finite(const char* function, const Inputs& inputs);

// Under `prefiltered`: raises for a Gaussian that is not visible [N], unless its position is not finite.
void refuse_culled(const char* function, const Inputs& inputs, const Tensor& visible);

// Under `debug`: raises where a tensor holds NaN, naming it and the index. `what` begins with the function's name.
void refuse_nan(const std::string& what, const Tensor& tensor);

}  // namespace binding
}  // namespace dsmoe

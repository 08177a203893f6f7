// What the ops refuse. Errors name the function, the argument, what it is and what it must be: ValueError for shapes
// and values, TypeError for types and devices. This is the only place that checks; Python adds none of these.
#pragma once

#include <string>

#include "tensors.h"

namespace dsmoe {
namespace binding {

// Tensors and numbers of one rendering, before any memory is read.
void check_arguments(const Inputs& inputs, const Options& options);

// The backward op's own arguments; for a caller that is not our autograd formula.
void check_backward_arguments(const Inputs& inputs, const Options& options, const Outputs& outputs,
                              const ImageGradientTensors& image_gradients, const InputMask& wanted);

// The op contributions: of the outputs those that it reads.
void check_contribution_arguments(const at::Tensor& pixel_weights, const Outputs& outputs,
                                  const at::Tensor& background_gate, const Options& blend);

void check_positions(const at::Tensor& positions, const at::Tensor& viewmatrix);

// Under `strict`: raises for Gaussian `index`, which has an attribute that is not finite; -1 is none.
void refuse_non_finite(const Inputs& inputs, int64_t index);

// Under `prefiltered`: raises for a Gaussian that is not visible [N], unless its position is not finite.
void refuse_culled(const Inputs& inputs, const at::Tensor& visible);

// Under `debug`: raises where a tensor holds NaN, naming it and the index. `what` begins with the function's name.
void refuse_nan(const std::string& what, const at::Tensor& tensor);

}  // namespace binding
}  // namespace dsmoe

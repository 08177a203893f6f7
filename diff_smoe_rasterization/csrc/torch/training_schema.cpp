// What torch knows of the trainers' ops.
#include "tensor.h"

DSMOE_LIBRARY_FRAGMENT(m) {
  // One step of Adam in place. rates and root_scales: a number per parameter, see dsmoe/adam.h. visible [N]: rows of
  // every parameter that are stepped.
  m.def(
      "adam(Tensor(a!)[] parameters, Tensor[] gradients, Tensor(b!)[] moments, Tensor(c!)[] squares, float[] rates, "
      "float[] root_scales, float beta1, float beta2, float epsilon, Tensor? visible) -> ()");
  // Brings rows of parameters [N, ...] up to date: all, or those whose radii [N] are above 0. See dsmoe/lazy_adam.h.
  // marks [N] int32; rates [capacity, tensors, 2], of which `steps` are written. given_steps [1]: on the device, in
  // place of `steps`.
  m.def(
      "lazy_adam_catch_up(Tensor(a!)[] parameters, Tensor(b!)[] moments, Tensor(c!)[] squares, Tensor[] gradients, "
      "Tensor(d!) marks, Tensor rates, int steps, float beta1, float beta2, float epsilon, Tensor? radii, "
      "Tensor? given_steps=None) -> ()");
  // Writes rates[steps], and marks the rows whose radii are above 0. given_steps [1], given_rates [tensors, 2]: on the
  // device, in place of the numbers.
  m.def(
      "lazy_adam_step(Tensor(a!) marks, Tensor(b!) rates, int steps, float[] new_rates, float[] root_scales, "
      "Tensor radii, Tensor? given_steps=None, Tensor? given_rates=None) -> ()");
  // One step of Adam, in place, on raw means, opacities, scales and rotations, from the gradients by what `activate`
  // makes of them in the rows whose radii [N] are above 0. values: what it made of the last three; written anew.
  // given_rates [4, 2]: on the device, in place of the numbers.
  m.def(
      "gaussian_adam(Tensor(a!)[] raw, Tensor(b!)[] values, Tensor[] dL_dvalues, Tensor(c!)[] moments, "
      "Tensor(d!)[] squares, Tensor radii, float[] rates, float[] root_scales, float beta1, float beta2, "
      "float epsilon, Tensor? given_rates=None) -> ()");
  // rows [M] of each tensor [N, ...], which have one type.
  m.def("gather_rows(Tensor[] tensors, Tensor rows) -> Tensor[]");
  // offset + l1_weight mean |image - target| + l2_weight mean (image - target)^2 + ssim_weight mean SSIM, where the
  // mean of SSIM leaves out `margin` pixels at each side; gradient by image, or empty. image [..., H, W]; target alike,
  // or bytes.
  m.def(
      "image_loss(Tensor image, Tensor target, float l1_weight, float l2_weight, float ssim_weight, float offset, "
      "int margin, bool with_gradient) -> (Tensor loss, Tensor gradient)");
  // Sigmoid of the opacities [N, 1], exp of the scales [N, 3], normalised rotations [N, 4].
  m.def("activate(Tensor opacities, Tensor scales, Tensor rotations) -> (Tensor, Tensor, Tensor)");
  // Gradients by the arguments of `activate`, which are `raw`, from those by its results, which are `values`.
  m.def(
      "activate_backward(Tensor[] raw, Tensor[] values, Tensor? dL_dopacities, Tensor? dL_dscales, "
      "Tensor? dL_drotations) -> (Tensor, Tensor, Tensor)");
  // For densification: adds |dL_dmeans2D[:, :2]| and 1 where radii > 0. All [N] but dL_dmeans2D [N, 3].
  m.def("add_view(Tensor dL_dmeans2D, Tensor radii, Tensor(a!) gradient_sum, Tensor(b!) view_count) -> ()");
  // One step of Adam on p, and gate = bound + exp(p). All tensors [1]; gradient: by the gate. limit: of |p|.
  m.def(
      "gate_adam(Tensor(a!) logarithm, Tensor(b!) moment, Tensor(c!) square, Tensor(d!) gate, Tensor gradient, "
      "float rate, float root_scale, float beta1, float beta2, float epsilon, float bound, float limit) -> ()");
  // What a step that repeats reads anew each time, in one launch: copies tensors, dense and of any type, and writes
  // numbers. to, from: at most 8; numbers [n]: at most 32.
  m.def("set_inputs(Tensor(a!)[] to, Tensor[] source, Tensor(b!) numbers, float[] new_numbers) -> ()");
  // Mean squared distance of each point [N, 3] to its three nearest others.
  m.def("mean_squared_neighbour_distances(Tensor points) -> Tensor");
}

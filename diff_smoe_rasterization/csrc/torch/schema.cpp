// What torch knows of the ops. Their arguments are listed in fields.h.
#include <string>

#include "tensors.h"

namespace {

#define DSMOE_ARGUMENT(first, schema, name, ...) schema " " #name ", "
const std::string kInputs = DSMOE_INPUTS(DSMOE_ARGUMENT);
const std::string kOptions = DSMOE_OPTIONS(DSMOE_ARGUMENT);
#undef DSMOE_ARGUMENT

// All images but the radii, each name behind `before`.
std::string of_differentiable(const std::string& before) {
  std::string list;
  using namespace dsmoe::binding;
  for (const Image image : kDifferentiable) list += before + kImageNames[image] + ", ";
  return list;
}
const std::string kImageGradients = of_differentiable("Tensor? dL_d");

std::string without_comma(const std::string& list) { return list.substr(0, list.size() - 2); }

// Besides the images, a backend returns what its backward pass reads again, as ordinary typed tensors, so that torch
// accounts for their memory. Which they are is the backend's own affair; the first is [N, 8], `projected` of params.h.
#define DSMOE_RESULT(enumerator, name) "Tensor " #name ", "
const std::string kRasterize =
    "rasterize(" + kInputs + without_comma(kOptions) + ") -> (" DSMOE_IMAGES(DSMOE_RESULT) "Tensor[] saved)";
#undef DSMOE_RESULT

// images, saved: all results of rasterize; inputs: the present ones of its tensors. Returned are the gradients of the
// wanted inputs, in their order. The lists hold no None, or torch would not see that they require a gradient.
const std::string kRasterizeBackward = "rasterize_backward(" + kImageGradients +
                                       "Tensor[] inputs, bool[] present, Tensor[] images, Tensor[] saved, " + kOptions +
                                       "bool[] wanted) -> Tensor[]";

// The same into the caller's memory, a tensor for each wanted input. Of the Gaussians only the rows are written whose
// radius is above 0; the others stay as they are.
const std::string kRasterizeBackwardSeen = "rasterize_backward_seen(" + kImageGradients +
                                           "Tensor[] inputs, bool[] present, Tensor[] images, Tensor[] saved, " +
                                           kOptions + "bool[] wanted, Tensor(a!)[] gradients) -> ()";

// The radii [N] that rasterize would return for the same arguments.
const std::string kRadii = "radii(" + kInputs + without_comma(kOptions) + ") -> Tensor";

// The two halves of rasterize, with the footprints of N Gaussians between them: what the blend reads of each. gates:
// [N, 8], `projected` of params.h; features: [N, F], the colour's channels, then z and 1 / z where the options ask for
// them; radii: [N]. The blend also takes features whose rows are filled up to a multiple of four. Footprints of equal
// depth are blended in their order.
const std::string kProject =
    "project(" + kInputs + without_comma(kOptions) + ") -> (Tensor gates, Tensor features, Tensor radii)";
const std::string kBlend = "blend(Tensor gates, Tensor features, Tensor radii, Tensor bg, Tensor? background_gate, " +
                           without_comma(kOptions) + ") -> (" + of_differentiable("Tensor ") + "Tensor[] saved)";

// records: [N, 6 + F] gradients by a footprint's centre (2 numbers), conic (3), opacity and features.
const std::string kBlendBackward =
    "blend_backward(" + kImageGradients +
    "Tensor[] images, Tensor[] saved, Tensor radii, Tensor bg, Tensor? background_gate, " + kOptions +
    "bool wants_background) -> (Tensor records, Tensor dL_dbg, Tensor dL_dbackground_gate)";

// dL_ddepths: [N] by the view depths, besides what the features say. Returned is what rasterize_backward returns.
const std::string kProjectBackward =
    "project_backward(Tensor records, Tensor? dL_ddepths, Tensor[] inputs, bool[] present, Tensor features, "
    "Tensor radii, " +
    kOptions + "bool[] wanted) -> Tensor[]";

// The first half for a batch of V views (params.h), whose arguments are those of the first view but for the cameras:
// viewmatrix, projmatrix and campos of each view. images: kNumbersOfImage of each: width, height, tanfovx, tanfovy,
// camera_model, how many numbers its lens has, and these, filled up with anything. float32.
const std::string kBatch = kInputs + kOptions + "Tensor[] cameras, float[] images";

// radii [V, N] and offsets [V, blocks + 1] int32: the last offset of a view says how many rows it has.
const std::string kCountRows = "count_rows(" + kBatch + ") -> (Tensor radii, Tensor offsets)";

// Fills gates [M, 8] and features [M, 4] of each view.
const std::string kProjectRows =
    "project_rows(" + kBatch + ", Tensor(a!) radii, Tensor offsets, Tensor(b!)[] gates, Tensor(c!)[] features) -> ()";

// records: [M, 9] of each view. dL_dmeans2D: [V, N, 3], written where the radius is above 0. gradients: those by the
// Gaussians that the arguments hold, but for means2D, in their order, summed over the views.
const std::string kProjectRowsBackward =
    "project_rows_backward(" + kBatch +
    ", Tensor radii, Tensor offsets, Tensor[] features, Tensor[] records) -> (Tensor dL_dmeans2D, Tensor[] gradients)";

// From a map [H, W] and what one rasterize saved: sums over the pixels of each Gaussian.
const std::string kContributions =
    "contributions(Tensor pixel_weights, Tensor radii, Tensor[] saved, Tensor? background_gate, " +
    without_comma(kOptions) + ") -> (Tensor pixel_weights, Tensor pixels, Tensor blend_weights, Tensor distances)";

// From the images of one rendering, weights of its pixels [H, W] and what it saved: what each Gaussian is worth.
const std::string kImportance =
    "importance(Tensor pixel_weights, Tensor share_weights, Tensor color, Tensor gate_sum, Tensor bg, Tensor radii, "
    "Tensor[] saved, Tensor? background_gate, " +
    without_comma(kOptions) + ") -> (Tensor shares, Tensor squared_shares, Tensor removal_costs)";

// From what one rasterize saved: the Gaussian of the greatest gate in each pixel [H, W], how many have a part, and the
// median one.
const std::string kGateMap = "gate_map(Tensor gate_sum, Tensor radii, Tensor[] saved, Tensor? background_gate, " +
                             without_comma(kOptions) + ") -> (Tensor gaussians, Tensor counts, Tensor medians)";

}  // namespace

DSMOE_LIBRARY(m) {
  m.def(kRasterize.c_str());
  m.def(kRasterizeBackward.c_str());
  m.def(kRasterizeBackwardSeen.c_str());
  m.def(kRadii.c_str());
  m.def(kProject.c_str());
  m.def(kProjectBackward.c_str());
  m.def(kBlend.c_str());
  m.def(kBlendBackward.c_str());
  m.def(kCountRows.c_str());
  m.def(kProjectRows.c_str());
  m.def(kProjectRowsBackward.c_str());
  m.def(kContributions.c_str());
  m.def(kImportance.c_str());
  m.def(kGateMap.c_str());
  m.def("mark_visible(Tensor positions, Tensor viewmatrix, float near, int camera_model=0) -> Tensor");

  // The trainers' ops.

  // One step of Adam in place. rates and root_scales: a number per parameter, see dsmoe/training/adam.h. visible [N]:
  // rows of every parameter that are stepped.
  m.def(
      "adam(Tensor(a!)[] parameters, Tensor[] gradients, Tensor(b!)[] moments, Tensor(c!)[] squares, float[] rates, "
      "float[] root_scales, float beta1, float beta2, float epsilon, Tensor? visible) -> ()");
  // Brings rows of parameters [N, ...] up to date: all, or those whose radii [N] are above 0. See
  // dsmoe/training/adam.h. marks [N] int32; rates [capacity, tensors, 2], of which `steps` are written. given_steps
  // [1]: on the device, in place of `steps`.
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

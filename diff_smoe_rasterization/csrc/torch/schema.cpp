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
  m.def(
      "mark_visible(Tensor positions, Tensor viewmatrix, float near, int camera_model=0, Tensor? viewmatrix_end=None) "
      "-> Tensor");
}

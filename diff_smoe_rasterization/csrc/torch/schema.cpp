// What torch knows of the ops. `alpha` and every other image but the colour is optional; what is made for the backward
// pass are ordinary typed tensors among the results, so that torch accounts for their memory. Without `for_backward`,
// what only makes that pass faster is left out. The background's gate is `background_gate`, else the fixed number.
#include <torch/library.h>

#include <string>

namespace {

const std::string kOptions =
    "SymInt image_height, SymInt image_width, float tanfovx, float tanfovy, float scale_modifier, float near, "
    "float alpha_min, float fixed_background_gate, int sh_degree, int blend_mode, bool antialiasing, bool depth, bool "
    "inverse_depth, bool deterministic, bool debug, bool clamp_color";

const std::string kRasterize =
    "rasterize(Tensor means3D, Tensor? means2D, Tensor opacities, Tensor? dc, Tensor? shs, Tensor? colors_precomp, "
    "Tensor? scales, Tensor? rotations, Tensor? cov3D_precomp, Tensor bg, Tensor viewmatrix, Tensor projmatrix, "
    "Tensor campos, Tensor? background_gate, " +
    kOptions +
    ", bool strict, bool prefiltered, bool for_backward=True) -> "
    "(Tensor color, Tensor radii, Tensor gate_sum, Tensor depth, Tensor inverse_depth, Tensor projected, "
    "Tensor features, Tensor instance_offsets, Tensor tile_offsets, Tensor instances, Tensor final_transmittance, "
    "Tensor last_contributor, Tensor order, Tensor segments, Tensor segment_queue)";

// inputs: the present ones of the 14 tensors of rasterize; outputs: all its results. Returned are the gradients of the
// wanted inputs, in their order. The lists hold no None, or torch would not see that they require a gradient.
const std::string kRasterizeBackward =
    "rasterize_backward(Tensor? dL_dcolor, Tensor? dL_dgate_sum, Tensor? dL_ddepth, Tensor? dL_dinverse_depth, "
    "Tensor[] inputs, bool[14] present, Tensor[] outputs, " +
    kOptions + ", bool[14] wanted) -> Tensor[]";

// From a map and what one rasterize saved: sums over the pixels of each Gaussian.
const std::string kContributions =
    "contributions(Tensor pixel_weights, Tensor radii, Tensor projected, Tensor instance_offsets, "
    "Tensor tile_offsets, Tensor instances, Tensor last_contributor, Tensor order, Tensor? background_gate, float "
    "alpha_min, float fixed_background_gate, int blend_mode) -> (Tensor pixel_weights, Tensor pixels, Tensor "
    "blend_weights, Tensor distances)";

}  // namespace

TORCH_LIBRARY(diff_smoe_rasterization, m) {
  m.def(kRasterize.c_str());
  m.def(kRasterizeBackward.c_str());
  m.def(kContributions.c_str());
  m.def("mark_visible(Tensor positions, Tensor viewmatrix, float near) -> Tensor");
}

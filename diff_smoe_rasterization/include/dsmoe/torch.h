// The rasterizer for LibTorch: arguments, names and results of Python's `rasterize`, differentiable, on the device of
// its tensors. With C++20's designated initialisers:
//
//     dsmoe::GaussianRasterizationSettings settings;  // fill the camera and the background
//     settings.blend_mode = "smoe";
//     const dsmoe::Rendering rendering = dsmoe::rasterize(
//         means3D, opacities, settings, {.shs = shs, .scales = scales, .rotations = rotations, .outputs = {"alpha"}});
//     rendering.color.sum().backward();
//
// Errors are c10::Error: c10::ValueError for shapes and values, c10::TypeError for types and devices.
#pragma once

#include <ATen/ATen.h>

#include <array>
#include <cstdint>
#include <memory>
#include <optional>
#include <string>
#include <tuple>
#include <utility>
#include <vector>

namespace dsmoe {

/// How much the background weighs in `smoe`, 0 or more: a number, or a tensor of one element, which gets a gradient.
/// The number 1 is alpha blending, bit for bit. The value of a tensor on a GPU is not checked.
struct BackgroundGate {
  BackgroundGate(double number) : number(number) {}
  BackgroundGate(at::Tensor tensor) : tensor(std::move(tensor)) {}
  double number = 0;
  at::Tensor tensor;  // undefined: the number counts
};

/// Camera and options of one rendering: the fields of Python's class of this name, in its order. Environment variables
/// are not read. Matrices are transposed, as every 3DGS trainer passes them: a row vector times the matrix.
struct GaussianRasterizationSettings {
  int64_t image_height = 0;  // pixels
  int64_t image_width = 0;   // pixels
  double tanfovx = 0;        // tan of half the horizontal field of view
  double tanfovy = 0;
  at::Tensor bg;                     // [C] background colour, C = 3 unless colors_precomp has other channels
  double scale_modifier = 1;         // multiplies every scale
  at::Tensor viewmatrix;             // [4, 4] world to view, transposed
  at::Tensor projmatrix;             // [4, 4] world to clip (view and projection), transposed
  int64_t sh_degree = 0;             // active degree, 0 to 3; shs may hold more
  at::Tensor campos;                 // [3] camera centre, world
  bool prefiltered = false;          // the caller asserts that every point lies in front of the near plane
  bool debug = false;                // check images and gradients for NaN; slower
  bool antialiasing = false;         // scale opacity by sqrt(det(cov2D) / det(cov2D + low_pass I))
  double near = 0.2;                 // Gaussians with view depth <= near are culled
  double alpha_min = 0;              // SMoE modes: also skip alpha below this; `smoe`: such pairs are not strong ones
  bool strict = false;               // raise if an attribute is NaN or infinite, instead of culling that Gaussian
  std::string blend_mode = "alpha";  // "alpha", "smoe", "smoe_eq7", "smoe_tn" or "smoe_std"
  bool deterministic = false;        // CUDA: gradients equal bit for bit from run to run; slower
  bool clamp_color = true;           // colours from shs are at least 0
  std::optional<BackgroundGate> background_gate;  // `smoe` and `smoe_eq7` only; absent: 0
  double low_pass = 0.3;                          // px^2 added to the variances on the image
  std::optional<double> faint_below;              // `smoe` and `smoe_eq7`: faint pairs and tails count if the gate
                                                  // sum of near ones is below this; absent: 0.25 and 2, everywhere
  std::string camera_model = "pinhole";  // a name of kLensNames (lens.h). But for "pinhole", viewmatrix has all
                                         // of the pose, projmatrix is not read and gets no gradient, and the
                                         // focal lengths are image_width / (2 tanfovx) and so on
  std::vector<double> distortion;        // as LensCalibration (lens.h) has it
  std::optional<std::array<double, 2>> principal_point;  // pixels; the centre of the first pixel is (0.5, 0.5). Absent:
                                                         // of the image. A pinhole's is in projmatrix
  std::string rolling_shutter = "global";  // a name of kShutterNames (camera.h): the order of rows or columns. But for
                                           // "global", viewmatrix is the pose at the first and viewmatrix_end that at
                                           // the last, and a pinhole needs principal_point, as of any lens
  at::Tensor viewmatrix_end;               // [4, 4] transposed; undefined with "global"
};

/// The optional arguments of `rasterize`, N Gaussians; an undefined tensor, or one without elements, is absent.
struct RasterizeArguments {
  at::Tensor means2D;                // [N, 3]; only its gradient is of use: dL/d(pixel) times (W/2, H/2), z = 0
  at::Tensor dc;                     // [N, 1, 3] if shs [N, K - 1, 3] holds only the other coefficients
  at::Tensor shs;                    // [N, K, 3] spherical harmonics, K >= (sh_degree + 1)^2
  at::Tensor colors_precomp;         // [N, C] instead of shs
  at::Tensor scales;                 // [N, 3] standard deviations, world
  at::Tensor rotations;              // [N, 4] quaternions (w, x, y, z), used as given
  at::Tensor cov3D_precomp;          // [N, 6] (xx, xy, xz, yy, yz, zz) instead of scales and rotations
  std::vector<std::string> outputs;  // images to return beside the colour: "alpha", "depth", "inverse_depth"
  at::Tensor means2D_abs;            // [N, 2]; its gradient: sum over pixels of |dL/d(pixel)| times (W/2, H/2)
};

/// What `rasterize` returns; an output that was not asked for is undefined. Until the backward pass has run, its images
/// must not be changed in place: torch then raises an error.
struct Rendering {
  at::Tensor color;          // [C, H, W]
  at::Tensor radii;          // [N] int32; 3-sigma radius in pixels, 0 if the Gaussian touches nothing
  at::Tensor alpha;          // [1, H, W]; W = sum alpha_i T_i; smoe: W / D; smoe_tn, smoe_std: sum alpha_i
  at::Tensor depth;          // [1, H, W]; expected view depth sum(w z) / sum(w), 0 if nothing is hit
  at::Tensor inverse_depth;  // [1, H, W]; 1 / z blended as a colour, over background 0
};

/// Renders N Gaussians. means3D: [N, 3] centres, world. opacities: [N, 1] or [N]; may exceed 1. All tensors have one
/// type, float32 or float64, and one device. Gradients reach every tensor, those of the settings too; second
/// derivatives do not exist. A Gaussian with a NaN or infinite attribute, or an opacity above 1e20, is
/// culled: radius 0, gradients 0.
Rendering rasterize(const at::Tensor& means3D, const at::Tensor& opacities,
                    const GaussianRasterizationSettings& settings, const RasterizeArguments& arguments = {});

/// Sums over the pixels that blended each of N Gaussians; a Gaussian without pixels has 0.
struct Contributions {
  at::Tensor pixel_weights;  // [N] sum of the given map
  at::Tensor pixels;         // [N] int32, how many they are
  at::Tensor blend_weights;  // [N] sum of alpha T, in `smoe_std` of alpha; divided by no gate sum
  at::Tensor distances;      // [N] sum of |pixel - centre| in pixels
};

/// What each of N Gaussians is worth to an image: sums over the pixels, with e the weight of a pixel and f the share of
/// the Gaussian, dC/dc of its colour c. A culled Gaussian has 0.
struct Importance {
  at::Tensor shares;          // [N] sum e f
  at::Tensor squared_shares;  // [N] sum e f^2
  at::Tensor removal_costs;   // [N] sum e |C' - C|^2, over all channels; C' is the pixel without the Gaussian
};

/// What one rendering knows of each Gaussian, as Python's class of this name. Nothing here has a gradient. The images
/// of the rendering must not be changed in place meanwhile.
class Splats {
 public:
  /// pixel_weights: [H, W], any numbers, of the Gaussians' type and device.
  Contributions contributions(const at::Tensor& pixel_weights) const;

  /// pixel_weights: [H, W] e; undefined: 1. share_weights: [H, W] e of the shares; undefined: pixel_weights.
  Importance importance(const at::Tensor& pixel_weights = {}, const at::Tensor& share_weights = {}) const;

  /// Returns three images [H, W] int32. gaussians: which has the largest gate of the pixel, -1 where none has one.
  /// counts: how many Gaussians are in the numerator. medians: with which one the weights, front to back (in
  /// `smoe_std` by index), reach half of the denominator, -1 where none does.
  std::tuple<at::Tensor, at::Tensor, at::Tensor> gate_map() const;

  struct Saved;                        // of the implementation
  std::shared_ptr<const Saved> saved;  // likewise
};

/// The same as `rasterize`, and what scores its Gaussians.
std::pair<Rendering, Splats> rasterize_with_splats(const at::Tensor& means3D, const at::Tensor& opacities,
                                                   const GaussianRasterizationSettings& settings,
                                                   const RasterizeArguments& arguments = {});

/// The settings of a camera, transposed matrices included, as Python's function of this name; for a lens other than a
/// pinhole set camera_model, distortion and principal_point of the result, for a rolling shutter rolling_shutter,
/// viewmatrix_end and principal_point. K: [3, 3]
/// intrinsics in pixels; as in COLMAP, the centre of the top left pixel is (0.5, 0.5). R, t: [3, 3] and [3], world to
/// view: x_view = R x_world + t, with x right, y down, z forward. bg: [C]; the matrices get its type and its device.
/// They have gradients with respect to R, t and, in the projection, K.
GaussianRasterizationSettings settings_from_camera(const at::Tensor& K, const at::Tensor& R, const at::Tensor& t,
                                                   int64_t width, int64_t height, const at::Tensor& bg,
                                                   int64_t sh_degree = 3, double scale_modifier = 1);

}  // namespace dsmoe

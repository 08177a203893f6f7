// The arguments of the op `rasterize`, once. Its schema, the structs that C++ passes on, the order in which the ops
// read them and the names by which Python gives values all follow from these lists. To add a setting, add its line to
// DSMOE_OPTIONS, its field to GaussianRasterizationSettings, and its use.
#pragma once

// The tensors: X(enumerator, type in the schema, name, shape...). N Gaussians, C channels: 3 with shs.
#define DSMOE_INPUTS(X)                                                                                        \
  X(kMeans3D, "Tensor", means3D, "N", 3)                                                                       \
  X(kMeans2D, "Tensor?", means2D, "N", 3)    /* only its gradient is of use */                                 \
  X(kOpacities, "Tensor", opacities, "N", 1) /* or [N] */                                                      \
  X(kDc, "Tensor?", dc, "N", 1, 3)                                                                             \
  X(kShs, "Tensor?", shs, "N", "K", 3)                                                                         \
  X(kColorsPrecomp, "Tensor?", colors_precomp, "N", "C")                                                       \
  X(kScales, "Tensor?", scales, "N", 3)                                                                        \
  X(kRotations, "Tensor?", rotations, "N", 4)                                                                  \
  X(kCov3DPrecomp, "Tensor?", cov3D_precomp, "N", 6)                                                           \
  X(kBackground, "Tensor", bg, "C")                                                                            \
  X(kViewMatrix, "Tensor", viewmatrix, 4, 4)                                                                   \
  X(kProjMatrix, "Tensor", projmatrix, 4, 4)                                                                   \
  X(kCampos, "Tensor", campos, 3)                                                                              \
  X(kViewMatrixEnd, "Tensor?", viewmatrix_end, 4, 4) /* absent: the shutter does not roll */                   \
  X(kBackgroundGate, "Tensor?", background_gate, 1)  /* in any number of dimensions; absent: a fixed number */ \
  X(kMeans2DAbs, "Tensor?", means2D_abs, "N", 2)     /* only its gradient is of use */

// The others: X(type in C++, type in the schema, name). They mean what the field of that name means in settings.py.
// for_backward stays the last one: callers in Python append it.
#define DSMOE_OPTIONS(X)                                                                            \
  X(int64_t, "SymInt", image_height)                                                                \
  X(int64_t, "SymInt", image_width)                                                                 \
  X(double, "float", tanfovx)                                                                       \
  X(double, "float", tanfovy)                                                                       \
  X(double, "float", scale_modifier)                                                                \
  X(double, "float", near)                                                                          \
  X(double, "float", alpha_min)                                                                     \
  X(double, "float", faint_below)                                                                   \
  X(double, "float", low_pass)                                                                      \
  X(double, "float", fixed_background_gate) /* where no tensor is given */                          \
  X(int64_t, "int", sh_degree)                                                                      \
  X(int64_t, "int", blend_mode)           /* its number */                                          \
  X(int64_t, "int", camera_model)         /* its number */                                          \
  X(std::vector<double>, "float[]", lens) /* principal point and distortion; empty for a pinhole */ \
  X(int64_t, "int", rolling_shutter)      /* its number */                                          \
  X(bool, "bool", antialiasing)                                                                     \
  X(bool, "bool", depth)         /* whether that image is wanted */                                 \
  X(bool, "bool", inverse_depth) /* whether that image is wanted */                                 \
  X(bool, "bool", deterministic)                                                                    \
  X(bool, "bool", debug)                                                                            \
  X(bool, "bool", clamp_color)                                                                      \
  X(bool, "bool", strict)                                                                           \
  X(bool, "bool", prefiltered)                                                                      \
  X(bool, "bool", for_backward) /* whether a backward pass may follow; else what only makes it faster is left out */

// The images on request, [1, H, W], or [0] if the option of that name is not set: X(enumerator, name). Each is of a
// feature behind the colour's channels; in the core a flag of RasterConfig and a pointer of ImageOutputs and of
// ImageGradients have the name too.
#define DSMOE_FEATURE_IMAGES(X) \
  X(kDepth, depth)              \
  X(kInverseDepth, inverse_depth)

// All images: X(enumerator, name). All but the radii are differentiable.
#define DSMOE_IMAGES(X)                                                 \
  X(kColor, color)      /* [C, H, W] */                                 \
  X(kRadii, radii)      /* [N] int32; no image, but the caller's too */ \
  X(kGateSum, gate_sum) /* [1, H, W] the alpha image */                 \
  DSMOE_FEATURE_IMAGES(X)

// One Gaussian from the world to the image plane, and its gradient back. Values go in and come out. arrays.h loads and
// stores them.
#pragma once

#include <cstdint>

#include "dsmoe/blend.h"
#include "dsmoe/camera.h"
#include "dsmoe/covariance.h"
#include "dsmoe/tiles.h"

namespace dsmoe {

// What a Gaussian is made of, except its colours. Its covariance is given, or made of scale and rotation.
template <class S> struct Gaussian {
  Vec3<S> mean;  // world
  S opacity;     // may exceed 1, up to kMaxOpacity
  bool has_covariance;
  Vec3<S> scale;
  Vec4<S> rotation;  // quaternion (w, x, y, z), used as given
  Sym3<S> covariance;
};

template <class S> struct ProjectionRules {
  BlendMode mode;
  S scale_modifier;
  AlphaCut<S> cut;
  S low_pass;  // px^2 added to the projected variances
  bool antialiasing;
  bool inverse_depth;  // 1 / z is blended too
};

// One Gaussian on the image plane: all that the blend reads of it except its features. Aligned to load as vectors.
template <class S> struct alignas(16) ProjectedGaussian {
  Vec2<S> mean;     // pixels
  Sym2<S> conic;    // per px^2
  S opacity;        // after antialiasing
  S squared_reach;  // k^2 of the footprint
  S depth;          // view z
};
constexpr int kProjectedGaussianSize = 8;

template <class S> struct Projection {
  int32_t radius;  // pixels; 0 if the Gaussian is culled: then the rest means nothing
  ProjectedGaussian<S> gaussian;
};

template <class S> DSMOE_HD bool in_range(S opacity) { return abs(opacity) <= S(kMaxOpacity); }

// A Gaussian with an attribute that is NaN or infinite is culled, and so is one of a larger opacity than kMaxOpacity.
template <class S> DSMOE_HD bool is_finite(const Gaussian<S>& g) {
  const S place[] = {g.mean.x, g.mean.y, g.mean.z};
  if (!in_range(g.opacity) || !all_finite(place, 3)) return false;
  if (g.has_covariance) {
    const auto& c = g.covariance;
    const S shape[] = {c.xx, c.xy, c.xz, c.yy, c.yz, c.zz};
    return all_finite(shape, 6);
  }
  const S shape[] = {g.scale.x, g.scale.y, g.scale.z, g.rotation.x, g.rotation.y, g.rotation.z, g.rotation.w};
  return all_finite(shape, 7);
}

// The tiles that may hold pairs of a Gaussian. mean and radius: pixels. The radius is only read if the mode is
// within_radius().
template <class S> DSMOE_HD TileRect tile_bounds(BlendMode mode, TileGrid grid, Vec2<S> mean, S radius) {
  if (within_radius(mode)) return radius_rect(mean, radius, grid);
  return {0, 0, grid.columns, grid.rows};
}

// A Gaussian's covariance on the image plane, and what the backward pass needs of its making.
template <class S> struct Covariances {
  Vec3<S> scale;     // modified; if the covariance is not given
  Mat3<S> rotation;  // if the covariance is not given
  ProjectionJacobian<S> jacobian;
  Mat23<S> axes;
  ImageFactor<S> factor;  // if the covariance is not given
  Sym2<S> image;          // px^2, before the low-pass filter
  Conic<S> conic;
};

template <class S>
DSMOE_HD Covariances<S> covariances(const Gaussian<S>& gaussian, const Camera<S>& camera, Vec3<S> view,
                                    const ProjectionRules<S>& rules) {
  Covariances<S> out = {};
  out.jacobian = projection_jacobian(camera, view);
  out.axes = image_axes(out.jacobian.jacobian, view_rotation(camera.view));
  if (gaussian.has_covariance) {
    out.image = covariance_2d(out.axes, gaussian.covariance);
    out.conic = make_conic(out.image, rules.low_pass);
  } else {
    out.scale = rules.scale_modifier * gaussian.scale;
    out.rotation = quaternion_to_rotation(gaussian.rotation);
    out.factor = image_factor(out.axes, out.scale, out.rotation);
    out.image = covariance_2d(out.factor);
    out.conic = conic_of(out.factor, rules.low_pass);
  }
  return out;
}

template <class S>
DSMOE_HD Projection<S> project(const Gaussian<S>& gaussian, const Camera<S>& camera, const ProjectionRules<S>& rules) {
  Projection<S> out;
  out.radius = 0;
  const Vec3<S> view = transform_point(camera.view, gaussian.mean);
  if (!(view.z > camera.near) || !in_range(gaussian.opacity)) return out;
  const auto made = covariances(gaussian, camera, view, rules);
  const Conic<S>& conic = made.conic;
  const Vec2<S> pixel = project_to_pixel(camera, gaussian.mean);
  const S radius = screen_radius(conic);
  // NaN and infinity in any other attribute reach the determinant or the pixel.
  if (!is_ellipse(conic) || !is_finite(radius)) return out;
  if (!is_finite(pixel.x) || !is_finite(pixel.y)) return out;
  const Cut cut = cut_of(rules.mode);
  const S widest_reach = squared_reach(cut, S(1), S(0));
  const bool seen = within_radius(rules.mode)
                        ? !tile_bounds(rules.mode, TileGrid(camera.width, camera.height), pixel, radius).empty()
                        : meets_image(conic.inverse, pixel, widest_reach, camera.width, camera.height);
  if (!seen) return out;
  S opacity = gaussian.opacity;
  if (rules.antialiasing) opacity *= opacity_compensation(conic);
  const S reach = squared_reach(cut, opacity, rules.cut.of(opacity));
  out.gaussian = {pixel, conic.inverse, opacity, reach, view.z};
  out.radius = static_cast<int32_t>(min(radius, S(1 << 30)));
  return out;
}

// What comes back from a Gaussian's pixels.
template <class S> struct ProjectedGradient {
  GateGradient<S> gate;
  S depth, inverse_depth;  // by z and 1 / z; 0 if nothing asks for them
  Vec3<S> color;           // by the mean, on the way of the colour
};

template <class S> struct GaussianGradient {
  Vec3<S> mean;
  Vec2<S> mean2D;  // dL/dpixel times (W / 2, H / 2): what densification reads
  S opacity;
  Vec3<S> scale;  // if the covariance is not given
  Vec4<S> rotation;
  Sym3<S> covariance;  // if it is given
  CameraShare<S> camera;
};

template <class S>
DSMOE_HD GaussianGradient<S> project_backward(const Gaussian<S>& gaussian, const Camera<S>& camera,
                                              const ProjectionRules<S>& rules, const ProjectedGradient<S>& g) {
  GaussianGradient<S> out = {};
  const Vec3<S> view = transform_point(camera.view, gaussian.mean);
  const auto made = covariances(gaussian, camera, view, rules);
  const Conic<S>& conic = made.conic;

  ImageGradient<S> by_image = {conic.inverse, g.gate.conic, {S(0), S(0), S(0)}};
  out.opacity = g.gate.opacity;
  if (rules.antialiasing) {
    const auto by = opacity_compensation_backward(conic, rules.low_pass, g.gate.opacity * gaussian.opacity);
    if (gaussian.has_covariance) {
      by_image.direct = by.dense(made.image);
    } else {
      by_image.direct = {by.by_identity, S(0), by.by_identity}, by_image.by_adjugate = by.by_adjugate;
    }
    out.opacity *= opacity_compensation(conic);
  }
  Mat23<S> dL_daxes;
  if (gaussian.has_covariance) {
    const auto by = covariance_2d_backward(made.axes, gaussian.covariance, by_image);
    out.covariance = by.cov, dL_daxes = by.axes;
  } else {
    const auto by = image_factor_backward(made.axes, made.scale, made.rotation, made.factor, by_image);
    out.scale = rules.scale_modifier * by.scale, dL_daxes = by.axes;
    out.rotation = quaternion_to_rotation_backward(gaussian.rotation, by.rotation);
  }

  const Mat3<S> view_axes = view_rotation(camera.view);
  const Mat23<S> dL_dJ = {view_axes * dL_daxes.r0, view_axes * dL_daxes.r1};
  Vec3<S> dL_dview = projection_jacobian_backward(made.jacobian, dL_dJ);
  dL_dview.z += g.depth;
  if (rules.inverse_depth) dL_dview.z -= g.inverse_depth / (view.z * view.z);
  const auto by_pixel = project_to_pixel_backward(camera, gaussian.mean, g.gate.mean);
  out.mean = transform_point_backward(camera.view, dL_dview) + by_pixel.point + g.color;
  out.mean2D = {g.gate.mean.x * S(0.5) * S(camera.width), g.gate.mean.y * S(0.5) * S(camera.height)};

  const auto& j = made.jacobian.jacobian;
  const Mat3<S> dL_drotation = {j.r0.x * dL_daxes.r0, j.r1.y * dL_daxes.r1,
                                j.r0.z * dL_daxes.r0 + j.r1.z * dL_daxes.r1};
  out.camera = {gaussian.mean, dL_dview, dL_drotation, by_pixel.clip, S(-1) * g.color};
  return out;
}

}  // namespace dsmoe

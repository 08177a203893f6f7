// One Gaussian from the world to the image plane, and its gradient back. Values go in and come out. arrays.h loads and
// stores them.
#pragma once

#include <cstdint>

#include "dsmoe/blend.h"
#include "dsmoe/camera.h"
#include "dsmoe/covariance.h"
#include "dsmoe/shutter.h"
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
  S depth;          // view z; of a lens that sees around, the distance from the camera
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

// What comes back from a Gaussian's pixels.
template <class S> struct ProjectedGradient {
  GateGradient<S> gate;
  S depth, inverse_depth;  // by the depth and its inverse; 0 if nothing asks for them
  Vec3<S> color;           // by the mean, on the way of the colour
};

// What comes back to a point in view space, and to the camera's projection.
template <class S> struct ViewGradient {
  Vec3<S> view;
  PixelGradient<S> pixel;
};

// What comes back to a Gaussian's mean and to the camera by way of the pose.
template <class S> struct PoseGradient {
  Vec3<S> mean;
  CameraShare<S> camera;
};

template <class S>
DSMOE_HD PoseGradient<S> pose_backward(const PinholeCamera<S>& camera, Vec3<S> mean, const ViewGradient<S>& by,
                                       const Mat3<S>& dL_drotation) {
  PoseGradient<S> out = {};
  out.mean = transform_point_backward(camera.view, by.view) + by.pixel.point;
  out.camera.point = mean, out.camera.dL_dview = by.view, out.camera.dL_drotation = dL_drotation;
  out.camera.dL_dclip = by.pixel.clip;
  return out;
}

// J^T dL_daxes, where all of J counts.
template <class S> DSMOE_HD Mat3<S> rotation_backward(const Mat23<S>& j, const Mat23<S>& dL_daxes) {
  return {j.r0.x * dL_daxes.r0 + j.r1.x * dL_daxes.r1, j.r0.y * dL_daxes.r0 + j.r1.y * dL_daxes.r1,
          j.r0.z * dL_daxes.r0 + j.r1.z * dL_daxes.r1};
}

// The three ways to the image. By the camera's matrix:
template <class S> struct ByMatrix {
  using Point = ProjectionJacobian<S>;
  const PinholeCamera<S>& camera;

  DSMOE_HD Vec3<S> to_view(Vec3<S> mean) const { return transform_point(camera.view, mean); }
  DSMOE_HD Mat3<S> rotation() const { return view_rotation(camera.view); }
  DSMOE_HD S depth(Vec3<S> view) const { return view.z; }
  DSMOE_HD Point point(Vec3<S> view) const { return projection_jacobian(camera, view); }
  DSMOE_HD bool sees(const Point&) const { return true; }
  DSMOE_HD Vec2<S> pixel(Vec3<S> mean, const Point&) const { return project_to_pixel(camera, mean); }

  DSMOE_HD ViewGradient<S> backward(Vec3<S> mean, Vec3<S> view, const Point& point, const Mat23<S>& dL_dJ,
                                    const ProjectedGradient<S>& g, bool inverse_depth) const {
    ViewGradient<S> out;
    out.view = projection_jacobian_backward(point, dL_dJ);
    out.view.z += g.depth;
    if (inverse_depth) out.view.z -= g.inverse_depth / (view.z * view.z);
    out.pixel = project_to_pixel_backward(camera, mean, g.gate.mean);
    return out;
  }

  DSMOE_HD PoseGradient<S> pose_backward(Vec3<S> mean, const Point& point, const ViewGradient<S>& by,
                                         const Mat23<S>& dL_daxes) const {
    const Mat23<S>& j = point.jacobian;
    return dsmoe::pose_backward(
        camera, mean, by, {j.r0.x * dL_daxes.r0, j.r1.y * dL_daxes.r1, j.r0.z * dL_daxes.r0 + j.r1.z * dL_daxes.r1});
  }
};

// Through a lens other than a pinhole. All of the pose comes from the view matrix.
template <class S> struct ByLens {
  using Point = LensPoint<S>;
  const LensCamera<S>& camera;

  DSMOE_HD Vec3<S> to_view(Vec3<S> mean) const { return transform_point(camera.view, mean); }
  DSMOE_HD Mat3<S> rotation() const { return view_rotation(camera.view); }
  DSMOE_HD S depth(Vec3<S> view) const { return view_depth(camera.lens.model, view); }
  DSMOE_HD Point point(Vec3<S> view) const { return through_lens(camera.lens, view); }
  DSMOE_HD bool sees(const Point& point) const { return point.seen; }
  DSMOE_HD Vec2<S> pixel(Vec3<S>, const Point& point) const { return point.pixel; }

  DSMOE_HD ViewGradient<S> backward(Vec3<S>, Vec3<S> view, const Point&, const Mat23<S>& dL_dJ,
                                    const ProjectedGradient<S>& g, bool inverse_depth) const {
    S dL_ddepth = g.depth;
    if (inverse_depth) dL_ddepth -= g.inverse_depth / (depth(view) * depth(view));
    return {through_lens_backward(camera.lens, view, g.gate.mean, dL_dJ) +
                view_depth_backward(camera.lens.model, view, dL_ddepth),
            {}};
  }

  DSMOE_HD PoseGradient<S> pose_backward(Vec3<S> mean, const Point& point, const ViewGradient<S>& by,
                                         const Mat23<S>& dL_daxes) const {
    return dsmoe::pose_backward(camera, mean, by, rotation_backward(point.jacobian, dL_daxes));
  }
};

// Through its lens by the pose of the time at which the shutter reads the Gaussian's mean.
template <class S> struct ByShutter {
  using Point = ShutterPoint<S>;
  const Camera<S>& camera;
  Readout<S> readout;
  ShutterTime<S> moment;

  DSMOE_HD ByShutter(const Camera<S>& camera, Vec3<S> mean)
      : camera(camera), readout(camera), moment(shutter_time(camera, readout, mean)) {}

  DSMOE_HD Vec3<S> to_view(Vec3<S>) const { return moment.view; }
  DSMOE_HD Mat3<S> rotation() const {
    return between(view_rotation(camera.view), view_rotation(camera.view_end), moment.time);
  }
  DSMOE_HD S depth(Vec3<S> view) const { return view_depth(camera.lens.model, view); }
  DSMOE_HD Point point(Vec3<S>) const { return through_shutter(camera.lens, readout, moment); }
  DSMOE_HD bool sees(const Point& point) const { return point.seen; }
  DSMOE_HD Vec2<S> pixel(Vec3<S>, const Point& point) const { return point.pixel; }

  // At a fixed time; `pose_backward` adds what comes by way of the time.
  DSMOE_HD MovingGradient<S> backward(Vec3<S>, Vec3<S> view, const Point& point, const Mat23<S>& dL_dJ,
                                      const ProjectedGradient<S>& g, bool inverse_depth) const {
    S dL_ddepth = g.depth;
    if (inverse_depth) dL_ddepth -= g.inverse_depth / (depth(view) * depth(view));
    auto out = through_shutter_backward(camera.lens, readout, moment, point, g.gate.mean, dL_dJ);
    out.view = out.view + view_depth_backward(camera.lens.model, view, dL_ddepth);
    return out;
  }

  DSMOE_HD PoseGradient<S> pose_backward(Vec3<S> mean, const Point& point, const MovingGradient<S>& by,
                                         const Mat23<S>& dL_daxes) const {
    const Mat3<S> dL_drotation = rotation_backward(point.jacobian, dL_daxes);
    const auto [start, end] = shutter_time_backward(camera, readout, moment, by, dL_drotation);
    const S time = moment.time;
    PoseGradient<S> out = {};
    out.mean = transform_point_backward(camera.view, start) + transform_point_backward(camera.view_end, end);
    out.camera.point = mean;
    out.camera.dL_dview = start, out.camera.dL_drotation = (S(1) - time) * dL_drotation;
    out.camera.dL_dview_end = end, out.camera.dL_drotation_end = time * dL_drotation;
    return out;
  }
};

// A Gaussian's covariance on the image plane, and what the backward pass needs of its making.
template <class S, class Point> struct Covariances {
  Vec3<S> scale;     // modified; if the covariance is not given
  Mat3<S> rotation;  // if the covariance is not given
  Point point;
  Mat23<S> axes;
  ImageFactor<S> factor;  // if the covariance is not given
  Sym2<S> image;          // px^2, before the low-pass filter
  Conic<S> conic;
};

template <class S, class Way>
DSMOE_HD Covariances<S, typename Way::Point> covariances(const Gaussian<S>& gaussian, const Way& way, Vec3<S> view,
                                                         const ProjectionRules<S>& rules) {
  Covariances<S, typename Way::Point> out = {};
  out.point = way.point(view);
  out.axes = image_axes(out.point.jacobian, way.rotation());
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

template <class S, class Way>
DSMOE_HD Projection<S> project_by(const Way& way, const Gaussian<S>& gaussian, const ProjectionRules<S>& rules) {
  const PinholeCamera<S>& camera = way.camera;
  Projection<S> out;
  out.radius = 0;
  const Vec3<S> view = way.to_view(gaussian.mean);
  const S depth = way.depth(view);
  if (!(depth > camera.near) || !in_range(gaussian.opacity)) return out;
  const auto made = covariances(gaussian, way, view, rules);
  if (!way.sees(made.point)) return out;
  const Conic<S>& conic = made.conic;
  const Vec2<S> pixel = way.pixel(gaussian.mean, made.point);
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
  out.gaussian = {pixel, conic.inverse, opacity, reach, depth};
  out.radius = static_cast<int32_t>(min(radius, S(1 << 30)));
  return out;
}

template <class S>
DSMOE_HD Projection<S> project(const Gaussian<S>& gaussian, const PinholeCamera<S>& camera,
                               const ProjectionRules<S>& rules) {
  return project_by(ByMatrix<S>{camera}, gaussian, rules);
}

template <class S>
DSMOE_HD Projection<S> project(const Gaussian<S>& gaussian, const LensCamera<S>& camera,
                               const ProjectionRules<S>& rules) {
  if (camera.lens.model == LensModel::kPinhole) return project_by(ByMatrix<S>{camera}, gaussian, rules);
  return project_by(ByLens<S>{camera}, gaussian, rules);
}

template <class S>
DSMOE_HD Projection<S> project(const Gaussian<S>& gaussian, const Camera<S>& camera, const ProjectionRules<S>& rules) {
  if (camera.shutter != Shutter::kGlobal) return project_by(ByShutter<S>(camera, gaussian.mean), gaussian, rules);
  return project<S>(gaussian, static_cast<const LensCamera<S>&>(camera), rules);
}

template <class S> struct GaussianGradient {
  Vec3<S> mean;
  Vec2<S> mean2D;  // dL/dpixel times (W / 2, H / 2): what densification reads
  S opacity;
  Vec3<S> scale;  // if the covariance is not given
  Vec4<S> rotation;
  Sym3<S> covariance;  // if it is given
  CameraShare<S> camera;
};

template <class S, class Way>
DSMOE_HD GaussianGradient<S> project_backward_by(const Way& way, const Gaussian<S>& gaussian,
                                                 const ProjectionRules<S>& rules, const ProjectedGradient<S>& g) {
  const PinholeCamera<S>& camera = way.camera;
  GaussianGradient<S> out = {};
  const Vec3<S> view = way.to_view(gaussian.mean);
  const auto made = covariances(gaussian, way, view, rules);
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

  const Mat3<S> view_axes = way.rotation();
  const Mat23<S> dL_dJ = {view_axes * dL_daxes.r0, view_axes * dL_daxes.r1};
  const auto by = way.backward(gaussian.mean, view, made.point, dL_dJ, g, rules.inverse_depth);
  const auto by_pose = way.pose_backward(gaussian.mean, made.point, by, dL_daxes);
  out.mean = by_pose.mean + g.color;
  out.mean2D = {g.gate.mean.x * S(0.5) * S(camera.width), g.gate.mean.y * S(0.5) * S(camera.height)};
  out.camera = by_pose.camera;
  out.camera.dL_dposition = S(-1) * g.color;
  return out;
}

template <class S>
DSMOE_HD GaussianGradient<S> project_backward(const Gaussian<S>& gaussian, const PinholeCamera<S>& camera,
                                              const ProjectionRules<S>& rules, const ProjectedGradient<S>& g) {
  return project_backward_by(ByMatrix<S>{camera}, gaussian, rules, g);
}

template <class S>
DSMOE_HD GaussianGradient<S> project_backward(const Gaussian<S>& gaussian, const LensCamera<S>& camera,
                                              const ProjectionRules<S>& rules, const ProjectedGradient<S>& g) {
  if (camera.lens.model == LensModel::kPinhole) return project_backward_by(ByMatrix<S>{camera}, gaussian, rules, g);
  return project_backward_by(ByLens<S>{camera}, gaussian, rules, g);
}

template <class S>
DSMOE_HD GaussianGradient<S> project_backward(const Gaussian<S>& gaussian, const Camera<S>& camera,
                                              const ProjectionRules<S>& rules, const ProjectedGradient<S>& g) {
  if (camera.shutter != Shutter::kGlobal) {
    return project_backward_by(ByShutter<S>(camera, gaussian.mean), gaussian, rules, g);
  }
  return project_backward<S>(gaussian, static_cast<const LensCamera<S>&>(camera), rules, g);
}

}  // namespace dsmoe

// Covariances: from scale and rotation to 3D, and from 3D to the image plane. Each backward function stands below its
// forward.
#pragma once

#include "dsmoe/camera.h"
#include "dsmoe/constants.h"
#include "dsmoe/vec.h"

namespace dsmoe {

// Rotation matrix of a quaternion (w, x, y, z), used as given: callers normalise.
template <class S> DSMOE_HD Mat3<S> quaternion_to_rotation(Vec4<S> q) {
  const S r = q.x, x = q.y, y = q.z, z = q.w;
  return {{S(1) - S(2) * (y * y + z * z), S(2) * (x * y - r * z), S(2) * (x * z + r * y)},
          {S(2) * (x * y + r * z), S(1) - S(2) * (x * x + z * z), S(2) * (y * z - r * x)},
          {S(2) * (x * z - r * y), S(2) * (y * z + r * x), S(1) - S(2) * (x * x + y * y)}};
}

template <class S> DSMOE_HD Vec4<S> quaternion_to_rotation_backward(Vec4<S> q, const Mat3<S>& g) {
  const S r = q.x, x = q.y, y = q.z, z = q.w;
  return {
      S(2) * (x * (g.r2.y - g.r1.z) + y * (g.r0.z - g.r2.x) + z * (g.r1.x - g.r0.y)),
      S(2) * (r * (g.r2.y - g.r1.z) + y * (g.r0.y + g.r1.x) + z * (g.r0.z + g.r2.x) - S(2) * x * (g.r1.y + g.r2.z)),
      S(2) * (r * (g.r0.z - g.r2.x) + x * (g.r0.y + g.r1.x) + z * (g.r1.z + g.r2.y) - S(2) * y * (g.r0.x + g.r2.z)),
      S(2) * (r * (g.r1.x - g.r0.y) + x * (g.r0.z + g.r2.x) + y * (g.r1.z + g.r2.y) - S(2) * z * (g.r0.x + g.r1.y))};
}

// J, 2x3: the perspective projection's local affine approximation (EWA splatting), by view coordinates. The slopes x/z
// and y/z are clamped a little outside the frustum, where the approximation would explode.
template <class S> struct ProjectionJacobian {
  Vec2<S> focal;  // pixels
  Vec2<S> slope;  // clamped x/z, y/z
  bool clamped_x, clamped_y;
  S inverse_z;
  Mat23<S> jacobian;  // J
};

template <class S> DSMOE_HD ProjectionJacobian<S> projection_jacobian(const Camera<S>& camera, Vec3<S> view) {
  ProjectionJacobian<S> out;
  out.focal = {S(camera.width) / (S(2) * camera.tan_fov_x), S(camera.height) / (S(2) * camera.tan_fov_y)};
  const S limit_x = S(kFrustumMargin) * camera.tan_fov_x, limit_y = S(kFrustumMargin) * camera.tan_fov_y;
  out.inverse_z = S(1) / view.z;
  const Vec2<S> slope = {view.x * out.inverse_z, view.y * out.inverse_z};
  out.slope = {clamp(slope.x, -limit_x, limit_x), clamp(slope.y, -limit_y, limit_y)};
  out.clamped_x = out.slope.x != slope.x;
  out.clamped_y = out.slope.y != slope.y;
  const S fx = out.focal.x * out.inverse_z, fy = out.focal.y * out.inverse_z;
  out.jacobian = {{fx, S(0), -fx * out.slope.x}, {S(0), fy, -fy * out.slope.y}};
  return out;
}

template <class S>
DSMOE_HD Vec3<S> projection_jacobian_backward(const ProjectionJacobian<S>& f, const Mat23<S>& dL_dJ) {
  const S fx = f.focal.x * f.inverse_z, fy = f.focal.y * f.inverse_z;
  const S dL_dslope_x = -fx * dL_dJ.r0.z, dL_dslope_y = -fy * dL_dJ.r1.z;
  const S dL_dfx = dL_dJ.r0.x - f.slope.x * dL_dJ.r0.z, dL_dfy = dL_dJ.r1.y - f.slope.y * dL_dJ.r1.z;
  Vec3<S> dL_dview = {S(0), S(0), -f.inverse_z * (fx * dL_dfx + fy * dL_dfy)};
  if (!f.clamped_x) {
    dL_dview.x += dL_dslope_x * f.inverse_z;
    dL_dview.z -= dL_dslope_x * f.slope.x * f.inverse_z;
  }
  if (!f.clamped_y) {
    dL_dview.y += dL_dslope_y * f.inverse_z;
    dL_dview.z -= dL_dslope_y * f.slope.y * f.inverse_z;
  }
  return dL_dview;
}

// M = J W, the rows that take world vectors to the image plane.
template <class S> DSMOE_HD Mat23<S> image_axes(const Mat23<S>& jacobian, const Mat3<S>& rotation) {
  return {transposed_times(rotation, jacobian.r0), transposed_times(rotation, jacobian.r1)};
}

// The image covariance of a given 3D covariance: Sigma2D = M Sigma M^T, before the low-pass filter.
template <class S> DSMOE_HD Sym2<S> covariance_2d(const Mat23<S>& axes, const Sym3<S>& cov) {
  const Vec3<S> u = cov * axes.r0, v = cov * axes.r1;
  return {dot(axes.r0, u), dot(axes.r0, v), dot(axes.r1, v)};
}

template <class S> struct Covariance2dGradient {
  Sym3<S> cov;
  Mat23<S> axes;
};

// The derivative by each of the six stored numbers of Sigma: an off-diagonal one stands for two matrix entries.
template <class S> DSMOE_HD Sym3<S> dL_dcovariance(const Mat23<S>& axes, const Sym2<S>& g) {
  const Vec3<S> a = axes.r0, b = axes.r1;
  return {g.xx * a.x * a.x + g.xy * a.x * b.x + g.yy * b.x * b.x,
          S(2) * g.xx * a.x * a.y + g.xy * (a.x * b.y + a.y * b.x) + S(2) * g.yy * b.x * b.y,
          S(2) * g.xx * a.x * a.z + g.xy * (a.x * b.z + a.z * b.x) + S(2) * g.yy * b.x * b.z,
          g.xx * a.y * a.y + g.xy * a.y * b.y + g.yy * b.y * b.y,
          S(2) * g.xx * a.y * a.z + g.xy * (a.y * b.z + a.z * b.y) + S(2) * g.yy * b.y * b.z,
          g.xx * a.z * a.z + g.xy * a.z * b.z + g.yy * b.z * b.z};
}

template <class S>
DSMOE_HD Covariance2dGradient<S> covariance_2d_backward(const Mat23<S>& axes, const Sym3<S>& cov, const Sym2<S>& g) {
  const Vec3<S> u = cov * axes.r0, v = cov * axes.r1;
  return {dL_dcovariance(axes, g), {S(2) * g.xx * u + g.xy * v, g.xy * u + S(2) * g.yy * v}};
}

// The image covariance of scale and rotation. Sigma = R S S^T R^T (3DGS Eq. 6), so Sigma2D = L L^T with L = M R S. Its
// determinant is the sum of the squared minors of L. No term of that sum cancels another, however long and thin the
// Gaussian is. The scale has the scale modifier in it.
template <class S> struct ImageFactor {
  Mat23<S> turned;  // M R
  Mat23<S> half;    // L
};

template <class S> DSMOE_HD ImageFactor<S> image_factor(const Mat23<S>& axes, Vec3<S> scale, const Mat3<S>& rotation) {
  const Vec3<S> a = transposed_times(rotation, axes.r0), b = transposed_times(rotation, axes.r1);
  return {{a, b}, {scale * a, scale * b}};
}

template <class S> DSMOE_HD Sym2<S> covariance_2d(const ImageFactor<S>& factor) {
  const Vec3<S> a = factor.half.r0, b = factor.half.r1;
  return {dot(a, a), dot(a, b), dot(b, b)};
}

template <class S> struct ImageFactorGradient {
  Vec3<S> scale;
  Mat3<S> rotation;
  Mat23<S> axes;
};

// The derivative by R is taken through Sigma, to which column k of R adds scale_k^2 r_k r_k^T. The derivative by Sigma
// is symmetric to the last bit. So the unturned quaternion of a round Gaussian has a gradient of exactly 0.
template <class S>
DSMOE_HD ImageFactorGradient<S> image_factor_backward(const Mat23<S>& axes, Vec3<S> scale, const Mat3<S>& rotation,
                                                      const ImageFactor<S>& factor, const Sym2<S>& g) {
  const Vec3<S> dL_da = S(2) * g.xx * factor.half.r0 + g.xy * factor.half.r1;
  const Vec3<S> dL_db = g.xy * factor.half.r0 + S(2) * g.yy * factor.half.r1;
  const Sym3<S> dL_dcov = dL_dcovariance(axes, g);
  const S half = S(0.5);
  const Sym3<S> by = {dL_dcov.xx, half * dL_dcov.xy, half * dL_dcov.xz, dL_dcov.yy, half * dL_dcov.yz, dL_dcov.zz};
  const auto column = [&](S axis, Vec3<S> r) {
    const S twice_variance = product(S(2) * axis, axis);
    const Vec3<S> turned = by * r;
    return Vec3<S>{product(twice_variance, turned.x), product(twice_variance, turned.y),
                   product(twice_variance, turned.z)};
  };
  const Vec3<S> x = column(scale.x, {rotation.r0.x, rotation.r1.x, rotation.r2.x});
  const Vec3<S> y = column(scale.y, {rotation.r0.y, rotation.r1.y, rotation.r2.y});
  const Vec3<S> z = column(scale.z, {rotation.r0.z, rotation.r1.z, rotation.r2.z});
  return {factor.turned.r0 * dL_da + factor.turned.r1 * dL_db,
          {{x.x, y.x, z.x}, {x.y, y.y, z.y}, {x.z, y.z, z.z}},
          {rotation * (scale * dL_da), rotation * (scale * dL_db)}};
}

// The conic, the inverse of Sigma2D + low-pass, with what the radius and antialiasing need.
template <class S> struct Conic {
  Sym2<S> inverse;   // per px^2
  Sym2<S> filtered;  // Sigma2D + low-pass, px^2
  S determinant;     // of filtered; there is no footprint where it is not above 0
  S unfiltered;      // the determinant of Sigma2D
};

// A Gaussian whose covariance on the image plane is cov2d. The determinants: before the low-pass filter, and after.
// low_pass: px^2 that are added to both variances.
template <class S> DSMOE_HD Conic<S> make_conic(const Sym2<S>& cov2d, S unfiltered, S determinant, S low_pass) {
  const Sym2<S> c = {cov2d.xx + low_pass, cov2d.xy, cov2d.yy + low_pass};
  const S scale = S(1) / determinant;
  return {{c.yy * scale, -c.xy * scale, c.xx * scale}, c, determinant, unfiltered};
}

template <class S> DSMOE_HD Conic<S> make_conic(const Sym2<S>& c, S low_pass = S(kLowPass)) {
  return make_conic(c, difference_of_products(c.xx, c.yy, c.xy, c.xy),
                    difference_of_products(c.xx + low_pass, c.yy + low_pass, c.xy, c.xy), low_pass);
}

template <class S> DSMOE_HD Conic<S> conic_of(const ImageFactor<S>& factor, S low_pass = S(kLowPass)) {
  const Vec3<S> minors = cross(factor.half.r0, factor.half.r1);
  const Sym2<S> c = covariance_2d(factor);
  const S unfiltered = dot(minors, minors);
  return make_conic(c, unfiltered, unfiltered + low_pass * (c.xx + c.yy + low_pass), low_pass);
}

// Whether the filtered covariance is positive definite. That of a caller's cov3D_precomp may not be.
template <class S> DSMOE_HD bool is_ellipse(const Conic<S>& conic) {
  return conic.filtered.xx > S(0) && conic.determinant > S(0) && is_finite(conic.determinant);
}

// d(C^-1) = -C^-1 dC C^-1; g.xy is the derivative by the one stored off-diagonal number.
template <class S> DSMOE_HD Sym2<S> make_conic_backward(const Conic<S>& conic, const Sym2<S>& g) {
  const auto& k = conic.inverse;
  return {-(g.xx * k.xx * k.xx + g.xy * k.xx * k.xy + g.yy * k.xy * k.xy),
          -(S(2) * g.xx * k.xx * k.xy + g.xy * (k.xx * k.yy + k.xy * k.xy) + S(2) * g.yy * k.xy * k.yy),
          -(g.xx * k.xy * k.xy + g.xy * k.xy * k.yy + g.yy * k.yy * k.yy)};
}

// Antialiasing: the factor on the opacity that keeps a Gaussian's total weight when the low-pass filter widens it.
template <class S> DSMOE_HD S opacity_compensation(const Conic<S>& conic) {
  return sqrt(max(S(kCompensationFloor), conic.unfiltered / conic.determinant));
}

template <class S>
DSMOE_HD Sym2<S> opacity_compensation_backward(const Sym2<S>& cov2d, const Conic<S>& conic, S dL_dfactor) {
  const S ratio = conic.unfiltered / conic.determinant;
  if (!(ratio > S(kCompensationFloor))) return {S(0), S(0), S(0)};
  const S dL_dratio = dL_dfactor * S(0.5) / sqrt(ratio);
  const S dL_dbefore = dL_dratio / conic.determinant, dL_dafter = -dL_dratio * ratio / conic.determinant;
  const auto& c = conic.filtered;
  return {dL_dbefore * cov2d.yy + dL_dafter * c.yy, S(-2) * (dL_dbefore + dL_dafter) * cov2d.xy,
          dL_dbefore * cov2d.xx + dL_dafter * c.xx};
}

// The 3-sigma radius in pixels that the trainers prune and count by, whatever the blend mode.
template <class S> DSMOE_HD S screen_radius(const Conic<S>& conic) {
  const S mid = S(0.5) * (conic.filtered.xx + conic.filtered.yy);
  const S root = sqrt(max(S(kRadiusRootFloor), mid * mid - conic.determinant));
  return ceil(S(3) * sqrt(mid + root));
}

}  // namespace dsmoe

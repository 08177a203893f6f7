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

template <class S> DSMOE_HD ProjectionJacobian<S> projection_jacobian(const PinholeCamera<S>& camera, Vec3<S> view) {
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

// The columns of a 2x3 matrix.
template <class S> struct Columns {
  Vec2<S> of[3];
  DSMOE_HD explicit Columns(const Mat23<S>& m) : of{{m.r0.x, m.r1.x}, {m.r0.y, m.r1.y}, {m.r0.z, m.r1.z}} {}
};

// M = J W, the rows that take world vectors to the image plane.
template <class S> DSMOE_HD Mat23<S> image_axes(const Mat23<S>& jacobian, const Mat3<S>& rotation) {
  return {transposed_times(rotation, jacobian.r0), transposed_times(rotation, jacobian.r1)};
}

// The image covariance of a given 3D covariance: Sigma2D = M Sigma M^T, before the low-pass filter.
template <class S> DSMOE_HD Sym2<S> covariance_2d(const Mat23<S>& axes, const Sym3<S>& cov) {
  const Vec3<S> u = cov * axes.r0, v = cov * axes.r1;
  return {dot(axes.r0, u), dot(axes.r0, v), dot(axes.r1, v)};
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

// The conic, the inverse of Sigma2D + low-pass, with what the radius and antialiasing need.
template <class S> struct Conic {
  Sym2<S> inverse;   // per px^2
  Sym2<S> filtered;  // Sigma2D + low-pass, px^2
  S determinant;     // of filtered; there is no footprint if it is not above 0
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

// Antialiasing: the factor on the opacity that keeps a Gaussian's total weight when the low-pass filter widens it.
template <class S> DSMOE_HD S opacity_compensation(const Conic<S>& conic) {
  return sqrt(max(S(kCompensationFloor), conic.unfiltered / conic.determinant));
}

// The loss's derivative by Sigma2D, H = -K G K + E, as the factors that it is made of. K is the conic, G the derivative
// by it, and E comes from antialiasing. H itself is never formed: that of a long thin Gaussian is large, and its
// rounding is no longer orthogonal to what H multiplies next. So K meets that first.
template <class S> struct ImageGradient {
  Sym2<S> conic;         // K
  Sym2<S> by_conic;      // G, by the three stored numbers
  Sym2<S> direct;        // of E, likewise
  S by_adjugate = S(0);  // the rest of E is this times adj(Sigma2D); for scale and rotation, whose minors it is made of
};

// p^T G q, where the off-diagonal number of G stands for two entries. In kernels too it is the same number, to the last
// bit, with p and q exchanged.
template <class S> DSMOE_HD S bilinear(const Sym2<S>& g, Vec2<S> p, Vec2<S> q) {
  const S cross = S(0.5) * g.xy * (product(p.x, q.y) + product(p.y, q.x));
  return product(g.xx, product(p.x, q.x)) + (product(g.yy, product(p.y, q.y)) + cross);
}

// G m, and K m, for each of three columns.
template <class S> DSMOE_HD Mat23<S> derivative_times(const Sym2<S>& g, const Mat23<S>& m) {
  const S half = S(0.5) * g.xy;
  return {g.xx * m.r0 + half * m.r1, half * m.r0 + g.yy * m.r1};
}
template <class S> DSMOE_HD Mat23<S> operator*(const Sym2<S>& k, const Mat23<S>& m) {
  return {k.xx * m.r0 + k.xy * m.r1, k.xy * m.r0 + k.yy * m.r1};
}

// H m, for each of three columns.
template <class S> DSMOE_HD Mat23<S> operator*(const ImageGradient<S>& h, const Mat23<S>& m) {
  const Mat23<S> by_conic = h.conic * derivative_times(h.by_conic, h.conic * m), direct = derivative_times(h.direct, m);
  return {direct.r0 - by_conic.r0, direct.r1 - by_conic.r1};
}
template <class S> struct CovarianceGradient {
  Sym3<S> cov;  // by the six stored numbers: an off-diagonal one stands for two matrix entries
  Mat23<S> axes;
};

template <class S>
DSMOE_HD CovarianceGradient<S> covariance_2d_backward(const Mat23<S>& axes, const Sym3<S>& cov,
                                                      const ImageGradient<S>& h) {
  const Mat23<S> by_axes = h * Mat23<S>{cov * axes.r0, cov * axes.r1};
  const Columns<S> m(axes), km(h.conic * axes);
  const auto entry = [&](int i, int j) {
    return bilinear(h.direct, m.of[i], m.of[j]) - bilinear(h.by_conic, km.of[i], km.of[j]);
  };
  const S two = S(2);
  return {{entry(0, 0), two * entry(0, 1), two * entry(0, 2), entry(1, 1), two * entry(1, 2), entry(2, 2)},
          {two * by_axes.r0, two * by_axes.r1}};
}

template <class S> struct ImageFactorGradient {
  Vec3<S> scale;
  Mat3<S> rotation;
  Mat23<S> axes;
};

// dL/dR_ij = 2 s_j^2 (M_i^T H t_j), where M_i and t_j are columns of M and of M R. It is symmetric to the last bit
// if R is 1 and all s are equal. So the unturned quaternion of a round Gaussian has a gradient of exactly 0.
template <class S>
DSMOE_HD ImageFactorGradient<S> image_factor_backward(const Mat23<S>& axes, Vec3<S> scale, const Mat3<S>& rotation,
                                                      const ImageFactor<S>& factor, const ImageGradient<S>& h) {
  Mat23<S> by_half = h * factor.half;
  // adj(Sigma2D) = sum_k n_k n_k^T, where n_k is column k of L = M R S, turned by 90 degrees: n_k^T p is the cross
  // product of that column and p. Of columns of L the cross products are its minors, and that of a column and itself is
  // 0. A formed adj(Sigma2D) would lose all digits of what it makes of a needle's long column.
  const Vec3<S> minors = cross(factor.turned.r0, factor.turned.r1);  // of columns 1 and 2, 2 and 0, 0 and 1
  const S variance[] = {product(scale.x, scale.x), product(scale.y, scale.y), product(scale.z, scale.z)};
  if (h.by_adjugate != S(0)) {
    const Vec3<S> z = {scale.y * scale.z * minors.x, scale.z * scale.x * minors.y, scale.x * scale.y * minors.z};
    by_half.r0 = by_half.r0 + h.by_adjugate * cross(factor.half.r1, z);
    by_half.r1 = by_half.r1 + h.by_adjugate * cross(z, factor.half.r0);
  }
  const Vec3<S> dL_da = S(2) * by_half.r0, dL_db = S(2) * by_half.r1;
  const Columns<S> m(axes), km(h.conic * axes), t(factor.turned), kt(h.conic * factor.turned);
  const S minor[] = {minors.x, minors.y, minors.z};
  // M_i^T adj(Sigma2D) t_j
  const auto adjugate = [&](int i, int j) {
    const int k = (j + 1) % 3, l = (j + 2) % 3;
    // The cross product of t_c and M_i, the same bits as the minor if M is t.
    const auto across = [&](int c) {
      const Vec2<S>&p = t.of[c], &q = m.of[i];
      const bool forward = i == (c + 1) % 3;
      return forward ? difference_of_products(p.x, q.y, q.x, p.y) : -difference_of_products(q.x, p.y, p.x, q.y);
    };
    // The columns k, j have the minor -minor[l], and l, j have minor[k].
    return product(variance[l], product(minor[k], across(l))) - product(variance[k], product(minor[l], across(k)));
  };
  const auto entry = [&](int i, int j) {
    S by_cov = bilinear(h.direct, m.of[i], t.of[j]) - bilinear(h.by_conic, km.of[i], kt.of[j]);
    if (h.by_adjugate != S(0)) by_cov += product(h.by_adjugate, adjugate(i, j));
    return product(S(2) * variance[j], by_cov);
  };
  return {factor.turned.r0 * dL_da + factor.turned.r1 * dL_db,
          {{entry(0, 0), entry(0, 1), entry(0, 2)},
           {entry(1, 0), entry(1, 1), entry(1, 2)},
           {entry(2, 0), entry(2, 1), entry(2, 2)}},
          {rotation * (scale * dL_da), rotation * (scale * dL_db)}};
}

// dL/dopacity times the opacity before, on its way to Sigma2D: what ImageGradient calls E, by_adjugate adj(Sigma2D) +
// by_identity I.
template <class S> struct CompensationGradient {
  S by_adjugate, by_identity;

  // By the three stored numbers of Sigma2D.
  DSMOE_HD Sym2<S> dense(const Sym2<S>& cov2d) const {
    return {by_adjugate * cov2d.yy + by_identity, S(-2) * by_adjugate * cov2d.xy, by_adjugate * cov2d.xx + by_identity};
  }
};

template <class S>
DSMOE_HD CompensationGradient<S> opacity_compensation_backward(const Conic<S>& conic, S low_pass, S dL_dfactor) {
  const S ratio = conic.unfiltered / conic.determinant;
  if (!(ratio > S(kCompensationFloor))) return {S(0), S(0)};
  // ratio = det A / det C, C = A + low_pass: its derivative by A is (adj A - ratio adj C) / det C, and adj C is
  // adj A + low_pass.
  const auto& c = conic.filtered;
  const S less = low_pass * (c.xx + c.yy - low_pass) / conic.determinant;  // 1 - ratio
  const S by_ratio = dL_dfactor * S(0.5) / (sqrt(ratio) * conic.determinant);
  return {by_ratio * less, -by_ratio * ratio * low_pass};
}

// The 3-sigma radius in pixels that the trainers prune and count by, whatever the blend mode.
template <class S> DSMOE_HD S screen_radius(const Conic<S>& conic) {
  const S mid = S(0.5) * (conic.filtered.xx + conic.filtered.yy);
  const S root = sqrt(max(S(kRadiusRootFloor), mid * mid - conic.determinant));
  return ceil(S(3) * sqrt(mid + root));
}

}  // namespace dsmoe

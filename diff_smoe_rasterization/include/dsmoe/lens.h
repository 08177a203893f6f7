// Lenses other than a pinhole: from a point in view space to its pixel, the 2x3 Jacobian of that, and the derivative of
// both. A lens is a map to a plane (by its model), a distortion of that plane, and focal lengths with a principal
// point. Each backward function stands below its forward. docs/method.md has the equations.
#pragma once

#include <cmath>
#include <initializer_list>
#include <sstream>
#include <stdexcept>
#include <string>
#include <vector>

#include "dsmoe/constants.h"
#include "dsmoe/vec.h"

namespace dsmoe {

enum class LensModel : int {
  kPinhole,           // has no Lens: its projection is the camera's matrix
  kOrthographic,      // x, y
  kOpencv,            // x / z, y / z, distorted; COLMAP's OPENCV and FULL_OPENCV
  kFisheye,           // the angle to the axis as the radius, distorted; Kannala-Brandt, COLMAP's OPENCV_FISHEYE
  kThinPrismFisheye,  // the same with COLMAP's distortion of this name
  kEquirectangular,   // longitude and latitude
};
constexpr const char* kLensNames[] = {"pinhole", "orthographic",       "opencv",
                                      "fisheye", "thin_prism_fisheye", "equirectangular"};
constexpr int kNumLensModels = sizeof(kLensNames) / sizeof(kLensNames[0]);

// Whether a lens sees what lies beside and behind the camera. Then a depth is the distance from the camera, else view
// z.
DSMOE_HD bool sees_around(LensModel model) { return model >= LensModel::kFisheye; }

// q: the squared radius r^2 on the plane. u = a R + 2 p1 a b + p2 (q + 2 a^2) + s1 q + s2 q^2 and v = b R + p1 (q + 2
// b^2) + 2 p2 a b + s3 q + s4 q^2, where R = (1 + n1 q + ... + n4 q^4) / (1 + d1 q + ... + d3 q^3).
template <class S> struct Distortion {
  S numerator[4] = {}, denominator[3] = {};  // n, d
  S tangential[2] = {};                      // p
  S prism[4] = {};                           // s
};

template <class S> struct Lens {
  LensModel model = LensModel::kPinhole;
  Vec2<S> focal = {}, principal = {};  // pixels; the centre of the first pixel is (0, 0)
  Distortion<S> distortion;
  Vec2<S> slope_limit = {};  // kOpencv: the Jacobian is taken at most at these |x/z| and |y/z|
  S range = 0;               // a radius on the plane. What lies beyond is not seen. kEquirectangular: see there

  template <class To> Lens<To> as() const {
    Lens<To> to;
    to.model = model;
    to.focal = {To(focal.x), To(focal.y)}, to.principal = {To(principal.x), To(principal.y)};
    const auto copy = [](const auto& from, auto& into) {
      for (size_t i = 0; i < sizeof(from) / sizeof(from[0]); ++i) into[i] = To(from[i]);
    };
    copy(distortion.numerator, to.distortion.numerator), copy(distortion.denominator, to.distortion.denominator);
    copy(distortion.tangential, to.distortion.tangential), copy(distortion.prism, to.distortion.prism);
    to.slope_limit = {To(slope_limit.x), To(slope_limit.y)}, to.range = To(range);
    return to;
  }
};

// The angle to the axis at which every fisheye ends, radians: near 180 degrees a point becomes a ring.
constexpr double kFisheyeEnd = 0.97 * 3.14159265358979323846;
// Equirectangular: points this close to the poles, as a part of their distance, are not seen. Their longitude has no
// derivative.
constexpr double kPole = 1e-3;

template <class S> DSMOE_HD S view_depth(LensModel model, Vec3<S> view) {
  return sees_around(model) ? sqrt(dot(view, view)) : view.z;
}

template <class S> DSMOE_HD Vec3<S> view_depth_backward(LensModel model, Vec3<S> view, S dL_ddepth) {
  if (!sees_around(model)) return {S(0), S(0), dL_ddepth};
  return (dL_ddepth / sqrt(dot(view, view))) * view;
}

// R and its first two derivatives by q.
template <class S> struct Radial { S value, first, second; };

template <class S> DSMOE_HD Radial<S> radial_of(const Distortion<S>& d, S q) {
  const S *n = d.numerator, *m = d.denominator;
  const S two = S(2), top = S(1) + q * (n[0] + q * (n[1] + q * (n[2] + q * n[3])));
  const S top1 = n[0] + q * (two * n[1] + q * (S(3) * n[2] + q * S(4) * n[3]));
  const S top2 = two * n[1] + q * (S(6) * n[2] + q * S(12) * n[3]);
  const S inverse = S(1) / (S(1) + q * (m[0] + q * (m[1] + q * m[2])));
  const S under1 = m[0] + q * (two * m[1] + q * S(3) * m[2]), under2 = two * m[1] + q * S(6) * m[2];
  const S value = top * inverse, first = (top1 - value * under1) * inverse;
  return {value, first, (top2 - two * first * under1 - value * under2) * inverse};
}

// A distorted point of the plane, with the Jacobian by the undistorted one.
template <class S> struct Distorted {
  Vec2<S> at;
  Vec2<S> row_u, row_v;  // (du/da, du/db), (dv/da, dv/db)
};

template <class S> DSMOE_HD Distorted<S> distort(const Distortion<S>& d, Vec2<S> plane) {
  const S a = plane.x, b = plane.y, q = a * a + b * b, two = S(2);
  const Radial<S> radial = radial_of(d, q);
  const S p1 = d.tangential[0], p2 = d.tangential[1];
  const S *s = d.prism, r = radial.value, r1 = two * radial.first;
  const S prism_u = two * (s[0] + two * s[1] * q), prism_v = two * (s[2] + two * s[3] * q);
  const S mixed = a * b * r1 + two * (p1 * a + p2 * b);
  return {{a * r + two * p1 * a * b + p2 * (q + two * a * a) + q * (s[0] + q * s[1]),
           b * r + p1 * (q + two * b * b) + two * p2 * a * b + q * (s[2] + q * s[3])},
          {r + a * a * r1 + two * p1 * b + S(6) * p2 * a + a * prism_u, mixed + b * prism_u},
          {mixed + a * prism_v, r + b * b * r1 + S(6) * p1 * b + two * p2 * a + b * prism_v}};
}

// From the gradient by the Jacobian's rows to that by the undistorted point.
template <class S>
DSMOE_HD Vec2<S> distortion_jacobian_backward(const Distortion<S>& d, Vec2<S> plane, Vec2<S> dL_drow_u,
                                              Vec2<S> dL_drow_v) {
  const S a = plane.x, b = plane.y, q = a * a + b * b, two = S(2), four = S(4);
  const Radial<S> radial = radial_of(d, q);
  const S r1 = two * radial.first, r2 = four * radial.second;
  const S p1 = two * d.tangential[0], p2 = two * d.tangential[1];
  const S* s = d.prism;
  const S prism_u = two * (s[0] + two * s[1] * q), prism_v = two * (s[2] + two * s[3] * q);
  const S aab = b * (r1 + a * a * r2) + p1, abb = a * (r1 + b * b * r2) + p2;
  const S cross_u = S(8) * s[1], cross_v = S(8) * s[3];
  const S u_aa = a * (S(3) * r1 + a * a * r2) + S(3) * p2 + prism_u + cross_u * a * a;
  const S u_ab = aab + cross_u * a * b, u_bb = abb + prism_u + cross_u * b * b;
  const S v_aa = aab + prism_v + cross_v * a * a, v_ab = abb + cross_v * a * b;
  const S v_bb = b * (S(3) * r1 + b * b * r2) + S(3) * p1 + prism_v + cross_v * b * b;
  return {dL_drow_u.x * u_aa + dL_drow_u.y * u_ab + dL_drow_v.x * v_aa + dL_drow_v.y * v_ab,
          dL_drow_u.x * u_ab + dL_drow_u.y * u_bb + dL_drow_v.x * v_ab + dL_drow_v.y * v_bb};
}

// A point on the plane of a model, with the Jacobian by the point in view space. shape: where the Jacobian is taken.
template <class S> struct PlanePoint {
  Vec2<S> at, shape;
  Mat23<S> jacobian;
  bool seen;
};

// What comes back to it. shape: by way of the Jacobian of the distortion.
template <class S> struct PlaneGradient {
  Vec2<S> at, shape;
  Mat23<S> jacobian;
};

template <class S> DSMOE_HD PlanePoint<S> perspective(const Lens<S>& lens, Vec3<S> view) {
  const S w = S(1) / view.z;
  const Vec2<S> at = {view.x * w, view.y * w};
  const Vec2<S> shape = {clamp(at.x, -lens.slope_limit.x, lens.slope_limit.x),
                         clamp(at.y, -lens.slope_limit.y, lens.slope_limit.y)};
  return {at,
          shape,
          {{w, S(0), -w * shape.x}, {S(0), w, -w * shape.y}},
          at.x * at.x + at.y * at.y < lens.range * lens.range};
}

template <class S> DSMOE_HD Vec3<S> perspective_backward(const Lens<S>& lens, Vec3<S> view, const PlaneGradient<S>& g) {
  const auto point = perspective(lens, view);
  const S w = point.jacobian.r0.x;
  Vec2<S> by_shape = {g.shape.x - w * g.jacobian.r0.z, g.shape.y - w * g.jacobian.r1.z};
  if (point.shape.x != point.at.x) by_shape.x = S(0);
  if (point.shape.y != point.at.y) by_shape.y = S(0);
  const Vec2<S> by_at = {g.at.x + by_shape.x, g.at.y + by_shape.y};
  const S by_w = g.jacobian.r0.x + g.jacobian.r1.y - point.shape.x * g.jacobian.r0.z - point.shape.y * g.jacobian.r1.z;
  return {w * by_at.x, w * by_at.y, -w * (w * by_w + point.at.x * by_at.x + point.at.y * by_at.y)};
}

// theta / rho, the angle to the axis over the distance from it, and its derivatives by rho^2.
template <class S> struct AnglePerDistance { S value, first, second; };

template <class S> DSMOE_HD AnglePerDistance<S> angle_per_distance(S squared_rho, S z, S squared_norm) {
  // Near the axis the closed form is 0 / 0, so the series of atan stands in. Six terms leave less than 1e-13.
  if (z > S(0) && squared_rho < S(1.0 / 128) * z * z) {
    const S w = S(1) / z, w2 = w * w, e = squared_rho * w2;
    const S value = S(1) - e * (S(1.0 / 3) - e * (S(1.0 / 5) - e * (S(1.0 / 7) - e * (S(1.0 / 9) - e * S(1.0 / 11)))));
    const S first =
        -S(1.0 / 3) + e * (S(2.0 / 5) - e * (S(3.0 / 7) - e * (S(4.0 / 9) - e * (S(5.0 / 11) - e * S(6.0 / 13)))));
    const S second =
        S(2.0 / 5) - e * (S(6.0 / 7) - e * (S(12.0 / 9) - e * (S(20.0 / 11) - e * (S(30.0 / 13) - e * S(42.0 / 15)))));
    return {w * value, w * w2 * first, w * w2 * w2 * second};
  }
  const S rho = sqrt(squared_rho), value = atan2(rho, z) / rho, cosine = z / squared_norm;
  const S half = S(0.5) / squared_rho, first = (cosine - value) * half;
  return {value, first, -(cosine / squared_norm + S(3) * first) * half};
}

template <class S> DSMOE_HD PlanePoint<S> equidistant(const Lens<S>& lens, Vec3<S> view) {
  const S x = view.x, y = view.y, squared_rho = x * x + y * y, squared_norm = squared_rho + view.z * view.z;
  const auto t = angle_per_distance(squared_rho, view.z, squared_norm);
  const S t1 = S(2) * t.first, by_z = S(-1) / squared_norm;
  const Vec2<S> at = {x * t.value, y * t.value};
  return {at,
          at,
          {{t.value + x * x * t1, x * y * t1, x * by_z}, {x * y * t1, t.value + y * y * t1, y * by_z}},
          at.x * at.x + at.y * at.y < lens.range * lens.range};
}

template <class S> DSMOE_HD Vec3<S> equidistant_backward(Vec3<S> view, const PlaneGradient<S>& g) {
  const S x = view.x, y = view.y, squared_rho = x * x + y * y, squared_norm = squared_rho + view.z * view.z;
  const auto t = angle_per_distance(squared_rho, view.z, squared_norm);
  const S t1 = S(2) * t.first, by_z = S(-1) / squared_norm;
  const S at_x = g.at.x + g.shape.x, at_y = g.at.y + g.shape.y;
  const Vec3<S>&gx = g.jacobian.r0, &gy = g.jacobian.r1;
  const S mixed = gx.y + gy.x;
  // By t, by its derivative in rho^2 (times two), and by that in z.
  const S by_t = at_x * x + at_y * y + gx.x + gy.y, by_t1 = x * x * gx.x + x * y * mixed + y * y * gy.y;
  const S by_tz = x * gx.z + y * gy.z;
  const S t_zz = S(2) * view.z * by_z * by_z, t_sz = by_z * by_z;
  const S by_s = by_t * t.first + by_t1 * S(2) * t.second + by_tz * t_sz;
  return {at_x * t.value + t1 * (S(2) * x * gx.x + y * mixed) + by_z * gx.z + S(2) * x * by_s,
          at_y * t.value + t1 * (S(2) * y * gy.y + x * mixed) + by_z * gy.z + S(2) * y * by_s,
          by_t * by_z + by_t1 * S(2) * t_sz + by_tz * t_zz};
}

// Longitude, 0 along z and growing to the right, and latitude, growing downwards.
template <class S> DSMOE_HD PlanePoint<S> equirectangular(Vec3<S> view) {
  const S x = view.x, y = view.y, z = view.z, h2 = x * x + z * z, h = sqrt(h2), n = h2 + y * y;
  const S by_h = -y / n, inverse = S(1) / h;
  const Vec2<S> at = {atan2(x, z), atan2(y, h)};
  return {
      at, at, {{z / h2, S(0), -x / h2}, {by_h * x * inverse, h / n, by_h * z * inverse}}, h2 > S(kPole * kPole) * n};
}

template <class S> DSMOE_HD Vec3<S> equirectangular_backward(Vec3<S> view, const PlaneGradient<S>& g) {
  const S x = view.x, y = view.y, z = view.z, h2 = x * x + z * z, h = sqrt(h2), n = h2 + y * y;
  const S inverse = S(1) / h, inverse2 = S(1) / h2, inverse_n = S(1) / n;
  const S sine = x * inverse, cosine = z * inverse;  // of the longitude
  const S by_longitude = g.at.x + g.shape.x, by_latitude = g.at.y + g.shape.y;
  const Vec3<S>&lon = g.jacobian.r0, &lat = g.jacobian.r1;
  // Of the longitude: its second derivatives are those of the angle of (z, x).
  const S double_sine = S(2) * sine * cosine, double_cosine = cosine * cosine - sine * sine;
  S dx = inverse * cosine * by_longitude - inverse2 * (double_sine * lon.x + double_cosine * lon.z);
  S dz = -inverse * sine * by_longitude + inverse2 * (double_sine * lon.z - double_cosine * lon.x);
  // Of the latitude, first as a function of h and y.
  const S by_h = -y * inverse_n, by_y = h * inverse_n;
  const S hh = S(-2) * by_h * by_y, hy = by_h * by_h - by_y * by_y;  // yy is -hh
  const S radial = sine * lat.x + cosine * lat.z, around = cosine * lat.x - sine * lat.z;
  const S dh = by_latitude * by_h + radial * hh + lat.y * hy, turn = by_h * inverse * around;
  dx += sine * dh + cosine * turn;
  dz += cosine * dh - sine * turn;
  return {dx, by_latitude * by_y + radial * hy - lat.y * hh, dz};
}

// A point in view space on the image.
template <class S> struct LensPoint {
  Vec2<S> pixel;      // pixel centres are integers
  Mat23<S> jacobian;  // pixels, by view coordinates
  bool seen;          // whether the lens sees it; else the rest means nothing
};

template <class S> DSMOE_HD PlanePoint<S> plane_point(const Lens<S>& lens, Vec3<S> view) {
  if (lens.model == LensModel::kOpencv) return perspective(lens, view);
  if (lens.model == LensModel::kEquirectangular) return equirectangular(view);
  if (lens.model != LensModel::kOrthographic) return equidistant(lens, view);
  return {{view.x, view.y}, {view.x, view.y}, {{S(1), S(0), S(0)}, {S(0), S(1), S(0)}}, true};
}

template <class S> DSMOE_HD Vec3<S> plane_point_backward(const Lens<S>& lens, Vec3<S> view, const PlaneGradient<S>& g) {
  if (lens.model == LensModel::kOpencv) return perspective_backward(lens, view, g);
  if (lens.model == LensModel::kEquirectangular) return equirectangular_backward(view, g);
  if (lens.model != LensModel::kOrthographic) return equidistant_backward(view, g);
  return {g.at.x + g.shape.x, g.at.y + g.shape.y, S(0)};
}

// The distortion at a plane's point, and where its Jacobian is taken.
template <class S> struct DistortedPoint { Distorted<S> at, shape; };

template <class S> DSMOE_HD DistortedPoint<S> distorted(const Lens<S>& lens, const PlanePoint<S>& plane) {
  const auto at = distort(lens.distortion, plane.at);
  if (plane.shape.x == plane.at.x && plane.shape.y == plane.at.y) return {at, at};
  return {at, distort(lens.distortion, plane.shape)};
}

template <class S> DSMOE_HD LensPoint<S> through_lens(const Lens<S>& lens, Vec3<S> view) {
  const auto plane = plane_point(lens, view);
  const auto [at, shape] = distorted(lens, plane);
  const Mat23<S>& j = plane.jacobian;
  return {{lens.focal.x * at.at.x + lens.principal.x, lens.focal.y * at.at.y + lens.principal.y},
          {lens.focal.x * (shape.row_u.x * j.r0 + shape.row_u.y * j.r1),
           lens.focal.y * (shape.row_v.x * j.r0 + shape.row_v.y * j.r1)},
          plane.seen};
}

template <class S>
DSMOE_HD Vec3<S> through_lens_backward(const Lens<S>& lens, Vec3<S> view, Vec2<S> dL_dpixel,
                                       const Mat23<S>& dL_djacobian) {
  const auto plane = plane_point(lens, view);
  const auto [at, shape] = distorted(lens, plane);
  const Vec3<S> u = lens.focal.x * dL_djacobian.r0, v = lens.focal.y * dL_djacobian.r1;
  const S by_u = lens.focal.x * dL_dpixel.x, by_v = lens.focal.y * dL_dpixel.y;
  PlaneGradient<S> g;
  g.at = {by_u * at.row_u.x + by_v * at.row_v.x, by_u * at.row_u.y + by_v * at.row_v.y};
  g.jacobian = {shape.row_u.x * u + shape.row_v.x * v, shape.row_u.y * u + shape.row_v.y * v};
  const Mat23<S>& j = plane.jacobian;
  g.shape = distortion_jacobian_backward<S>(lens.distortion, plane.shape, {dot(u, j.r0), dot(u, j.r1)},
                                            {dot(v, j.r0), dot(v, j.r1)});
  return plane_point_backward(lens, view, g);
}

// A pixel along an axis of the image, and its gradient by the point in view space: of the pixel itself, also where the
// Jacobian above is taken at another slope.
template <class S> struct AlongAxis {
  S at;
  Vec3<S> gradient;
};

template <class S> DSMOE_HD AlongAxis<S> along_axis(const Lens<S>& lens, Vec3<S> view, Vec2<S> axis) {
  const auto plane = plane_point(lens, view);
  Mat23<S> j = plane.jacobian;
  if (lens.model == LensModel::kOpencv) j.r0.z = -j.r0.x * plane.at.x, j.r1.z = -j.r1.y * plane.at.y;
  const auto to = distort(lens.distortion, plane.at);
  const S u = axis.x * lens.focal.x, v = axis.y * lens.focal.y;
  return {u * to.at.x + v * to.at.y + axis.x * lens.principal.x + axis.y * lens.principal.y,
          (u * to.row_u.x + v * to.row_v.x) * j.r0 + (u * to.row_u.y + v * to.row_v.y) * j.r1};
}

// What a calibration says of a lens.
struct LensCalibration {
  LensModel model = LensModel::kPinhole;
  int width = 0, height = 0;  // pixels
  double fx = 0, fy = 0;  // focal lengths, pixels; orthographic: pixels by unit of length. Equirectangular: not read
  double cx = 0, cy = 0;  // principal point, pixels; the centre of the first pixel is (0.5, 0.5). Likewise
  // kOpencv: k1 k2 p1 p2 k3 k4 k5 k6 s1 s2 s3 s4, as OpenCV has them: none, 1, 2, 4, 5, 8 or 12.
  // kFisheye: k1 k2 k3 k4: none, 1, 2 or 4. kThinPrismFisheye: k1 k2 p1 p2 k3 k4 sx1 sy1, as COLMAP has them: none
  // or 8.
  std::vector<double> distortion;
};
constexpr int kMostDistortion = 12;

namespace lens_making {

template <class... Parts> [[noreturn]] void refuse_lens(const LensCalibration& of, const Parts&... parts) {
  std::ostringstream message;
  message << "lens_of: ";
  (message << ... << parts);
  message << " (camera_model " << kLensNames[static_cast<int>(of.model)] << ")";
  throw std::invalid_argument(message.str());
}

inline void check_count(const LensCalibration& of, std::initializer_list<size_t> allowed, const char* names) {
  for (const size_t count : allowed) {
    if (of.distortion.size() == count) return;
  }
  refuse_lens(of, "distortion has ", of.distortion.size(), " numbers; it must have ", names);
}

inline Distortion<double> distortion_of(const LensCalibration& of) {
  Distortion<double> d;
  const auto at = [&](size_t i) { return i < of.distortion.size() ? of.distortion[i] : 0.0; };
  switch (of.model) {
    case LensModel::kOpencv:
      check_count(of, {0, 1, 2, 4, 5, 8, 12}, "0, 1, 2, 4, 5, 8 or 12: k1 k2 p1 p2 k3 k4 k5 k6 s1 s2 s3 s4");
      d = {{at(0), at(1), at(4), 0}, {at(5), at(6), at(7)}, {at(2), at(3)}, {at(8), at(9), at(10), at(11)}};
      break;
    case LensModel::kFisheye:
      check_count(of, {0, 1, 2, 4}, "0, 1, 2 or 4: k1 k2 k3 k4");
      d = {{at(0), at(1), at(2), at(3)}, {}, {}, {}};
      break;
    case LensModel::kThinPrismFisheye:  // COLMAP multiplies p1 and p2 as OpenCV does
      check_count(of, {0, 8}, "0 or 8: k1 k2 p1 p2 k3 k4 sx1 sy1");
      d = {{at(0), at(1), at(4), at(5)}, {}, {at(2), at(3)}, {at(6), 0, at(7), 0}};
      break;
    default:
      check_count(of, {0}, "0");
  }
  for (size_t i = 0; i < of.distortion.size(); ++i) {
    if (!is_finite(of.distortion[i])) {
      refuse_lens(of, "distortion[", i, "] is ", of.distortion[i], "; it must be finite");
    }
  }
  return d;
}

// Whether the distorted radius r R still rises at r, by its radial part.
inline bool rises(const Distortion<double>& d, double r) {
  const double q = r * r, *m = d.denominator;
  const auto radial = radial_of(d, q);
  return 1 + q * (m[0] + q * (m[1] + q * m[2])) > 0 && radial.value + 2 * q * radial.first > 0;
}

// The least radius at which it stops, or `end`. The radius is looked for by its angle, which ends.
inline double range_of(const Distortion<double>& d, double end, bool slopes) {
  const auto radius = [&](double angle) { return slopes ? std::tan(angle) : angle; };
  const double last = slopes ? std::atan(end) : end;
  constexpr int kSteps = 512;
  for (int i = 1; i <= kSteps; ++i) {
    double low = last * (i - 1) / kSteps, high = last * i / kSteps;
    if (rises(d, radius(high))) continue;
    for (int step = 0; step < 60; ++step) {
      const double middle = (low + high) / 2;
      (rises(d, radius(middle)) ? low : high) = middle;
    }
    return radius(low);
  }
  return end;
}

// The undistorted radius over the distorted one, r. The undistorted one is at most `range`.
inline double stretch(const Distortion<double>& d, double range, double r) {
  double low = 0, high = range;
  for (int step = 0; step < 80; ++step) {
    const double middle = (low + high) / 2;
    (middle * radial_of(d, middle * middle).value < r ? low : high) = middle;
  }
  return low / r;
}

}  // namespace lens_making

// Slopes end here: a point this far off the axis is 0.06 degrees from the plane of the camera.
constexpr double kMostSlope = 1e3;

// The lens of a calibration. Throws std::invalid_argument for what cannot be one.
inline Lens<double> lens_of(const LensCalibration& of) {
  using namespace lens_making;
  const int model = static_cast<int>(of.model);
  if (model < 0 || model >= kNumLensModels) {
    throw std::invalid_argument("lens_of: camera_model is " + std::to_string(model) + "; it must be 0 to " +
                                std::to_string(kNumLensModels - 1));
  }
  Lens<double> lens;
  lens.model = of.model;
  const Distortion<double>& d = lens.distortion = distortion_of(of);
  if (of.model == LensModel::kPinhole) return lens;
  double fx = of.fx, fy = of.fy, cx = of.cx, cy = of.cy;
  if (of.model == LensModel::kEquirectangular) {
    constexpr double kPi = 3.14159265358979323846;
    fx = of.width / (2 * kPi), fy = of.height / kPi, cx = 0.5 * of.width, cy = 0.5 * of.height;
  }
  const auto is_positive = [](double x) { return x > 0 && is_finite(x); };
  if (!is_positive(fx) || !is_positive(fy)) {
    refuse_lens(of, "the focal lengths are ", fx, " and ", fy, "; they must be positive and finite");
  }
  if (!is_finite(cx) || !is_finite(cy)) {
    refuse_lens(of, "principal_point is ", cx, ", ", cy, "; it must be finite");
  }
  lens.focal = {fx, fy}, lens.principal = {cx - 0.5, cy - 0.5};
  const bool slopes = of.model == LensModel::kOpencv;
  if (!slopes && of.model != LensModel::kFisheye && of.model != LensModel::kThinPrismFisheye) return lens;
  const double range = range_of(d, slopes ? kMostSlope : kFisheyeEnd, slopes);
  lens.range = range;
  const double distorted = range * radial_of(d, range * range).value;
  if (!(distorted * std::fmax(fx, fy) >= 1)) {  // not even a pixel of the image
    refuse_lens(of, "distortion folds the image back at ", distorted * std::fmax(fx, fy),
                " pixels from the principal point; it must rise over 1 or more");
  }
  if (slopes) {
    const double u = std::fmax(cx, of.width - cx) / fx, v = std::fmax(cy, of.height - cy) / fy;
    const double corner = stretch(d, range, std::hypot(u, v));
    lens.slope_limit = {kFrustumMargin * u * std::fmax(corner, stretch(d, range, u)),
                        kFrustumMargin * v * std::fmax(corner, stretch(d, range, v))};
  }
  return lens;
}

}  // namespace dsmoe

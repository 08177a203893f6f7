// Rolling shutters: each row, or column, of the image is taken at its own time, from 0 at the first to 1 at the last,
// and by the pose of that time. The matrices of two poses are mixed linearly. Each backward function stands below its
// forward. docs/method.md has the equations.
#pragma once

#include "dsmoe/camera.h"
#include "dsmoe/constants.h"
#include "dsmoe/lens.h"
#include "dsmoe/vec.h"

namespace dsmoe {

// Times end as far beyond the image as the slopes of a pinhole do. Beyond, the pose stands still.
constexpr double kFirstTime = 0.5 - 0.5 * kFrustumMargin, kLastTime = 0.5 + 0.5 * kFrustumMargin;
// Newton's steps to the time, from the middle of the image. Each doubles the digits. Where the image moves by 0.4 of
// its height, four leave less than 1e-11 pixels.
constexpr int kTimeSteps = 4;
// A point is culled if it moves along with the shutter at more than 0.9 of its speed, or if its time is not found to
// this many pixels of the readout and of its way: the shutter may see it twice, or never.
constexpr double kLeastShutterSpeed = 0.1, kMostTimeError = 0.1;

// Where on the image the time is: (dot(axis, pixel) - first) / length.
template <class S> struct Readout {
  Vec2<S> axis;
  S first, length;  // pixels

  DSMOE_HD explicit Readout(const Camera<S>& camera) {
    const bool columns = camera.shutter == Shutter::kLeftToRight || camera.shutter == Shutter::kRightToLeft;
    const bool back = camera.shutter == Shutter::kBottomToTop || camera.shutter == Shutter::kRightToLeft;
    const S sign = back ? S(-1) : S(1);
    length = S(max(1, (columns ? camera.width : camera.height) - 1));
    axis = {columns ? sign : S(0), columns ? S(0) : sign};
    first = back ? -length : S(0);
  }

  DSMOE_HD S along(Vec2<S> pixel) const { return axis.x * pixel.x + axis.y * pixel.y; }
};

template <class S> DSMOE_HD Mat3<S> between(const Mat3<S>& a, const Mat3<S>& b, S time) {
  return {a.r0 + time * (b.r0 - a.r0), a.r1 + time * (b.r1 - a.r1), a.r2 + time * (b.r2 - a.r2)};
}

// When a point is seen, and where it then is.
template <class S> struct ShutterTime {
  S time;
  bool moves;            // false: the time is beyond the image, and at its limit
  Vec3<S> view, motion;  // in view space; the derivative of that by the time
};

template <class S>
DSMOE_HD ShutterTime<S> shutter_time(const Camera<S>& camera, const Readout<S>& readout, Vec3<S> mean) {
  ShutterTime<S> out;
  const Vec3<S> start = transform_point(camera.view, mean);
  out.motion = transform_point(camera.view_end, mean) - start;
  out.time = S(0.5);
  const S least = S(kLeastShutterSpeed) * readout.length;
  for (int step = 0; step < kTimeSteps; ++step) {
    const auto pixel = along_axis(camera.lens, start + out.time * out.motion, readout.axis);
    const S late = pixel.at - readout.first - out.time * readout.length;
    out.time += late / max(least, readout.length - dot(pixel.gradient, out.motion));
    out.time = clamp(out.time, S(kFirstTime), S(kLastTime));
  }
  out.moves = out.time > S(kFirstTime) && out.time < S(kLastTime);
  out.view = start + out.time * out.motion;
  return out;
}

// What comes back to a point at a fixed time, and to its motion.
template <class S> struct MovingGradient { Vec3<S> view, motion; };

// What comes back to the point in the view spaces of both poses.
template <class S> struct PosesGradient { Vec3<S> start, end; };

// dL_drotation: by the rotation part of the pose at the time.
template <class S>
DSMOE_HD PosesGradient<S> shutter_time_backward(const Camera<S>& camera, const Readout<S>& readout,
                                                const ShutterTime<S>& of, const MovingGradient<S>& by,
                                                const Mat3<S>& dL_drotation) {
  Vec3<S> dL_dview = by.view;
  if (of.moves) {
    // The time is where length time = along(pixel) - first, so that its derivative is one by the point over what that
    // equation's sides differ by in speed.
    const Mat3<S> a = view_rotation(camera.view), b = view_rotation(camera.view_end);
    const S dL_dtime = dot(by.view, of.motion) + dot(dL_drotation.r0, b.r0 - a.r0) + dot(dL_drotation.r1, b.r1 - a.r1) +
                       dot(dL_drotation.r2, b.r2 - a.r2);
    const Vec3<S> gradient = along_axis(camera.lens, of.view, readout.axis).gradient;
    dL_dview = dL_dview + (dL_dtime / (readout.length - dot(gradient, of.motion))) * gradient;
  }
  return {(S(1) - of.time) * dL_dview - by.motion, of.time * dL_dview + by.motion};
}

// A point of that time on the image. The Jacobian is that of the rolling image: J + v (axis^T J) / (length - axis^T v),
// where J is the lens's and v = J motion is the pixel's velocity. So what moves with the shutter is stretched.
template <class S> struct ShutterPoint : LensPoint<S> {
  Mat23<S> still;    // J
  Vec2<S> velocity;  // v
  S inverse_speed;   // 1 / (length - axis^T v); 0 if the pose stands still
};

template <class S>
DSMOE_HD ShutterPoint<S> through_shutter(const Lens<S>& lens, const Readout<S>& readout, const ShutterTime<S>& of) {
  ShutterPoint<S> out;
  static_cast<LensPoint<S>&>(out) = through_lens(lens, of.view);
  const Mat23<S> j = out.still = out.jacobian;
  out.velocity = {dot(j.r0, of.motion), dot(j.r1, of.motion)};
  const S time = (readout.along(out.pixel) - readout.first) / readout.length;
  const S error = abs(clamp(time, S(kFirstTime), S(kLastTime)) - of.time);
  out.seen = out.seen && error * (readout.length + abs(out.velocity.x) + abs(out.velocity.y)) < S(kMostTimeError);
  out.inverse_speed = S(0);
  if (!of.moves) return out;
  const S speed = readout.length - readout.along(out.velocity);
  out.seen = out.seen && speed > S(kLeastShutterSpeed) * readout.length;
  out.inverse_speed = S(1) / speed;
  const Vec3<S> row = out.inverse_speed * (readout.axis.x * j.r0 + readout.axis.y * j.r1);
  out.jacobian = {j.r0 + out.velocity.x * row, j.r1 + out.velocity.y * row};
  return out;
}

template <class S>
DSMOE_HD MovingGradient<S> through_shutter_backward(const Lens<S>& lens, const Readout<S>& readout,
                                                    const ShutterTime<S>& of, const ShutterPoint<S>& point,
                                                    Vec2<S> dL_dpixel, Mat23<S> dL_djacobian) {
  const Mat23<S>& j = point.still;
  const S q = point.inverse_speed;
  const Vec2<S> v = point.velocity, axis = readout.axis;
  const Vec3<S> row = axis.x * j.r0 + axis.y * j.r1;
  const Vec3<S> by_row = v.x * dL_djacobian.r0 + v.y * dL_djacobian.r1;
  const S by_x = q * dot(dL_djacobian.r0, row), by_y = q * dot(dL_djacobian.r1, row);
  const S by_speed = q * (v.x * by_x + v.y * by_y);
  const Vec2<S> by_v = {by_x + by_speed * axis.x, by_y + by_speed * axis.y};
  dL_djacobian.r0 = dL_djacobian.r0 + q * axis.x * by_row + by_v.x * of.motion;
  dL_djacobian.r1 = dL_djacobian.r1 + q * axis.y * by_row + by_v.y * of.motion;
  return {through_lens_backward(lens, of.view, dL_dpixel, dL_djacobian), by_v.x * j.r0 + by_v.y * j.r1};
}

}  // namespace dsmoe

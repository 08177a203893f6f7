// The camera: from world points to view space and to pixels, each backward under its forward.
#pragma once

#include "dsmoe/constants.h"
#include "dsmoe/vec.h"

namespace dsmoe {

// Matrices as the trainers pass them: element [4 * row + column] of the transposed matrix, so that a point is a row
// vector to its left. view: world to view; projection: world to clip, principal point included.
template <class S> struct Camera {
  int width = 0, height = 0;       // pixels
  S tan_fov_x = 0, tan_fov_y = 0;  // tan of half the field of view
  S view[16] = {};                 // [4, 4]
  S projection[16] = {};           // [4, 4]
  S position[3] = {};              // world
  S near = S(0.2);                 // view depth; nearer Gaussians are culled
};

template <class S> struct CameraGradient {
  S view[16] = {};
  S projection[16] = {};
  S position[3] = {};
};

template <class S> DSMOE_HD Vec3<S> transform_point(const S* m, Vec3<S> p) {
  return {m[0] * p.x + m[4] * p.y + m[8] * p.z + m[12], m[1] * p.x + m[5] * p.y + m[9] * p.z + m[13],
          m[2] * p.x + m[6] * p.y + m[10] * p.z + m[14]};
}

// Adds to dL_dm where it is given; returns dL/dp.
template <class S> DSMOE_HD Vec3<S> transform_point_backward(const S* m, Vec3<S> p, Vec3<S> dL_dout, S* dL_dm) {
  if (dL_dm != nullptr) {
    const S point[4] = {p.x, p.y, p.z, S(1)};
    for (int i = 0; i < 4; ++i) {
      dL_dm[4 * i + 0] += point[i] * dL_dout.x;
      dL_dm[4 * i + 1] += point[i] * dL_dout.y;
      dL_dm[4 * i + 2] += point[i] * dL_dout.z;
    }
  }
  return {m[0] * dL_dout.x + m[1] * dL_dout.y + m[2] * dL_dout.z,
          m[4] * dL_dout.x + m[5] * dL_dout.y + m[6] * dL_dout.z,
          m[8] * dL_dout.x + m[9] * dL_dout.y + m[10] * dL_dout.z};
}

// The rotation part of the world-to-view matrix.
template <class S> DSMOE_HD Mat3<S> view_rotation(const S* m) {
  return {{m[0], m[4], m[8]}, {m[1], m[5], m[9]}, {m[2], m[6], m[10]}};
}

template <class S> DSMOE_HD void view_rotation_backward(const Mat3<S>& dL_drotation, S* dL_dm) {
  dL_dm[0] += dL_drotation.r0.x, dL_dm[4] += dL_drotation.r0.y, dL_dm[8] += dL_drotation.r0.z;
  dL_dm[1] += dL_drotation.r1.x, dL_dm[5] += dL_drotation.r1.y, dL_dm[9] += dL_drotation.r1.z;
  dL_dm[2] += dL_drotation.r2.x, dL_dm[6] += dL_drotation.r2.y, dL_dm[10] += dL_drotation.r2.z;
}

// World to pixel coordinates; pixel centres are integers, NDC -1 and 1 are the outer edges of the border pixels.
template <class S> DSMOE_HD Vec2<S> project_to_pixel(const Camera<S>& camera, Vec3<S> p) {
  const S* m = camera.projection;
  const Vec3<S> clip = transform_point(m, p);
  const S w = m[3] * p.x + m[7] * p.y + m[11] * p.z + m[15];
  const S inverse_w = S(1) / (w + S(kHomogeneousEpsilon));
  return {((clip.x * inverse_w + S(1)) * S(camera.width) - S(1)) * S(0.5),
          ((clip.y * inverse_w + S(1)) * S(camera.height) - S(1)) * S(0.5)};
}

// Adds to dL_dprojection where it is given; returns dL/dp.
template <class S>
DSMOE_HD Vec3<S> project_to_pixel_backward(const Camera<S>& camera, Vec3<S> p, Vec2<S> dL_dpixel, S* dL_dprojection) {
  const S* m = camera.projection;
  const Vec3<S> clip = transform_point(m, p);
  const S w = m[3] * p.x + m[7] * p.y + m[11] * p.z + m[15];
  const S inverse_w = S(1) / (w + S(kHomogeneousEpsilon));
  const S dL_dx = dL_dpixel.x * S(0.5) * S(camera.width) * inverse_w;
  const S dL_dy = dL_dpixel.y * S(0.5) * S(camera.height) * inverse_w;
  const S dL_dw = -(dL_dx * clip.x + dL_dy * clip.y) * inverse_w;
  if (dL_dprojection != nullptr) {
    const S point[4] = {p.x, p.y, p.z, S(1)};
    for (int i = 0; i < 4; ++i) {
      dL_dprojection[4 * i + 0] += point[i] * dL_dx;
      dL_dprojection[4 * i + 1] += point[i] * dL_dy;
      dL_dprojection[4 * i + 3] += point[i] * dL_dw;
    }
  }
  return {m[0] * dL_dx + m[1] * dL_dy + m[3] * dL_dw, m[4] * dL_dx + m[5] * dL_dy + m[7] * dL_dw,
          m[8] * dL_dx + m[9] * dL_dy + m[11] * dL_dw};
}

}  // namespace dsmoe

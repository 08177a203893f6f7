// The camera: from world points to view space and to pixels. Each backward function stands below its forward.
#pragma once

#include <array>

#include "dsmoe/constants.h"
#include "dsmoe/lens.h"
#include "dsmoe/vec.h"

namespace dsmoe {

// Matrices are transposed, as the trainers pass them: a point is a row vector, to the left of the matrix. They are
// stored row by row. view: world to view. projection: world to clip, with the principal point.
template <class S> struct PinholeCamera {
  int width = 0, height = 0;       // pixels
  S tan_fov_x = 0, tan_fov_y = 0;  // tan of half the field of view
  S view[16] = {};                 // [4, 4]
  S projection[16] = {};           // [4, 4]
  S position[3] = {};              // world
  S near = S(0.2);                 // view depth; nearer Gaussians are culled
};

// With a lens other than a pinhole, neither the tangents nor `projection` are read: all of the pose is in `view`.
template <class S> struct LensCamera : PinholeCamera<S> { Lens<S> lens; };

// How an image is read out: at once, or by rows or columns in this order.
enum class Shutter : int { kGlobal, kTopToBottom, kLeftToRight, kBottomToTop, kRightToLeft };
constexpr const char* kShutterNames[] = {"global", "top_to_bottom", "left_to_right", "bottom_to_top", "right_to_left"};
constexpr int kNumShutters = sizeof(kShutterNames) / sizeof(kShutterNames[0]);

// With a rolling shutter `view` is the pose at the first row, or column, and the lens is not a pinhole: one without
// distortion is kOpencv.
template <class S> struct Camera : LensCamera<S> {
  Shutter shutter = Shutter::kGlobal;
  S view_end[16] = {};  // [4, 4] the pose at the last row. Only read with a rolling shutter
};

// A calibrated pinhole camera. View axes are x right, y down, z forward. The centre of the top left pixel is
// (0.5, 0.5), as in COLMAP.
struct Pinhole {
  int width = 0, height = 0;               // pixels
  double fx = 0, fy = 0;                   // focal lengths, pixels
  double cx = 0, cy = 0;                   // principal point, pixels
  std::array<double, 9> rotation = {};     // [3, 3] world to view, by rows
  std::array<double, 3> translation = {};  // x_view = rotation x_world + translation
};

// Clip range of a pinhole camera's projection. Nothing reads clip z, as culling is by view depth: it only is finite.
constexpr double kClipNear = 0.01, kClipFar = 100;

// The camera that the rasterizer takes. `near` is the caller's.
template <class S> Camera<S> pinhole_camera(const Pinhole& of) {
  Camera<S> camera;
  camera.width = of.width, camera.height = of.height;
  camera.tan_fov_x = S(of.width / (2 * of.fx)), camera.tan_fov_y = S(of.height / (2 * of.fy));
  // project_to_pixel puts NDC x at the pixel index ((x + 1) width - 1) / 2. A point at fx X / Z + cx, half a pixel
  // above its index, therefore has x = 2 fx / width X / Z + 2 cx / width - 1.
  constexpr double kDepth = kClipFar / (kClipFar - kClipNear);
  const double clip[4][4] = {{2 * of.fx / of.width, 0, 2 * of.cx / of.width - 1, 0},
                             {0, 2 * of.fy / of.height, 2 * of.cy / of.height - 1, 0},
                             {0, 0, kDepth, -kClipNear * kDepth},
                             {0, 0, 1, 0}};
  const std::array<double, 9>& r = of.rotation;
  const std::array<double, 3>& t = of.translation;
  const double view[4][4] = {
      {r[0], r[1], r[2], t[0]}, {r[3], r[4], r[5], t[1]}, {r[6], r[7], r[8], t[2]}, {0, 0, 0, 1}};
  for (int row = 0; row < 4; ++row) {
    for (int column = 0; column < 4; ++column) {
      double product = 0;
      for (int k = 0; k < 4; ++k) product += clip[row][k] * view[k][column];
      camera.view[4 * column + row] = S(view[row][column]);
      camera.projection[4 * column + row] = S(product);
    }
  }
  for (int axis = 0; axis < 3; ++axis) {
    camera.position[axis] = S(-(r[axis] * t[0] + r[3 + axis] * t[1] + r[6 + axis] * t[2]));
  }
  return camera;
}

// What one Gaussian adds to the gradient of its camera: vectors, from which CameraGradient makes the matrices.
template <class S> struct CameraShare {
  Vec3<S> point;         // the Gaussian's mean, world
  Vec3<S> dL_dview;      // by the point in view space
  Mat3<S> dL_drotation;  // by the rotation part of the view matrix
  Vec3<S> dL_dclip;      // by x, y and w of the point in clip space
  Vec3<S> dL_dposition;
  Vec3<S> dL_dview_end;  // the same two by the pose at the end of a rolling shutter
  Mat3<S> dL_drotation_end;
};

template <class S> struct CameraGradient {
  S view[16] = {};
  S projection[16] = {};
  S position[3] = {};
  S view_end[16] = {};  // on a device only written with a rolling shutter

  DSMOE_HD void add(const CameraShare<S>& share) {
    const S point[4] = {share.point.x, share.point.y, share.point.z, S(1)};
    for (int i = 0; i < 4; ++i) {
      projection[4 * i + 0] += point[i] * share.dL_dclip.x;
      projection[4 * i + 1] += point[i] * share.dL_dclip.y;
      projection[4 * i + 3] += point[i] * share.dL_dclip.z;
    }
    add_pose(view, point, share.dL_dview, share.dL_drotation);
    add_pose(view_end, point, share.dL_dview_end, share.dL_drotation_end);
    position[0] += share.dL_dposition.x, position[1] += share.dL_dposition.y, position[2] += share.dL_dposition.z;
  }

  DSMOE_HD void add(const CameraGradient& other) {
    for (int k = 0; k < 16; ++k) view[k] += other.view[k], projection[k] += other.projection[k];
    for (int k = 0; k < 16; ++k) view_end[k] += other.view_end[k];
    for (int k = 0; k < 3; ++k) position[k] += other.position[k];
  }

 private:
  DSMOE_HD static void add_pose(S* to, const S* point, Vec3<S> dL_dview, const Mat3<S>& dL_drotation) {
    for (int i = 0; i < 4; ++i) {
      to[4 * i + 0] += point[i] * dL_dview.x;
      to[4 * i + 1] += point[i] * dL_dview.y;
      to[4 * i + 2] += point[i] * dL_dview.z;
    }
    const auto& [x, y, z] = dL_drotation;
    to[0] += x.x, to[4] += x.y, to[8] += x.z;
    to[1] += y.x, to[5] += y.y, to[9] += y.z;
    to[2] += z.x, to[6] += z.y, to[10] += z.z;
  }
};

template <class S> DSMOE_HD Vec3<S> transform_point(const S* m, Vec3<S> p) {
  return {m[0] * p.x + m[4] * p.y + m[8] * p.z + m[12], m[1] * p.x + m[5] * p.y + m[9] * p.z + m[13],
          m[2] * p.x + m[6] * p.y + m[10] * p.z + m[14]};
}

// Returns dL/dp. The gradient by the matrix is CameraGradient's affair.
template <class S> DSMOE_HD Vec3<S> transform_point_backward(const S* m, Vec3<S> dL_dout) {
  return {m[0] * dL_dout.x + m[1] * dL_dout.y + m[2] * dL_dout.z,
          m[4] * dL_dout.x + m[5] * dL_dout.y + m[6] * dL_dout.z,
          m[8] * dL_dout.x + m[9] * dL_dout.y + m[10] * dL_dout.z};
}

// The rotation part of the world-to-view matrix.
template <class S> DSMOE_HD Mat3<S> view_rotation(const S* m) {
  return {{m[0], m[4], m[8]}, {m[1], m[5], m[9]}, {m[2], m[6], m[10]}};
}

// 1 / w of a point in clip space. m: the projection.
template <class S> DSMOE_HD S inverse_clip_w(const S* m, Vec3<S> p) {
  return S(1) / (m[3] * p.x + m[7] * p.y + m[11] * p.z + m[15] + S(kHomogeneousEpsilon));
}

// World to pixel coordinates. Pixel centres are integers. NDC -1 and 1 are the outer edges of the border pixels.
template <class S> DSMOE_HD Vec2<S> project_to_pixel(const PinholeCamera<S>& camera, Vec3<S> p) {
  const S* m = camera.projection;
  const Vec3<S> clip = transform_point(m, p);
  const S inverse_w = inverse_clip_w(m, p);
  return {((clip.x * inverse_w + S(1)) * S(camera.width) - S(1)) * S(0.5),
          ((clip.y * inverse_w + S(1)) * S(camera.height) - S(1)) * S(0.5)};
}

template <class S> struct PixelGradient {
  Vec3<S> point;  // dL/dp
  Vec3<S> clip;   // by x, y and w of the point in clip space
};

template <class S>
DSMOE_HD PixelGradient<S> project_to_pixel_backward(const PinholeCamera<S>& camera, Vec3<S> p, Vec2<S> dL_dpixel) {
  const S* m = camera.projection;
  const Vec3<S> clip = transform_point(m, p);
  const S inverse_w = inverse_clip_w(m, p);
  const S dL_dx = dL_dpixel.x * S(0.5) * S(camera.width) * inverse_w;
  const S dL_dy = dL_dpixel.y * S(0.5) * S(camera.height) * inverse_w;
  const S dL_dw = -(dL_dx * clip.x + dL_dy * clip.y) * inverse_w;
  return {{m[0] * dL_dx + m[1] * dL_dy + m[3] * dL_dw, m[4] * dL_dx + m[5] * dL_dy + m[7] * dL_dw,
           m[8] * dL_dx + m[9] * dL_dy + m[11] * dL_dw},
          {dL_dx, dL_dy, dL_dw}};
}

}  // namespace dsmoe

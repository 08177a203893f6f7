// View-dependent colour from real spherical harmonics up to degree 3, backward under forward.
#pragma once

#include "dsmoe/vec.h"

namespace dsmoe {

constexpr int kMaxShDegree = 3;
constexpr int kMaxShCoefficients = 16;

DSMOE_HD constexpr int sh_coefficients(int degree) { return (degree + 1) * (degree + 1); }

// sqrt(1 / 4 pi), sqrt(3 / 4 pi), and the factors of degrees 2 and 3 in the field's order and signs.
constexpr double kSh0 = 0.28209479177387814;
constexpr double kSh1 = 0.4886025119029199;
constexpr double kSh2_0 = 1.0925484305920792;
constexpr double kSh2_1 = -1.0925484305920792;
constexpr double kSh2_2 = 0.31539156525252005;
constexpr double kSh2_3 = -1.0925484305920792;
constexpr double kSh2_4 = 0.5462742152960396;
constexpr double kSh3_0 = -0.5900435899266435;
constexpr double kSh3_1 = 2.890611442640554;
constexpr double kSh3_2 = -0.4570457994644658;
constexpr double kSh3_3 = 0.3731763325901154;
constexpr double kSh3_4 = -0.4570457994644658;
constexpr double kSh3_5 = 1.445305721320277;
constexpr double kSh3_6 = -0.5900435899266435;

template <class S> DSMOE_HD void sh_basis(int degree, Vec3<S> d, S* basis) {
  basis[0] = S(kSh0);
  if (degree < 1) return;
  const S x = d.x, y = d.y, z = d.z;
  basis[1] = -S(kSh1) * y;
  basis[2] = S(kSh1) * z;
  basis[3] = -S(kSh1) * x;
  if (degree < 2) return;
  const S xx = x * x, yy = y * y, zz = z * z;
  basis[4] = S(kSh2_0) * x * y;
  basis[5] = S(kSh2_1) * y * z;
  basis[6] = S(kSh2_2) * (S(2) * zz - xx - yy);
  basis[7] = S(kSh2_3) * x * z;
  basis[8] = S(kSh2_4) * (xx - yy);
  if (degree < 3) return;
  basis[9] = S(kSh3_0) * y * (S(3) * xx - yy);
  basis[10] = S(kSh3_1) * x * y * z;
  basis[11] = S(kSh3_2) * y * (S(4) * zz - xx - yy);
  basis[12] = S(kSh3_3) * z * (S(2) * zz - S(3) * xx - S(3) * yy);
  basis[13] = S(kSh3_4) * x * (S(4) * zz - xx - yy);
  basis[14] = S(kSh3_5) * z * (xx - yy);
  basis[15] = S(kSh3_6) * x * (xx - S(3) * yy);
}

// dL/dd from dL/dbasis.
template <class S> DSMOE_HD Vec3<S> sh_basis_backward(int degree, Vec3<S> d, const S* g) {
  Vec3<S> out = {S(0), S(0), S(0)};
  if (degree < 1) return out;
  const S x = d.x, y = d.y, z = d.z;
  out = {-S(kSh1) * g[3], -S(kSh1) * g[1], S(kSh1) * g[2]};
  if (degree < 2) return out;
  const S xx = x * x, yy = y * y, zz = z * z;
  const S g4 = S(kSh2_0) * g[4], g5 = S(kSh2_1) * g[5], g6 = S(kSh2_2) * g[6], g7 = S(kSh2_3) * g[7],
          g8 = S(kSh2_4) * g[8];
  out.x += g4 * y - S(2) * g6 * x + g7 * z + S(2) * g8 * x;
  out.y += g4 * x + g5 * z - S(2) * g6 * y - S(2) * g8 * y;
  out.z += g5 * y + S(4) * g6 * z + g7 * x;
  if (degree < 3) return out;
  const S g9 = S(kSh3_0) * g[9], g10 = S(kSh3_1) * g[10], g11 = S(kSh3_2) * g[11], g12 = S(kSh3_3) * g[12],
          g13 = S(kSh3_4) * g[13], g14 = S(kSh3_5) * g[14], g15 = S(kSh3_6) * g[15];
  out.x += S(6) * g9 * x * y + g10 * y * z - S(2) * g11 * x * y - S(6) * g12 * x * z +
           g13 * (S(4) * zz - S(3) * xx - yy) + S(2) * g14 * x * z + S(3) * g15 * (xx - yy);
  out.y += S(3) * g9 * (xx - yy) + g10 * x * z + g11 * (S(4) * zz - xx - S(3) * yy) - S(6) * g12 * y * z -
           S(2) * g13 * x * y - S(2) * g14 * y * z - S(6) * g15 * x * y;
  out.z += g10 * x * y + S(8) * g11 * y * z + g12 * (S(6) * zz - S(3) * xx - S(3) * yy) + S(8) * g13 * x * z +
           g14 * (xx - yy);
  return out;
}

// Where a Gaussian's coefficients lie: degree 0 apart from the rest, or all in one array (then dc == rest - 3 in
// effect).
template <class S> struct ShCoefficients {
  S* dc;    // [3]
  S* rest;  // [coefficients - 1, 3]
};

// The viewing direction; a Gaussian at the camera centre has none and is seen as degree 0 sees it.
template <class S> DSMOE_HD Vec3<S> view_direction(Vec3<S> mean, const S* position, S& inverse_length) {
  const Vec3<S> offset = mean - Vec3<S>{position[0], position[1], position[2]};
  const S squared = dot(offset, offset);
  inverse_length = squared > S(0) ? S(1) / sqrt(squared) : S(0);
  return inverse_length * offset;
}

// colour = 1/2 + sum_k basis_k sh_k, and with `clamp` max(0, that)
template <class S>
DSMOE_HD void sh_color(int degree, Vec3<S> mean, const S* position, ShCoefficients<const S> sh, bool clamp, S* color) {
  S inverse_length, basis[kMaxShCoefficients];
  sh_basis(degree, view_direction(mean, position, inverse_length), basis);
  for (int c = 0; c < 3; ++c) color[c] = S(0.5) + basis[0] * sh.dc[c];
  for (int k = 1; k < sh_coefficients(degree); ++k) {
    for (int c = 0; c < 3; ++c) color[c] += basis[k] * sh.rest[3 * (k - 1) + c];
  }
  for (int c = 0; c < 3; ++c) color[c] = clamp && color[c] < S(0) ? S(0) : color[c];  // NaN stays, and is culled
}

// Writes dL/dsh for the active degree, where the outputs are given; returns dL/dmean (dL/dposition is its negative).
// color is the forward's result: with `clamp` 0 means clamped, and a clamped channel passes no gradient.
template <class S>
DSMOE_HD Vec3<S> sh_color_backward(int degree, Vec3<S> mean, const S* position, ShCoefficients<const S> sh, bool clamp,
                                   const S* color, const S* dL_dcolor, ShCoefficients<S> dL_dsh) {
  S inverse_length, basis[kMaxShCoefficients], dL_dbasis[kMaxShCoefficients];
  const Vec3<S> direction = view_direction(mean, position, inverse_length);
  sh_basis(degree, direction, basis);
  S g[3];
  for (int c = 0; c < 3; ++c) g[c] = !clamp || color[c] > S(0) ? dL_dcolor[c] : S(0);
  if (dL_dsh.dc != nullptr) {
    for (int c = 0; c < 3; ++c) dL_dsh.dc[c] = basis[0] * g[c];
  }
  dL_dbasis[0] = S(0);
  for (int k = 1; k < sh_coefficients(degree); ++k) {
    const S* row = sh.rest + 3 * (k - 1);
    dL_dbasis[k] = row[0] * g[0] + row[1] * g[1] + row[2] * g[2];
    if (dL_dsh.rest != nullptr) {
      for (int c = 0; c < 3; ++c) dL_dsh.rest[3 * (k - 1) + c] = basis[k] * g[c];
    }
  }
  const Vec3<S> dL_ddirection = sh_basis_backward(degree, direction, dL_dbasis);
  // d(v / |v|) = (I - n n^T) / |v|
  return inverse_length * (dL_ddirection - dot(dL_ddirection, direction) * direction);
}

}  // namespace dsmoe

// View-dependent colour from real spherical harmonics up to degree 3. Each backward function stands below its forward.
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
constexpr double kSh2_1 = -kSh2_0;
constexpr double kSh2_2 = 0.31539156525252005;
constexpr double kSh2_3 = -kSh2_0;
constexpr double kSh2_4 = 0.5462742152960396;
constexpr double kSh3_0 = -0.5900435899266435;
constexpr double kSh3_1 = 2.890611442640554;
constexpr double kSh3_2 = -0.4570457994644658;
constexpr double kSh3_3 = 0.3731763325901154;
constexpr double kSh3_4 = kSh3_2;
constexpr double kSh3_5 = 1.445305721320277;
constexpr double kSh3_6 = kSh3_0;

// One number per coefficient. Those above the degree in use mean nothing.
template <class S> struct ShNumbers {
  S values[kMaxShCoefficients];
  DSMOE_HD S& operator[](int k) { return values[k]; }
  DSMOE_HD S operator[](int k) const { return values[k]; }
};

template <class S> DSMOE_HD ShNumbers<S> sh_basis(int degree, Vec3<S> d) {
  ShNumbers<S> basis;
  basis[0] = S(kSh0);
  if (degree < 1) return basis;
  const S x = d.x, y = d.y, z = d.z;
  basis[1] = -S(kSh1) * y;
  basis[2] = S(kSh1) * z;
  basis[3] = -S(kSh1) * x;
  if (degree < 2) return basis;
  const S xx = x * x, yy = y * y, zz = z * z;
  basis[4] = S(kSh2_0) * x * y;
  basis[5] = S(kSh2_1) * y * z;
  basis[6] = S(kSh2_2) * (S(2) * zz - xx - yy);
  basis[7] = S(kSh2_3) * x * z;
  basis[8] = S(kSh2_4) * (xx - yy);
  if (degree < 3) return basis;
  basis[9] = S(kSh3_0) * y * (S(3) * xx - yy);
  basis[10] = S(kSh3_1) * x * y * z;
  basis[11] = S(kSh3_2) * y * (S(4) * zz - xx - yy);
  basis[12] = S(kSh3_3) * z * (S(2) * zz - S(3) * xx - S(3) * yy);
  basis[13] = S(kSh3_4) * x * (S(4) * zz - xx - yy);
  basis[14] = S(kSh3_5) * z * (xx - yy);
  basis[15] = S(kSh3_6) * x * (xx - S(3) * yy);
  return basis;
}

// dL/dd from dL/dbasis.
template <class S> DSMOE_HD Vec3<S> sh_basis_backward(int degree, Vec3<S> d, const ShNumbers<S>& g) {
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

// The viewing direction. A Gaussian at the camera's centre has none, and shows its colour of degree 0.
template <class S> struct ViewDirection {
  Vec3<S> unit;
  S inverse_length;  // of the offset from the camera
};

template <class S> DSMOE_HD ViewDirection<S> view_direction(Vec3<S> mean, Vec3<S> position) {
  const Vec3<S> offset = mean - position;
  const S squared = dot(offset, offset);
  const S inverse_length = squared > S(0) ? S(1) / sqrt(squared) : S(0);
  return {inverse_length * offset, inverse_length};
}

template <class S> struct ShRules {
  int degree;        // active, 0 to 3
  bool clamp;        // colours are at least 0
  Vec3<S> position;  // of the camera, world
};

// colour = 1/2 + sum_k basis_k sh_k, and with `clamp` max(0, that). sh(k): coefficient k, a Vec3.
template <class S, class Coefficients>
DSMOE_HD Vec3<S> sh_color(const ShRules<S>& rules, Vec3<S> mean, Coefficients sh) {
  const auto basis = sh_basis(rules.degree, view_direction(mean, rules.position).unit);
  Vec3<S> color = Vec3<S>{S(0.5), S(0.5), S(0.5)} + basis[0] * sh(0);
  for (int k = 1; k < sh_coefficients(rules.degree); ++k) color = color + basis[k] * sh(k);
  const auto clamped = [&](S c) { return rules.clamp && c < S(0) ? S(0) : c; };  // NaN stays, and is culled
  return {clamped(color.x), clamped(color.y), clamped(color.z)};
}

// Hands dL/dsh_k of the active degree to store(k, Vec3), each after sh(k) was read; returns dL/dmean, whose negative is
// dL/dposition. color is the forward's result: with `clamp` 0 means clamped, and a clamped channel passes no gradient.
template <class S, class Coefficients, class Store>
DSMOE_HD Vec3<S> sh_color_backward(const ShRules<S>& rules, Vec3<S> mean, Coefficients sh, Vec3<S> color,
                                   Vec3<S> dL_dcolor, Store store) {
  const auto direction = view_direction(mean, rules.position);
  const auto basis = sh_basis(rules.degree, direction.unit);
  const auto passed = [&](S c, S dL_dc) { return !rules.clamp || c > S(0) ? dL_dc : S(0); };
  const Vec3<S> g = {passed(color.x, dL_dcolor.x), passed(color.y, dL_dcolor.y), passed(color.z, dL_dcolor.z)};
  store(0, basis[0] * g);
  ShNumbers<S> dL_dbasis;
  dL_dbasis[0] = S(0);
  for (int k = 1; k < sh_coefficients(rules.degree); ++k) {
    dL_dbasis[k] = dot(sh(k), g);
    store(k, basis[k] * g);
  }
  const Vec3<S> dL_ddirection = sh_basis_backward(rules.degree, direction.unit, dL_dbasis);
  // d(v / |v|) = (I - n n^T) / |v|
  return direction.inverse_length * (dL_ddirection - dot(dL_ddirection, direction.unit) * direction.unit);
}

}  // namespace dsmoe

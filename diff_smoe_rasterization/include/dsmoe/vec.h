// Small vectors and matrices, with what the projection needs of them.
#pragma once

#include "dsmoe/hd.h"

namespace dsmoe {

template <class S> struct Vec2 { S x, y; };

template <class S> struct Vec3 { S x, y, z; };

template <class S> struct Vec4 { S x, y, z, w; };

// Symmetric matrices, upper triangle.
template <class S> struct Sym2 { S xx, xy, yy; };

template <class S> struct Sym3 { S xx, xy, xz, yy, yz, zz; };

// Rows of a 3x3 matrix.
template <class S> struct Mat3 { Vec3<S> r0, r1, r2; };

// Rows of a 2x3 matrix.
template <class S> struct Mat23 { Vec3<S> r0, r1; };

template <class S> DSMOE_HD Vec3<S> operator+(Vec3<S> a, Vec3<S> b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
template <class S> DSMOE_HD Vec3<S> operator-(Vec3<S> a, Vec3<S> b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
template <class S> DSMOE_HD Vec3<S> operator*(S s, Vec3<S> a) { return {s * a.x, s * a.y, s * a.z}; }
template <class S> DSMOE_HD Vec3<S> operator*(Vec3<S> a, Vec3<S> b) { return {a.x * b.x, a.y * b.y, a.z * b.z}; }
template <class S> DSMOE_HD Vec3<S> cross(Vec3<S> a, Vec3<S> b) {
  return {difference_of_products(a.y, b.z, a.z, b.y), difference_of_products(a.z, b.x, a.x, b.z),
          difference_of_products(a.x, b.y, a.y, b.x)};
}
template <class S> DSMOE_HD S dot(Vec3<S> a, Vec3<S> b) { return a.x * b.x + a.y * b.y + a.z * b.z; }

template <class S> DSMOE_HD Vec3<S> operator*(const Sym3<S>& m, Vec3<S> v) {
  return {m.xx * v.x + m.xy * v.y + m.xz * v.z, m.xy * v.x + m.yy * v.y + m.yz * v.z,
          m.xz * v.x + m.yz * v.y + m.zz * v.z};
}

template <class S> DSMOE_HD Vec3<S> operator*(const Mat3<S>& m, Vec3<S> v) {
  return {dot(m.r0, v), dot(m.r1, v), dot(m.r2, v)};
}

template <class S> DSMOE_HD Mat3<S> operator*(S s, const Mat3<S>& m) { return {s * m.r0, s * m.r1, s * m.r2}; }

template <class S> DSMOE_HD Vec3<S> transposed_times(const Mat3<S>& m, Vec3<S> v) {
  return v.x * m.r0 + v.y * m.r1 + v.z * m.r2;
}

template <class S> DSMOE_HD bool is_finite(S x) { return x - x == S(0); }
template <class S> DSMOE_HD bool is_finite(Vec3<S> v) { return is_finite(v.x) && is_finite(v.y) && is_finite(v.z); }

// 0 x is 0 for every finite x. NaN and infinity give NaN, which stays in the sums. There are four sums, so that the
// additions do not wait for each other.
template <class S> DSMOE_HD bool all_finite(const S* values, int count) {
  S poison[4] = {S(0), S(0), S(0), S(0)};
  int i = 0;
  DSMOE_UNROLL
  for (; i + 4 <= count; i += 4) {
    for (int k = 0; k < 4; ++k) poison[k] += S(0) * values[i + k];
  }
  for (; i < count; ++i) poison[0] += S(0) * values[i];
  return (poison[0] + poison[1]) + (poison[2] + poison[3]) == S(0);
}

}  // namespace dsmoe

// A pack of pixels that behaves like one number, so that the mathematics of include/dsmoe works on it.
//
// Included once per instruction set (simd_target.h). It uses the compilers' vector types, and intrinsics where those
// make poor masks or no FMA. The compilers' own macros (__AVX2__ ...) cannot choose: GCC expands them before it sees
// the target pragma.
#pragma once

#include <cstdint>
#if DSMOE_SIMD_BYTES >= 32
#include <immintrin.h>
#endif

#include "dsmoe/hd.h"

namespace dsmoe {
namespace DSMOE_SIMD {

template <class T> struct Register;
template <> struct Register<float> {
  typedef float Values __attribute__((vector_size(DSMOE_SIMD_BYTES)));
  typedef int32_t Bits __attribute__((vector_size(DSMOE_SIMD_BYTES)));
};
template <> struct Register<double> {
  typedef double Values __attribute__((vector_size(DSMOE_SIMD_BYTES)));
  typedef int64_t Bits __attribute__((vector_size(DSMOE_SIMD_BYTES)));
};

template <class T> struct Pack;

#if DSMOE_SIMD_BYTES == 64
template <class T> struct LaneBits;
template <> struct LaneBits<float> { using Type = __mmask16; };
template <> struct LaneBits<double> { using Type = __mmask8; };

template <class T> struct PackMask {
  typename LaneBits<T>::Type bits;

  friend DSMOE_HD PackMask operator&(PackMask a, PackMask b) {
    return {static_cast<typename LaneBits<T>::Type>(a.bits & b.bits)};
  }
  static DSMOE_HD PackMask all() { return {static_cast<typename LaneBits<T>::Type>(~0)}; }
  friend DSMOE_HD bool any(PackMask m) { return m.bits != 0; }
  friend DSMOE_HD uint32_t bits_of(PackMask m) { return m.bits; }
};
#else
template <class T> struct PackMask {
  typename Register<T>::Bits bits;

  friend DSMOE_HD PackMask operator&(PackMask a, PackMask b) { return {a.bits & b.bits}; }
  static DSMOE_HD PackMask all() { return {~typename Register<T>::Bits{}}; }
  friend DSMOE_HD bool any(PackMask m) {
#if DSMOE_SIMD_BYTES == 32
    return !_mm256_testz_si256(reinterpret_cast<__m256i>(m.bits), reinterpret_cast<__m256i>(m.bits));
#else
    int64_t all = 0;
    typedef int64_t Words __attribute__((vector_size(DSMOE_SIMD_BYTES)));
    const Words words = reinterpret_cast<Words>(m.bits);
    for (unsigned i = 0; i < DSMOE_SIMD_BYTES / sizeof(int64_t); ++i) all |= words[i];
    return all != 0;
#endif
  }
  // One bit a lane, the first lane's the lowest.
  friend DSMOE_HD uint32_t bits_of(PackMask m) {
#if DSMOE_SIMD_BYTES == 32
    if (sizeof(T) == sizeof(float)) return _mm256_movemask_ps(reinterpret_cast<__m256>(m.bits));
    return _mm256_movemask_pd(reinterpret_cast<__m256d>(m.bits));
#else
    uint32_t out = 0;
    for (unsigned i = 0; i < DSMOE_SIMD_BYTES / sizeof(T); ++i) out |= (m.bits[i] != 0 ? 1u : 0u) << i;
    return out;
#endif
  }
};
#endif

template <class T> struct Pack {
  using Values = typename Register<T>::Values;
  using Bits = typename Register<T>::Bits;
  static constexpr int kLanes = DSMOE_SIMD_BYTES / sizeof(T);

  Values v;

  Pack() = default;
  DSMOE_HD Pack(Values values) : v(values) {}
  DSMOE_HD Pack(T value) : v(value - Values{}) {}  // value - 0 is value, also if that is -0: no subtraction is left

  static DSMOE_HD Pack load(const T* p) { return *reinterpret_cast<const Values*>(p); }  // aligned
  DSMOE_HD void store(T* p) const { *reinterpret_cast<Values*>(p) = v; }                 // aligned

  friend DSMOE_HD Pack operator+(Pack a, Pack b) { return a.v + b.v; }
  friend DSMOE_HD Pack operator-(Pack a, Pack b) { return a.v - b.v; }
  friend DSMOE_HD Pack operator*(Pack a, Pack b) { return a.v * b.v; }
  friend DSMOE_HD Pack operator/(Pack a, Pack b) { return a.v / b.v; }
  friend DSMOE_HD Pack operator-(Pack a) { return -a.v; }
  // The sums over the lanes of a, b, c and d, to out[0 ... 3].
  friend DSMOE_HD void sum_lanes(Pack a, Pack b, Pack c, Pack d, T* out) {
#if DSMOE_SIMD_BYTES >= 32
    if constexpr (sizeof(T) == sizeof(float)) {
      _mm_storeu_ps(out, four_sums(a.v, b.v, c.v, d.v));
      return;
    }
#endif
    out[0] = sum_lanes(a), out[1] = sum_lanes(b), out[2] = sum_lanes(c), out[3] = sum_lanes(d);
  }
  friend DSMOE_HD PackMask<T> operator>(Pack a, Pack b) { return b < a; }
  friend DSMOE_HD PackMask<T> operator>=(Pack a, Pack b) { return b <= a; }

#if DSMOE_SIMD_BYTES == 64
  friend DSMOE_HD PackMask<T> operator<(Pack a, Pack b) { return {compare_less(a.v, b.v)}; }
  friend DSMOE_HD PackMask<T> operator<=(Pack a, Pack b) { return {compare_less_equal(a.v, b.v)}; }
  friend DSMOE_HD Pack select(PackMask<T> m, Pack a, Pack b) { return blend(m.bits, a.v, b.v); }
  friend DSMOE_HD Pack min(Pack a, Pack b) { return minimum(a.v, b.v); }
  friend DSMOE_HD Pack max(Pack a, Pack b) { return maximum(a.v, b.v); }
  friend DSMOE_HD Pack fma(Pack a, Pack b, Pack c) { return fused(a.v, b.v, c.v); }
  friend DSMOE_HD T sum_lanes(Pack a) { return sum(a.v); }
  friend DSMOE_HD Pack sqrt(Pack a) { return root(a.v); }
  friend DSMOE_HD Pack abs(Pack a) { return magnitude(a.v); }
  friend DSMOE_HD Pack reciprocal(Pack a) { return T(1) / a.v; }

 private:
  static DSMOE_HD __m512 magnitude(__m512 a) { return _mm512_abs_ps(a); }
  static DSMOE_HD __m512d magnitude(__m512d a) { return _mm512_abs_pd(a); }
  static DSMOE_HD __mmask16 compare_less(__m512 a, __m512 b) { return _mm512_cmp_ps_mask(a, b, _CMP_LT_OQ); }
  static DSMOE_HD __mmask8 compare_less(__m512d a, __m512d b) { return _mm512_cmp_pd_mask(a, b, _CMP_LT_OQ); }
  static DSMOE_HD __mmask16 compare_less_equal(__m512 a, __m512 b) { return _mm512_cmp_ps_mask(a, b, _CMP_LE_OQ); }
  static DSMOE_HD __mmask8 compare_less_equal(__m512d a, __m512d b) { return _mm512_cmp_pd_mask(a, b, _CMP_LE_OQ); }
  static DSMOE_HD __m512 blend(__mmask16 m, __m512 a, __m512 b) { return _mm512_mask_blend_ps(m, b, a); }
  static DSMOE_HD __m512d blend(__mmask8 m, __m512d a, __m512d b) { return _mm512_mask_blend_pd(m, b, a); }
  static DSMOE_HD __m512 minimum(__m512 a, __m512 b) { return _mm512_min_ps(a, b); }
  static DSMOE_HD __m512d minimum(__m512d a, __m512d b) { return _mm512_min_pd(a, b); }
  static DSMOE_HD __m512 maximum(__m512 a, __m512 b) { return _mm512_max_ps(a, b); }
  static DSMOE_HD __m512d maximum(__m512d a, __m512d b) { return _mm512_max_pd(a, b); }
  static DSMOE_HD __m512 fused(__m512 a, __m512 b, __m512 c) { return _mm512_fmadd_ps(a, b, c); }
  static DSMOE_HD __m512d fused(__m512d a, __m512d b, __m512d c) { return _mm512_fmadd_pd(a, b, c); }
  static DSMOE_HD __m512 root(__m512 a) { return _mm512_sqrt_ps(a); }
  static DSMOE_HD __m512d root(__m512d a) { return _mm512_sqrt_pd(a); }
  static DSMOE_HD float sum(__m512 a) { return _mm512_reduce_add_ps(a); }
  static DSMOE_HD double sum(__m512d a) { return _mm512_reduce_add_pd(a); }
  static DSMOE_HD __m128 four_sums(__m512 a, __m512 b, __m512 c, __m512 d) {
    const __m512 ab = _mm512_add_ps(_mm512_unpacklo_ps(a, b), _mm512_unpackhi_ps(a, b));
    const __m512 cd = _mm512_add_ps(_mm512_unpacklo_ps(c, d), _mm512_unpackhi_ps(c, d));
    const __m512 abcd = _mm512_add_ps(_mm512_shuffle_ps(ab, cd, 0x44), _mm512_shuffle_ps(ab, cd, 0xee));
    const __m256 half = _mm256_add_ps(_mm512_castps512_ps256(abcd), _mm512_extractf32x8_ps(abcd, 1));
    return _mm_add_ps(_mm256_castps256_ps128(half), _mm256_extractf128_ps(half, 1));
  }
#else
  friend DSMOE_HD PackMask<T> operator<(Pack a, Pack b) { return {a.v < b.v}; }
  friend DSMOE_HD PackMask<T> operator<=(Pack a, Pack b) { return {a.v <= b.v}; }
  friend DSMOE_HD Pack select(PackMask<T> m, Pack a, Pack b) { return m.bits ? a.v : b.v; }
  friend DSMOE_HD Pack min(Pack a, Pack b) { return a.v < b.v ? a.v : b.v; }
  friend DSMOE_HD Pack max(Pack a, Pack b) { return a.v > b.v ? a.v : b.v; }
  friend DSMOE_HD Pack abs(Pack a) { return max(a, -a); }
  friend DSMOE_HD Pack reciprocal(Pack a) { return T(1) / a.v; }
  friend DSMOE_HD T sum_lanes(Pack a) {
    T total = a.v[0];
    for (int i = 1; i < kLanes; ++i) total += a.v[i];
    return total;
  }
#if DSMOE_SIMD_BYTES == 32
  friend DSMOE_HD Pack fma(Pack a, Pack b, Pack c) { return fused(a.v, b.v, c.v); }
  friend DSMOE_HD Pack sqrt(Pack a) { return root(a.v); }

 private:
  static DSMOE_HD __m256 root(__m256 a) { return _mm256_sqrt_ps(a); }
  static DSMOE_HD __m256d root(__m256d a) { return _mm256_sqrt_pd(a); }
  static DSMOE_HD __m256 fused(__m256 a, __m256 b, __m256 c) { return _mm256_fmadd_ps(a, b, c); }
  static DSMOE_HD __m256d fused(__m256d a, __m256d b, __m256d c) { return _mm256_fmadd_pd(a, b, c); }
  static DSMOE_HD __m128 four_sums(__m256 a, __m256 b, __m256 c, __m256 d) {
    const __m256 ab = _mm256_add_ps(_mm256_unpacklo_ps(a, b), _mm256_unpackhi_ps(a, b));
    const __m256 cd = _mm256_add_ps(_mm256_unpacklo_ps(c, d), _mm256_unpackhi_ps(c, d));
    const __m256 abcd = _mm256_add_ps(_mm256_shuffle_ps(ab, cd, 0x44), _mm256_shuffle_ps(ab, cd, 0xee));
    return _mm_add_ps(_mm256_castps256_ps128(abcd), _mm256_extractf128_ps(abcd, 1));
  }
#else
  friend DSMOE_HD Pack fma(Pack a, Pack b, Pack c) { return a.v * b.v + c.v; }
  friend DSMOE_HD Pack sqrt(Pack a) {
    for (int i = 0; i < kLanes; ++i) a.v[i] = ::dsmoe::sqrt(a.v[i]);
    return a;
  }
#endif
#endif
};

// exp(x) = 2^n e^r with n = round(x / ln 2), |r| <= ln 2 / 2. Adding kRound leaves n in the low mantissa bits.
// float: minimax polynomial of degree 6, relative error 2e-9 before rounding. Below -80 the result is no longer exact:
// no pair counts there.
DSMOE_HD Pack<float> exp(Pack<float> x) {
  using P = Pack<float>;
  const P kRound = 12582912.0f;  // 1.5 * 2^23
  const P clamped = max(x, P(-80.0f));
  const P shifted = fma(clamped, P(float(kLog2E)), kRound);
  const P n = shifted - kRound;
  P r = fma(n, P(-0.693359375f), clamped);  // ln 2 in two parts: the first times n is exact
  r = fma(n, P(2.12194440e-4f), r);
  P p = fma(P(1.3836846e-3f), r, P(8.3748158e-3f));
  p = fma(p, r, P(4.1668226e-2f));
  p = fma(p, r, P(1.6666420e-1f));
  p = fma(p, r, P(4.9999992e-1f));
  p = fma(p, r, P(1.0f));
  p = fma(p, r, P(1.0f));
  const P::Bits power = (reinterpret_cast<P::Bits>(shifted.v) << 23) + 0x3f800000;
  return p * P(reinterpret_cast<P::Values>(power));
}

// double: Taylor to degree 13, whose remainder is below 5e-18 for |r| <= ln 2 / 2.
DSMOE_HD Pack<double> exp_of_remainder(Pack<double> r) {
  using P = Pack<double>;
  P p = P(1.0 / 6227020800.0);
  constexpr double kInverseFactorials[] = {1.0 / 479001600.0,
                                           1.0 / 39916800.0,
                                           1.0 / 3628800.0,
                                           1.0 / 362880.0,
                                           1.0 / 40320.0,
                                           1.0 / 5040.0,
                                           1.0 / 720.0,
                                           1.0 / 120.0,
                                           1.0 / 24.0,
                                           1.0 / 6.0,
                                           0.5,
                                           1.0,
                                           1.0};
  for (const double c : kInverseFactorials) p = fma(p, r, P(c));
  return p;
}

DSMOE_HD Pack<double> exp(Pack<double> x) {
  using P = Pack<double>;
  const P kRound = 6755399441055744.0;  // 1.5 * 2^52
  const P clamped = max(x, P(-700.0));
  const P shifted = fma(clamped, P(kLog2E), kRound);
  const P n = shifted - kRound;
  P r = fma(n, P(-0.693147180369123816490), clamped);
  r = fma(n, P(-1.90821492927058770002e-10), r);
  const P::Bits power = (reinterpret_cast<P::Bits>(shifted.v) << 52) + 0x3ff0000000000000;
  return exp_of_remainder(r) * P(reinterpret_cast<P::Values>(power));
}

}  // namespace DSMOE_SIMD

template <class T> struct RealTraits<DSMOE_SIMD::Pack<T>> {
  using Scalar = T;
  using Mask = DSMOE_SIMD::PackMask<T>;
  using Whole = DSMOE_SIMD::Pack<T>;
};

}  // namespace dsmoe

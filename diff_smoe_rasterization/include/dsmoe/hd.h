// Qualifiers for functions that run on host and device, and the scalar functions that the mathematics needs.
#pragma once

#include <cmath>
#include <cstdint>

#if defined(__CUDACC__)
#define DSMOE_HD __host__ __device__ __forceinline__
#define DSMOE_UNROLL _Pragma("unroll")  // in kernels: keeps arrays in registers
#else
#define DSMOE_HD inline __attribute__((always_inline))
#define DSMOE_UNROLL
#endif

namespace dsmoe {

// The other headers call these functions unqualified, so that argument-dependent lookup finds those of a SIMD pack.
// A pack of pixels has a mask type and a scalar type. For a single pixel they are bool and the type itself. Whole is
// for whole numbers: counts, and places in a list.
template <class Real> struct RealTraits {
  using Scalar = Real;
  using Mask = bool;
  using Whole = int32_t;
};
template <class Real> using Mask = typename RealTraits<Real>::Mask;
template <class Real> using Scalar = typename RealTraits<Real>::Scalar;
template <class Real> using Whole = typename RealTraits<Real>::Whole;

constexpr double kLog2E = 1.4426950408889634, kLn2 = 0.6931471805599453;

// In kernels, exp, exp2 and reciprocal of a float are the hardware's own. exp2 and reciprocal run once a (Gaussian,
// pixel) pair; their relative errors are at most 2^-22. That of exp(x) is at most 7.3e-8 |x| more, from x log2(e).
DSMOE_HD float exp(float x) {
#if defined(__CUDA_ARCH__)
  float y;
  asm("ex2.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x * float(kLog2E)));
  return y;
#else
  return ::expf(x);
#endif
}
DSMOE_HD double exp(double x) { return ::exp(x); }
DSMOE_HD float exp2(float x) {
#if defined(__CUDA_ARCH__)
  float y;
  asm("ex2.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x));
  return y;
#else
  return ::exp2f(x);
#endif
}
DSMOE_HD double exp2(double x) { return ::exp2(x); }
DSMOE_HD float log2(float x) { return ::log2f(x); }
DSMOE_HD double log2(double x) { return ::log2(x); }
DSMOE_HD float log(float x) { return ::logf(x); }
DSMOE_HD double log(double x) { return ::log(x); }
DSMOE_HD float sqrt(float x) { return ::sqrtf(x); }
DSMOE_HD double sqrt(double x) { return ::sqrt(x); }
DSMOE_HD float atan2(float y, float x) { return ::atan2f(y, x); }
DSMOE_HD double atan2(double y, double x) { return ::atan2(y, x); }
DSMOE_HD float ceil(float x) { return ::ceilf(x); }
DSMOE_HD double ceil(double x) { return ::ceil(x); }
DSMOE_HD float floor(float x) { return ::floorf(x); }
DSMOE_HD double floor(double x) { return ::floor(x); }
DSMOE_HD float abs(float x) { return ::fabsf(x); }
DSMOE_HD double abs(double x) { return ::fabs(x); }
DSMOE_HD float fma(float a, float b, float c) { return ::fmaf(a, b, c); }
DSMOE_HD double fma(double a, double b, double c) { return ::fma(a, b, c); }
DSMOE_HD float reciprocal(float x) {
#if defined(__CUDA_ARCH__)
  float y;
  asm("rcp.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x));
  return y;
#else
  return 1.0f / x;
#endif
}
DSMOE_HD double reciprocal(double x) { return 1.0 / x; }

// For bounds that are widened by a thousandth. In kernels these are the hardware's own, good to 22 bits.
DSMOE_HD float rough_reciprocal(float x) { return reciprocal(x); }
DSMOE_HD double rough_reciprocal(double x) { return 1.0 / x; }
DSMOE_HD float rough_sqrt(float x) {
#if defined(__CUDA_ARCH__)
  float y;
  asm("sqrt.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x));
  return y;
#else
  return ::sqrtf(x);
#endif
}
DSMOE_HD double rough_sqrt(double x) { return ::sqrt(x); }

template <class S> DSMOE_HD S min(S a, S b) { return a < b ? a : b; }
template <class S> DSMOE_HD S max(S a, S b) { return a > b ? a : b; }
#if defined(__CUDACC__)  // one instruction, which the comparison above does not become
DSMOE_HD float min(float a, float b) { return ::fminf(a, b); }
DSMOE_HD float max(float a, float b) { return ::fmaxf(a, b); }
#endif
template <class S> DSMOE_HD S clamp(S x, S low, S high) { return min(max(x, low), high); }
template <class S> DSMOE_HD S select(bool mask, S a, S b) { return mask ? a : b; }

// a b, rounded. In kernels it never becomes part of a fused multiply-add, so that equal products cancel exactly.
DSMOE_HD float product(float a, float b) {
#if defined(__CUDA_ARCH__)
  return __fmul_rn(a, b);
#else
  return a * b;
#endif
}
DSMOE_HD double product(double a, double b) {
#if defined(__CUDA_ARCH__)
  return __dmul_rn(a, b);
#else
  return a * b;
#endif
}

// a b - c d, with an error of the result's rounding and not of the products' (Kahan). In determinants of long, thin
// Gaussians the products cancel almost completely.
template <class S> DSMOE_HD S difference_of_products(S a, S b, S c, S d) {
  const S cd = c * d;
  const S error = fma(-c, d, cd);
  return fma(a, b, -cd) + error;
}

}  // namespace dsmoe

// Lanes across Gaussians: lane l of every vector belongs to one Gaussian. No operation mixes lanes, so the result of a
// Gaussian does not depend on its neighbours.
//
// Shapes are computed in double even for float scenes (docs/PRECISION.md), so a vector of float spans two of double.
#pragma once

#include "simd.h"

namespace gsplat {
namespace GSPLAT_ISA {

using MD = Vector<double>::M;

constexpr int WIDE = Vector<double>::LANES;

// As many floats as a vector of doubles has lanes.
typedef float HalfF __attribute__((vector_size(WIDE * sizeof(float))));

// To double. GCC 12 converts the two halves of a wider vector separately, and NEON's lanes one by one, hence the intrinsics.
GSPLAT_INLINE VD widened(HalfF v) {
#if GSPLAT_VECTOR_BYTES == 64
    return (VD)_mm512_cvtps_pd((__m256)v);
#elif GSPLAT_VECTOR_BYTES == 32
    return (VD)_mm256_cvtps_pd((__m128)v);
#elif defined(__aarch64__)
    return (VD)vcvt_f64_f32((float32x2_t)v);
#else
    return __builtin_convertvector(v, VD);
#endif
}

// WIDE numbers of the scene's type as doubles, and back, rounded.
GSPLAT_INLINE VD widened(const float *p) { return widened(load<HalfF>(p)); }
GSPLAT_INLINE VD widened(const double *p) { return load<VD>(p); }
GSPLAT_INLINE void narrowed(float *p, VD v) { store(p, __builtin_convertvector(v, HalfF)); }
GSPLAT_INLINE void narrowed(double *p, VD v) { store(p, v); }

// Rounded to the scene's type.
template <class T>
GSPLAT_INLINE VD rounded(VD v) {
    if (sizeof(T) == sizeof(double)) return v;
    return widened(__builtin_convertvector(v, HalfF));
}

// v - v is 0 for finite v only.
GSPLAT_INLINE MD finite(VD v) { return v - v == VD{}; }

GSPLAT_INLINE VF sqrt_(VF v) {
#if GSPLAT_VECTOR_BYTES == 64
    return (VF)_mm512_sqrt_ps((__m512)v);
#elif GSPLAT_VECTOR_BYTES == 32
    return (VF)_mm256_sqrt_ps((__m256)v);
#elif defined(__SSE2__)
    return (VF)_mm_sqrt_ps((__m128)v);
#elif defined(__aarch64__)
    return (VF)vsqrtq_f32((float32x4_t)v);
#else
    for (int i = 0; i < Vector<float>::LANES; ++i) v[i] = sqrtf(v[i]);
    return v;
#endif
}

GSPLAT_INLINE VD sqrt_(VD v) {
#if GSPLAT_VECTOR_BYTES == 64
    return (VD)_mm512_sqrt_pd((__m512d)v);
#elif GSPLAT_VECTOR_BYTES == 32
    return (VD)_mm256_sqrt_pd((__m256d)v);
#elif defined(__SSE2__)
    return (VD)_mm_sqrt_pd((__m128d)v);
#elif defined(__aarch64__)
    return (VD)vsqrtq_f64((float64x2_t)v);
#else
    for (int i = 0; i < WIDE; ++i) v[i] = sqrt(v[i]);
    return v;
#endif
}

GSPLAT_INLINE VF abs_(VF v) { return v < VF{} ? -v : v; }
GSPLAT_INLINE VD abs_(VD v) { return v < VD{} ? -v : v; }

// e^x to 1 ulp, also where the result is subnormal: x = n ln 2 + f, then 1 + f + f² P(f), fitted for its relative error, 3e-9.
// 2^n is applied in two halves because n goes from -150 to 128.
GSPLAT_INLINE VF exp_(VF x) {
    const VF magic = splat(12582912.0f), bottom = splat(-104.0f), top = splat(89.0f);
    x = x < bottom ? bottom : x;  // NaN stays
    x = x > top ? top : x;
    const VF n = (x * splat(1.44269504f) + magic) - magic;
    const VF f = (x - n * splat(0.693145752f)) - n * splat(1.42860677e-6f);
    VF y = splat(1.381446268e-3f);
    y = y * f + splat(8.368780870e-3f);
    y = y * f + splat(4.166839430e-2f);
    y = y * f + splat(1.666652010e-1f);
    y = y * f + splat(4.999999341e-1f);
    y = y * f * f + f + splat(1.0f);
    const Vector<float>::M e = __builtin_convertvector(n, Vector<float>::M), half = e >> 1;
    return y * (VF)((half + 127) << 23) * (VF)((e - half + 127) << 23);
}

GSPLAT_INLINE VD exp_(VD x) {
    for (int i = 0; i < WIDE; ++i) x[i] = exp(x[i]);
    return x;
}

// log2(x) of positive normal numbers: x = 2^e (1 + f), |f| < 0.42, then ln(1 + f) = f - f²/2 + f³ P(f), fitted for its
// relative error, 6e-9.
GSPLAT_INLINE VF log2_(VF x) {
    using M = Vector<float>::M;
    const M bits = (M)x, e = (bits - 0x3f3504f3) >> 23;  // the bits of sqrt(1/2)
    const VF f = (VF)(bits - (e << 23)) - splat(1.0f), ff = f * f;
    VF y = splat(-7.634347596e-2f);
    y = y * f + splat(1.276151705e-1f);
    y = y * f + splat(-1.316021053e-1f);
    y = y * f + splat(1.420176803e-1f);
    y = y * f + splat(-1.662335544e-1f);
    y = y * f + splat(2.000122641e-1f);
    y = y * f + splat(-2.500082108e-1f);
    y = y * f + splat(3.333333171e-1f);
    y = f + (y * f - splat(0.5f)) * ff;
    return y * splat(1.44269504f) + __builtin_convertvector(e, VF);
}

GSPLAT_INLINE VD log2_(VD x) {
    for (int i = 0; i < WIDE; ++i) x[i] = log2(x[i]);
    return x;
}

}  // namespace GSPLAT_ISA
}  // namespace gsplat

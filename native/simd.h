// SIMD through the vector extensions of GCC and Clang: one source, any width.
//
// This file is compiled once per instruction set, each time in its own namespace (GSPLAT_ISA). It uses only C functions of
// the standard library: an inline function shared between two instruction sets would be linked once, perhaps in a version
// that the machine cannot run.
#pragma once

#include <math.h>
#include <stdint.h>
#include <string.h>
#if defined(__SSE2__)
#include <immintrin.h>
#endif

#if defined(__AVX512F__)
#define GSPLAT_VECTOR_BYTES 64
#elif defined(__AVX2__)
#define GSPLAT_VECTOR_BYTES 32
#else
#define GSPLAT_VECTOR_BYTES 16
#endif

#define GSPLAT_INLINE static inline __attribute__((always_inline))

namespace gsplat {
namespace GSPLAT_ISA {

template <class T>
struct Vector;

template <>
struct Vector<float> {
    typedef float V __attribute__((vector_size(GSPLAT_VECTOR_BYTES)));
    typedef int32_t M __attribute__((vector_size(GSPLAT_VECTOR_BYTES)));
    static constexpr int LANES = GSPLAT_VECTOR_BYTES / 4;
};

template <>
struct Vector<double> {
    typedef double V __attribute__((vector_size(GSPLAT_VECTOR_BYTES)));
    typedef int64_t M __attribute__((vector_size(GSPLAT_VECTOR_BYTES)));
    static constexpr int LANES = GSPLAT_VECTOR_BYTES / 8;
};

using VF = Vector<float>::V;
using VD = Vector<double>::V;

// A scalar in every lane; written as scalar + zero vector, which compiles to one broadcast.
GSPLAT_INLINE VF splat(float x) { return x - VF{}; }
GSPLAT_INLINE VD splat(double x) { return x - VD{}; }

template <class V, class T>
GSPLAT_INLINE V load(const T *p) {
    V v;
    memcpy(&v, p, sizeof(V));
    return v;
}

template <class V, class T>
GSPLAT_INLINE void store(T *p, V v) {
    memcpy(p, &v, sizeof(V));
}

// 0, 1, 2, ... in the lanes.
template <class T>
GSPLAT_INLINE typename Vector<T>::V iota() {
    typename Vector<T>::V v;
    for (int i = 0; i < Vector<T>::LANES; ++i) v[i] = T(i);
    return v;
}

template <class T>
GSPLAT_INLINE T vmax(T a, T b) {
    return a > b ? a : b;
}

template <class T>
GSPLAT_INLINE T vmin(T a, T b) {
    return a < b ? a : b;
}

// Horizontal sum by halves, always in the same order.
GSPLAT_INLINE float sum(VF v) {
#if GSPLAT_VECTOR_BYTES == 64
    typedef float H __attribute__((vector_size(32)));
    H h = __builtin_shufflevector(v, v, 0, 1, 2, 3, 4, 5, 6, 7) + __builtin_shufflevector(v, v, 8, 9, 10, 11, 12, 13, 14, 15);
    typedef float Q __attribute__((vector_size(16)));
    Q q = __builtin_shufflevector(h, h, 0, 1, 2, 3) + __builtin_shufflevector(h, h, 4, 5, 6, 7);
#elif GSPLAT_VECTOR_BYTES == 32
    typedef float Q __attribute__((vector_size(16)));
    Q q = __builtin_shufflevector(v, v, 0, 1, 2, 3) + __builtin_shufflevector(v, v, 4, 5, 6, 7);
#else
    VF q = v;
#endif
    return (q[0] + q[2]) + (q[1] + q[3]);
}

GSPLAT_INLINE double sum(VD v) {
    double lanes[Vector<double>::LANES];
    store(lanes, v);
    for (int half = Vector<double>::LANES / 2; half; half /= 2)
        for (int i = 0; i < half; ++i) lanes[i] += lanes[i + half];
    return lanes[0];
}

GSPLAT_INLINE bool any_at_least(VF v, float x) {
#if GSPLAT_VECTOR_BYTES == 64
    return _mm512_cmp_ps_mask((__m512)v, _mm512_set1_ps(x), _CMP_GE_OQ) != 0;
#else
    auto mask = v >= splat(x);
    int32_t any = 0;
    for (int i = 0; i < Vector<float>::LANES; ++i) any |= mask[i];
    return any != 0;
#endif
}

GSPLAT_INLINE bool any_at_least(VD v, double x) {
    auto mask = v >= splat(x);
    int64_t any = 0;
    for (int i = 0; i < Vector<double>::LANES; ++i) any |= mask[i];
    return any != 0;
}

// 2^min(p, most), 0 where p < least; most <= 0 and -126 <= least. n = round(p) (by adding and subtracting 1.5 * 2^23, which -ffast-math
// would fold away), then a polynomial of degree 5 on [-1/2, 1/2] fitted for its relative error, 2.4e-7.
GSPLAT_INLINE VF exp2_between(VF p, float least, float most) {
#if GSPLAT_VECTOR_BYTES == 64
    const __mmask16 keep = _mm512_cmp_ps_mask((__m512)p, _mm512_set1_ps(least), _CMP_GE_OQ);
    p = (VF)_mm512_min_ps((__m512)p, _mm512_set1_ps(most));
    const __m512 n = _mm512_roundscale_ps((__m512)p, _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC);
    const VF f = p - (VF)n;
#else
    const VF magic = splat(12582912.0f), bottom = splat(least), top = splat(most);
    const auto keep = p >= bottom;
    p = p < top ? p : top;
    p = p > bottom ? p : bottom;  // a smaller value would overflow the exponent bits
    const VF n = (p + magic) - magic;
    const VF f = p - n;
#endif
    VF y = splat(1.33952915e-3f);
    y = y * f + splat(9.67037690e-3f);
    y = y * f + splat(5.55033013e-2f);
    y = y * f + splat(2.40222633e-1f);
    y = y * f + splat(6.93147182e-1f);
    y = y * f + splat(1.0f);
#if GSPLAT_VECTOR_BYTES == 64
    return (VF)_mm512_maskz_scalef_ps(keep, (__m512)y, n);
#else
    const Vector<float>::M e = __builtin_convertvector(n, Vector<float>::M);
    return keep ? (VF)((Vector<float>::M)y + (e << 23)) : VF{};
#endif
}

GSPLAT_INLINE VD exp2_between(VD p, double least, double most) {
    for (int i = 0; i < Vector<double>::LANES; ++i) p[i] = p[i] >= least ? exp2(p[i] < most ? p[i] : most) : 0.0;
    return p;
}

// x where key is below the limit, otherwise 0.
GSPLAT_INLINE VF where_below(VF key, float limit, VF x) {
#if GSPLAT_VECTOR_BYTES == 64
    return (VF)_mm512_maskz_mov_ps(_mm512_cmp_ps_mask((__m512)key, _mm512_set1_ps(limit), _CMP_LT_OQ), (__m512)x);
#else
    return key < splat(limit) ? x : VF{};
#endif
}

GSPLAT_INLINE VD where_below(VD key, double limit, VD x) { return key < splat(limit) ? x : VD{}; }

// 1 / x. AVX-512 has an estimate of 14 bits; one Newton step refines it to 2^-27 at a third of the cost of a division.
GSPLAT_INLINE VF reciprocal(VF x) {
#if GSPLAT_VECTOR_BYTES == 64
    const VF y = (VF)_mm512_rcp14_ps((__m512)x);
    return y * (splat(2.0f) - x * y);
#else
    return splat(1.0f) / x;
#endif
}

GSPLAT_INLINE VD reciprocal(VD x) { return splat(1.0) / x; }

// Writes the lane sums of eight vectors to out[0..7]: three rounds fold pairs of vectors into one, which leaves every sum
// split over the two halves of the register.
GSPLAT_INLINE void sum8(const VF *v, float *out) {
#if GSPLAT_VECTOR_BYTES == 64
    VF a[4], b[2];
    for (int i = 0; i < 4; ++i)
        a[i] = __builtin_shufflevector(v[2 * i], v[2 * i + 1], 0, 16, 2, 18, 4, 20, 6, 22, 8, 24, 10, 26, 12, 28, 14, 30) +
               __builtin_shufflevector(v[2 * i], v[2 * i + 1], 1, 17, 3, 19, 5, 21, 7, 23, 9, 25, 11, 27, 13, 29, 15, 31);
    for (int i = 0; i < 2; ++i)
        b[i] = __builtin_shufflevector(a[2 * i], a[2 * i + 1], 0, 1, 16, 17, 4, 5, 20, 21, 8, 9, 24, 25, 12, 13, 28, 29) +
               __builtin_shufflevector(a[2 * i], a[2 * i + 1], 2, 3, 18, 19, 6, 7, 22, 23, 10, 11, 26, 27, 14, 15, 30, 31);
    const VF c = __builtin_shufflevector(b[0], b[1], 0, 1, 2, 3, 16, 17, 18, 19, 8, 9, 10, 11, 24, 25, 26, 27) +
                 __builtin_shufflevector(b[0], b[1], 4, 5, 6, 7, 20, 21, 22, 23, 12, 13, 14, 15, 28, 29, 30, 31);
    typedef float H __attribute__((vector_size(32)));
    const H h = __builtin_shufflevector(c, c, 0, 1, 2, 3, 4, 5, 6, 7) + __builtin_shufflevector(c, c, 8, 9, 10, 11, 12, 13, 14, 15);
    memcpy(out, &h, sizeof h);
#else
    for (int i = 0; i < 8; ++i) out[i] = sum(v[i]);
#endif
}

GSPLAT_INLINE void sum8(const VD *v, double *out) {
    for (int i = 0; i < 8; ++i) out[i] = sum(v[i]);
}

}  // namespace GSPLAT_ISA
}  // namespace gsplat

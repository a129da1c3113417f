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
#elif defined(__aarch64__)
#include <arm_neon.h>
#endif

#if defined(__AVX512F__)
#define GSPLAT_VECTOR_BYTES 64
#elif defined(__AVX2__)
#define GSPLAT_VECTOR_BYTES 32
#else
#define GSPLAT_VECTOR_BYTES 16
#endif

#define GSPLAT_INLINE static inline __attribute__((always_inline))
#define GSPLAT_METHOD inline __attribute__((always_inline))
#define GSPLAT_CALLED static __attribute__((noinline))  // the compiler finds better registers for a large function on its own
// Of two copies of a function, the compiler may contract other products into sums. Results that have to be equal to the last bit
// come from one copy.
#if defined(__GNUC__) && !defined(__clang__)
#define GSPLAT_ONE_COPY static __attribute__((noinline, noclone))
#else
#define GSPLAT_ONE_COPY static __attribute__((noinline))
#endif

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
typedef uint64_t VU __attribute__((vector_size(GSPLAT_VECTOR_BYTES)));

// A scalar in every lane; written as scalar + zero vector, which compiles to one broadcast.
GSPLAT_INLINE VF splat(float x) { return x - VF{}; }
GSPLAT_INLINE VD splat(double x) { return x - VD{}; }

// A number that a loop needs in a register. GCC loads constants that NEON cannot write as immediates in every round.
template <class V>
GSPLAT_INLINE V kept(V v) {
#if defined(__aarch64__)
    asm("" : "+w"(v));
#endif
    return v;
}

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

// Products of the lower halves of the lanes and a number of 32 bits.
GSPLAT_INLINE VU multiply_low(VU a, uint32_t b) {
#if GSPLAT_VECTOR_BYTES == 64
    return (VU)_mm512_mul_epu32((__m512i)a, _mm512_set1_epi64(b));
#elif defined(__AVX2__)
    return (VU)_mm256_mul_epu32((__m256i)a, _mm256_set1_epi64x(b));
#elif defined(__SSE2__)
    return (VU)_mm_mul_epu32((__m128i)a, _mm_set1_epi64x(b));
#elif defined(__aarch64__)
    return (VU)vmull_u32(vmovn_u64((uint64x2_t)a), vdup_n_u32(b));
#else
    return (a & 0xFFFFFFFFu) * b;
#endif
}

// A vector of bytes, as floats. (GCC 12 converts lane by lane.)
template <class V>
GSPLAT_INLINE V load_bytes(const uint8_t *p);

template <>
inline __attribute__((always_inline)) VF load_bytes<VF>(const uint8_t *p) {
#if GSPLAT_VECTOR_BYTES == 64
    return (VF)_mm512_cvtepi32_ps(_mm512_cvtepu8_epi32(load<__m128i>(p)));
#elif defined(__AVX2__)
    return (VF)_mm256_cvtepi32_ps(_mm256_cvtepu8_epi32(_mm_loadl_epi64(reinterpret_cast<const __m128i *>(p))));
#elif defined(__aarch64__)
    uint32_t four;
    memcpy(&four, p, sizeof four);
    return (VF)vcvtq_f32_u32(vmovl_u16(vget_low_u16(vmovl_u8(vreinterpret_u8_u32(vdup_n_u32(four))))));
#else
    Vector<float>::M v;
    for (int i = 0; i < Vector<float>::LANES; ++i) v[i] = p[i];
    return __builtin_convertvector(v, VF);
#endif
}

template <>
inline __attribute__((always_inline)) VD load_bytes<VD>(const uint8_t *p) {
    VD v;
    for (int i = 0; i < Vector<double>::LANES; ++i) v[i] = p[i];
    return v;
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

#if defined(__aarch64__)
// One instruction instead of a comparison and a selection. Where only a is NaN, the result is b, as above.
GSPLAT_INLINE float vmax(float a, float b) { return fmaxf(a, b); }
GSPLAT_INLINE float vmin(float a, float b) { return fminf(a, b); }
GSPLAT_INLINE double vmax(double a, double b) { return fmax(a, b); }
GSPLAT_INLINE double vmin(double a, double b) { return fmin(a, b); }
GSPLAT_INLINE VF vmax(VF a, VF b) { return (VF)vmaxnmq_f32((float32x4_t)a, (float32x4_t)b); }
GSPLAT_INLINE VF vmin(VF a, VF b) { return (VF)vminnmq_f32((float32x4_t)a, (float32x4_t)b); }
GSPLAT_INLINE VD vmax(VD a, VD b) { return (VD)vmaxnmq_f64((float64x2_t)a, (float64x2_t)b); }
GSPLAT_INLINE VD vmin(VD a, VD b) { return (VD)vminnmq_f64((float64x2_t)a, (float64x2_t)b); }
#endif

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
    const VF q = v;
#endif
#if defined(__aarch64__)
    return vaddvq_f32((float32x4_t)q);
#else
    return (q[0] + q[2]) + (q[1] + q[3]);
#endif
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
#elif GSPLAT_VECTOR_BYTES == 32
    return _mm256_movemask_ps((__m256)(v >= splat(x))) != 0;
#elif defined(__SSE2__)
    return _mm_movemask_ps((__m128)(v >= splat(x))) != 0;
#elif defined(__aarch64__)
    return vmaxnmvq_f32((float32x4_t)v) >= x;  // where a lane is NaN, the others count
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

// 2^f on [-1/2, 1/2], a polynomial of degree 5 fitted for its relative error, 2.4e-7.
GSPLAT_INLINE VF exp2_fraction(VF f) {
    VF y = splat(1.33952915e-3f);
    y = y * f + splat(9.67037690e-3f);
    y = y * f + splat(5.55033013e-2f);
    y = y * f + splat(2.40222633e-1f);
    y = y * f + splat(6.93147182e-1f);
    return y * f + splat(1.0f);
}

// 2^p for -126 <= p < 128. n = round(p), by adding and subtracting 1.5 * 2^23, which -ffast-math would fold away; the lowest
// bits of the sum are those of n, and go to the exponent.
GSPLAT_INLINE VF exp2_(VF p) {
    typedef uint32_t Bits __attribute__((vector_size(GSPLAT_VECTOR_BYTES)));  // wraps instead of overflowing
    const VF magic = splat(12582912.0f), rounded = p + magic;
    return (VF)((Bits)exp2_fraction(p - (rounded - magic)) + ((Bits)rounded << 23));
}

GSPLAT_INLINE VD exp2_(VD p) {
    for (int i = 0; i < Vector<double>::LANES; ++i) p[i] = exp2(p[i]);
    return p;
}

// 2^min(p, most), 0 where p < least; most <= 0 and -126 <= least.
GSPLAT_INLINE VF exp2_between(VF p, float least, float most) {
#if GSPLAT_VECTOR_BYTES == 64
    const __mmask16 keep = _mm512_cmp_ps_mask((__m512)p, _mm512_set1_ps(least), _CMP_GE_OQ);
    p = (VF)_mm512_min_ps((__m512)p, _mm512_set1_ps(most));
    const __m512 n = _mm512_roundscale_ps((__m512)p, _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC);
    return (VF)_mm512_maskz_scalef_ps(keep, (__m512)exp2_fraction(p - (VF)n), n);
#else
    const auto keep = p >= splat(least);
    const VF y = exp2_(vmin(p, splat(most)));  // garbage where p is too small, which is not kept
    return keep ? y : VF{};
#endif
}

GSPLAT_INLINE VD exp2_between(VD p, double least, double most) {
    for (int i = 0; i < Vector<double>::LANES; ++i) p[i] = p[i] >= least ? exp2(p[i] < most ? p[i] : most) : 0.0;
    return p;
}

// min(x, most), 0 where x < least.
GSPLAT_INLINE VF between(VF x, VF least, VF most) {
#if GSPLAT_VECTOR_BYTES == 64
    return (VF)_mm512_maskz_min_ps(_mm512_cmp_ps_mask((__m512)x, (__m512)least, _CMP_GE_OQ), (__m512)x, (__m512)most);
#else
    const VF y = vmin(x, most);
    return x >= least ? y : VF{};
#endif
}

GSPLAT_INLINE VD between(VD x, VD least, VD most) {
    const VD y = vmin(x, most);
    return x >= least ? y : VD{};
}

// x where key is below the limit, otherwise 0.
GSPLAT_INLINE VF where_below(VF key, VF limit, VF x) {
#if GSPLAT_VECTOR_BYTES == 64
    return (VF)_mm512_maskz_mov_ps(_mm512_cmp_ps_mask((__m512)key, (__m512)limit, _CMP_LT_OQ), (__m512)x);
#else
    return key < limit ? x : VF{};
#endif
}

GSPLAT_INLINE VD where_below(VD key, VD limit, VD x) { return key < limit ? x : VD{}; }

// 1 / x. AVX-512 has an estimate of 14 bits; one Newton step refines it to 2^-27 at a third of the cost of a division.
GSPLAT_INLINE VF reciprocal(VF x) {
#if GSPLAT_VECTOR_BYTES == 64
    const VF y = (VF)_mm512_maskz_rcp14_ps(0xFFFF, (__m512)x);  // without a mask GCC 12 warns of its header
    return y * (splat(2.0f) - x * y);
#else
    return splat(1.0f) / x;
#endif
}

GSPLAT_INLINE VD reciprocal(VD x) { return splat(1.0) / x; }

// Turns the rows of a square of numbers, as many as a vector has, into columns: first in squares of four, then these squares.
GSPLAT_INLINE void transpose_square(const float *in, int64_t stride, float *out, int64_t out_stride) {
    constexpr int LANES = Vector<float>::LANES;
    VF v[LANES];
    for (int i = 0; i < LANES; ++i) v[i] = load<VF>(in + i * stride);
    for (int i = 0; i < LANES; i += 4) {
        const VF a = v[i], b = v[i + 1], c = v[i + 2], d = v[i + 3];
#if GSPLAT_VECTOR_BYTES == 64
#define GSPLAT_ZIP(x, y, k)                                                                                                             \
    __builtin_shufflevector(x, y, k, k + 16, k + 1, k + 17, k + 4, k + 20, k + 5, k + 21, k + 8, k + 24, k + 9, k + 25, k + 12, k + 28, \
                            k + 13, k + 29)
#define GSPLAT_ZIP_PAIRS(x, y, k)                                                                                                       \
    __builtin_shufflevector(x, y, k, k + 1, k + 16, k + 17, k + 4, k + 5, k + 20, k + 21, k + 8, k + 9, k + 24, k + 25, k + 12, k + 13, \
                            k + 28, k + 29)
#elif GSPLAT_VECTOR_BYTES == 32
#define GSPLAT_ZIP(x, y, k) __builtin_shufflevector(x, y, k, k + 8, k + 1, k + 9, k + 4, k + 12, k + 5, k + 13)
#define GSPLAT_ZIP_PAIRS(x, y, k) __builtin_shufflevector(x, y, k, k + 1, k + 8, k + 9, k + 4, k + 5, k + 12, k + 13)
#else
#define GSPLAT_ZIP(x, y, k) __builtin_shufflevector(x, y, k, k + 4, k + 1, k + 5)
#define GSPLAT_ZIP_PAIRS(x, y, k) __builtin_shufflevector(x, y, k, k + 1, k + 4, k + 5)
#endif
        const VF ab = GSPLAT_ZIP(a, b, 0), cd = GSPLAT_ZIP(c, d, 0), ab_high = GSPLAT_ZIP(a, b, 2), cd_high = GSPLAT_ZIP(c, d, 2);
        v[i] = GSPLAT_ZIP_PAIRS(ab, cd, 0), v[i + 1] = GSPLAT_ZIP_PAIRS(ab, cd, 2);
        v[i + 2] = GSPLAT_ZIP_PAIRS(ab_high, cd_high, 0), v[i + 3] = GSPLAT_ZIP_PAIRS(ab_high, cd_high, 2);
#undef GSPLAT_ZIP
#undef GSPLAT_ZIP_PAIRS
    }
#if GSPLAT_VECTOR_BYTES == 64
#define GSPLAT_FOURS(x, y, i, j)                                                                                                          \
    __builtin_shufflevector(x, y, i, i + 1, i + 2, i + 3, j, j + 1, j + 2, j + 3, i + 16, i + 17, i + 18, i + 19, j + 16, j + 17, j + 18, \
                            j + 19)
    for (int i = 0; i < 4; ++i) {
        const VF ab = GSPLAT_FOURS(v[i], v[i + 4], 0, 4), ab_high = GSPLAT_FOURS(v[i], v[i + 4], 8, 12);
        const VF cd = GSPLAT_FOURS(v[i + 8], v[i + 12], 0, 4), cd_high = GSPLAT_FOURS(v[i + 8], v[i + 12], 8, 12);
        v[i] = GSPLAT_FOURS(ab, cd, 0, 8), v[i + 4] = GSPLAT_FOURS(ab, cd, 4, 12);
        v[i + 8] = GSPLAT_FOURS(ab_high, cd_high, 0, 8), v[i + 12] = GSPLAT_FOURS(ab_high, cd_high, 4, 12);
    }
#undef GSPLAT_FOURS
#elif GSPLAT_VECTOR_BYTES == 32
    for (int i = 0; i < 4; ++i) {
        const VF a = v[i], b = v[i + 4];
        v[i] = __builtin_shufflevector(a, b, 0, 1, 2, 3, 8, 9, 10, 11),
        v[i + 4] = __builtin_shufflevector(a, b, 4, 5, 6, 7, 12, 13, 14, 15);
    }
#endif
    for (int i = 0; i < LANES; ++i) store(out + i * out_stride, v[i]);
}

GSPLAT_INLINE void transpose_square(const double *in, int64_t stride, double *out, int64_t out_stride) {
    for (int i = 0; i < Vector<double>::LANES; ++i)
        for (int j = 0; j < Vector<double>::LANES; ++j) out[j * out_stride + i] = in[i * stride + j];
}

// x / (1 - x).
GSPLAT_INLINE VF odds(VF x) {
#if GSPLAT_VECTOR_BYTES == 64
    return x * reciprocal(splat(1.0f) - x);
#else
    return x / (splat(1.0f) - x);
#endif
}

GSPLAT_INLINE VD odds(VD x) { return x / (splat(1.0) - x); }

// Writes the lane sums of eight vectors to out[0..7]: each round folds pairs of vectors into one.
GSPLAT_INLINE void sum8(const VF *v, float *out) {
#if GSPLAT_VECTOR_BYTES == 64
    VF a[4], b[2];
    for (int i = 0; i < 4; ++i)
        a[i] = __builtin_shufflevector(v[2 * i], v[2 * i + 1], 0, 16, 1, 17, 4, 20, 5, 21, 8, 24, 9, 25, 12, 28, 13, 29) +
               __builtin_shufflevector(v[2 * i], v[2 * i + 1], 2, 18, 3, 19, 6, 22, 7, 23, 10, 26, 11, 27, 14, 30, 15, 31);
    for (int i = 0; i < 2; ++i)
        b[i] = __builtin_shufflevector(a[2 * i], a[2 * i + 1], 0, 1, 16, 17, 4, 5, 20, 21, 8, 9, 24, 25, 12, 13, 28, 29) +
               __builtin_shufflevector(a[2 * i], a[2 * i + 1], 2, 3, 18, 19, 6, 7, 22, 23, 10, 11, 26, 27, 14, 15, 30, 31);
    const VF c = __builtin_shufflevector(b[0], b[1], 0, 1, 2, 3, 16, 17, 18, 19, 8, 9, 10, 11, 24, 25, 26, 27) +
                 __builtin_shufflevector(b[0], b[1], 4, 5, 6, 7, 20, 21, 22, 23, 12, 13, 14, 15, 28, 29, 30, 31);
    typedef float Half __attribute__((vector_size(32)));
    const Half h = __builtin_shufflevector(c, c, 0, 1, 2, 3, 4, 5, 6, 7) + __builtin_shufflevector(c, c, 8, 9, 10, 11, 12, 13, 14, 15);
    memcpy(out, &h, sizeof h);
#elif GSPLAT_VECTOR_BYTES == 32
    VF a[4], b[2];
    for (int i = 0; i < 4; ++i)
        a[i] = __builtin_shufflevector(v[2 * i], v[2 * i + 1], 0, 8, 1, 9, 4, 12, 5, 13) +
               __builtin_shufflevector(v[2 * i], v[2 * i + 1], 2, 10, 3, 11, 6, 14, 7, 15);
    for (int i = 0; i < 2; ++i)
        b[i] = __builtin_shufflevector(a[2 * i], a[2 * i + 1], 0, 1, 8, 9, 4, 5, 12, 13) +
               __builtin_shufflevector(a[2 * i], a[2 * i + 1], 2, 3, 10, 11, 6, 7, 14, 15);
    store(out, VF(__builtin_shufflevector(b[0], b[1], 0, 1, 2, 3, 8, 9, 10, 11) +
                  __builtin_shufflevector(b[0], b[1], 4, 5, 6, 7, 12, 13, 14, 15)));
#elif defined(__aarch64__)
    float32x4_t pairs[4];
    for (int i = 0; i < 4; ++i) pairs[i] = vpaddq_f32((float32x4_t)v[2 * i], (float32x4_t)v[2 * i + 1]);
    vst1q_f32(out, vpaddq_f32(pairs[0], pairs[1])), vst1q_f32(out + 4, vpaddq_f32(pairs[2], pairs[3]));
#else
    for (int half = 0; half < 8; half += 4) {
        VF a[2];
        for (int i = 0; i < 2; ++i)
            a[i] = __builtin_shufflevector(v[half + 2 * i], v[half + 2 * i + 1], 0, 4, 1, 5) +
                   __builtin_shufflevector(v[half + 2 * i], v[half + 2 * i + 1], 2, 6, 3, 7);
        store(out + half, VF(__builtin_shufflevector(a[0], a[1], 0, 1, 4, 5) + __builtin_shufflevector(a[0], a[1], 2, 3, 6, 7)));
    }
#endif
}

GSPLAT_INLINE void sum8(const VD *v, double *out) {
    for (int i = 0; i < 8; ++i) out[i] = sum(v[i]);
}

}  // namespace GSPLAT_ISA
}  // namespace gsplat

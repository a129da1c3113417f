// noise: one random step of every mean, along its covariance; the fainter the Gaussian, the larger.
//
//     mean += amount sigmoid(k (t - opacity)) Sigma n,  n ~ N(0, I);  a sigmoid below e^-60 counts as 0
//
// The Philox generator turns the seed of the step and the index of a Gaussian into four 32-bit words, without a state. So no
// draw depends on the draws before it, nor on the thread. Of each word the upper 24 bits count: they are exact as a float.
//
// Source: Salmon et al. 2011, "Parallel Random Numbers: As Easy as 1, 2, 3" (Philox 4x32-10); Box and Muller 1958.
#include "gaussian_math.h"
#include "isa.h"

namespace gsplat {
namespace GSPLAT_ISA {

// Gaussians that are processed together, in loops over local arrays that the compiler turns into vectors.
constexpr int GROUP = 64;

template <class T>
using Column = T[GROUP];

// Four words for each of the Gaussians from `first`, as whole numbers below 2^24. A lane of 64 bits holds one word; only its lower half
// counts, so products need no unpacking.
GSPLAT_INLINE void draw_words(uint64_t seed, int64_t first, Column<int32_t> *words) {
    constexpr int LANES = int(sizeof(VU) / sizeof(uint64_t));
    for (int i = 0; i < GROUP; i += LANES) {
        VU c0, c1, c2{}, c3{};
        for (int lane = 0; lane < LANES; ++lane) c0[lane] = uint64_t(first + i + lane);
        c1 = c0 >> 32;
        uint32_t key0 = uint32_t(seed), key1 = uint32_t(seed >> 32);
        for (int round = 0; round < 10; ++round, key0 += 0x9E3779B9u, key1 += 0xBB67AE85u) {
            const VU a = multiply_low(c0, 0xD2511F53u), b = multiply_low(c2, 0xCD9E8D57u);
            c0 = (b >> 32) ^ c1 ^ key0, c1 = b;
            c2 = (a >> 32) ^ c3 ^ key1, c3 = a;
        }
        for (int lane = 0; lane < LANES; ++lane) {
            words[0][i + lane] = int32_t(uint32_t(c0[lane]) >> 8), words[1][i + lane] = int32_t(uint32_t(c1[lane]) >> 8);
            words[2][i + lane] = int32_t(uint32_t(c2[lane]) >> 8), words[3][i + lane] = int32_t(uint32_t(c3[lane]) >> 8);
        }
    }
}

// The functions below are written for loops: no branch, no call. In double they are libm's.

// log u for u from 2^-24 to 1: u = 2^e m with m from sqrt(1/2) to sqrt(2), and log m = 2 artanh s as a series. The first term left
// out is 2e-9 of the result.
GSPLAT_INLINE float log_uniform(float u) {
    constexpr uint32_t root_half = 0x3F3504F3;
    const uint32_t bits = __builtin_bit_cast(uint32_t, u) - root_half;
    const float e = float(int32_t(bits) >> 23), m = __builtin_bit_cast(float, (bits & 0x7FFFFF) + root_half);
    const float s = (m - 1) / (m + 1), z = s * s;
    return e * 0.693147181f + 2 * s * (1 + z * (1 / 3.0f + z * (1 / 5.0f + z * (1 / 7.0f + z * (1 / 9.0f)))));
}
GSPLAT_INLINE double log_uniform(double u) { return log(u); }

// Cosine and sine of a full turn times x, x from 0 to 1: Taylor series on an eighth of a turn on each side of the nearest
// quarter. The first terms left out are below 3e-8.
GSPLAT_INLINE void cos_sin_turns(float x, float *cosine, float *sine) {
    const int32_t quarter = int32_t(4 * x + 0.5f);
    const float a = (x - 0.25f * float(quarter)) * 6.28318531f, z = a * a;
    const float s = a * (1 + z * (-1 / 6.0f + z * (1 / 120.0f + z * (-1 / 5040.0f + z * (1 / 362880.0f)))));
    const float c = 1 + z * (-1 / 2.0f + z * (1 / 24.0f + z * (-1 / 720.0f + z * (1 / 40320.0f))));
    const float on_x = quarter & 1 ? s : c, on_y = quarter & 1 ? c : s;
    *cosine = (quarter + 1) & 2 ? -on_x : on_x, *sine = quarter & 2 ? -on_y : on_y;
}
GSPLAT_INLINE void cos_sin_turns(double x, double *cosine, double *sine) {
    *cosine = cos(6.283185307179586 * x), *sine = sin(6.283185307179586 * x);
}

// exp x, relative error 2e-7; infinity above 88.8. 2^n is applied in two factors, because n exceeds the exponents of a float.
GSPLAT_INLINE float exp_branchless(float x) {
    x = x > 100.0f ? 100.0f : x;
    x = x < -100.0f ? -100.0f : x;  // NaN passes
    const float magic = 12582912.0f, shifted = x * 1.44269504f + magic, n = shifted - magic;
    const float r = (x - n * 0.693359375f) + n * 2.12194440e-4f;
    const float y =
        1 + r * (1 + r * (1 / 2.0f + r * (1 / 6.0f + r * (1 / 24.0f + r * (1 / 120.0f + r * (1 / 720.0f + r * (1 / 5040.0f)))))));
    const int32_t whole = __builtin_bit_cast(int32_t, shifted) - __builtin_bit_cast(int32_t, magic), half = whole >> 1;
    const auto power = [](int32_t k) { return __builtin_bit_cast(float, uint32_t(k + 127) << 23); };
    return y * power(half) * power(whole - half);
}
GSPLAT_INLINE double exp_branchless(double x) { return exp(x); }

// Three standard normal numbers for each Gaussian from four words: radius and angle, twice.
template <class T>
GSPLAT_INLINE void normals(const Column<int32_t> *words, Column<T> *out) {
    for (int i = 0; i < GROUP; ++i) {
        const T step = T(0x1p-24);
        const T radius = sqrt_(-2 * log_uniform(T(words[0][i] + 1) * step)), other = sqrt_(-2 * log_uniform(T(words[2][i] + 1) * step));
        T x, y, z, unused;
        cos_sin_turns(T(words[1][i]) * step, &x, &y);
        cos_sin_turns(T(words[3][i]) * step, &z, &unused);
        out[0][i] = radius * x, out[1][i] = radius * y, out[2][i] = other * z;
    }
}

// The steps of a group, which replace the normal numbers.
template <class T>
GSPLAT_INLINE void steps(const NoiseArgs<T> &args, const Column<T> *quats, const Column<T> *log_scales, const T *logits, Column<T> *n) {
    const T amount = T(args.amount), k = T(args.sharpness), t = T(args.threshold);
    for (int i = 0; i < GROUP; ++i) {
        T q[4] = {quats[0][i], quats[1][i], quats[2][i], quats[3][i]}, R[9], along[3];
        // The largest entry first: the norm of the rest can neither overflow nor underflow.
        const T size = 1 / vmax(vmax(abs_(q[0]), abs_(q[1])), vmax(abs_(q[2]), abs_(q[3])));
        for (T &entry : q) entry *= size;
        const T unit = 1 / sqrt_(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
        for (T &entry : q) entry *= unit;
        rotation(q, T(1), R);
        for (int a = 0; a < 3; ++a)
            along[a] = exp_branchless(2 * log_scales[a][i]) * (R[a] * n[0][i] + R[3 + a] * n[1][i] + R[6 + a] * n[2][i]);
        const T opacity = 1 / (1 + exp_branchless(-logits[i])), x = k * (opacity - t);
        const T shut = T(60),
                gate = x > shut ? 0 : amount / (1 + exp_branchless(x > shut ? shut : x));  // a denormal takes a hundred cycles
        for (int a = 0; a < 3; ++a) n[a][i] = gate * (R[3 * a] * along[0] + R[3 * a + 1] * along[1] + R[3 * a + 2] * along[2]);
    }
}

template <class T>
void noise(const NoiseArgs<T> &args, int64_t begin, int64_t end) {
    Column<int32_t> words[4];
    Column<T> n[3], quats[4] = {}, log_scales[3] = {};
    T logits[GROUP] = {};
    for (int64_t first = begin; first < end; first += GROUP) {
        const int count = int(vmin<int64_t>(GROUP, end - first));
        for (int i = 0; i < count; ++i) {
            for (int a = 0; a < 4; ++a) quats[a][i] = args.quats[4 * (first + i) + a];
            for (int a = 0; a < 3; ++a) log_scales[a][i] = args.log_scales[3 * (first + i) + a];
            logits[i] = args.logit_opacities[first + i];
        }
        draw_words(args.seed, first, words);
        normals<T>(words, n);
        steps<T>(args, quats, log_scales, logits, n);
        for (int i = 0; i < count; ++i)
            for (int a = 0; a < 3; ++a) args.means[3 * (first + i) + a] += n[a][i];
    }
}

template void noise<float>(const NoiseArgs<float> &, int64_t, int64_t);
template void noise<double>(const NoiseArgs<double> &, int64_t, int64_t);

}  // namespace GSPLAT_ISA
}  // namespace gsplat

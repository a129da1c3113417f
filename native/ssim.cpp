// ssim: the training loss (1 - k) L1 + k (1 - SSIM) of one band of rows, and its gradient.
//
// With G a blur of 11 taps (sigma 1.5, zero outside the image), mx = G x, my = G y, v = G (x² + y²) - mx² - my² (the sum
// of both variances), c = G xy - mx my:
//
//     S = A1 A2 / (B1 B2),  A1 = 2 mx my + C1,  A2 = 2 c + C2,  B1 = mx² + my² + C1,  B2 = v + C2
//     dS/dv = -S / B2,  dS/dc = 2 A1 / (B1 B2),  dS/dmx = 2 my A2 / (B1 B2) - 2 mx S / B1 - 2 mx dS/dv - my dS/dc
//     dsum(S)/dx = G dS/dmx + 2 x G dS/dv + y G dS/dc
//
// Channels are interleaved, so a tap to the right is three numbers further on. A band goes through in strips, so that
// the rows that a strip needs again and again stay in a core's cache.
#include "gaussian_math.h"
#include "isa.h"

namespace gsplat {
namespace GSPLAT_ISA {

constexpr int HALF = SSIM_HALF, CHANNELS = 3, MARGIN = HALF * CHANNELS;
constexpr int64_t STRIP = SSIM_STRIP, ROWS = SSIM_BAND + 2 * HALF, PLANE = ROWS * STRIP;

// A strip of a band: image rows first .. last - 1, numbers x0 .. x0 + count - 1 of each.
struct Strip {
    int64_t first, last, x0, count, width, height;
};

// Part of an image row with what lies MARGIN to its left and right, zero outside the image.
template <class T>
struct Segment {
    alignas(64) T numbers[STRIP + 2 * MARGIN + 64];
    T *middle() { return numbers + MARGIN; }
};

template <class T, class S>
GSPLAT_INLINE void cut(const S *row, T factor, const Strip &s, Segment<T> &out) {
    const int64_t begin = vmax<int64_t>(s.x0 - MARGIN, 0), end = vmin<int64_t>(s.x0 + STRIP + MARGIN, s.width);
    if (end - begin < STRIP + 2 * MARGIN) memset(out.numbers, 0, sizeof out.numbers);
    T *to = out.numbers + (begin - (s.x0 - MARGIN));
    for (int64_t i = 0; i < end - begin; ++i) to[i] = T(row[begin + i]) * factor;
}

template <class T>
GSPLAT_INLINE void cut_target(const LossArgs<T> &args, int64_t row, const Strip &s, Segment<T> &out) {
    if (args.target_bytes)
        cut(args.target_bytes + row * s.width, T(1) / T(255), s, out);
    else
        cut(args.target + row * s.width, T(1), s, out);
}

// G along x at one place of a segment; `at(i)` loads the vector i numbers away.
template <class V, class T, class F>
GSPLAT_INLINE V blur_x(F at) {
    V sum = splat(T(SSIM_TAP[0])) * at(0);
    for (int k = 1; k <= HALF; ++k) sum += splat(T(SSIM_TAP[k])) * (at(-CHANNELS * k) + at(CHANNELS * k));
    return sum;
}

template <class V, class T>
GSPLAT_INLINE V blur_y(const T *in) {
    V sum = splat(T(SSIM_TAP[0])) * load<V>(in);
    for (int k = 1; k <= HALF; ++k)
        sum += splat(T(SSIM_TAP[k])) * (load<V>(in - k * STRIP) + load<V>(in + k * STRIP));
    return sum;
}

// Calls body(strip) for every strip of a band.
template <class T, class F>
GSPLAT_INLINE void strips(const LossArgs<T> &args, int64_t band, F body) {
    const int64_t width = int64_t(args.W) * CHANNELS, first = band * SSIM_BAND;
    const int64_t last = vmin<int64_t>(first + SSIM_BAND, args.H);
    for (int64_t x0 = 0; x0 < width; x0 += STRIP)
        body(Strip{first, last, x0, vmin<int64_t>(STRIP, width - x0), width, args.H});
}

// The four blurs along x, of x, y, x² + y² and xy, of the strip's rows and of those its windows reach.
template <class T>
GSPLAT_INLINE void blur_inputs(const LossArgs<T> &args, const Strip &s, T *scratch) {
    using V = typename Vector<T>::V;
    Segment<T> x, y;
    for (int64_t r = 0; r < s.last - s.first + 2 * HALF; ++r) {
        const int64_t row = s.first + r - HALF;
        T *out = scratch + r * STRIP;
        if (row < 0 || row >= s.height) {
            for (int p = 0; p < 4; ++p) memset(out + p * PLANE, 0, STRIP * sizeof(T));
            continue;
        }
        cut(args.image + row * s.width, T(1), s, x);
        cut_target(args, row, s, y);
        for (int64_t i = 0; i < STRIP; i += Vector<T>::LANES) {
            const T *a = x.middle() + i, *b = y.middle() + i;
            const V x0 = load<V>(a), y0 = load<V>(b), tap = splat(T(SSIM_TAP[0]));
            V mx = tap * x0, my = tap * y0, squares = tap * (x0 * x0 + y0 * y0), product = tap * (x0 * y0);
            for (int k = 1; k <= HALF; ++k) {
                const V xl = load<V>(a - CHANNELS * k), xr = load<V>(a + CHANNELS * k);
                const V yl = load<V>(b - CHANNELS * k), yr = load<V>(b + CHANNELS * k);
                const V w = splat(T(SSIM_TAP[k]));
                mx += w * (xl + xr), my += w * (yl + yr);
                squares += w * (xl * xl + xr * xr + yl * yl + yr * yr);
                product += w * (xl * yl + xr * yr);
            }
            store(out + i, mx), store(out + PLANE + i, my);
            store(out + 2 * PLANE + i, squares), store(out + 3 * PLANE + i, product);
        }
    }
}

// Stores the first `count` lanes.
template <class V, class T>
GSPLAT_INLINE void store_some(T *to, V v, int64_t count) {
    if (count >= Vector<T>::LANES) return store(to, v);
    memcpy(to, &v, size_t(count) * sizeof(T));
}

// L1 alone: sum and gradient of a band in one go.
template <class T>
GSPLAT_INLINE void l1_only(const LossArgs<T> &args, int64_t band) {
    const T each = T(1 / (double(args.H) * args.W * CHANNELS));
    double total = 0;
    strips(args, band, [&](const Strip &s) {
        Segment<T> y;
        for (int64_t row = s.first; row < s.last; ++row) {
            cut_target(args, row, s, y);
            const T *x = args.image + row * s.width + s.x0;
            T *out = args.grad + row * s.width + s.x0;
            T row_sum = 0;
            for (int64_t i = 0; i < s.count; ++i) {
                const T d = x[i] - y.middle()[i];
                out[i] = d > 0 ? each : (d < 0 ? -each : T(0));
                row_sum += d > 0 ? d : -d;
            }
            total += double(row_sum);
        }
    });
    args.sums[2 * band] = total, args.sums[2 * band + 1] = 0;
}

template <class T>
void loss_forward(const LossArgs<T> &args, int64_t band, T *scratch) {
    if (args.ssim_weight == 0) return l1_only(args, band);
    using V = typename Vector<T>::V;
    constexpr int LANES = Vector<T>::LANES;
    const V C1 = splat(T(SSIM_C1)), C2 = splat(T(SSIM_C2)), one = splat(T(1)), two = splat(T(2));
    double sum_l1 = 0, sum_ssim = 0;
    strips(args, band, [&](const Strip &s) {
        blur_inputs(args, s, scratch);
        Segment<T> x, y;
        for (int64_t row = s.first; row < s.last; ++row) {
            const T *in = scratch + (row - s.first + HALF) * STRIP;
            T *out = args.maps + row * s.width + s.x0;
            const int64_t map = s.height * s.width;
            cut(args.image + row * s.width, T(1), s, x);
            cut_target(args, row, s, y);
            V row_ssim{}, row_l1{};
            for (int64_t i = 0; i < s.count; i += LANES) {
                const V mx = blur_y<V>(in + i), my = blur_y<V>(in + PLANE + i);
                const V v = blur_y<V>(in + 2 * PLANE + i) - mx * mx - my * my;
                const V c = blur_y<V>(in + 3 * PLANE + i) - mx * my;
                const V A1 = two * mx * my + C1, A2 = two * c + C2, B1 = mx * mx + my * my + C1, B2 = v + C2;
                const V inverse = one / (B1 * B2), S = A1 * A2 * inverse;
                const V dv = -S * B1 * inverse, dc = two * A1 * inverse;
                const V dm = two * (my * A2 * inverse - mx * S * B2 * inverse - mx * dv) - my * dc;
                const int64_t left = s.count - i;
                store_some(out + i, dm, left), store_some(out + map + i, dv, left), store_some(out + 2 * map + i, dc, left);
                const V difference = load<V>(x.middle() + i) - load<V>(y.middle() + i);
                const V inside = iota<T>() < splat(T(left < LANES ? left : LANES)) ? one : V{};
                row_ssim += S * inside;
                row_l1 += (difference > V{} ? difference : -difference) * inside;
            }
            sum_ssim += double(sum(row_ssim)), sum_l1 += double(sum(row_l1));
        }
    });
    args.sums[2 * band] = sum_l1, args.sums[2 * band + 1] = sum_ssim;
}

template <class T>
void loss_backward(const LossArgs<T> &args, int64_t band, T *scratch) {
    if (args.ssim_weight == 0) return;
    using V = typename Vector<T>::V;
    const double pixels = double(args.H) * args.W * CHANNELS;
    const V l1 = splat(T((1 - args.ssim_weight) / pixels)), ssim = splat(T(args.ssim_weight / pixels)), two = splat(T(2));
    strips(args, band, [&](const Strip &s) {
        Segment<T> x, y;
        for (int64_t r = 0; r < s.last - s.first + 2 * HALF; ++r) {
            const int64_t row = s.first + r - HALF;
            for (int p = 0; p < 3; ++p) {
                T *out = scratch + p * PLANE + r * STRIP;
                if (row < 0 || row >= s.height) {
                    memset(out, 0, STRIP * sizeof(T));
                    continue;
                }
                cut(args.maps + (p * s.height + row) * s.width, T(1), s, x);
                for (int64_t i = 0; i < STRIP; i += Vector<T>::LANES)
                    store(out + i, blur_x<V, T>([&](int64_t k) { return load<V>(x.middle() + i + k); }));
            }
        }
        for (int64_t row = s.first; row < s.last; ++row) {
            const T *in = scratch + (row - s.first + HALF) * STRIP;
            cut(args.image + row * s.width, T(1), s, x);
            cut_target(args, row, s, y);
            for (int64_t i = 0; i < s.count; i += Vector<T>::LANES) {
                const V a = load<V>(x.middle() + i), b = load<V>(y.middle() + i);
                const V d = blur_y<V>(in + i) + two * a * blur_y<V>(in + PLANE + i) + b * blur_y<V>(in + 2 * PLANE + i);
                const V sign = (a > b ? l1 : V{}) - (a < b ? l1 : V{});
                store_some(args.grad + row * s.width + s.x0 + i, sign - ssim * d, s.count - i);
            }
        }
    });
}

template void loss_forward<float>(const LossArgs<float> &, int64_t, float *);
template void loss_forward<double>(const LossArgs<double> &, int64_t, double *);
template void loss_backward<float>(const LossArgs<float> &, int64_t, float *);
template void loss_backward<double>(const LossArgs<double> &, int64_t, double *);

}  // namespace GSPLAT_ISA
}  // namespace gsplat

// ssim: the training loss (1 - k) L1 + k (1 - SSIM) of one band of rows, and its gradient.
//
// With G a blur of 11 taps (sigma 1.5, zero outside the image), mx = G x, my = G y, v = G (x² + y²) - mx² - my² (the sum
// of both variances), c = G xy - mx my:
//
//     S = A1 A2 / (B1 B2),  A1 = 2 mx my + C1,  A2 = 2 c + C2,  B1 = mx² + my² + C1,  B2 = v + C2
//     dS/dv = -S / B2,  dS/dc = 2 A1 / (B1 B2),  dS/dmx = 2 my A2 / (B1 B2) - 2 mx S / B1 - 2 mx dS/dv - my dS/dc
//     dsum(S)/dx = G dS/dmx + 2 x G dS/dv + y G dS/dc
//
// Channels are interleaved, so the next tap to the right is three numbers away. A band is processed in strips, each with a
// margin of two window halves (for S and for the gradient), so that only images are read from and written to memory.
#include "gaussian_math.h"
#include "isa.h"

namespace gsplat {
namespace GSPLAT_ISA {

constexpr int HALF = SSIM_HALF, CHANNELS = 3, MARGIN = HALF * CHANNELS;
constexpr int64_t STRIP = SSIM_STRIP, MAP = SSIM_MAP;            // numbers per row: of the strip, and of its map of S
constexpr int64_t MAP_ROWS = SSIM_BAND + 2 * HALF, IN_ROWS = SSIM_BAND + 4 * HALF;
constexpr int64_t IN_PLANE = IN_ROWS * MAP, OUT_PLANE = MAP_ROWS * STRIP;

// A strip of a band: image rows first .. last - 1, numbers x0 .. x0 + count - 1 of each.
struct Strip {
    int64_t first, last, x0, count, width, height;
    bool has_row(int64_t row) const { return row >= 0 && row < height; }
};

// Part of an image row, starting 2 MARGIN left of the strip; zero outside the image.
template <class T>
struct Segment {
    alignas(64) T numbers[MAP + 2 * MARGIN];
    T *strip() { return numbers + 2 * MARGIN; }
};

template <class T, class S>
GSPLAT_INLINE void cut(const S *row, T factor, const Strip &s, Segment<T> &out) {
    const int64_t origin = s.x0 - 2 * MARGIN, begin = vmax<int64_t>(origin, 0);
    const int64_t end = vmin<int64_t>(origin + MAP + 2 * MARGIN, s.width);
    if (end - begin < MAP + 2 * MARGIN) memset(out.numbers, 0, sizeof out.numbers);
    T *to = out.numbers + (begin - origin);
    for (int64_t i = 0; i < end - begin; ++i) to[i] = T(row[begin + i]) * factor;
}

template <class T>
GSPLAT_INLINE void cut_target(const LossArgs<T> &args, int64_t row, const Strip &s, Segment<T> &out) {
    if (args.target_bytes)
        cut(args.target_bytes + row * s.width, T(1) / T(255), s, out);
    else
        cut(args.target + row * s.width, T(1), s, out);
}

// G along y: `in` points to the central row; rows are `stride` numbers apart.
template <class V, class T>
GSPLAT_INLINE V blur_y(const T *in, int64_t stride) {
    V sum = splat(T(SSIM_TAP[0])) * load<V>(in);
    for (int k = 1; k <= HALF; ++k) sum += splat(T(SSIM_TAP[k])) * (load<V>(in - k * stride) + load<V>(in + k * stride));
    return sum;
}

// Calls body(strip) for every strip of a band.
template <class T, class F>
GSPLAT_INLINE void strips(const LossArgs<T> &args, int64_t band, F body) {
    const int64_t width = int64_t(args.W) * CHANNELS, first = band * SSIM_BAND;
    const int64_t last = vmin<int64_t>(first + SSIM_BAND, args.H);
    for (int64_t x0 = 0; x0 < width; x0 += STRIP) body(Strip{first, last, x0, vmin<int64_t>(STRIP, width - x0), width, args.H});
}

// G along x of x, y, x² + y² and xy, for every row that the strip's maps need: four planes of IN_ROWS x MAP.
template <class T>
GSPLAT_INLINE void blur_inputs(const LossArgs<T> &args, const Strip &s, T *planes) {
    using V = typename Vector<T>::V;
    Segment<T> x, y;
    for (int64_t r = 0; r < s.last - s.first + 4 * HALF; ++r) {
        const int64_t row = s.first + r - 2 * HALF;
        T *out = planes + r * MAP;
        if (!s.has_row(row)) {
            for (int p = 0; p < 4; ++p) memset(out + p * IN_PLANE, 0, MAP * sizeof(T));
            continue;
        }
        cut(args.image + row * s.width, T(1), s, x);
        cut_target(args, row, s, y);
        for (int64_t i = 0; i < MAP; i += Vector<T>::LANES) {
            const T *a = x.numbers + MARGIN + i, *b = y.numbers + MARGIN + i;
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
            store(out + i, mx), store(out + IN_PLANE + i, my);
            store(out + 2 * IN_PLANE + i, squares), store(out + 3 * IN_PLANE + i, product);
        }
    }
}

// One row of dS/dmx, dS/dv and dS/dc from the blurred inputs; 0 outside the image. Returns the sum of S over the strip.
template <class T>
GSPLAT_INLINE T map_row(const Strip &s, const T *in, T (*maps)[MAP]) {
    using V = typename Vector<T>::V;
    const V C1 = splat(T(SSIM_C1)), C2 = splat(T(SSIM_C2)), one = splat(T(1)), two = splat(T(2));
    const V left = splat(T(vmax<int64_t>(MARGIN - s.x0, 0))), right = splat(T(vmin<int64_t>(MAP, s.width - s.x0 + MARGIN)));
    const V begin = splat(T(MARGIN)), end = splat(T(MARGIN + s.count));
    V total{}, column = iota<T>();
    for (int64_t i = 0; i < MAP; i += Vector<T>::LANES, column += splat(T(Vector<T>::LANES))) {
        const V mx = blur_y<V>(in + i, MAP), my = blur_y<V>(in + IN_PLANE + i, MAP);
        const V v = blur_y<V>(in + 2 * IN_PLANE + i, MAP) - mx * mx - my * my;
        const V c = blur_y<V>(in + 3 * IN_PLANE + i, MAP) - mx * my;
        const V A1 = two * mx * my + C1, A2 = two * c + C2, B1 = mx * mx + my * my + C1, B2 = v + C2;
        const V inverse = one / (B1 * B2), S = A1 * A2 * inverse;
        const V inside = (column >= left ? one : V{}) * (column < right ? one : V{});
        const V dv = -S * B1 * inverse * inside, dc = two * A1 * inverse * inside;
        const V dm = two * inside * inverse * (my * A2 - mx * S * B2) - two * mx * dv - my * dc;
        store(maps[0] + i, dm), store(maps[1] + i, dv), store(maps[2] + i, dc);
        total += S * (column >= begin ? one : V{}) * (column < end ? one : V{});
    }
    return sum(total);
}

// Stores the first `count` lanes.
template <class V, class T>
GSPLAT_INLINE void store_some(T *to, V v, int64_t count) {
    if (count >= Vector<T>::LANES) return store(to, v);
    memcpy(to, &v, size_t(count) * sizeof(T));
}

// The gradient of the strip's rows, from the maps blurred along x; returns the sum of |x - y|.
template <class T>
GSPLAT_INLINE double gradient(const LossArgs<T> &args, const Strip &s, const T *planes) {
    using V = typename Vector<T>::V;
    const double numbers = double(args.H) * args.W * CHANNELS;
    const V l1 = splat(T((1 - args.ssim_weight) / numbers)), ssim = splat(T(args.ssim_weight / numbers)), two = splat(T(2));
    Segment<T> x, y;
    double total = 0;
    for (int64_t row = s.first; row < s.last; ++row) {
        const T *in = planes + (row - s.first + HALF) * STRIP;
        cut(args.image + row * s.width, T(1), s, x);
        cut_target(args, row, s, y);
        V row_sum{}, column = iota<T>();
        for (int64_t i = 0; i < s.count; i += Vector<T>::LANES, column += splat(T(Vector<T>::LANES))) {
            const V a = load<V>(x.strip() + i), b = load<V>(y.strip() + i), difference = a - b;
            const V d =
                blur_y<V>(in + i, STRIP) + two * a * blur_y<V>(in + OUT_PLANE + i, STRIP) + b * blur_y<V>(in + 2 * OUT_PLANE + i, STRIP);
            const V sign = (a > b ? l1 : V{}) - (a < b ? l1 : V{});
            store_some(args.grad + row * s.width + s.x0 + i, sign - ssim * d, s.count - i);
            row_sum += column < splat(T(s.count)) ? (difference > V{} ? difference : -difference) : V{};
        }
        total += double(sum(row_sum));
    }
    return total;
}

// L1 alone needs no windows.
template <class T>
GSPLAT_INLINE double l1_gradient(const LossArgs<T> &args, const Strip &s) {
    const T each = T(1 / (double(args.H) * args.W * CHANNELS));
    Segment<T> y;
    double total = 0;
    for (int64_t row = s.first; row < s.last; ++row) {
        cut_target(args, row, s, y);
        const T *x = args.image + row * s.width + s.x0;
        T *out = args.grad + row * s.width + s.x0;
        T row_sum = 0;
        for (int64_t i = 0; i < s.count; ++i) {
            const T d = x[i] - y.strip()[i];
            out[i] = d > 0 ? each : (d < 0 ? -each : T(0));
            row_sum += d > 0 ? d : -d;
        }
        total += double(row_sum);
    }
    return total;
}

template <class T>
void loss(const LossArgs<T> &args, int64_t band, T *scratch) {
    using V = typename Vector<T>::V;
    double sum_l1 = 0, sum_ssim = 0;
    strips(args, band, [&](const Strip &s) {
        if (args.ssim_weight == 0) {
            sum_l1 += l1_gradient(args, s);
            return;
        }
        T *blurred = scratch + 4 * IN_PLANE;
        alignas(64) T maps[3][MAP];
        blur_inputs(args, s, scratch);
        for (int64_t r = 0; r < s.last - s.first + 2 * HALF; ++r) {
            const int64_t row = s.first + r - HALF;
            T *out = blurred + r * STRIP;
            if (!s.has_row(row)) {
                for (int p = 0; p < 3; ++p) memset(out + p * OUT_PLANE, 0, STRIP * sizeof(T));
                continue;
            }
            const T ssim = map_row(s, scratch + (r + HALF) * MAP, maps);
            if (row >= s.first && row < s.last) sum_ssim += double(ssim);
            for (int p = 0; p < 3; ++p)
                for (int64_t i = 0; i < STRIP; i += Vector<T>::LANES) {
                    const T *in = maps[p] + MARGIN + i;
                    V total = splat(T(SSIM_TAP[0])) * load<V>(in);
                    for (int k = 1; k <= HALF; ++k)
                        total += splat(T(SSIM_TAP[k])) * (load<V>(in - CHANNELS * k) + load<V>(in + CHANNELS * k));
                    store(out + p * OUT_PLANE + i, total);
                }
        }
        sum_l1 += gradient(args, s, blurred);
    });
    args.sums[2 * band] = sum_l1, args.sums[2 * band + 1] = sum_ssim;
}

template void loss<float>(const LossArgs<float> &, int64_t, float *);
template void loss<double>(const LossArgs<double> &, int64_t, double *);

}  // namespace GSPLAT_ISA
}  // namespace gsplat

// ssim: the training loss (1 - k) L1 + k (1 - SSIM) of a part of the image, and its gradient.
//
// With G a blur of 11 taps (sigma 1.5, zero outside the image), mx = G x, my = G y, v = G (x² + y²) - mx² - my² (the sum
// of both variances), c = G xy - mx my:
//
//     S = A1 A2 / (B1 B2),  A1 = 2 mx my + C1,  A2 = 2 c + C2,  B1 = mx² + my² + C1,  B2 = v + C2
//     dS/dv = -S / B2,  dS/dc = 2 A1 / (B1 B2),  dS/dmx = 2 my A2 / (B1 B2) - 2 mx S / B1 - 2 mx dS/dv - my dS/dc
//     dsum(S)/dx = G dS/dmx + 2 x G dS/dv + y G dS/dc
//
// A task is a strip of the image: some rows of some columns. Its rows pass through in blocks of 16, a few columns at a time,
// while those are in the first cache. Blurred along y, a block is transposed: the lanes of a vector are then rows, and a blur
// along x takes whole vectors as one along y does, without loads that cross cache lines. S and its maps are computed there, and
// the maps blurred along x; then they are transposed back. Only the maps of two blocks outlive that. Images are read from and
// written to memory, nothing else is. Channels are interleaved, so the next tap to the right is three numbers away.
#include "gaussian_math.h"
#include "isa.h"

namespace gsplat {
namespace GSPLAT_ISA {

constexpr int HALF = SSIM_HALF, ROWS = SSIM_BLOCK, WINDOWS = ROWS + 2 * HALF, CHANNELS = 3;
constexpr int64_t STRIP = SSIM_STRIP, EDGE = SSIM_EDGE, MAP = STRIP + 2 * EDGE;
constexpr int64_t COLUMNS = ROWS * CHANNELS;  // that are processed together
constexpr int64_t AHEAD = 64;                 // numbers of the gradient whose lines are asked for before they are written

// Columns of a block, ROWS numbers each, for each of some maps: those that are processed and, before them, two edges.
template <class T, int MAPS>
struct Columns {
    alignas(64) T columns[MAPS][2 * EDGE + COLUMNS][ROWS];

    // Keeps the last two edges.
    GSPLAT_METHOD void slide() {
        using V = typename Vector<T>::V;
        for (auto &map : columns)
            for (int64_t k = 0; k < 2 * EDGE * ROWS; k += Vector<T>::LANES) store(map[0] + k, load<V>(map[COLUMNS] + k));
    }
};

// Half of dS/dmx, dS/dv and half of dS/dc of a block, blurred along x, row by row; the first two edges mean nothing.
template <class T>
struct Maps {
    alignas(64) T rows[3][ROWS][MAP];
};

// Image rows first .. last - 1, numbers x0 .. x0 + count - 1 of each.
struct Strip {
    int64_t first, last, x0, count, width, height;
};

template <class V>
GSPLAT_INLINE V load_numbers(const float *p) {
    return load<V>(p);
}
template <class V>
GSPLAT_INLINE V load_numbers(const double *p) {
    return load<V>(p);
}
template <class V>
GSPLAT_INLINE V load_numbers(const uint8_t *p) {
    return load_bytes<V>(p);
}

// Numbers n .. n + LANES - 1 of an image row; zero outside the image.
template <class T, class S>
GSPLAT_INLINE typename Vector<T>::V numbers(const S *row, int64_t n, int64_t width) {
    constexpr int LANES = Vector<T>::LANES;
    if (n >= 0 && n + LANES <= width) return load_numbers<typename Vector<T>::V>(row + n);
    S some[LANES] = {};
    const int64_t begin = vmax<int64_t>(-n, 0), end = vmin<int64_t>(width - n, LANES);
    if (begin < end) memcpy(some + begin, row + n + begin, size_t(end - begin) * sizeof(S));
    return load_numbers<typename Vector<T>::V>(some);
}

template <class T>
GSPLAT_INLINE typename Vector<T>::V target_numbers(const LossArgs<T> &args, int64_t row, int64_t n, int64_t width) {
    if (args.target_bytes) return numbers<T>(args.target_bytes + row * width, n, width) * splat(T(1) / T(255));
    return numbers<T>(args.target + row * width, n, width);
}

// G of the WINDOWS vectors in(0), in(1), ... A window of them stays in registers; numbers at the same distance from its centre are
// added first.
template <class T, class In>
GSPLAT_INLINE void blur(In in, T *out, int64_t stride) {
    using V = typename Vector<T>::V;
    V window[WINDOWS];
#pragma GCC unroll 32
    for (int i = 0; i < 2 * HALF; ++i) window[i] = in(i);
#pragma GCC unroll 32
    for (int r = 0; r < ROWS; ++r) {
        window[r + 2 * HALF] = in(r + 2 * HALF);
        V total = splat(T(SSIM_TAP[0])) * window[r + HALF];
#pragma GCC unroll 8
        for (int k = 1; k <= HALF; ++k) total += splat(T(SSIM_TAP[k])) * (window[r + HALF - k] + window[r + HALF + k]);
        store(out + r * stride, total);
    }
}

// G along x of one channel's columns, from that half a window before the first one.
template <class T>
GSPLAT_CALLED void blur_columns(const T (*in)[ROWS], T (*out)[ROWS], int64_t out_step) {
    using V = typename Vector<T>::V;
    for (int row = 0; row < ROWS; row += Vector<T>::LANES)
        blur([&](int i) { return load<V>(in[CHANNELS * i] + row); }, out[0] + row, out_step * ROWS);
}

// Numbers n .. n + LANES - 1 of WINDOWS image rows, from row `first`; zero outside the image. Asks for those that the next block needs.
template <class T, class S, class V>
GSPLAT_INLINE void load_rows(const S *image, const Strip &s, int64_t first, int64_t n, V *out) {
    const int begin = int(vmax<int64_t>(-first, 0)), end = int(vmin<int64_t>(WINDOWS, s.height - first));
    for (int r = 0; r < begin; ++r) out[r] = V{};
    for (int r = vmax(end, 0); r < WINDOWS; ++r) out[r] = V{};
    const S *at = image + (first + begin) * s.width;
    if (n >= 0 && n + Vector<T>::LANES <= s.width)
        for (int r = begin; r < end; ++r, at += s.width) {
            if (r >= 2 * HALF) __builtin_prefetch(at + ROWS * s.width + n, 0, 2);
            out[r] = load_numbers<V>(at + n);
        }
    else
        for (int r = begin; r < end; ++r, at += s.width) out[r] = numbers<T>(at, n, s.width);
}

// G along y of x, y, x² + y² and xy at the numbers from n, for the ROWS image rows from `first`, as columns from `at`.
template <class T>
GSPLAT_CALLED void blur_inputs(const LossArgs<T> &args, const Strip &s, int64_t first, int64_t n, Columns<T, 4> &to, int64_t at) {
    using V = typename Vector<T>::V;
    constexpr int LANES = Vector<T>::LANES;
    V x[WINDOWS], y[WINDOWS];
    load_rows<T>(args.image, s, first - HALF, n, x);
    if (args.target_bytes)
        load_rows<T>(args.target_bytes, s, first - HALF, n, y);
    else
        load_rows<T>(args.target, s, first - HALF, n, y);
    const V unit = splat(args.target_bytes ? T(1) / T(255) : T(1));
    for (V &row : y) row *= unit;
    alignas(64) T blurred[ROWS][LANES];
    const auto write = [&](int p) {
        for (int row = 0; row < ROWS; row += LANES) transpose_square(blurred[row], LANES, to.columns[p][at] + row, ROWS);
    };
    blur([&](int i) { return x[i]; }, blurred[0], LANES), write(0);
    blur([&](int i) { return y[i]; }, blurred[0], LANES), write(1);
    for (int i = 0; i < WINDOWS; ++i) {
        const V product = x[i] * y[i];
        x[i] = x[i] * x[i] + y[i] * y[i], y[i] = product;
    }
    blur([&](int i) { return x[i]; }, blurred[0], LANES), write(2);
    blur([&](int i) { return y[i]; }, blurred[0], LANES), write(3);
}

// The maps of one channel's ROWS columns, the first of which is the strip's number n, from their blurred inputs; zero outside the
// image. Returns S in each lane, summed over the strip.
template <class T>
GSPLAT_CALLED typename Vector<T>::V make_columns(const T (*blurred)[ROWS][ROWS], const Strip &s, int64_t first, int64_t n,
                                                 Columns<T, 3> &maps, int64_t at) {
    using V = typename Vector<T>::V;
    constexpr int LANES = Vector<T>::LANES;
    const V C1 = splat(T(SSIM_C1)), C2 = splat(T(SSIM_C2)), two = splat(T(2));
    V total{};
    for (int row = 0; row < ROWS; row += LANES) {
        const V y = iota<T>() + splat(T(row));
        const auto inside = (y >= splat(T(-first))) & (y < splat(T(s.height - first)));
        const auto counts = (y >= splat(T(s.first - first))) & (y < splat(T(s.last - first)));
        for (int64_t k = 0; k < ROWS; ++k) {
            const int64_t column = n + CHANNELS * k, to = at + CHANNELS * k;
            const V mx = load<V>(blurred[0][k] + row), my = load<V>(blurred[1][k] + row), product = mx * my, squares = mx * mx + my * my;
            const V v = load<V>(blurred[2][k] + row) - squares, c = load<V>(blurred[3][k] + row) - product;
            const V A1 = two * product + C1, A2 = two * c + C2, B1 = squares + C1, B2 = v + C2;
            const V inverse = reciprocal(B1 * B2), dc = A1 * inverse, S = A2 * dc, part = S * inverse;
            const V dmx = my * (A2 * inverse - dc) - mx * (part * (B2 - B1)), dv = -part * B1;
            const bool in_image = s.x0 + column >= 0 && s.x0 + column < s.width;
            const auto drawn = in_image ? inside : inside ^ inside;
            store(maps.columns[0][to] + row, drawn ? dmx : V{});
            store(maps.columns[1][to] + row, drawn ? dv : V{});
            store(maps.columns[2][to] + row, drawn ? dc : V{});
            if (column >= 0 && column < s.count) total += counts ? S : V{};
        }
    }
    return total;
}

// The maps of the image rows from `first`, blurred along x. Returns the sum of S over the strip.
template <class T>
GSPLAT_INLINE double make_maps(const LossArgs<T> &args, const Strip &s, int64_t first, Maps<T> &to) {
    constexpr int LANES = Vector<T>::LANES;
    Columns<T, 4> inputs;
    Columns<T, 3> maps;
    alignas(64) T blurred[4][ROWS][ROWS], finished[COLUMNS][ROWS];
    typename Vector<T>::V total{};
    memset(maps.columns, 0, sizeof maps.columns);
    // A map's column n is the image's number x0 - EDGE + n.
    for (int64_t start = 0; start < s.count + 2 * EDGE; start += COLUMNS) {
        if (start) inputs.slide(), maps.slide();
        for (int64_t at = start ? 2 * EDGE : 0; at < COLUMNS + 2 * EDGE; at += LANES)
            blur_inputs(args, s, first, s.x0 - 2 * EDGE + start + at, inputs, at);
        for (int channel = 0; channel < CHANNELS; ++channel) {
            for (int p = 0; p < 4; ++p) blur_columns(inputs.columns[p] + EDGE - CHANNELS * HALF + channel, blurred[p], 1);
            total += make_columns(blurred, s, first, start + channel - EDGE, maps, 2 * EDGE + channel);
        }
        for (int p = 0; p < 3; ++p) {
            for (int channel = 0; channel < CHANNELS; ++channel)
                blur_columns(maps.columns[p] + EDGE - CHANNELS * HALF + channel, finished + channel, CHANNELS);
            for (int row = 0; row < ROWS; row += LANES)
                for (int64_t k = 0; k < COLUMNS; k += LANES) transpose_square(finished[k] + row, ROWS, to.rows[p][row] + start + k, MAP);
        }
    }
    return double(sum(total));
}

// Stores the first `count` lanes.
template <class V, class T>
GSPLAT_INLINE void store_some(T *to, V v, int64_t count) {
    if (count >= Vector<T>::LANES) return store(to, v);
    memcpy(to, &v, size_t(count) * sizeof(T));
}

// The gradient of the image rows from `first`, from the maps of the rows around them; returns the sum of |x - y|.
template <class T>
GSPLAT_CALLED double gradient(const LossArgs<T> &args, const Strip &s, int64_t first, const Maps<T> &above, const Maps<T> &below) {
    using V = typename Vector<T>::V;
    const double size = double(args.H) * args.W * CHANNELS;
    const V l1 = splat(T((1 - args.ssim_weight) / size)), ssim = splat(T(2 * args.ssim_weight / size));
    const int64_t end = vmin<int64_t>(ROWS, s.last - first);
    V total{};
    for (int64_t n = 0; n < s.count; n += Vector<T>::LANES) {
        V sums[3][ROWS];
        for (int p = 0; p < 3; ++p)
            blur([&](int i) { return load<V>((i < ROWS ? above.rows[p][i] : below.rows[p][i - ROWS]) + 2 * EDGE + n); },
                 reinterpret_cast<T *>(sums[p]), Vector<T>::LANES);
        for (int r = 0; r < end; ++r) __builtin_prefetch(args.grad + (first + r) * s.width + s.x0 + n + AHEAD, 1);
        for (int r = 0; r < end; ++r) {
            const int64_t row = first + r, i = s.x0 + n;
            const V x = numbers<T>(args.image + row * s.width, i, s.width), y = target_numbers(args, row, i, s.width);
            const V sign = (x > y ? l1 : V{}) - (x < y ? l1 : V{}), difference = x - y;
            store_some(args.grad + row * s.width + i, sign - ssim * (sums[0][r] + x * sums[1][r] + y * sums[2][r]), s.count - n);
            total += difference > V{} ? difference : -difference;
        }
    }
    return double(sum(total));
}

// L1 alone needs no windows.
template <class T>
GSPLAT_INLINE double l1_gradient(const LossArgs<T> &args, const Strip &s) {
    using V = typename Vector<T>::V;
    const V each = splat(T(1 / (double(args.H) * args.W * CHANNELS)));
    double total = 0;
    for (int64_t row = s.first; row < s.last; ++row) {
        V row_total{};
        for (int64_t i = 0; i < s.count; i += Vector<T>::LANES) {
            const int64_t n = s.x0 + i;
            const V x = numbers<T>(args.image + row * s.width, n, s.width), y = target_numbers(args, row, n, s.width);
            const V difference = x - y;
            store_some(args.grad + row * s.width + n, (x > y ? each : V{}) - (x < y ? each : V{}), s.count - i);
            row_total += difference > V{} ? difference : -difference;
        }
        total += double(sum(row_total));
    }
    return total;
}

template <class T>
void loss(const LossArgs<T> &args, int64_t task, T *room) {
    static_assert(2 * sizeof(Maps<T>) == sizeof(T) * LossArgs<T>::SCRATCH);
    const int64_t width = int64_t(args.W) * CHANNELS, height = args.H, strips = args.strips();
    const int64_t first = task / strips * args.rows(), x0 = task % strips * STRIP;
    const Strip s{first, vmin(first + args.rows(), height), x0, vmin(STRIP, width - x0), width, height};
    double sum_l1 = 0, sum_ssim = 0;
    if (args.ssim_weight == 0) {
        sum_l1 = l1_gradient(args, s);
    } else {
        auto *maps = reinterpret_cast<Maps<T> *>(room);
        sum_ssim = make_maps(args, s, first - HALF, maps[0]);
        for (int64_t row = first, k = 0; row < s.last; row += ROWS, ++k) {
            sum_ssim += make_maps(args, s, row + ROWS - HALF, maps[(k + 1) % 2]);
            sum_l1 += gradient(args, s, row, maps[k % 2], maps[(k + 1) % 2]);
        }
    }
    args.sums[2 * task] = sum_l1, args.sums[2 * task + 1] = sum_ssim;
}

template void loss<float>(const LossArgs<float> &, int64_t, float *);
template void loss<double>(const LossArgs<double> &, int64_t, double *);

}  // namespace GSPLAT_ISA
}  // namespace gsplat

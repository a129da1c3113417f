// ssim: the training loss (1 - k) L1 + k (1 - SSIM) of a part of the image, and its gradient.
//
// With G a blur of 11 taps (sigma 1.5, zero outside the image), mx = G x, my = G y, v = G (x² + y²) - mx² - my² (the sum
// of both variances), c = G xy - mx my:
//
//     S = A1 A2 / (B1 B2),  A1 = 2 mx my + C1,  A2 = 2 c + C2,  B1 = mx² + my² + C1,  B2 = v + C2
//     dS/dv = -S / B2,  dS/dc = 2 A1 / (B1 B2),  dS/dmx = 2 my A2 / (B1 B2) - 2 mx S / B1 - 2 mx dS/dv - my dS/dc
//     dsum(S)/dx = G dS/dmx + 2 x G dS/dv + y G dS/dc
//
// A task is a strip of the image: some rows of some columns. Its rows pass through in blocks of as many as the window has
// besides its centre, so that a blur along y needs exactly two blocks. Of every block, a few columns at a time are blurred along y
// and then along x, while they are in the first cache; only the maps of two blocks outlive that. Images are read from and
// written to memory, nothing else is. Channels are interleaved, so the next tap to the right is three numbers away.
#include "gaussian_math.h"
#include "isa.h"

namespace gsplat {
namespace GSPLAT_ISA {

constexpr int HALF = SSIM_HALF, ROWS = SSIM_BLOCK, CHANNELS = 3;
constexpr int64_t STRIP = SSIM_STRIP, EDGE = SSIM_EDGE, MAP = STRIP + 2 * EDGE;
constexpr int64_t COLUMNS = 64;  // columns that are blurred at a time

// An array of rows for each of some maps.
template <class T, int MAPS, int64_t NUMBERS>
struct Block {
    alignas(64) T rows[MAPS][ROWS][NUMBERS];
};

// Columns that are blurred along y, with half a window on each side.
template <class T, int MAPS>
using Columns = Block<T, MAPS, COLUMNS + 2 * EDGE>;

template <class T>
using Maps = Block<T, 3, MAP>;  // half of dS/dmx, dS/dv, half of dS/dc

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

template <class V, class T>
GSPLAT_INLINE V blur_x(const T *in) {
    V total = splat(T(SSIM_TAP[0])) * load<V>(in);
    for (int k = 1; k <= HALF; ++k) total += splat(T(SSIM_TAP[k])) * (load<V>(in - CHANNELS * k) + load<V>(in + CHANNELS * k));
    return total;
}

// G along y of ROWS rows, from the rows of two blocks. Every row is loaded once, and added to those within half a window.
template <int ROW = 0, class T, class V>
GSPLAT_INLINE void blur_y(const T *above, const T *below, int64_t stride, V *out) {
    const V v = load<V>((ROW < ROWS ? above : below) + ROW % ROWS * stride);
    for (int r = 0; r < ROWS; ++r) {
        const int tap = ROW - r - HALF;
        if (tap == -HALF)
            out[r] = splat(T(SSIM_TAP[HALF])) * v;
        else if (tap > -HALF && tap <= HALF)
            out[r] += splat(T(SSIM_TAP[tap < 0 ? -tap : tap])) * v;
    }
    if constexpr (ROW + 1 < 2 * ROWS) blur_y<ROW + 1>(above, below, stride, out);
}

// Calls make(n, at) to fill the columns from `at`, numbers n of all maps, and use(n, at) for those whose neighbours are there.
template <class T, int MAPS, class Make, class Use>
GSPLAT_INLINE void slide(Columns<T, MAPS> &columns, int64_t count, Make make, Use use) {
    constexpr int64_t LANES = Vector<T>::LANES;
    for (int64_t start = 0; start < count; start += COLUMNS) {
        if (start)
            for (auto &map : columns.rows)
                for (T *row : map) memcpy(row, row + COLUMNS, 2 * EDGE * sizeof(T));
        const int64_t end = vmin<int64_t>(COLUMNS, count - start);
        for (int64_t at = start ? 2 * EDGE : 0; at < end + 2 * EDGE; at += LANES) make(start + at, at);
        for (int64_t at = 0; at < end; at += LANES) use(start + at, at + EDGE);
    }
}

// Numbers n .. n + LANES - 1 of 2 ROWS image rows, from row `first`; zero outside the image. Asks for those that the next block needs.
template <class T, class S, class V>
GSPLAT_INLINE void load_rows(const S *image, const Strip &s, int64_t first, int64_t n, V *out) {
    const int begin = int(vmax<int64_t>(-first, 0)), end = int(vmin<int64_t>(2 * ROWS, s.height - first));
    for (int r = 0; r < begin; ++r) out[r] = V{};
    for (int r = vmax(end, 0); r < 2 * ROWS; ++r) out[r] = V{};
    const S *at = image + (first + begin) * s.width;
    if (n >= 0 && n + Vector<T>::LANES <= s.width)
        for (int r = begin; r < end; ++r, at += s.width) {
            __builtin_prefetch(at + ROWS * s.width + n);
            out[r] = load_numbers<V>(at + n);
        }
    else
        for (int r = begin; r < end; ++r, at += s.width) out[r] = numbers<T>(at, n, s.width);
}

// G along y of x, y, x² + y² and xy at the numbers from n, for the ROWS image rows from `first`.
template <class T, class V>
GSPLAT_INLINE void blur_inputs(const LossArgs<T> &args, const Strip &s, int64_t first, int64_t n, V (*out)[ROWS]) {
    V in[4][2 * ROWS];
    load_rows<T>(args.image, s, first - HALF, n, in[0]);
    if (args.target_bytes)
        load_rows<T>(args.target_bytes, s, first - HALF, n, in[1]);
    else
        load_rows<T>(args.target, s, first - HALF, n, in[1]);
    const V unit = splat(args.target_bytes ? T(1) / T(255) : T(1));
    for (int r = 0; r < 2 * ROWS; ++r) {
        const V x = in[0][r], y = in[1][r] * unit;
        in[1][r] = y, in[2][r] = x * x + y * y, in[3][r] = x * y;
    }
    for (int p = 0; p < 4; ++p)
        blur_y(reinterpret_cast<const T *>(in[p]), reinterpret_cast<const T *>(in[p] + ROWS), Vector<T>::LANES, out[p]);
}

// The maps of the image rows from `first`; zero outside the image. Returns the sum of S over the strip.
template <class T>
GSPLAT_INLINE double make_maps(const LossArgs<T> &args, const Strip &s, int64_t first, Maps<T> &maps) {
    using V = typename Vector<T>::V;
    const V C1 = splat(T(SSIM_C1)), C2 = splat(T(SSIM_C2)), one = splat(T(1)), two = splat(T(2));
    const int begin = int(vmax<int64_t>(-first, 0)), end = int(vmin<int64_t>(ROWS, vmin(s.height, s.last + HALF) - first));
    Columns<T, 4> columns;
    V total{};
    const auto make = [&](int64_t n, int64_t at) {
        V sums[4][ROWS];
        blur_inputs(args, s, first, s.x0 + n - 2 * EDGE, sums);
        for (int p = 0; p < 4; ++p)
            for (int r = 0; r < ROWS; ++r) store(columns.rows[p][r] + at, sums[p][r]);
    };
    const auto use = [&](int64_t n, int64_t at) {
        V S_sum{};
        for (int r = begin; r < end; ++r) {
            const V mx = blur_x<V>(columns.rows[0][r] + at), my = blur_x<V>(columns.rows[1][r] + at);
            const V product = mx * my, squares = mx * mx + my * my;
            const V v = blur_x<V>(columns.rows[2][r] + at) - squares, c = blur_x<V>(columns.rows[3][r] + at) - product;
            const V A1 = two * product + C1, A2 = two * c + C2, B1 = squares + C1, B2 = v + C2;
            const V inverse = reciprocal(B1 * B2), dc = A1 * inverse, S = A2 * dc, part = S * inverse;
            store(maps.rows[0][r] + n, my * (A2 * inverse - dc) - mx * (part * (B2 - B1)));
            store(maps.rows[1][r] + n, -part * B1), store(maps.rows[2][r] + n, dc);
            if (first + r >= s.first && first + r < s.last) S_sum += S;
        }
        const V column = iota<T>() + splat(T(n - EDGE));
        total += (column >= V{} ? one : V{}) * (column < splat(T(s.count)) ? S_sum : V{});
    };
    slide<T, 4>(columns, s.count + 2 * EDGE, make, use);
    const int64_t left = vmax<int64_t>(EDGE - s.x0, 0), right = vmin<int64_t>(s.width - s.x0 + EDGE, MAP);
    for (auto &map : maps.rows)
        for (int r = 0; r < ROWS; ++r) {
            if (r < begin || r >= end) memset(map[r], 0, sizeof map[r]);
            memset(map[r], 0, size_t(left) * sizeof(T)), memset(map[r] + right, 0, size_t(MAP - right) * sizeof(T));
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
GSPLAT_INLINE double gradient(const LossArgs<T> &args, const Strip &s, int64_t first, const Maps<T> &above, const Maps<T> &below) {
    using V = typename Vector<T>::V;
    const double size = double(args.H) * args.W * CHANNELS;
    const V l1 = splat(T((1 - args.ssim_weight) / size)), ssim = splat(T(2 * args.ssim_weight / size));
    const int64_t end = vmin<int64_t>(ROWS, s.last - first);
    Columns<T, 3> columns;
    V total{};
    const auto make = [&](int64_t n, int64_t at) {
        for (int p = 0; p < 3; ++p) {
            V sums[ROWS];
            blur_y(above.rows[p][0] + n, below.rows[p][0] + n, MAP, sums);
            for (int r = 0; r < ROWS; ++r) store(columns.rows[p][r] + at, sums[r]);
        }
    };
    const auto use = [&](int64_t n, int64_t at) {
        for (int r = 0; r < end; ++r) {
            const int64_t row = first + r, i = s.x0 + n;
            const V x = numbers<T>(args.image + row * s.width, i, s.width), y = target_numbers(args, row, i, s.width);
            const V sign = (x > y ? l1 : V{}) - (x < y ? l1 : V{}), difference = x - y;
            const V d =
                blur_x<V>(columns.rows[0][r] + at) + x * blur_x<V>(columns.rows[1][r] + at) + y * blur_x<V>(columns.rows[2][r] + at);
            store_some(args.grad + row * s.width + i, sign - ssim * d, s.count - n);
            total += difference > V{} ? difference : -difference;
        }
    };
    slide<T, 3>(columns, s.count, make, use);
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

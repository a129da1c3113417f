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
// besides its centre. Therefore a blur along y needs exactly two blocks, and the two latest ones of everything that is blurred
// along x are all that is kept: images are read from and written to memory, nothing else is. Channels are interleaved, so the
// next tap to the right is three numbers away.
#include "gaussian_math.h"
#include "isa.h"

namespace gsplat {
namespace GSPLAT_ISA {

constexpr int HALF = SSIM_HALF, ROWS = SSIM_BLOCK, CHANNELS = 3;
constexpr int64_t STRIP = SSIM_STRIP, EDGE = SSIM_EDGE;
constexpr int64_t MAP = STRIP + 2 * EDGE, INPUT = MAP + 2 * EDGE;  // numbers per row: of the maps of S, of the images that they need

// An array of rows for each of some maps.
template <class T, int MAPS, int64_t NUMBERS>
struct Block {
    alignas(64) T rows[MAPS][ROWS][NUMBERS];
};

template <class T>
struct Scratch {
    Block<T, 4, MAP> inputs[2];    // G along x of x, y, x² + y², xy
    Block<T, 3, MAP> maps;         // half of dS/dmx, dS/dv, half of dS/dc
    Block<T, 3, STRIP> blurred[2]; // G along x of these
    alignas(64) T row[4][INPUT];   // x, y, x² + y², xy
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

// Asks for an image row, for the next block.
template <class T>
GSPLAT_INLINE void fetch(const LossArgs<T> &args, const Strip &s, int64_t row) {
    if (row >= s.height) return;
    const int64_t line = 64 / int64_t(sizeof(T)), start = row * s.width + vmax<int64_t>(s.x0 - 2 * EDGE, 0);
    for (int64_t i = 0; i < s.count + 4 * EDGE; i += line) __builtin_prefetch(args.image + start + i);
    if (args.target_bytes)
        for (int64_t i = 0; i < s.count + 4 * EDGE; i += 64) __builtin_prefetch(args.target_bytes + start + i);
    else
        for (int64_t i = 0; i < s.count + 4 * EDGE; i += line) __builtin_prefetch(args.target + start + i);
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

// G along x of x, y, x² + y² and xy, of the image rows from `first`.
template <class T>
GSPLAT_INLINE void blur_inputs(const LossArgs<T> &args, const Strip &s, int64_t first, Scratch<T> &scratch, Block<T, 4, MAP> &out) {
    using V = typename Vector<T>::V;
    auto &numbers_of = scratch.row;
    for (int r = 0; r < ROWS; ++r) {
        const int64_t row = first + r;
        if (row < 0 || row >= vmin(s.height, s.last + 2 * HALF)) {
            for (int p = 0; p < 4; ++p) memset(out.rows[p][r], 0, sizeof out.rows[p][r]);
            continue;
        }
        fetch(args, s, row + ROWS);
        for (int64_t i = 0; i < s.count + 4 * EDGE; i += Vector<T>::LANES) {
            const V x = numbers<T>(args.image + row * s.width, s.x0 + i - 2 * EDGE, s.width);
            const V y = target_numbers(args, row, s.x0 + i - 2 * EDGE, s.width);
            store(numbers_of[0] + i, x), store(numbers_of[1] + i, y);
            store(numbers_of[2] + i, x * x + y * y), store(numbers_of[3] + i, x * y);
        }
        for (int64_t i = 0; i < s.count + 2 * EDGE; i += Vector<T>::LANES)
            for (int p = 0; p < 4; ++p) store(out.rows[p][r] + i, blur_x<V>(numbers_of[p] + EDGE + i));
    }
}

// Three maps of the image rows from `first`, blurred along x; zero outside the image. Returns the sum of S over the strip.
template <class T>
GSPLAT_INLINE double blur_maps(const Strip &s, int64_t first, const Block<T, 4, MAP> *const in[2], Block<T, 3, MAP> &maps,
                               Block<T, 3, STRIP> &out) {
    using V = typename Vector<T>::V;
    const V C1 = splat(T(SSIM_C1)), C2 = splat(T(SSIM_C2)), one = splat(T(1)), two = splat(T(2));
    const int begin = int(vmax<int64_t>(-first, 0)), end = int(vmin<int64_t>(ROWS, vmin(s.height, s.last + HALF) - first));
    V total{}, column = iota<T>() - splat(T(EDGE));
    for (int64_t i = 0; i < s.count + 2 * EDGE; i += Vector<T>::LANES, column += splat(T(Vector<T>::LANES))) {
        V sums[4][ROWS], S_sum{};
        for (int p = 0; p < 4; ++p) blur_y(in[0]->rows[p][0] + i, in[1]->rows[p][0] + i, MAP, sums[p]);
        for (int r = begin; r < end; ++r) {
            const V mx = sums[0][r], my = sums[1][r], product = mx * my, squares = mx * mx + my * my;
            const V v = sums[2][r] - squares, c = sums[3][r] - product;
            const V A1 = two * product + C1, A2 = two * c + C2, B1 = squares + C1, B2 = v + C2;
            const V inverse = reciprocal(B1 * B2), dc = A1 * inverse, S = A2 * dc, part = S * inverse, dv = -part * B1;
            store(maps.rows[0][r] + i, my * (A2 * inverse - dc) - mx * (part * (B2 - B1)));
            store(maps.rows[1][r] + i, dv), store(maps.rows[2][r] + i, dc);
            if (first + r >= s.first && first + r < s.last) S_sum += S;
        }
        total += (column >= V{} ? one : V{}) * (column < splat(T(s.count)) ? S_sum : V{});
    }
    const int64_t left = vmax<int64_t>(EDGE - s.x0, 0), right = vmin<int64_t>(s.width - s.x0 + EDGE, MAP);
    for (int p = 0; p < 3; ++p)
        for (int r = 0; r < ROWS; ++r) {
            T *row = maps.rows[p][r];
            if (r < begin || r >= end) {
                memset(out.rows[p][r], 0, sizeof out.rows[p][r]);
                continue;
            }
            memset(row, 0, size_t(left) * sizeof(T)), memset(row + right, 0, size_t(MAP - right) * sizeof(T));
            for (int64_t i = 0; i < s.count; i += Vector<T>::LANES) store(out.rows[p][r] + i, blur_x<V>(row + EDGE + i));
        }
    return double(sum(total));
}

// Stores the first `count` lanes.
template <class V, class T>
GSPLAT_INLINE void store_some(T *to, V v, int64_t count) {
    if (count >= Vector<T>::LANES) return store(to, v);
    memcpy(to, &v, size_t(count) * sizeof(T));
}

// The gradient of the image rows from `first`; returns the sum of |x - y|.
template <class T>
GSPLAT_INLINE double gradient(const LossArgs<T> &args, const Strip &s, int64_t first, const Block<T, 3, STRIP> *const in[2]) {
    using V = typename Vector<T>::V;
    const double size = double(args.H) * args.W * CHANNELS;
    const V l1 = splat(T((1 - args.ssim_weight) / size)), ssim = splat(T(2 * args.ssim_weight / size));
    const int64_t end = vmin<int64_t>(ROWS, s.last - first);
    V total{};
    for (int64_t i = 0; i < s.count; i += Vector<T>::LANES) {
        V sums[3][ROWS];
        for (int p = 0; p < 3; ++p) blur_y(in[0]->rows[p][0] + i, in[1]->rows[p][0] + i, STRIP, sums[p]);
        for (int64_t r = 0; r < end; ++r) {
            const int64_t row = first + r, n = s.x0 + i;
            const V x = numbers<T>(args.image + row * s.width, n, s.width), y = target_numbers(args, row, n, s.width);
            const V sign = (x > y ? l1 : V{}) - (x < y ? l1 : V{}), difference = x - y;
            store_some(args.grad + row * s.width + n, sign - ssim * (sums[0][r] + x * sums[1][r] + y * sums[2][r]), s.count - i);
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
    static_assert(sizeof(Scratch<T>) == sizeof(T) * LossArgs<T>::SCRATCH);
    const int64_t width = int64_t(args.W) * CHANNELS, height = args.H, strips = args.strips();
    const int64_t first = task / strips * args.rows(), x0 = task % strips * STRIP;
    const Strip s{first, vmin(first + args.rows(), height), x0, vmin(STRIP, width - x0), width, height};
    double sum_l1 = 0, sum_ssim = 0;
    if (args.ssim_weight == 0) {
        sum_l1 = l1_gradient(args, s);
    } else {
        auto &scratch = *reinterpret_cast<Scratch<T> *>(room);
        for (int64_t k = 0; s.first + (k - 2) * ROWS < s.last; ++k) {
            const int now = k % 2, before = 1 - now;
            const Block<T, 4, MAP> *const inputs[2] = {&scratch.inputs[before], &scratch.inputs[now]};
            const Block<T, 3, STRIP> *const blurred[2] = {&scratch.blurred[now], &scratch.blurred[before]};
            const int64_t row = s.first + k * ROWS;
            blur_inputs(args, s, row - 2 * HALF, scratch, scratch.inputs[now]);
            if (k >= 1) sum_ssim += blur_maps(s, row - ROWS - HALF, inputs, scratch.maps, scratch.blurred[before]);
            if (k >= 2) sum_l1 += gradient(args, s, row - 2 * ROWS, blurred);
        }
    }
    args.sums[2 * task] = sum_l1, args.sums[2 * task + 1] = sum_ssim;
}

template void loss<float>(const LossArgs<float> &, int64_t, float *);
template void loss<double>(const LossArgs<double> &, int64_t, double *);

}  // namespace GSPLAT_ISA
}  // namespace gsplat

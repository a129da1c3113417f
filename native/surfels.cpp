// surfels, surfels_backward: compositing of 2D Gaussians (Huang et al. 2024), and its gradient.
//
// The pixel p, less a splat's reference point, is (x, y). The ray through it meets the plane of the splat at (cx, cy) / cz, in
// standard deviations, where the record's lines give c = A x + B y + C. With the centre m of the image of the splat:
//
//     s = min((cx² + cy²) / cz², 2 |m - p|²),   alpha = min(ALPHA_MOST, o exp(-s / 2)), 0 below ALPHA_MIN or if cz = 0
//     w = T alpha,   image = sum w c,   distortion = 2 sum w (z (1 - T) - sum before of w z)
//
// The median is z, the channel `depth`, of the last splat with T > 1/2. A pixel ends before the splat that would take T to
// T_STOP or below. Near to far again, with q = dL/dw, S = sum w and Z = sum w z, the backward pass has
//
//     q = g . c + g_distortion (4 (z (1 - T) - sum before of w z) + 2 (Z - z S)),   R = sum of w q behind + g_T T_final
//     h = alpha dL/dalpha = w q - R alpha / (1 - alpha), 0 where alpha was clamped;   dL/ds = -h / 2
//
// R begins as g . image + 2 g_distortion distortion + g_T T_final, because distortion is quadratic in w. Every pair of a splat
// and a tile writes its sums over the tile's pixels to its own slot.
#include "isa.h"
#include "simd.h"

namespace gsplat {
namespace GSPLAT_ISA {

constexpr double ALPHA_MOST = 0.999;  // gsplat's clamp
constexpr double FAR = 1e30;          // a finite s that is drawn by no opacity
constexpr double HALF_LOG2E = 0.72134752044448170;
constexpr double FILTER = 2;          // factor of |m - p|²: a splat is never narrower than 1 / sqrt(2) px

// Whole numbers as wide as T, which a plane of T holds.
template <class T>
struct WholeOf;
template <>
struct WholeOf<float> {
    using I = int32_t;
};
template <>
struct WholeOf<double> {
    using I = int64_t;
};

// The rows of a tile that a splat touches; none if first is larger than last.
struct Touched {
    int64_t first, last;
};

// One tile, and the planes of its pixels in a thread's scratch: rows of `stride` numbers.
template <class T>
struct Patch {
    using V = typename Vector<T>::V;
    static constexpr int LANES = Vector<T>::LANES;
    int64_t x0, y0, width, height, stride, plane, first_pixel;
    T *alpha, *before, *weight, *left;  // of the pair at hand; T after it, negative where the pixel has ended
    T *others;                          // planes for the passes

    GSPLAT_METHOD Patch(const SurfelArgs<T> &args, int64_t tile, T *scratch) : stride(args.stride()), plane(args.plane()) {
        const int64_t tiles = args.tiles_x * args.tiles_y, place = tile % tiles;
        x0 = place % args.tiles_x * args.edge, y0 = place / args.tiles_x * args.edge;
        width = vmax(int64_t(0), vmin(args.edge, args.W - x0)), height = vmax(int64_t(0), vmin(args.edge, args.H - y0));
        first_pixel = (tile / tiles * args.H + y0) * args.W + x0;
        alpha = scratch, before = alpha + plane, weight = before + plane, left = weight + plane, others = left + plane;
        for (int64_t row = 0; row < height; ++row)
            for (int64_t u = 0; u < stride; ++u) left[row * stride + u] = u < width ? T(1) : T(-1);
    }

    // Calls f(index in a plane, pixel) for all pixels of the tile.
    template <class F>
    GSPLAT_METHOD void pixels(const SurfelArgs<T> &args, F f) const {
        for (int64_t row = 0; row < height; ++row)
            for (int64_t u = 0; u < width; ++u) f(row * stride + u, first_pixel + row * args.W + u);
    }

    // Calls f(index in a plane, row, column) for each vector that has pixels in these rows.
    template <class F>
    GSPLAT_METHOD void vectors(Touched rows, F f) const {
        for (int64_t row = rows.first; row <= rows.last; ++row)
            for (int64_t column = 0; column < width; column += LANES) f(row * stride + column, row, column);
    }

    GSPLAT_METHOD bool open() const {
        for (int64_t at = 0; at < height * stride; at += LANES)
            if (any_at_least(load<V>(left + at), T(0))) return true;
        return false;
    }
};

// Where the ray of each lane's pixel meets a splat.
template <class T>
struct Meeting {
    using V = typename Vector<T>::V;
    V dx, dy, inverse, sx, sy, ex, ey, solid, flat;
    GSPLAT_METHOD Meeting(const T *record, const Patch<T> &patch, int64_t row, int64_t column) {
        const T *A = record + LINES, *B = A + 3, *C = B + 3;
        dx = iota<T>() + splat(T(patch.x0 + column) + T(0.5) - record[REFERENCE]);
        const T y = T(patch.y0 + row) + T(0.5) - record[REFERENCE + 1];
        dy = splat(y);
        const V cx = splat(C[0] + B[0] * y) + splat(A[0]) * dx, cy = splat(C[1] + B[1] * y) + splat(A[1]) * dx;
        const V cz = splat(C[2] + B[2] * y) + splat(A[2]) * dx;
        const auto meets = cz != V{};
        inverse = meets ? reciprocal(cz) : V{};
        sx = cx * inverse, sy = cy * inverse;
        ex = splat(record[CENTRE]) - dx, ey = splat(record[CENTRE + 1]) - dy;
        solid = vmin(sx * sx + sy * sy, splat(T(FAR)));
        flat = meets ? splat(T(FILTER)) * (ex * ex + ey * ey) : splat(T(FAR));
        solid = meets ? solid : splat(T(FAR));
    }
};

// Writes alpha, T before and the weight of every pixel in the rows that a splat touches, and takes the weights from T.
// Both passes come to the same decisions, because both call this copy.
template <class T>
GSPLAT_ONE_COPY Touched weigh(const T *record, const Patch<T> &patch) {
    using V = typename Vector<T>::V;
    Touched touched{patch.height, -1};
    if (!(record[OPACITY] >= T(ALPHA_MIN))) return touched;
    const V opacity = splat(record[OPACITY]), limit = splat(T(2 * log(double(record[OPACITY]) / ALPHA_MIN) * 1.0001 + 1e-4));
    patch.vectors({0, patch.height - 1}, [&](int64_t at, int64_t row, int64_t column) {
        const Meeting<T> meeting(record, patch, row, column);
        const V s = vmin(meeting.solid, meeting.flat), t = load<V>(patch.left + at);
        store(patch.before + at, t);
        if (!any_at_least(limit - s, T(0))) {
            store(patch.alpha + at, V{}), store(patch.weight + at, V{});
            return;
        }
        touched.first = vmin(touched.first, row), touched.last = row;
        const V falloff = exp2_(vmax(splat(T(-HALF_LOG2E)) * s, splat(T(-126))));
        const V alpha = between(opacity * falloff, splat(T(ALPHA_MIN)), splat(T(ALPHA_MOST)));
        const V wanted = alpha * t, next = t - wanted;
        const auto open = next > splat(T(T_STOP));
        store(patch.alpha + at, alpha), store(patch.weight + at, open ? wanted : V{});
        store(patch.left + at, open ? next : (t < V{} ? t : -t));
    });
    return touched;
}

template <class T>
void surfels(const SurfelArgs<T> &args, int64_t tile, T *scratch) {
    using V = typename Vector<T>::V;
    using M = typename Vector<T>::M;
    using Whole = typename WholeOf<T>::I;
    Patch<T> patch(args, tile, scratch);
    const int64_t plane = patch.plane, begin = args.tile_begin[tile];
    T *distortion = patch.others, *median = distortion + plane, *which = median + plane, *image = which + plane;
    memset(distortion, 0, size_t(2 * plane) * sizeof(T)), memset(image, 0, size_t(args.count * plane) * sizeof(T));
    memset(which, -1, size_t(plane) * sizeof(T));
    int64_t k = begin;
    for (; k < args.tile_begin[tile + 1]; ++k) {
        if ((k - begin) % 8 == 0 && !patch.open()) break;
        const Touched touched = weigh(args.records + SURFEL * args.rows[k], patch);
        const T *channels = args.channels + args.count * args.rows[k];
        const V z = splat(channels[args.depth]);
        patch.vectors(touched, [&](int64_t at, int64_t, int64_t) {
            const V w = load<V>(patch.weight + at), t = load<V>(patch.before + at), wz = load<V>(image + args.depth * plane + at);
            store(distortion + at, load<V>(distortion + at) + splat(T(2)) * w * (z * (splat(T(1)) - t) - wz));
            const auto middle = (w > V{}) & (t > splat(T(0.5)));
            store(median + at, middle ? z : load<V>(median + at));
            store(which + at, M(middle ? M{} + Whole(k - begin) : load<M>(which + at)));
        });
        for (int64_t c = 0; c < args.count; ++c) {
            const V value = splat(channels[c]);
            T *sums = image + c * plane;
            patch.vectors(touched,
                          [&](int64_t at, int64_t, int64_t) { store(sums + at, load<V>(sums + at) + load<V>(patch.weight + at) * value); });
        }
    }
    args.done[tile] = k - begin;
    patch.pixels(args, [&](int64_t at, int64_t pixel) {
        for (int64_t c = 0; c < args.count; ++c) args.image[pixel * args.count + c] = image[c * plane + at];
        args.transmittance[pixel] = T(fabs(patch.left[at])), args.distortion[pixel] = distortion[at], args.median[pixel] = median[at];
        Whole place;
        memcpy(&place, which + at, sizeof place);
        args.median_places[pixel] = place;
    });
}

// Planes of the backward pass: gradients, and sums over all splats of a pixel or over those that are not passed yet.
template <class T>
struct PatchGradient {
    T *distortion, *median, *which, *rest, *passed, *depth, *weights, *image;
    GSPLAT_METHOD PatchGradient(const SurfelArgs<T> &args, const Patch<T> &patch) {
        T **const planes[] = {&distortion, &median, &which, &rest, &passed, &depth, &weights, &image};
        for (int k = 0; k < 8; ++k) *planes[k] = patch.others + k * patch.plane;
        memset(patch.others, 0, size_t((7 + args.count) * patch.plane) * sizeof(T));
        patch.pixels(args, [&](int64_t at, int64_t pixel) {
            const T *shown = args.image + pixel * args.count, *g = args.grad_image + pixel * args.count;
            const auto place = typename WholeOf<T>::I(args.median_places[pixel]);
            memcpy(which + at, &place, sizeof place);
            distortion[at] = args.grad_distortion[pixel], median[at] = args.grad_median[pixel];
            depth[at] = shown[args.depth], weights[at] = 1 - args.transmittance[pixel];
            T sum = args.grad_transmittance[pixel] * args.transmittance[pixel] + 2 * distortion[at] * args.distortion[pixel];
            for (int64_t c = 0; c < args.count; ++c) sum += g[c] * shown[c], image[c * patch.plane + at] = g[c];
            rest[at] = sum;
        });
    }
};

// Sums of one pair over the lanes' pixels, in the order of a slot; `depth` is of the channel of this name, beyond w g.
template <class T>
struct PairSums {
    using V = typename Vector<T>::V;
    V sums[SURFEL] = {}, depth = V{};

    // Adds what h, the gradient of log alpha, makes of the record.
    GSPLAT_METHOD void add(const Meeting<T> &meeting, V h) {
        const auto solid = meeting.solid <= meeting.flat;
        const V part = solid ? h * meeting.inverse : V{};
        const V of_c[3] = {solid ? -part * meeting.sx : V{}, solid ? -part * meeting.sy : V{}, solid ? part * meeting.solid : V{}};
        for (int k = 0; k < 3; ++k) sums[k] += meeting.dx * of_c[k], sums[3 + k] += meeting.dy * of_c[k], sums[6 + k] += of_c[k];
        const V flat = solid ? V{} : splat(T(-FILTER)) * h, of_x = flat * meeting.ex, of_y = flat * meeting.ey;
        sums[CENTRE] += of_x, sums[CENTRE + 1] += of_y, sums[OPACITY] += h;
        sums[REFERENCE] += of_x < V{} ? -of_x : of_x, sums[REFERENCE + 1] += of_y < V{} ? -of_y : of_y;
    }
};

// Writes one pair's sums to its slot.
template <class T>
GSPLAT_INLINE void pair_backward(const SurfelArgs<T> &args, const Patch<T> &patch, const PatchGradient<T> &gradient, int64_t place,
                                 int64_t pair) {
    using V = typename Vector<T>::V;
    using M = typename Vector<T>::M;
    const T *record = args.records + SURFEL * args.rows[pair], *channels = args.channels + args.count * args.rows[pair];
    const Touched touched = weigh(record, patch);
    const V z = splat(channels[args.depth]), one = splat(T(1)), two = splat(T(2)), four = splat(T(4));
    PairSums<T> pair_sums;
    patch.vectors(touched, [&](int64_t at, int64_t row, int64_t column) {
        const V w = load<V>(patch.weight + at), alpha = load<V>(patch.alpha + at), hidden = one - load<V>(patch.before + at);
        const V g = load<V>(gradient.distortion + at), passed = load<V>(gradient.passed + at), all = load<V>(gradient.weights + at);
        V q = g * (four * (z * hidden - passed) + two * (load<V>(gradient.depth + at) - z * all));
        for (int64_t c = 0; c < args.count; ++c) q += load<V>(gradient.image + c * patch.plane + at) * splat(channels[c]);
        const V drawn = w * q, rest = load<V>(gradient.rest + at) - drawn;
        store(gradient.rest + at, rest), store(gradient.passed + at, passed + w * z);
        const auto median = load<M>(gradient.which + at) == M{} + typename WholeOf<T>::I(place);
        pair_sums.depth += two * w * g * (two * hidden - all + w) + (median ? load<V>(gradient.median + at) : V{});
        const auto free = (w > V{}) & (alpha < splat(T(ALPHA_MOST)));
        pair_sums.add(Meeting<T>(record, patch, row, column), free ? drawn - rest * odds(alpha) : V{});
    });
    T *slot = args.slots + (SURFEL + args.count) * args.slot_of[pair];
    for (int k = 0; k < SURFEL; ++k) slot[k] = sum(pair_sums.sums[k]);
    if (touched.first <= touched.last) slot[OPACITY] /= record[OPACITY];
    for (int64_t c = 0; c < args.count; ++c) {
        V total = c == args.depth ? pair_sums.depth : V{};
        const T *g = gradient.image + c * patch.plane;
        patch.vectors(touched, [&](int64_t at, int64_t, int64_t) { total += load<V>(patch.weight + at) * load<V>(g + at); });
        slot[SURFEL + c] = sum(total);
    }
}

template <class T>
void surfels_backward(const SurfelArgs<T> &args, int64_t tile, T *scratch) {
    const Patch<T> patch(args, tile, scratch);
    const PatchGradient<T> gradient(args, patch);
    const int64_t begin = args.tile_begin[tile], end = args.tile_begin[tile + 1], numbers = SURFEL + args.count;
    for (int64_t pair = begin; pair < end; ++pair)
        if (pair - begin < args.done[tile])
            pair_backward(args, patch, gradient, pair - begin, pair);
        else
            memset(args.slots + numbers * args.slot_of[pair], 0, size_t(numbers) * sizeof(T));
}

template void surfels<float>(const SurfelArgs<float> &, int64_t, float *);
template void surfels<double>(const SurfelArgs<double> &, int64_t, double *);
template void surfels_backward<float>(const SurfelArgs<float> &, int64_t, float *);
template void surfels_backward<double>(const SurfelArgs<double> &, int64_t, double *);

}  // namespace GSPLAT_ISA
}  // namespace gsplat

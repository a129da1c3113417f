// Code shared by the forward and backward pass of a tile.
#pragma once

#include <stddef.h>

#include "gaussian_math.h"

namespace gsplat {
namespace GSPLAT_ISA {

// What is composited: colours; depth as well; features as well; or also median depth or statistics. The last three do what is asked for.
// WRAPPED does so, too, in an image whose left and right edges meet.
enum Mode { COLORS, WITH_DEPTH, WITH_FEATURES, WITH_ALL, WRAPPED };

// With Settings::pixel_stop a pixel ends before the first splat that would take its transmittance to T_STOP or below, and keeps the
// transmittance that it has. The planes mark a pixel that has ended by a negative transmittance. Sets alpha to 0 where the pixel has
// ended or ends here, and marks the latter.
template <class T>
GSPLAT_INLINE void end_pixels(typename Vector<T>::V &t, typename Vector<T>::V &alpha) {
    const typename Vector<T>::V zero{};
    const typename Vector<T>::M ends = (t > zero) & (t - t * alpha <= splat(T(T_STOP))), open = (t > zero) & ~ends;
    alpha = open ? alpha : zero, t = ends ? -t : t;
}

// Pixels of one tile inside the image.
struct TileBox {
    int32_t x0, y0, width, height;
};

GSPLAT_INLINE TileBox tile_box(const Grid &grid, const gsplat::Camera &cam, int32_t tile) {
    TileBox box;
    box.x0 = tile % grid.tiles_x * TILE, box.y0 = tile / grid.tiles_x * TILE;
    box.width = vmin(TILE, cam.W - box.x0), box.height = vmin(TILE, cam.H - box.y0);
    return box;
}

// One number per pixel of a tile, row by row.
template <class T>
struct alignas(64) Plane {
    T values[TILE * TILE];
};

// Four neighbouring pixels of a row.
template <class T>
struct Four {
    typedef T V __attribute__((vector_size(4 * sizeof(T))));
};

// Turns rows into columns: four members of four structures into four structures of four members, and back.
template <class Q>
GSPLAT_INLINE void transpose(Q *m) {
    const Q a = __builtin_shufflevector(m[0], m[1], 0, 4, 1, 5), b = __builtin_shufflevector(m[0], m[1], 2, 6, 3, 7);
    const Q c = __builtin_shufflevector(m[2], m[3], 0, 4, 1, 5), d = __builtin_shufflevector(m[2], m[3], 2, 6, 3, 7);
    m[0] = __builtin_shufflevector(a, c, 0, 1, 4, 5), m[1] = __builtin_shufflevector(a, c, 2, 3, 6, 7);
    m[2] = __builtin_shufflevector(b, d, 0, 1, 4, 5), m[3] = __builtin_shufflevector(b, d, 2, 3, 6, 7);
}

// Reads `count` pixels of an interleaved image, at most four; the others are 0.
template <class T>
GSPLAT_INLINE void load_colors(const T *from, int count, typename Four<T>::V *rgb) {
    using Q = typename Four<T>::V;
    alignas(Q) T part[12] = {};
    if (count < 4) {
        for (int i = 0; i < 3 * count; ++i) part[i] = from[i];
        from = part;
    }
    const Q a = load<Q>(from), b = load<Q>(from + 4), c = load<Q>(from + 8);
    rgb[0] = __builtin_shufflevector(__builtin_shufflevector(a, b, 0, 3, 6, 0), c, 0, 1, 2, 5);
    rgb[1] = __builtin_shufflevector(__builtin_shufflevector(a, b, 1, 4, 7, 0), c, 0, 1, 2, 6);
    rgb[2] = __builtin_shufflevector(__builtin_shufflevector(a, b, 2, 5, 0, 0), c, 0, 1, 4, 7);
}

template <class T>
GSPLAT_INLINE void store_colors(T *to, int count, const typename Four<T>::V *rgb) {
    using Q = typename Four<T>::V;
    const Q r = rgb[0], g = rgb[1], b = rgb[2];
    const Q out[3] = {__builtin_shufflevector(__builtin_shufflevector(r, g, 0, 4, 1, 1), b, 0, 1, 4, 2),
                      __builtin_shufflevector(__builtin_shufflevector(g, b, 1, 5, 2, 2), r, 0, 1, 6, 2),
                      __builtin_shufflevector(__builtin_shufflevector(b, r, 2, 7, 3, 3), g, 0, 1, 7, 2)};
    if (count == 4)  // vector by vector: reading `out` back in wider pieces than it was written waits for the stores
        for (int k = 0; k < 3; ++k) store(to + 4 * k, out[k]);
    else
        memcpy(to, out, size_t(3 * count) * sizeof(T));
}

// Reads `count` numbers of a plane of an image, at most four; the others are 0.
template <class T>
GSPLAT_INLINE typename Four<T>::V load_some(const T *from, int count) {
    using Q = typename Four<T>::V;
    if (count == 4) return load<Q>(from);
    Q v{};
    for (int i = 0; i < count; ++i) v[i] = from[i];
    return v;
}

// Calls visit(index in a plane, index in the image, count) for every run of at most four pixels of the tile.
template <class T, class F>
GSPLAT_INLINE void for_each_four(const TileBox &box, int32_t image_width, F visit) {
    for (int y = 0; y < box.height; ++y) {
        const int64_t row = int64_t(box.y0 + y) * image_width + box.x0;
        int x = 0;
        for (; x + 4 <= box.width; x += 4) visit(y * TILE + x, row + x, 4);  // with the count as a constant
        if (x < box.width) visit(y * TILE + x, row + x, box.width - x);
    }
}

// Prefetches one row of a tile of an interleaved image, nothing if the tile has no such row.
template <class T>
GSPLAT_INLINE void fetch_row(const T *image, int32_t channels, const TileBox &box, int32_t image_width, uint32_t row) {
    if (int32_t(row) >= box.height) return;
    const T *from = image + (int64_t(box.y0 + int32_t(row)) * image_width + box.x0) * channels, *end = from + box.width * channels;
    for (; from < end; from += 64 / sizeof(T)) __builtin_prefetch(from, 0, 2);
}

// A tile's columns, in strips of one vector each.
template <class T>
struct Strips {
    static constexpr int WIDTH = Vector<T>::LANES, COUNT = TILE / WIDTH;
};

// Prefetches the records of the batch after the one that begins at `pairs`; a record may span two cache lines.
template <class T>
GSPLAT_INLINE void fetch_next(const Splat<T> *splats, const Pair *pairs, uint32_t left) {
    for (uint32_t i = BATCH; i < 2 * BATCH && i < left; ++i) {
        const char *record = reinterpret_cast<const char *>(splats + pairs[i].gaussian);
        __builtin_prefetch(record);
        __builtin_prefetch(record + sizeof(Splat<T>) - 1);
    }
}

// The largest alpha, rounded once per tile.
template <class T>
struct AlphaClamp {
    T alpha, log2_alpha;

    GSPLAT_METHOD explicit AlphaClamp(const Settings &settings) : alpha(T(settings.alpha_max)), log2_alpha(T(settings.log2_alpha_max)) {}
};

// How alpha is found in the rows of a tile that a splat touches: with an exponential for each row; by steps from row to row; by
// steps, and it lies between its bounds everywhere. See Falloff.
enum FalloffKind : int32_t { STEEP, GENTLE, INSIDE };

constexpr double GENTLE_MOST = 92;         // largest s² + t² of a gentle splat: 2^-92 alone would leave 34 steps of the exponent
constexpr double INSIDE_MARGIN = 1.0 / 1024;  // in log2: 7e-4 of alpha, where 16 steps in float err by less than 1e-5

// For each of the next splats, the rows that it can touch in every strip of the tile, first > last if none.
template <class T>
struct Rows {
    int32_t first[Strips<T>::COUNT][BATCH], last[Strips<T>::COUNT][BATCH], top[BATCH], bottom[BATCH];
    FalloffKind kind[BATCH];
};

// Whether the forward pass leaves the rows of its batches to the backward pass. On AVX2 that gained nothing.
constexpr bool KEEPS_ROWS = GSPLAT_VECTOR_BYTES == 64;

// They take a byte for each strip, first + 16 last, and the kind another one. Without a row, first > last.
template <class T>
struct KeptRows {
    uint8_t rows[Strips<T>::COUNT][BATCH], kind[BATCH];
};

template <class T>
GSPLAT_INLINE void keep(const Rows<T> &rows, KeptRows<T> &kept) {
    for (int strip = 0; strip < Strips<T>::COUNT; ++strip)
        for (uint32_t i = 0; i < BATCH; ++i) {
            const int32_t first = rows.first[strip][i], last = rows.last[strip][i];
            kept.rows[strip][i] = uint8_t(first > last ? TILE - 1 : first + TILE * last);
        }
    for (uint32_t i = 0; i < BATCH; ++i) kept.kind[i] = uint8_t(rows.kind[i]);
}

template <class T>
GSPLAT_INLINE void take_back(const KeptRows<T> &kept, Rows<T> &rows) {
    __builtin_prefetch(&kept + 1), __builtin_prefetch(reinterpret_cast<const char *>(&kept + 2) - 1);
    for (uint32_t i = 0; i < BATCH; ++i) rows.top[i] = TILE, rows.bottom[i] = -1, rows.kind[i] = FalloffKind(kept.kind[i]);
    for (int strip = 0; strip < Strips<T>::COUNT; ++strip)
        for (uint32_t i = 0; i < BATCH; ++i) {
            const int32_t first = kept.rows[strip][i] % TILE, last = kept.rows[strip][i] / TILE;
            rows.first[strip][i] = first, rows.last[strip][i] = last;
            rows.top[i] = vmin(rows.top[i], first), rows.bottom[i] = vmax(rows.bottom[i], last);
        }
}

// The members of the splats id(0), id(1), ... of a batch, member by member; the first splat fills up.
template <class T, size_t MEMBERS, class F>
GSPLAT_INLINE void members_of(const Splat<T> *splats, F id, uint32_t count, T (&members)[MEMBERS][BATCH]) {
    using Q = typename Four<T>::V;
    static_assert(MEMBERS % 4 == 0 && BATCH % 4 == 0);
    for (uint32_t i = 0; i < BATCH; i += 4) {
        const T *four[4];
        for (uint32_t j = 0; j < 4; ++j) four[j] = reinterpret_cast<const T *>(splats + id(i + j < count ? i + j : 0));
        for (size_t k = 0; k < MEMBERS; k += 4) {
            Q m[4] = {load<Q>(four[0] + k), load<Q>(four[1] + k), load<Q>(four[2] + k), load<Q>(four[3] + k)};
            transpose(m);
            for (size_t j = 0; j < 4; ++j) store(members[k + j] + i, m[j]);
        }
    }
}

// Over the columns [low, high] (relative to the mean) of a strip the ellipse spans from its highest to its lowest point; if one
// lies outside the columns, the nearest column counts. At width dx it spans dy = tangent dx +- half sqrt(1 - (dx / ex)²).
// Plain loops over BATCH lanes, which the compiler vectorises.
template <class T>
GSPLAT_INLINE void rows_of(const Splat<T> *splats, const Pair *pairs, uint32_t count, const TileBox &box, const AlphaClamp<T> &clamp,
                           Rows<T> &rows) {
    using S = Strips<T>;
    T members[sizeof(Splat<T>) / sizeof(T)][BATCH], u[BATCH], v[BATCH], x[BATCH], y[BATCH], drop[BATCH];
    members_of(splats, [pairs](uint32_t i) { return pairs[i].gaussian; }, count, members);
    const auto of = [&](size_t offset) -> const T * { return members[offset / sizeof(T)]; };
    const T *sx = of(offsetof(Splat<T>, sx)), *sy = of(offsetof(Splat<T>, sy)), *ty = of(offsetof(Splat<T>, ty));
    const T *s0 = of(offsetof(Splat<T>, s0)), *t0 = of(offsetof(Splat<T>, t0)), *log2_o = of(offsetof(Splat<T>, log2_o));
    const T *ex = of(offsetof(Splat<T>, extent)), *ey = of(offsetof(Splat<T>, extent) + sizeof(T));
    for (uint32_t i = 0; i < BATCH; ++i) {
        u[i] = of(offsetof(Splat<T>, u))[i] - T(box.x0), v[i] = of(offsetof(Splat<T>, v))[i] - T(box.y0);
        x[i] = T(box.x0) - of(offsetof(Splat<T>, x))[i], y[i] = T(box.y0) - of(offsetof(Splat<T>, y))[i];
        drop[i] = log2_o[i] - T(LOG2_ALPHA_MIN);
    }
    T tangent[BATCH], half[BATCH], foot[BATCH], inverse_ex[BATCH], slack[BATCH];
    for (uint32_t i = 0; i < BATCH; ++i) {
        const T yy = sy[i] * sy[i] + ty[i] * ty[i];
        tangent[i] = -sx[i] * sy[i] / yy, half[i] = sqrt_(vmax(drop[i] / yy, T(0)));
        slack[i] = rim_slack(abs_(v[i]) + abs_(tangent[i]) * vmax(abs_(u[i]), abs_(T(TILE - 1) - u[i])) + half[i]);
        foot[i] = -sy[i] / sx[i] * ey[i], inverse_ex[i] = 1 / ex[i];
        rows.top[i] = TILE, rows.bottom[i] = -1;
    }
    const T lowest = T(box.height - 1);
    for (int strip = 0; strip < S::COUNT; ++strip)
        for (uint32_t i = 0; i < BATCH; ++i) {
            const T low = T(S::WIDTH * strip) - u[i], high = low + T(S::WIDTH - 1);
            const T xb = vmin(vmax(foot[i], low), high), xt = vmin(vmax(-foot[i], low), high);
            const T rb = xb * inverse_ex[i], rt = xt * inverse_ex[i];
            const T bottom = v[i] + tangent[i] * xb + half[i] * sqrt_(vmax(1 - rb * rb, T(0))) + slack[i];
            const T top = v[i] + tangent[i] * xt - half[i] * sqrt_(vmax(1 - rt * rt, T(0))) - slack[i];
            rows.first[strip][i] = int32_t(ceil_(vmin(vmax(top, T(0)), T(TILE))));
            rows.last[strip][i] = int32_t(floor_(vmin(vmax(bottom, T(-1)), lowest)));
            rows.top[i] = vmin(rows.top[i], rows.first[strip][i]), rows.bottom[i] = vmax(rows.bottom[i], rows.last[strip][i]);
        }
    const T open = clamp.log2_alpha - T(LOG2_ALPHA_MIN + INSIDE_MARGIN);  // a splat that drops less to 1/255 is never clamped
    for (uint32_t i = 0; i < BATCH; ++i) {  // the largest |s| and |t| in the touched rows of the tile
        const T across = T(TILE - 1) / 2, middle = T(rows.top[i] + rows.bottom[i]) / 2, down = T(rows.bottom[i] - rows.top[i]) / 2;
        const T s = abs_(s0[i] + sx[i] * (x[i] + across) + sy[i] * (y[i] + middle)) + abs_(sx[i]) * across + abs_(sy[i]) * down;
        const T t = abs_(t0[i] + ty[i] * (y[i] + middle)) + ty[i] * down;
        const T most = s * s + t * t;
        const bool inside = most <= drop[i] - T(INSIDE_MARGIN) && drop[i] <= open;
        rows.kind[i] = most > T(GENTLE_MOST) ? STEEP : inside ? INSIDE : GENTLE;
    }
}

// alpha down one strip of a tile. Where a splat is gentle, 2^p is stepped from row to row without an exponential each: p is
// quadratic in y, so with k rows from the first
//
//     2^p(k + 1) = 2^p(k) r(0) f(k),   r(0) = 2^(p(1) - p(0)),   f(k) = 2^(-2 k (sy² + ty²))
//
// Otherwise every row takes its exponential, because r and f would leave the range of a float. f, 2^p(0) and r(0) of a batch are
// computed ahead: the processor mispredicts where a splat's rows end, and would wait for these exponentials after each splat.
template <class T>
struct alignas(64) Steps {
    T factors[BATCH][TILE];                     // f
    T values[BATCH][TILE], ratios[BATCH][TILE];  // 2^p(0) and r(0) in the first row of each column's strip
};

template <class T>
GSPLAT_INLINE void steps_of(const Splat<T> *splats, const Pair *pairs, uint32_t count, const TileBox &box, const Rows<T> &rows,
                            Steps<T> &steps) {
    using V = typename Vector<T>::V;
    for (uint32_t i = 0; i < count; ++i) {
        if (rows.kind[i] == STEEP || rows.top[i] > rows.bottom[i]) continue;
        const Splat<T> &s = splats[pairs[i].gaussian];
        const V curve = splat(-2 * (s.sy * s.sy + s.ty * s.ty));
        for (int32_t k = 0; k <= rows.bottom[i] - rows.top[i]; k += Vector<T>::LANES)
            store(steps.factors[i] + k, exp2_(curve * (iota<T>() + splat(T(k)))));
        for (int strip = 0; strip < Strips<T>::COUNT; ++strip) {
            const int32_t column = strip * Strips<T>::WIDTH;
            const T dy = T(rows.first[strip][i] + box.y0) - s.y, t = s.t0 + s.ty * dy;
            const V dx = iota<T>() + splat(T(column + box.x0) - s.x);
            const V along = splat(s.s0) + splat(s.sx) * dx + splat(s.sy * dy);
            store(steps.values[i] + column, exp2_(splat(s.log2_o - t * t) - along * along));
            store(steps.ratios[i] + column, exp2_(splat(-s.ty * (2 * t + s.ty) - s.sy * s.sy) - splat(2 * s.sy) * along));
        }
    }
}

// The splats of a tile that are taken together. If rows are kept, `kept` gets them in the forward pass and has them in the backward
// pass, otherwise it is null.
template <class T>
struct Batch {
    Rows<T> rows;
    Steps<T> steps;

    template <bool AGAIN>
    GSPLAT_METHOD void begin(const Splat<T> *splats, const Pair *pairs, uint32_t left, const TileBox &box, const AlphaClamp<T> &clamp,
                             KeptRows<T> *kept) {
        fetch_next(splats, pairs, left);
        const uint32_t count = vmin(BATCH, left);
        if constexpr (AGAIN && KEEPS_ROWS)
            take_back(*kept, rows);
        else
            rows_of(splats, pairs, count, box, clamp, rows);
        if constexpr (!AGAIN && KEEPS_ROWS) keep(rows, *kept);
        steps_of(splats, pairs, count, box, rows, steps);
    }
};

// The whole turns, px, by which a mean at column u of an image that wraps is nearest to a tile.
template <class T>
GSPLAT_INLINE T seam_shift(const gsplat::Camera &cam, int32_t tile_left, T u) {
    return T(cam.W) * floor_((T(tile_left) + T(0.5 * (TILE - 1)) - u) / T(cam.W) + T(0.5));
}

// The splats of a batch in an image that wraps, each moved by whole turns to be nearest to the tile; and the pairs that name them.
template <class T>
struct WrappedSplats {
    Splat<T> splats[BATCH];
    Pair pairs[BATCH];

    GSPLAT_METHOD uint32_t take(const CompositeArgs<T> &args, const Pair *from, uint32_t left, const TileBox &box) {
        const uint32_t count = vmin(BATCH, left);
        for (uint32_t i = 0; i < count; ++i) {
            splats[i] = args.splats[from[i].gaussian], pairs[i] = {i, from[i].slot};
            const T shift = seam_shift(args.camera, box.x0, splats[i].u);
            splats[i].u += shift, splats[i].x += shift;
        }
        return count;
    }
};

// Where the rows of a tile's batches are kept.
template <class T>
GSPLAT_INLINE KeptRows<T> *kept_rows(const CompositeArgs<T> &args, int32_t tile) {
    return KEEPS_ROWS ? reinterpret_cast<KeptRows<T> *>(args.rows) + first_batch(args.tile_begin, tile) : nullptr;
}

// The rows of a splat that is not gentle: p = base - (across + shift)².
template <class T>
struct SteepRows {
    T base[TILE], shift[TILE];
};

template <class T, FalloffKind KIND>
struct Falloff {
    using V = typename Vector<T>::V;
    static constexpr bool GENTLY = KIND != STEEP;
    const T *factors, *values, *ratios;
    SteepRows<T> &steep;  // outside: vectors beside an array that is indexed would not stay in registers
    T highest;            // alpha's clamp, or its logarithm
    V across, value, ratio, least, most;

    GSPLAT_METHOD Falloff(const Steps<T> &steps, uint32_t i, SteepRows<T> &rows, const AlphaClamp<T> &clamp)
        : factors(steps.factors[i]),
          values(steps.values[i]),
          ratios(steps.ratios[i]),
          steep(rows),
          highest(GENTLY ? clamp.alpha : clamp.log2_alpha),
          across{},
          value{},
          ratio{},
          least(kept(splat(T(GENTLY ? ALPHA_MIN : LOG2_ALPHA_MIN)))),
          most(kept(splat(highest))) {}

    GSPLAT_METHOD void begin_splat(const Splat<T> &s, const TileBox &box) {
        if (GENTLY) return;
        for (int row = 0; row < TILE; ++row) {
            const T dy = T(row + box.y0) - s.y, t = s.t0 + s.ty * dy;
            steep.base[row] = s.log2_o - t * t, steep.shift[row] = s.sy * dy;
        }
    }

    GSPLAT_METHOD void begin_strip(const Splat<T> &s, int32_t column, V dx) {
        across = splat(s.s0) + splat(s.sx) * dx;
        if (GENTLY) value = load<V>(values + column), ratio = load<V>(ratios + column);
    }

    // alpha, 0 below 1/255, and the number by which it is clamped, as `where_open` takes it.
    GSPLAT_METHOD V alpha(int32_t row, V &key) const {
        if (KIND == INSIDE) return value;
        if (GENTLY) {
            key = value;
            return between(value, least, most);
        }
        const V q = across + splat(steep.shift[row]);
        key = splat(steep.base[row]) - q * q;
        return exp2_between(key, T(LOG2_ALPHA_MIN), highest);
    }

    // x where alpha is not clamped, otherwise 0.
    GSPLAT_METHOD V where_open(V key, V x) const { return KIND == INSIDE ? x : where_below(key, most, x); }

    GSPLAT_METHOD void step(int32_t k) {
        if (GENTLY) value *= ratio * splat(factors[k]);
    }
};

}  // namespace GSPLAT_ISA
}  // namespace gsplat

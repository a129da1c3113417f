// Code shared by the forward and backward pass of a tile.
#pragma once

#include <type_traits>

#include "gaussian_math.h"

namespace gsplat {
namespace GSPLAT_ISA {

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

// A vector holds one block of pixels: four columns and as many rows as there are lanes for. A tile's blocks are counted
// down its first four columns, then down the next four; block b is bit b of a mask, and a plane of a tile stores its pixels
// block by block.
template <class T>
struct Blocks {
    static constexpr int LANES = Vector<T>::LANES, WIDTH = 4, ROWS = LANES / WIDTH;
    static constexpr int STRIPS = TILE / WIDTH, DOWN = TILE / ROWS, COUNT = STRIPS * DOWN;
    // Where a plane stores the pixel (x, y) of the tile.
    static constexpr int index(int x, int y) { return (x / WIDTH * DOWN + y / ROWS) * LANES + y % ROWS * WIDTH + x % WIDTH; }
};

template <class T>
struct alignas(64) Plane {
    using V = typename Vector<T>::V;
    T values[TILE * TILE];
    V block(int b) const { return load<V>(values + b * Blocks<T>::LANES); }
    void set_block(int b, V v) { store(values + b * Blocks<T>::LANES, v); }
};

// Four neighbouring pixels of a row.
template <class T>
struct Four {
    typedef T V __attribute__((vector_size(4 * sizeof(T))));
};

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
    for (int y = 0; y < box.height; ++y)
        for (int x = 0; x < box.width; x += 4)
            visit(Blocks<T>::index(x, y), int64_t(box.y0 + y) * image_width + box.x0 + x, vmin(4, box.width - x));
}

// Coordinates of a tile's pixels, as planes. (Vectors of equal numbers would be multiplied as scalars and then broadcast.)
template <class T>
struct Coordinates {
    alignas(64) T x[TILE * TILE], y[TILE * TILE];
    constexpr Coordinates() : x(), y() {
        for (int row = 0; row < TILE; ++row)
            for (int column = 0; column < TILE; ++column)
                x[Blocks<T>::index(column, row)] = T(column), y[Blocks<T>::index(column, row)] = T(row);
    }
};

template <class T>
static constexpr Coordinates<T> coordinates{};

// A splat's s and t (see Splat) at the corner of a tile, and how they change per pixel.
template <class T>
struct Slope {
    typename Vector<T>::V s, t, sx, sy, ty, log2_o;
};

template <class T>
GSPLAT_INLINE Slope<T> slope(const Splat<T> &from, const TileBox &box) {
    const T dx = T(box.x0) - from.x, dy = T(box.y0) - from.y;
    return {splat(from.s0 + from.sx * dx + from.sy * dy),
            splat(from.t0 + from.ty * dy),
            splat(from.sx),
            splat(from.sy),
            splat(from.ty),
            splat(from.log2_o)};
}

// The exponent p at the pixels of a block, and s and t there.
template <class T, class V>
GSPLAT_INLINE V exponent(const Slope<T> &at, int block, V &s, V &t) {
    const V x = load<V>(coordinates<T>.x + block * Blocks<T>::LANES), y = load<V>(coordinates<T>.y + block * Blocks<T>::LANES);
    s = at.s + at.sx * x + at.sy * y, t = at.t + at.ty * y;
    return at.log2_o - t * t - s * s;
}

GSPLAT_INLINE int lowest_bit(uint32_t mask) { return __builtin_ctz(mask); }
GSPLAT_INLINE int lowest_bit(uint64_t mask) { return __builtin_ctzll(mask); }

constexpr uint32_t BATCH = 16;

// Prefetches the records of the batch after the one that begins at `pairs`; a record may span two cache lines.
template <class T>
GSPLAT_INLINE void fetch_next(const Splat<T> *splats, const Pair *pairs, uint32_t left) {
    for (uint32_t i = BATCH; i < 2 * BATCH && i < left; ++i) {
        const char *record = reinterpret_cast<const char *>(splats + pairs[i].gaussian);
        __builtin_prefetch(record);
        __builtin_prefetch(record + sizeof(Splat<T>) - 1);
    }
}

// The blocks of a tile that each of the next splats can touch, as masks.
template <class T>
struct Touched {
    static constexpr int COUNT = Blocks<T>::COUNT;
    using Mask = std::conditional_t<(COUNT > 32), uint64_t, uint32_t>;
    Mask masks[BATCH];
};

// Over the columns [low, high] (relative to the mean) of four pixels the ellipse spans from its highest to its lowest point;
// if one lies outside the columns, the nearest column counts. At width dx it spans dy = tangent dx +- half sqrt(1 - (dx / ex)²).
// Plain loops over BATCH lanes, which the compiler vectorises.
template <class T>
GSPLAT_INLINE void find_touched(const Splat<T> *splats, const Pair *pairs, uint32_t count, const TileBox &box, Touched<T> &out) {
    using B = Blocks<T>;
    using Mask = typename Touched<T>::Mask;
    T u[BATCH], v[BATCH], sx[BATCH], sy[BATCH], ty[BATCH], drop[BATCH], ex[BATCH], ey[BATCH];
    for (uint32_t i = 0; i < BATCH; ++i) {
        const Splat<T> &s = splats[pairs[i < count ? i : 0].gaussian];
        u[i] = s.u - T(box.x0), v[i] = s.v - T(box.y0);
        sx[i] = s.sx, sy[i] = s.sy, ty[i] = s.ty, ex[i] = s.extent[0], ey[i] = s.extent[1];
        drop[i] = s.log2_o - T(LOG2_ALPHA_MIN);
    }
    T tangent[BATCH], half[BATCH], foot[BATCH], inverse_ex[BATCH], slack[BATCH];
    for (uint32_t i = 0; i < BATCH; ++i) {
        const T yy = sy[i] * sy[i] + ty[i] * ty[i];
        tangent[i] = -sx[i] * sy[i] / yy, half[i] = sqrt_(vmax(drop[i] / yy, T(0)));
        slack[i] = rim_slack(abs_(v[i]) + abs_(tangent[i]) * vmax(abs_(u[i]), abs_(T(TILE - 1) - u[i])) + half[i]);
        foot[i] = -sy[i] / sx[i] * ey[i], inverse_ex[i] = 1 / ex[i];
        out.masks[i] = 0;
    }
    const T lowest = T(box.height - 1);
    for (int strip = 0; strip < B::STRIPS; ++strip)
        for (uint32_t i = 0; i < BATCH; ++i) {
            const T low = T(B::WIDTH * strip) - u[i], high = low + T(B::WIDTH - 1);
            const T xb = vmin(vmax(foot[i], low), high), xt = vmin(vmax(-foot[i], low), high);
            const T rb = xb * inverse_ex[i], rt = xt * inverse_ex[i];
            const T bottom = v[i] + tangent[i] * xb + half[i] * sqrt_(vmax(1 - rb * rb, T(0))) + slack[i];
            const T top = v[i] + tangent[i] * xt - half[i] * sqrt_(vmax(1 - rt * rt, T(0))) - slack[i];
            const int32_t first = int32_t(ceil_(vmin(vmax(top, T(0)), T(TILE))));
            const int32_t last = int32_t(floor_(vmin(vmax(bottom, T(-1)), lowest)));
            const uint32_t bits = (2u << uint32_t(vmax(last, 0)) / B::ROWS) - (1u << uint32_t(first) / B::ROWS);
            out.masks[i] |= Mask(first <= last ? bits : 0) << strip * B::DOWN;
        }
}

}  // namespace GSPLAT_ISA
}  // namespace gsplat

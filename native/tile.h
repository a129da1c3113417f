// Code shared by the forward and backward pass of a tile.
#pragma once

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

// The per-row part of a splat's exponent: p = base - (shift + s0 + sx dx)².
template <class T>
struct RowTerms {
    alignas(64) T base[TILE], shift[TILE];
};

template <class T>
GSPLAT_INLINE void row_terms(const Splat<T> &s, const TileBox &box, RowTerms<T> &terms) {
    for (int row = 0; row < TILE; ++row) {
        const T dy = T(row + box.y0) - s.y, t = s.t0 + s.ty * dy;
        terms.base[row] = s.log2_o - t * t, terms.shift[row] = s.sy * dy;
    }
}

// The rows of a tile that each of the next splats can touch; first > last if it touches none.
constexpr uint32_t BATCH = 16;

struct Rows {
    int32_t first[BATCH], last[BATCH];
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

// Over the tile's columns [low, high] (relative to the mean) the ellipse spans from its highest to its lowest point; if one
// lies outside the columns, the nearest column counts. At width dx it spans dy = tangent dx +- half sqrt(1 - (dx / ex)²).
// Plain loops over BATCH lanes, which the compiler vectorises.
template <class T>
GSPLAT_INLINE void rows_of(const Splat<T> *splats, const Pair *pairs, uint32_t count, const TileBox &box, Rows &rows) {
    T u[BATCH], v[BATCH], sx[BATCH], sy[BATCH], ty[BATCH], drop[BATCH], ex[BATCH], ey[BATCH];
    for (uint32_t i = 0; i < BATCH; ++i) {
        const Splat<T> &s = splats[pairs[i < count ? i : 0].gaussian];
        u[i] = s.u - T(box.x0), v[i] = s.v - T(box.y0);
        sx[i] = s.sx, sy[i] = s.sy, ty[i] = s.ty, ex[i] = s.extent[0], ey[i] = s.extent[1];
        drop[i] = s.log2_o - T(LOG2_ALPHA_MIN);
    }
    const T lowest = T(box.height - 1);
    for (uint32_t i = 0; i < BATCH; ++i) {
        const T low = -u[i], high = low + T(TILE - 1), yy = sy[i] * sy[i] + ty[i] * ty[i];
        const T tangent = -sx[i] * sy[i] / yy, half = sqrt_(vmax(drop[i] / yy, T(0)));
        const T slack = rim_slack(abs_(v[i]) + abs_(tangent) * vmax(abs_(low), abs_(high)) + half);
        const T foot = -sy[i] / sx[i] * ey[i];
        const T xb = vmin(vmax(foot, low), high), xt = vmin(vmax(-foot, low), high);
        const T qb = vmax(1 - (xb / ex[i]) * (xb / ex[i]), T(0)), qt = vmax(1 - (xt / ex[i]) * (xt / ex[i]), T(0));
        const T bottom = v[i] + tangent * xb + half * sqrt_(qb) + slack;
        const T top = v[i] + tangent * xt - half * sqrt_(qt) - slack;
        rows.first[i] = int32_t(ceil_(vmin(vmax(top, T(0)), T(TILE))));
        rows.last[i] = int32_t(floor_(vmin(vmax(bottom, T(-1)), lowest)));
    }
}

}  // namespace GSPLAT_ISA
}  // namespace gsplat

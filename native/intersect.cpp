// intersect: find exactly the tiles that an ellipse alpha >= 1/255 meets, and write the tile lists in depth order.
//
// The ellipse is (sx dx + sy dy)² + (ty dy)² <= L. Its x interval over a band of rows ends at the rightmost (leftmost) point of
// the ellipse if that lies in the band, otherwise at the edge of the band nearest to that point.
#include "gaussian_math.h"
#include "isa.h"

namespace gsplat {
namespace GSPLAT_ISA {

constexpr int64_t AHEAD = 16;  // Gaussians whose records are fetched before they are needed

// An ellipse in the form that the tile search needs.
template <class T>
struct Ellipse {
    T u, v, ex, ey;
    T inverse_ey;
    T slant;          // sx sy / (sy² + ty²): the rightmost point is at dy = -slant ex
    T half, tangent;  // at height dy the ellipse spans dx = tangent dy +- half sqrt(1 - (dy / ey)²)
};

template <class T>
GSPLAT_INLINE Ellipse<T> ellipse(const Splat<T> &s) {
    Ellipse<T> e;
    e.u = s.u, e.v = s.v, e.ex = s.extent[0], e.ey = s.extent[1];
    e.inverse_ey = 1 / e.ey;
    e.slant = s.sx * s.sy / (s.sy * s.sy + s.ty * s.ty);
    e.tangent = -s.sy / s.sx;
    // L = log2(255 o) is the drop of the exponent from the centre to the rim.
    const T drop = s.log2_o - T(LOG2_ALPHA_MIN);
    e.half = sqrt_(vmax(drop, T(0))) / s.sx;
    return e;
}

// Calls visit(tile_y, first tile_x, last tile_x) for every row of tiles that the ellipse meets.
template <class T, class F>
GSPLAT_INLINE void rows_of_tiles(const Ellipse<T> &e, const Camera &cam, F visit) {
    const T above = rim_slack(abs_(e.v) + e.ey);
    const int32_t first = int32_t(vmin(vmax(ceil_(e.v - e.ey - above), T(0)), T(cam.H)));
    const int32_t last = int32_t(vmax(vmin(floor_(e.v + e.ey + above), T(cam.H - 1)), T(-1)));
    if (first > last) return;
    const T slack = rim_slack(abs_(e.u) + abs_(e.tangent) * vmin(e.ey, abs_(e.v) + T(cam.H)) + e.half);
    for (int32_t ty = first / TILE; ty <= last / TILE; ++ty) {
        T low = T(ty * TILE) - e.v, high = T(ty * TILE + TILE - 1) - e.v;
        low = vmax(low, -e.ey), high = vmin(high, e.ey);
        if (low > high) low = high = (low + high) / 2;  // met by the slack alone
        const T right = vmin(vmax(-e.slant * e.ex, low), high), left = vmin(vmax(e.slant * e.ex, low), high);
        const T qr = 1 - (right * e.inverse_ey) * (right * e.inverse_ey), ql = 1 - (left * e.inverse_ey) * (left * e.inverse_ey);
        const T x1 = e.u + e.tangent * right + e.half * sqrt_(vmax(qr, T(0))) + slack;
        const T x0 = e.u + e.tangent * left - e.half * sqrt_(vmax(ql, T(0))) - slack;
        const int32_t c0 = int32_t(vmin(vmax(ceil_(x0), T(0)), T(cam.W))), c1 = int32_t(vmax(vmin(floor_(x1), T(cam.W - 1)), T(-1)));
        if (c0 <= c1) visit(ty, c0 / TILE, c1 / TILE);
    }
}

template <class T>
void count(const IntersectArgs<T> &args, int64_t begin, int64_t end, uint32_t *per_tile) {
    for (int64_t k = begin; k < end; ++k) {
        const uint32_t id = args.sorted[k];
        if (k + AHEAD < end) __builtin_prefetch(args.splats + args.sorted[k + AHEAD]);
        uint32_t total = 0;
        rows_of_tiles(ellipse(args.splats[id]), args.camera, [&](int32_t ty, int32_t tx0, int32_t tx1) {
            for (int32_t tx = tx0; tx <= tx1; ++tx) ++per_tile[ty * args.grid.tiles_x + tx];
            total += uint32_t(tx1 - tx0 + 1);
        });
        args.pairs_of[id] = total;
    }
}

template <class T>
void scatter(const IntersectArgs<T> &args, int64_t begin, int64_t end, uint32_t *next) {
    for (int64_t k = begin; k < end; ++k) {
        const uint32_t id = args.sorted[k];
        if (k + AHEAD < end) __builtin_prefetch(args.splats + args.sorted[k + AHEAD]);
        uint32_t slot = args.slot_begin[id];
        rows_of_tiles(ellipse(args.splats[id]), args.camera, [&](int32_t ty, int32_t tx0, int32_t tx1) {
            for (int32_t tx = tx0; tx <= tx1; ++tx) args.pairs[next[ty * args.grid.tiles_x + tx]++] = Pair{id, slot++};
        });
    }
}

template void count<float>(const IntersectArgs<float> &, int64_t, int64_t, uint32_t *);
template void count<double>(const IntersectArgs<double> &, int64_t, int64_t, uint32_t *);
template void scatter<float>(const IntersectArgs<float> &, int64_t, int64_t, uint32_t *);
template void scatter<double>(const IntersectArgs<double> &, int64_t, int64_t, uint32_t *);

}  // namespace GSPLAT_ISA
}  // namespace gsplat

// intersect: find exactly the tiles that an ellipse alpha >= 1/255 meets, and write the tile lists in depth order.
//
// The ellipse is (sx dx + sy dy)² + (ty dy)² <= L. Its x interval over a band of rows ends at the rightmost (leftmost) point of
// the ellipse if that lies in the band, otherwise at the edge of the band nearest to that point.
#include "gaussian_math.h"
#include "isa.h"

namespace gsplat {
namespace GSPLAT_ISA {

constexpr int64_t AHEAD = 16;  // Gaussians whose numbers are fetched before they are needed

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

// Calls visit(first tile, number of tiles) for every row of tiles that the ellipse meets, top to bottom. Rows are worked out
// four at a time, in plain loops that the compiler vectorises.
template <class T, class F>
GSPLAT_INLINE void for_each_run(const Ellipse<T> &e, const Camera &cam, const Grid &grid, F visit) {
    const T above = rim_slack(abs_(e.v) + e.ey);
    const int32_t first = int32_t(vmin(vmax(ceil_(e.v - e.ey - above), T(0)), T(cam.H)));
    const int32_t last = int32_t(vmax(vmin(floor_(e.v + e.ey + above), T(cam.H - 1)), T(-1)));
    if (first > last) return;
    const T slack = rim_slack(abs_(e.u) + abs_(e.tangent) * vmin(e.ey, abs_(e.v) + T(cam.H)) + e.half);
    const T end = T(cam.W - 1), rightmost = -e.slant * e.ex;
    for (int32_t ty = first / TILE; ty <= last / TILE; ty += 4) {
        int32_t c0[4], c1[4];
        for (int32_t r = 0; r < 4; ++r) {
            T low = T((ty + r) * TILE) - e.v, high = T((ty + r) * TILE + TILE - 1) - e.v;
            low = vmax(low, -e.ey), high = vmin(high, e.ey);
            const T middle = (low + high) / 2;  // of a row that only the slack meets
            const bool crossed = low > high;
            low = crossed ? middle : low, high = crossed ? middle : high;
            const T right = vmin(vmax(rightmost, low), high), left = vmin(vmax(-rightmost, low), high);
            const T yr = right * e.inverse_ey, yl = left * e.inverse_ey;
            const T x1 = e.u + e.tangent * right + e.half * sqrt_(vmax(1 - yr * yr, T(0))) + slack;
            const T x0 = e.u + e.tangent * left - e.half * sqrt_(vmax(1 - yl * yl, T(0))) - slack;
            c0[r] = int32_t(vmin(vmax(ceil_(x0), T(0)), T(cam.W))), c1[r] = int32_t(vmax(vmin(floor_(x1), end), T(-1)));
        }
        for (int32_t r = 0; r < 4 && ty + r <= last / TILE; ++r)
            if (c0[r] <= c1[r]) {
                const int32_t tx = c0[r] / TILE;
                visit(uint32_t((ty + r) * grid.tiles_x + tx), uint32_t(c1[r] / TILE - tx + 1));
            }
    }
}

template <class T>
GSPLAT_INLINE void fetch(const Splat<T> *record) {
    __builtin_prefetch(record);
    if (sizeof *record > 64) __builtin_prefetch(reinterpret_cast<const char *>(record) + 64);
}

template <class T>
void count(const IntersectArgs<T> &args, int64_t begin, int64_t end, uint32_t *per_tile) {
    for (int64_t k = begin; k < end; ++k) {
        const uint32_t id = args.sorted[k];
        if (k + AHEAD < end) fetch(args.splats + args.sorted[k + AHEAD]);
        uint32_t total = 0, rows = 0;
        TileRuns &kept = args.runs[k];
        for_each_run(ellipse(args.splats[id]), args.camera, args.grid, [&](uint32_t first, uint32_t tiles) {
            for (uint32_t tile = first; tile < first + tiles; ++tile) ++per_tile[tile];
            if (rows < TileRuns::KEPT) kept.runs[rows] = {first, tiles};
            total += tiles, ++rows;
        });
        kept.rows = rows;
        args.pairs_of[id] = total;
    }
}

template <class T>
void scatter(const IntersectArgs<T> &args, int64_t begin, int64_t end, uint32_t *next) {
    for (int64_t k = begin; k < end; ++k) {
        const uint32_t id = args.sorted[k];
        const TileRuns &kept = args.runs[k];
        if (k + AHEAD < end) __builtin_prefetch(args.slot_begin + args.sorted[k + AHEAD]);
        uint32_t slot = args.slot_begin[id];
        auto write = [&](uint32_t first, uint32_t tiles) {
            for (uint32_t tile = first; tile < first + tiles; ++tile) args.pairs[next[tile]++] = Pair{id, slot++};
        };
        if (kept.rows > TileRuns::KEPT)
            for_each_run(ellipse(args.splats[id]), args.camera, args.grid, write);
        else
            for (uint32_t row = 0; row < kept.rows; ++row) write(kept.runs[row].first, kept.runs[row].count);
    }
}

template void count<float>(const IntersectArgs<float> &, int64_t, int64_t, uint32_t *);
template void count<double>(const IntersectArgs<double> &, int64_t, int64_t, uint32_t *);
template void scatter<float>(const IntersectArgs<float> &, int64_t, int64_t, uint32_t *);
template void scatter<double>(const IntersectArgs<double> &, int64_t, int64_t, uint32_t *);

}  // namespace GSPLAT_ISA
}  // namespace gsplat

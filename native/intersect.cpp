// intersect: find exactly the tiles that an ellipse alpha >= 1/255 meets, and write the tile lists in depth order.
//
// The ellipse is (sx dx + sy dy)² + (ty dy)² <= L. Its x interval over a band of rows ends at the rightmost (leftmost) point of
// the ellipse if that lies in the band, otherwise at the edge of the band nearest to that point.
#include "isa.h"
#include "tile.h"

namespace gsplat {
namespace GSPLAT_ISA {

constexpr int64_t AHEAD = 16;  // Gaussians whose numbers are fetched before they are needed

// An ellipse in the form that the tile search needs.
template <class T>
struct Search {
    T u, v, ex, ey;
    T inverse_ey;
    T rightmost;            // dy of the rightmost point
    T half, tangent;        // at height dy the ellipse spans dx = tangent dy +- half sqrt(1 - (dy / ey)²)
    T slack;
    int32_t first, last;    // rows of pixels that the ellipse meets, first > last if none
};

// Counting and writing search for large ellipses twice, and have to find the same tiles: otherwise a list has a place that nothing
// is written to.
template <class T>
GSPLAT_ONE_COPY void begin_search(const Splat<T> &s, T shift, const Camera &cam, Search<T> &e) {
    e.u = s.u + shift, e.v = s.v, e.ex = s.extent[0], e.ey = s.extent[1];
    e.inverse_ey = 1 / e.ey;
    e.rightmost = -(s.sx * s.sy / (s.sy * s.sy + s.ty * s.ty)) * e.ex;
    e.tangent = -s.sy / s.sx;
    // L = log2(255 o) is the drop of the exponent from the centre to the rim.
    const T drop = s.log2_o - T(LOG2_ALPHA_MIN);
    e.half = sqrt_(vmax(drop, T(0))) / s.sx;
    const T above = rim_slack(abs_(e.v) + e.ey);
    e.first = int32_t(vmin(vmax(ceil_(e.v - e.ey - above), T(0)), T(cam.H)));
    e.last = int32_t(vmax(vmin(floor_(e.v + e.ey + above), T(cam.H - 1)), T(-1)));
    e.slack = rim_slack(abs_(e.u) + abs_(e.tangent) * vmin(e.ey, abs_(e.v) + T(cam.H)) + e.half);
}

// The columns of pixels that the ellipse meets in four rows of tiles from ty on, c0 > c1 if none; in plain loops that the compiler
// vectorises.
template <class T>
GSPLAT_ONE_COPY void columns_of(const Search<T> &e, const Camera &cam, int32_t ty, int32_t *c0, int32_t *c1) {
    const T end = T(cam.W - 1);
    for (int32_t r = 0; r < 4; ++r) {
        T low = T((ty + r) * TILE) - e.v, high = T((ty + r) * TILE + TILE - 1) - e.v;
        low = vmax(low, -e.ey), high = vmin(high, e.ey);
        const T middle = (low + high) / 2;  // of a row that only the slack meets
        const bool crossed = low > high;
        low = crossed ? middle : low, high = crossed ? middle : high;
        const T right = vmin(vmax(e.rightmost, low), high), left = vmin(vmax(-e.rightmost, low), high);
        const T yr = right * e.inverse_ey, yl = left * e.inverse_ey;
        const T x1 = e.u + e.tangent * right + e.half * sqrt_(vmax(1 - yr * yr, T(0))) + e.slack;
        const T x0 = e.u + e.tangent * left - e.half * sqrt_(vmax(1 - yl * yl, T(0))) - e.slack;
        c0[r] = int32_t(vmin(vmax(ceil_(x0), T(0)), T(cam.W))), c1[r] = int32_t(vmax(vmin(floor_(x1), end), T(-1)));
    }
}

// Calls visit(first tile, number of tiles) for every row of tiles that the ellipse meets, top to bottom.
template <class T, class F>
GSPLAT_INLINE void for_each_run(const Splat<T> &s, T shift, const Camera &cam, const Grid &grid, F visit) {
    Search<T> e;
    begin_search(s, shift, cam, e);
    if (e.first > e.last) return;
    for (int32_t ty = e.first / TILE; ty <= e.last / TILE; ty += 4) {
        int32_t c0[4], c1[4];
        columns_of(e, cam, ty, c0, c1);
        for (int32_t r = 0; r < 4 && ty + r <= e.last / TILE; ++r)
            if (c0[r] <= c1[r]) {
                const int32_t tx = c0[r] / TILE;
                visit(uint32_t((ty + r) * grid.tiles_x + tx), uint32_t(c1[r] / TILE - tx + 1));
            }
    }
}

// The columns of tiles to which one copy of a mean is the nearest, low > high if none.
template <class T>
GSPLAT_ONE_COPY void columns_of_copy(const Camera &cam, const Grid &grid, T u, int copy, int32_t *low, int32_t *high) {
    *low = grid.tiles_x, *high = -1;
    for (int32_t tx = 0; tx < grid.tiles_x; ++tx)
        if (seam_shift(cam, tx * TILE, u) == T(copy) * T(cam.W)) *low = vmin(*low, tx), *high = tx;
}

// The same in an image that wraps: for each copy of the ellipse, 360 degrees apart, the tiles to which it is the nearest.
template <class T, class F>
GSPLAT_INLINE void for_each_wrapped_run(const Splat<T> &s, const Camera &cam, const Grid &grid, F visit) {
    for (int copy = -1; copy <= 1; ++copy) {
        int32_t low, high;
        columns_of_copy(cam, grid, s.u, copy, &low, &high);
        if (high < 0) continue;
        for_each_run(s, T(copy) * T(cam.W), cam, grid, [&](uint32_t first, uint32_t n) {
            const int32_t row = int32_t(first) / grid.tiles_x * grid.tiles_x, begin = vmax(int32_t(first) - row, low);
            const int32_t end = vmin(int32_t(first + n) - row, high + 1);
            if (begin < end) visit(uint32_t(row + begin), uint32_t(end - begin));
        });
    }
}

template <class T, class F>
GSPLAT_INLINE void for_each_run_of(const Splat<T> &s, const Camera &cam, const Grid &grid, F visit) {
    cam.wraps() ? for_each_wrapped_run(s, cam, grid, visit) : for_each_run(s, T(0), cam, grid, visit);
}

template <class T>
GSPLAT_INLINE void fetch(const Splat<T> *record) {
    __builtin_prefetch(record);
    if (sizeof *record > 64) __builtin_prefetch(reinterpret_cast<const char *>(record) + 64);
}

// The runs of BATCH Gaussians, a lane each, those of up to KEPT rows of tiles; a run of 0 tiles begins at tile 0.
struct LaneRuns {
    int32_t rows[BATCH];  // rows of tiles, more than KEPT if the lane is left out
    int32_t first[TileRuns::KEPT][BATCH], count[TileRuns::KEPT][BATCH];
};

// The same as `for_each_run`, in plain loops over lanes, which the compiler vectorises.
template <class T>
GSPLAT_INLINE void runs_of(const Splat<T> *splats, const uint32_t *ids, uint32_t count, const Camera &cam, const Grid &grid,
                           LaneRuns &runs) {
    T members[sizeof(Splat<T>) / sizeof(T)][BATCH];
    members_of(splats, [ids](uint32_t i) { return ids[i]; }, count, members);
    const auto of = [&](size_t offset) -> const T * { return members[offset / sizeof(T)]; };
    const T *u = of(offsetof(Splat<T>, u)), *v = of(offsetof(Splat<T>, v));
    const T *sx = of(offsetof(Splat<T>, sx)), *sy = of(offsetof(Splat<T>, sy)), *ty = of(offsetof(Splat<T>, ty));
    const T *log2_o = of(offsetof(Splat<T>, log2_o)), *ex = of(offsetof(Splat<T>, extent)),
            *ey = of(offsetof(Splat<T>, extent) + sizeof(T));
    T inverse_ey[BATCH], rightmost[BATCH], tangent[BATCH], half[BATCH], slack[BATCH];
    int32_t top[BATCH], rows[BATCH];
    const int32_t tiles_x = grid.tiles_x;
    const T height = T(cam.H), lowest = T(cam.H - 1), width = T(cam.W), end = T(cam.W - 1);
    for (uint32_t i = 0; i < BATCH; ++i) {
        inverse_ey[i] = 1 / ey[i], tangent[i] = -sy[i] / sx[i];
        rightmost[i] = -(sx[i] * sy[i] / (sy[i] * sy[i] + ty[i] * ty[i])) * ex[i];
        half[i] = sqrt_(vmax(log2_o[i] - T(LOG2_ALPHA_MIN), T(0))) / sx[i];
        const T above = rim_slack(abs_(v[i]) + ey[i]);
        const int32_t first = int32_t(vmin(vmax(ceil_(v[i] - ey[i] - above), T(0)), height));
        const int32_t last = int32_t(vmax(vmin(floor_(v[i] + ey[i] + above), lowest), T(-1)));
        slack[i] = rim_slack(abs_(u[i]) + abs_(tangent[i]) * vmin(ey[i], abs_(v[i]) + height) + half[i]);
        top[i] = first / TILE, rows[i] = runs.rows[i] = first > last ? 0 : last / TILE - first / TILE + 1;
    }
    for (int32_t r = 0; r < int32_t(TileRuns::KEPT); ++r)
        for (uint32_t i = 0; i < BATCH; ++i) {
            T low = T((top[i] + r) * TILE) - v[i], high = T((top[i] + r) * TILE + TILE - 1) - v[i];
            low = vmax(low, -ey[i]), high = vmin(high, ey[i]);
            const T middle = (low + high) / 2;
            const bool crossed = low > high;
            low = crossed ? middle : low, high = crossed ? middle : high;
            const T right = vmin(vmax(rightmost[i], low), high), left = vmin(vmax(-rightmost[i], low), high);
            const T yr = right * inverse_ey[i], yl = left * inverse_ey[i];
            const T x1 = u[i] + tangent[i] * right + half[i] * sqrt_(vmax(1 - yr * yr, T(0))) + slack[i];
            const T x0 = u[i] + tangent[i] * left - half[i] * sqrt_(vmax(1 - yl * yl, T(0))) - slack[i];
            const int32_t c0 = int32_t(vmin(vmax(ceil_(x0), T(0)), width)), c1 = int32_t(vmax(vmin(floor_(x1), end), T(-1)));
            const bool met = (c0 <= c1) & (r < rows[i]);
            runs.first[r][i] = met ? (top[i] + r) * tiles_x + c0 / TILE : 0;
            runs.count[r][i] = met ? c1 / TILE - c0 / TILE + 1 : 0;
        }
}

// How many tiles of a run are drawn.
template <class T>
GSPLAT_INLINE uint32_t drawn_tiles(const IntersectArgs<T> &args, uint32_t first, uint32_t n) {
    return args.drawn_before ? args.drawn_before[first + n] - args.drawn_before[first] : n;
}

// Counts differences from tile to tile, two numbers per run, and adds them up at the end. No branch depends on a small ellipse.
template <class T>
void count(const IntersectArgs<T> &args, int64_t begin, int64_t end, uint32_t *per_tile) {
    const uint32_t tiles = uint32_t(args.grid.tiles());
    const auto add = [&](uint32_t first, uint32_t n) {
        ++per_tile[first];
        if (first + n < tiles) --per_tile[first + n];
    };
    LaneRuns runs;
    for (int64_t k = begin; k < end; k += BATCH) {
        const uint32_t lanes = uint32_t(vmin(int64_t(BATCH), end - k));
        for (int64_t next = k + BATCH; next < k + 2 * BATCH && next < end; ++next) fetch(args.splats + args.sorted[next]);
        runs_of(args.splats, args.sorted + k, lanes, args.camera, args.grid, runs);
        for (uint32_t i = 0; i < lanes; ++i) {
            const uint32_t id = args.sorted[k + i];
            uint32_t total = 0, rows = 0;
            TileRuns &kept = args.runs[k + i];
            if (runs.rows[i] > int32_t(TileRuns::KEPT) || args.camera.wraps()) {
                for_each_run_of(args.splats[id], args.camera, args.grid, [&](uint32_t first, uint32_t n) {
                    add(first, n);
                    if (rows < TileRuns::KEPT) kept.runs[rows] = {first, n};
                    total += drawn_tiles(args, first, n), ++rows;
                });
            } else {
                for (uint32_t r = 0; r < TileRuns::KEPT; ++r) {
                    const uint32_t first = uint32_t(runs.first[r][i]), n = uint32_t(runs.count[r][i]);
                    add(first, n);
                    kept.runs[rows] = {first, n};
                    total += drawn_tiles(args, first, n), rows += n > 0;
                }
            }
            kept.rows = rows;
            args.pairs_of[id] = total;
        }
    }
    uint32_t sum = 0;
    for (uint32_t tile = 0; tile < tiles; ++tile) {
        sum += per_tile[tile];
        per_tile[tile] = drawn_tiles(args, tile, 1) ? sum : 0;
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
            for (uint32_t tile = first; tile < first + tiles; ++tile)
                if (drawn_tiles(args, tile, 1)) args.pairs[next[tile]++] = Pair{id, slot++};
        };
        if (kept.rows > TileRuns::KEPT)
            for_each_run_of(args.splats[id], args.camera, args.grid, write);
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

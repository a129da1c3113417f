// composite: blend one tile's splats into its pixels, near to far.
//
//     p = log2_o - s² - t²;   alpha = min(0.99, 2^p), 0 where p < log2(1/255);   w = T alpha;   image += w c;   T -= w
//
// A tile stops once the transmittance of every pixel is below 1e-4.
#include "isa.h"
#include "tile.h"

namespace gsplat {
namespace GSPLAT_ISA {

template <class T>
struct TileState {
    Plane<T> transmittance, red, green, blue, depth;
};

// Draws one splat.
template <class T, bool DEPTH, bool GENTLY>
GSPLAT_INLINE void draw(const Splat<T> &s, const TileBox &box, const Rows<T> &rows, uint32_t i, TileState<T> &tile) {
    using V = typename Vector<T>::V;
    FalloffRows<T> steps;
    Falloff<T, GENTLY> falloff{steps, {}, {}, {}, {}, {}};
    falloff.begin_splat(s, box, rows.top[i], rows.bottom[i]);
    const V red = splat(s.color[0]), green = splat(s.color[1]), blue = splat(s.color[2]);
    for (int strip = 0; strip < Strips<T>::COUNT; ++strip) {
        const int32_t first = rows.first[strip][i], last = rows.last[strip][i], column = strip * Strips<T>::WIDTH;
        if (first > last) continue;
        falloff.begin_strip(s, iota<T>() + splat(T(column + box.x0) - s.x), T(first + box.y0) - s.y);
        for (int32_t row = first; row <= last; ++row) {
            const int at = row * TILE + column;
            V key;
            const V alpha = falloff.alpha(row, key), t = load<V>(tile.transmittance.values + at), w = t * alpha;
            store(tile.red.values + at, load<V>(tile.red.values + at) + w * red);
            store(tile.green.values + at, load<V>(tile.green.values + at) + w * green);
            store(tile.blue.values + at, load<V>(tile.blue.values + at) + w * blue);
            if (DEPTH) store(tile.depth.values + at, load<V>(tile.depth.values + at) + w * splat(s.depth));
            store(tile.transmittance.values + at, t - w);
            falloff.step(row - first);
        }
    }
}

// Whether any pixel still has a transmittance of T_STOP or more. Looks first where one had it the last time.
template <class T>
GSPLAT_INLINE bool lets_light_through(const TileState<T> &tile, int &where) {
    using V = typename Vector<T>::V;
    if (any_at_least(load<V>(tile.transmittance.values + where), T(T_STOP))) return true;
    for (where = 0; where < TILE * TILE; where += Vector<T>::LANES)
        if (any_at_least(load<V>(tile.transmittance.values + where), T(T_STOP))) return true;
    where = 0;
    return false;
}

// Writes the pixels of a tile, over the background.
template <class T, bool DEPTH>
GSPLAT_INLINE void finish_tile(const CompositeArgs<T> &args, const TileBox &box, const TileState<T> &tile) {
    using Q = typename Four<T>::V;
    const double *bg = args.settings.background;
    for_each_four<T>(box, args.camera.W, [&](int from, int64_t pixel, int count) {
        const Q t = load<Q>(tile.transmittance.values + from);
        const Q rgb[3] = {load<Q>(tile.red.values + from) + t * T(bg[0]), load<Q>(tile.green.values + from) + t * T(bg[1]),
                          load<Q>(tile.blue.values + from) + t * T(bg[2])};
        store_colors<T>(args.image + 3 * pixel, count, rgb);
        memcpy(args.transmittance + pixel, &t, size_t(count) * sizeof(T));
        if (DEPTH) memcpy(args.depth + pixel, tile.depth.values + from, size_t(count) * sizeof(T));
    });
}

template <class T, bool DEPTH>
void composite_tile(const CompositeArgs<T> &args, int32_t index) {
    const TileBox box = tile_box(args.grid, args.camera, index);
    TileState<T> tile;
    memset(&tile, 0, sizeof tile);
    for (int y = 0; y < box.height; ++y)
        for (int x = 0; x < box.width; ++x) tile.transmittance.values[y * TILE + x] = 1;

    const uint32_t begin = args.tile_begin[index], end = args.tile_begin[index + 1];
    uint32_t k = begin;
    Rows<T> rows;
    int bright = 0;
    for (; k < end; ++k) {
        const uint32_t i = (k - begin) % BATCH;
        if (i == 0) {
            fetch_next(args.splats, args.pairs + k, end - k);
            rows_of(args.splats, args.pairs + k, vmin(BATCH, end - k), box, rows);
        }
        if (rows.top[i] > rows.bottom[i]) continue;
        const Splat<T> &s = args.splats[args.pairs[k].gaussian];
        rows.gentle[i] ? draw<T, DEPTH, true>(s, box, rows, i, tile) : draw<T, DEPTH, false>(s, box, rows, i, tile);
        if (!lets_light_through(tile, bright)) {
            ++k;
            break;
        }
    }
    args.done[index] = k - begin;
    finish_tile<T, DEPTH>(args, box, tile);
}

template <class T>
void composite(const CompositeArgs<T> &args, int32_t tile) {
    args.depth ? composite_tile<T, true>(args, tile) : composite_tile<T, false>(args, tile);
}

template void composite<float>(const CompositeArgs<float> &, int32_t);
template void composite<double>(const CompositeArgs<double> &, int32_t);

}  // namespace GSPLAT_ISA
}  // namespace gsplat

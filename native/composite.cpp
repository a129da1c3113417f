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
    alignas(64) T transmittance[TILE][TILE];
    alignas(64) T red[TILE][TILE], green[TILE][TILE], blue[TILE][TILE], depth[TILE][TILE];
};

// Draws one splat; returns whether any pixel in the rows it touched still has a transmittance of T_STOP or more.
template <class T, bool DEPTH>
GSPLAT_INLINE bool draw(const Splat<T> &s, const TileBox &box, int32_t first, int32_t last, TileState<T> &tile) {
    using V = typename Vector<T>::V;
    constexpr int LANES = Vector<T>::LANES;
    RowTerms<T> terms;
    row_terms(s, box, terms);
    V brightest = V{};
    for (int column = 0; column < TILE; column += LANES) {
        const V dx = iota<T>() + splat(T(column + box.x0) - s.x);
        const V across = splat(s.s0) + splat(s.sx) * dx;
        for (int row = first; row <= last; ++row) {
            const V q = across + splat(terms.shift[row]);
            const V alpha = exp2_between(splat(terms.base[row]) - q * q, T(LOG2_ALPHA_MIN), T(LOG2_ALPHA_MAX));
            V t = load<V>(&tile.transmittance[row][column]);
            const V w = t * alpha;
            store(&tile.red[row][column], load<V>(&tile.red[row][column]) + w * splat(s.color[0]));
            store(&tile.green[row][column], load<V>(&tile.green[row][column]) + w * splat(s.color[1]));
            store(&tile.blue[row][column], load<V>(&tile.blue[row][column]) + w * splat(s.color[2]));
            if (DEPTH) store(&tile.depth[row][column], load<V>(&tile.depth[row][column]) + w * splat(s.depth));
            t -= w;
            store(&tile.transmittance[row][column], t);
            brightest = brightest > t ? brightest : t;
        }
    }
    return any_at_least(brightest, T(T_STOP));
}

template <class T>
GSPLAT_INLINE bool lets_light_through(const TileState<T> &tile) {
    using V = typename Vector<T>::V;
    V brightest = V{};
    for (int row = 0; row < TILE; ++row)
        for (int column = 0; column < TILE; column += Vector<T>::LANES) {
            const V t = load<V>(&tile.transmittance[row][column]);
            brightest = brightest > t ? brightest : t;
        }
    return any_at_least(brightest, T(T_STOP));
}

template <class T, bool DEPTH>
void composite_tile(const CompositeArgs<T> &args, int32_t index) {
    const TileBox box = tile_box(args.grid, args.camera, index);
    TileState<T> tile;
    memset(&tile, 0, sizeof tile);
    for (int y = 0; y < box.height; ++y)
        for (int x = 0; x < box.width; ++x) tile.transmittance[y][x] = 1;

    const uint32_t begin = args.tile_begin[index], end = args.tile_begin[index + 1];
    uint32_t k = begin;
    Rows rows;
    for (; k < end; ++k) {
        const uint32_t i = (k - begin) % BATCH;
        if (i == 0) {
            fetch_next(args.splats, args.pairs + k, end - k);
            rows_of(args.splats, args.pairs + k, vmin(BATCH, end - k), box, rows);
        }
        if (rows.first[i] > rows.last[i]) continue;
        const Splat<T> &s = args.splats[args.pairs[k].gaussian];
        if (!draw<T, DEPTH>(s, box, rows.first[i], rows.last[i], tile) && !lets_light_through(tile)) {
            ++k;
            break;
        }
    }
    args.done[index] = k - begin;
    for (int y = 0; y < box.height; ++y)
        for (int x = 0; x < box.width; ++x) {
            const int64_t pixel = int64_t(box.y0 + y) * args.camera.W + box.x0 + x;
            const T t = tile.transmittance[y][x];
            args.image[3 * pixel] = tile.red[y][x] + t * T(args.settings.background[0]);
            args.image[3 * pixel + 1] = tile.green[y][x] + t * T(args.settings.background[1]);
            args.image[3 * pixel + 2] = tile.blue[y][x] + t * T(args.settings.background[2]);
            args.transmittance[pixel] = t;
            if (DEPTH) args.depth[pixel] = tile.depth[y][x];
        }
}

template <class T>
void composite(const CompositeArgs<T> &args, int32_t tile) {
    args.depth ? composite_tile<T, true>(args, tile) : composite_tile<T, false>(args, tile);
}

template void composite<float>(const CompositeArgs<float> &, int32_t);
template void composite<double>(const CompositeArgs<double> &, int32_t);

}  // namespace GSPLAT_ISA
}  // namespace gsplat

// composite_backward: the gradient of compositing, again near to far, so that T is not recovered by division.
//
// With g = dL/dimage, t = dL/dT_final and R = g . image + t T_final at the end, for each splat near to far:
//
//     cg = g . c;   w = T alpha;   R -= w cg;   dL/dalpha = T cg - R / (1 - alpha);   T -= w
//     h = alpha dL/dalpha, 0 where alpha was clamped
//
// Every pair writes its sums over the tile's pixels, w g and the moments of h about the splat's reference point, to its own
// slot.
#include "isa.h"
#include "tile.h"

namespace gsplat {
namespace GSPLAT_ISA {

template <class T>
struct TileGradient {
    alignas(64) T transmittance[TILE][TILE], rest[TILE][TILE];
    alignas(64) T red[TILE][TILE], green[TILE][TILE], blue[TILE][TILE], depth[TILE][TILE];
};

// Writes one splat's sums over the tile to `slot`.
template <class T, bool WITH_DEPTH>
GSPLAT_INLINE void splat_backward(const Splat<T> &s, const TileBox &box, int32_t first, int32_t last, TileGradient<T> &tile, T *slot) {
    using V = typename Vector<T>::V;
    constexpr int LANES = Vector<T>::LANES;
    RowTerms<T> terms;
    row_terms(s, box, terms);
    // w g (3) and the moments of h, 1, x, xx, y, xy, in the order of a slot; then yy and w z.
    V sums[8] = {}, hyy = V{}, wz = V{};
    for (int column = 0; column < TILE; column += LANES) {
        const V dx = iota<T>() + splat(T(column + box.x0) - s.x);
        const V across = splat(s.s0) + splat(s.sx) * dx;
        V wr = V{}, wg = V{}, wb = V{};
        V sum0 = V{}, sum1 = V{}, sum2 = V{};  // h, h dy, h dy²; multiplied by dx once per splat
        V dy = splat(T(first + box.y0) - s.y);
        for (int row = first; row <= last; ++row, dy += splat(T(1))) {
            const V q = across + splat(terms.shift[row]), p = splat(terms.base[row]) - q * q;
            const V alpha = exp2_between(p, T(LOG2_ALPHA_MIN), T(LOG2_ALPHA_MAX));
            const V r = load<V>(&tile.red[row][column]), g = load<V>(&tile.green[row][column]);
            const V b = load<V>(&tile.blue[row][column]);
            V cg = r * splat(s.color[0]) + g * splat(s.color[1]) + b * splat(s.color[2]);
            const V t = load<V>(&tile.transmittance[row][column]);
            const V w = t * alpha;
            if (WITH_DEPTH) {
                const V z = load<V>(&tile.depth[row][column]);
                cg += z * splat(s.depth);
                wz += w * z;
            }
            const V rest = load<V>(&tile.rest[row][column]) - w * cg;
            const V h = where_below(p, T(LOG2_ALPHA_MAX), alpha * (t * cg - rest * reciprocal(splat(T(1)) - alpha)));
            store(&tile.rest[row][column], rest);
            store(&tile.transmittance[row][column], t - w);
            wr += w * r, wg += w * g, wb += w * b;
            const V hdy = h * dy;
            sum0 += h, sum1 += hdy, sum2 += hdy * dy;
        }
        const V hdx = sum0 * dx;
        sums[0] += wr, sums[1] += wg, sums[2] += wb;
        sums[3] += sum0, sums[4] += hdx, sums[5] += hdx * dx, sums[6] += sum1, sums[7] += sum1 * dx;
        hyy += sum2;
    }
    sum8(sums, slot);
    slot[HYY] = sum(hyy), slot[DEPTH] = WITH_DEPTH ? sum(wz) : T(0);
}

// Loads the inputs of a tile's pixels; returns the sum of g T_final through `background`.
template <class T, bool WITH_DEPTH>
GSPLAT_INLINE void begin_tile(const CompositeBackwardArgs<T> &args, const TileBox &box, TileGradient<T> &tile, T *background) {
    const CompositeArgs<T> &forward = args.forward;
    memset(&tile, 0, sizeof tile);
    background[0] = background[1] = background[2] = 0;
    for (int y = 0; y < box.height; ++y)
        for (int x = 0; x < box.width; ++x) {
            const int64_t pixel = int64_t(box.y0 + y) * forward.camera.W + box.x0 + x;
            const T *g = args.grad_image + 3 * pixel;
            const T t = forward.transmittance[pixel];
            tile.transmittance[y][x] = 1;
            tile.red[y][x] = g[0], tile.green[y][x] = g[1], tile.blue[y][x] = g[2];
            T rest = dot3(g, forward.image + 3 * pixel);
            if (args.grad_transmittance) rest += args.grad_transmittance[pixel] * t;
            if (WITH_DEPTH) {
                tile.depth[y][x] = args.grad_depth[pixel];
                rest += args.grad_depth[pixel] * forward.depth[pixel];
            }
            tile.rest[y][x] = rest;
            for (int k = 0; k < 3; ++k) background[k] += g[k] * t;
        }
}

template <class T, bool WITH_DEPTH>
void tile_backward(const CompositeBackwardArgs<T> &args, int32_t index) {
    const CompositeArgs<T> &forward = args.forward;
    const TileBox box = tile_box(forward.grid, forward.camera, index);
    TileGradient<T> tile;
    begin_tile<T, WITH_DEPTH>(args, box, tile, args.tile_background + 3 * index);
    const uint32_t begin = forward.tile_begin[index], end = forward.tile_begin[index + 1];
    const uint32_t stop = begin + forward.done[index];
    Rows rows;
    for (uint32_t k = begin; k < end; ++k) {
        T *slot = args.slots + int64_t(SLOT) * forward.pairs[k].slot;
        const uint32_t i = (k - begin) % BATCH;
        if (k + 4 < end) __builtin_prefetch(args.slots + int64_t(SLOT) * forward.pairs[k + 4].slot, 1);
        if (i == 0 && k < stop) {
            fetch_next(forward.splats, forward.pairs + k, stop - k);
            rows_of(forward.splats, forward.pairs + k, vmin(BATCH, stop - k), box, rows);
        }
        if (k >= stop || rows.first[i] > rows.last[i])
            for (int j = 0; j < SLOT; ++j) slot[j] = 0;
        else
            splat_backward<T, WITH_DEPTH>(forward.splats[forward.pairs[k].gaussian], box, rows.first[i], rows.last[i], tile, slot);
    }
}

template <class T>
void composite_backward(const CompositeBackwardArgs<T> &args, int32_t tile) {
    args.grad_depth ? tile_backward<T, true>(args, tile) : tile_backward<T, false>(args, tile);
}

template void composite_backward<float>(const CompositeBackwardArgs<float> &, int32_t);
template void composite_backward<double>(const CompositeBackwardArgs<double> &, int32_t);

}  // namespace GSPLAT_ISA
}  // namespace gsplat

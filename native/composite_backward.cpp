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
    Plane<T> transmittance, rest, red, green, blue, depth;
};

// Writes one splat's sums over the tile to `slot`.
template <class T, bool WITH_DEPTH, bool GENTLY>
GSPLAT_INLINE void splat_backward(const Splat<T> &s, const TileBox &box, const Rows<T> &rows, uint32_t i, TileGradient<T> &tile, T *slot) {
    using V = typename Vector<T>::V;
    FalloffRows<T> steps;
    Falloff<T, GENTLY> falloff{steps, {}, {}, {}, {}, {}};
    falloff.begin_splat(s, box, rows.top[i], rows.bottom[i]);
    const V red = splat(s.color[0]), green = splat(s.color[1]), blue = splat(s.color[2]);
    V sums[8] = {}, hyy = V{}, wz = V{};  // in the order of a slot
    for (int strip = 0; strip < Strips<T>::COUNT; ++strip) {
        const int32_t first = rows.first[strip][i], last = rows.last[strip][i], column = strip * Strips<T>::WIDTH;
        if (first > last) continue;
        const V dx = iota<T>() + splat(T(column + box.x0) - s.x);
        falloff.begin_strip(s, dx, T(first + box.y0) - s.y);
        V wr = V{}, wg = V{}, wb = V{};
        V sum0 = V{}, sum1 = V{}, sum2 = V{};  // h, h dy, h dy²; multiplied by dx once per strip
        V dy = splat(T(first + box.y0) - s.y);
        for (int32_t row = first; row <= last; ++row, dy += splat(T(1))) {
            const int at = row * TILE + column;
            V key;
            const V alpha = falloff.alpha(row, key);
            const V r = load<V>(tile.red.values + at), g = load<V>(tile.green.values + at), b = load<V>(tile.blue.values + at);
            V cg = r * red + g * green + b * blue;
            const V t = load<V>(tile.transmittance.values + at), w = t * alpha;
            if (WITH_DEPTH) {
                const V z = load<V>(tile.depth.values + at);
                cg += z * splat(s.depth);
                wz += w * z;
            }
            const V rest = load<V>(tile.rest.values + at) - w * cg;
            const V h = falloff.where_open(key, alpha * (t * cg - rest * reciprocal(splat(T(1)) - alpha)));
            store(tile.rest.values + at, rest);
            store(tile.transmittance.values + at, t - w);
            wr += w * r, wg += w * g, wb += w * b;
            const V hdy = h * dy;
            sum0 += h, sum1 += hdy, sum2 += hdy * dy;
            falloff.step(row - first);
        }
        const V hdx = sum0 * dx;
        sums[RED] += wr, sums[GREEN] += wg, sums[BLUE] += wb;
        sums[H] += sum0, sums[HX] += hdx, sums[HXX] += hdx * dx, sums[HY] += sum1, sums[HXY] += sum1 * dx;
        hyy += sum2;
    }
    sum8(sums, slot);
    slot[HYY] = sum(hyy), slot[DEPTH] = WITH_DEPTH ? sum(wz) : T(0);
}

// Loads the inputs of a tile's pixels; returns the sum of g T_final through `background`.
template <class T, bool WITH_DEPTH>
GSPLAT_INLINE void begin_tile(const CompositeBackwardArgs<T> &args, const TileBox &box, TileGradient<T> &tile, T *background) {
    using Q = typename Four<T>::V;
    const CompositeArgs<T> &forward = args.forward;
    memset(&tile, 0, sizeof tile);
    Q sums[3] = {};
    for_each_four<T>(box, forward.camera.W, [&](int to, int64_t pixel, int count) {
        Q g[3], drawn[3];
        load_colors(args.grad_image + 3 * pixel, count, g);
        load_colors(forward.image + 3 * pixel, count, drawn);
        const Q t = load_some(forward.transmittance + pixel, count);
        Q rest = g[0] * drawn[0] + g[1] * drawn[1] + g[2] * drawn[2];
        if (args.grad_transmittance) rest += load_some(args.grad_transmittance + pixel, count) * t;
        if (WITH_DEPTH) {
            const Q gz = load_some(args.grad_depth + pixel, count);
            store(tile.depth.values + to, gz);
            rest += gz * load_some(forward.depth + pixel, count);
        }
        store(tile.rest.values + to, rest);
        store(tile.red.values + to, g[0]), store(tile.green.values + to, g[1]), store(tile.blue.values + to, g[2]);
        for (int i = 0; i < count; ++i) tile.transmittance.values[to + i] = 1;
        for (int k = 0; k < 3; ++k) sums[k] += g[k] * t;
    });
    for (int k = 0; k < 3; ++k) background[k] = (sums[k][0] + sums[k][2]) + (sums[k][1] + sums[k][3]);
}

template <class T, bool WITH_DEPTH>
void tile_backward(const CompositeBackwardArgs<T> &args, int32_t index) {
    const CompositeArgs<T> &forward = args.forward;
    const TileBox box = tile_box(forward.grid, forward.camera, index);
    TileGradient<T> tile;
    begin_tile<T, WITH_DEPTH>(args, box, tile, args.tile_background + 3 * index);
    const uint32_t begin = forward.tile_begin[index], end = forward.tile_begin[index + 1];
    const uint32_t stop = begin + forward.done[index];
    Rows<T> rows;
    for (uint32_t k = begin; k < end; ++k) {
        T *slot = args.slots + int64_t(SLOT) * forward.pairs[k].slot;
        const uint32_t i = (k - begin) % BATCH;
        if (k + 4 < end) __builtin_prefetch(args.slots + int64_t(SLOT) * forward.pairs[k + 4].slot, 1);
        if (i == 0 && k < stop) {
            fetch_next(forward.splats, forward.pairs + k, stop - k);
            rows_of(forward.splats, forward.pairs + k, vmin(BATCH, stop - k), box, rows);
        }
        if (k >= stop || rows.top[i] > rows.bottom[i]) {
            for (int j = 0; j < SLOT; ++j) slot[j] = 0;
            continue;
        }
        const Splat<T> &s = forward.splats[forward.pairs[k].gaussian];
        rows.gentle[i] ? splat_backward<T, WITH_DEPTH, true>(s, box, rows, i, tile, slot)
                       : splat_backward<T, WITH_DEPTH, false>(s, box, rows, i, tile, slot);
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

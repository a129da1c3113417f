// composite_backward: the gradient of compositing, again near to far, so that T is not recovered by division.
//
// With g = dL/dimage, t = dL/dT_final and R = g . image + t T_final at the end, for each splat near to far:
//
//     cg = g . c;   w = T alpha;   R -= w cg;   dL/dalpha = T cg - R / (1 - alpha);   T -= w
//     h = alpha dL/dalpha, 0 where alpha was clamped
//
// Every pair writes its sums over the tile's pixels, w g and the moments of h in s and t (see Splat), to its own slot.
#include "isa.h"
#include "tile.h"

namespace gsplat {
namespace GSPLAT_ISA {

template <class T>
struct TileGradient {
    Plane<T> transmittance, rest, red, green, blue, depth;
};

// Writes one splat's sums over the tile to `slot`.
template <class T, bool WITH_DEPTH>
GSPLAT_INLINE void splat_backward(const Splat<T> &splat_, const TileBox &box, typename Touched<T>::Mask blocks, TileGradient<T> &tile,
                                  T *slot) {
    using V = typename Vector<T>::V;
    const Slope<T> at = slope(splat_, box);
    const V red = splat(splat_.color[0]), green = splat(splat_.color[1]), blue = splat(splat_.color[2]);
    V sums[8] = {}, htt = V{}, wz = V{};  // in the order of a slot
    for (; blocks; blocks &= blocks - 1) {
        const int b = lowest_bit(blocks);
        V s, t;
        const V p = exponent(at, b, s, t), alpha = exp2_between(p, T(LOG2_ALPHA_MIN), T(LOG2_ALPHA_MAX));
        const V gr = tile.red.block(b), gg = tile.green.block(b), gb = tile.blue.block(b);
        V cg = gr * red + gg * green + gb * blue;
        const V before = tile.transmittance.block(b), w = before * alpha;
        if (WITH_DEPTH) {
            const V gz = tile.depth.block(b);
            cg += gz * splat(splat_.depth);
            wz += w * gz;
        }
        const V rest = tile.rest.block(b) - w * cg;
        const V h = where_below(p, T(LOG2_ALPHA_MAX), alpha * (before * cg - rest * reciprocal(splat(T(1)) - alpha)));
        tile.rest.set_block(b, rest);
        tile.transmittance.set_block(b, before - w);
        sums[RED] += w * gr, sums[GREEN] += w * gg, sums[BLUE] += w * gb;
        const V hs = h * s, ht = h * t;
        sums[H] += h, sums[HS] += hs, sums[HSS] += hs * s, sums[HT] += ht, sums[HST] += hs * t, htt += ht * t;
    }
    sum8(sums, slot);
    slot[HTT] = sum(htt), slot[DEPTH] = WITH_DEPTH ? sum(wz) : T(0);
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
    Touched<T> touched;
    for (uint32_t k = begin; k < end; ++k) {
        T *slot = args.slots + int64_t(SLOT) * forward.pairs[k].slot;
        const uint32_t i = (k - begin) % BATCH;
        if (k + 4 < end) __builtin_prefetch(args.slots + int64_t(SLOT) * forward.pairs[k + 4].slot, 1);
        if (i == 0 && k < stop) {
            fetch_next(forward.splats, forward.pairs + k, stop - k);
            find_touched(forward.splats, forward.pairs + k, vmin(BATCH, stop - k), box, touched);
        }
        if (k >= stop || !touched.masks[i])
            for (int j = 0; j < SLOT; ++j) slot[j] = 0;
        else
            splat_backward<T, WITH_DEPTH>(forward.splats[forward.pairs[k].gaussian], box, touched.masks[i], tile, slot);
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

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

// Draws one splat into the blocks it touches; returns whether any of their pixels still has a transmittance of T_STOP or more.
template <class T, bool DEPTH>
GSPLAT_INLINE bool draw(const Splat<T> &splat_, const TileBox &box, typename Touched<T>::Mask blocks, TileState<T> &tile) {
    using V = typename Vector<T>::V;
    const Slope<T> at = slope(splat_, box);
    const V red = splat(splat_.color[0]), green = splat(splat_.color[1]), blue = splat(splat_.color[2]);
    V brightest = V{};
    for (; blocks; blocks &= blocks - 1) {
        const int b = lowest_bit(blocks);
        V s, t;
        const V alpha = exp2_between(exponent(at, b, s, t), T(LOG2_ALPHA_MIN), T(LOG2_ALPHA_MAX));
        const V before = tile.transmittance.block(b), w = before * alpha, after = before - w;
        tile.red.set_block(b, tile.red.block(b) + w * red);
        tile.green.set_block(b, tile.green.block(b) + w * green);
        tile.blue.set_block(b, tile.blue.block(b) + w * blue);
        if (DEPTH) tile.depth.set_block(b, tile.depth.block(b) + w * splat(splat_.depth));
        tile.transmittance.set_block(b, after);
        brightest = brightest > after ? brightest : after;
    }
    return any_at_least(brightest, T(T_STOP));
}

template <class T>
GSPLAT_INLINE bool lets_light_through(const TileState<T> &tile) {
    typename Vector<T>::V brightest{};
    for (int b = 0; b < Blocks<T>::COUNT; ++b) {
        const auto t = tile.transmittance.block(b);
        brightest = brightest > t ? brightest : t;
    }
    return any_at_least(brightest, T(T_STOP));
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
        for (int x = 0; x < box.width; ++x) tile.transmittance.values[Blocks<T>::index(x, y)] = 1;

    const uint32_t begin = args.tile_begin[index], end = args.tile_begin[index + 1];
    uint32_t k = begin;
    Touched<T> touched;
    for (; k < end; ++k) {
        const uint32_t i = (k - begin) % BATCH;
        if (i == 0) {
            fetch_next(args.splats, args.pairs + k, end - k);
            find_touched(args.splats, args.pairs + k, vmin(BATCH, end - k), box, touched);
        }
        if (!touched.masks[i]) continue;
        const Splat<T> &s = args.splats[args.pairs[k].gaussian];
        if (!draw<T, DEPTH>(s, box, touched.masks[i], tile) && !lets_light_through(tile)) {
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

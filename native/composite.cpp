// composite: blend one tile's splats into its pixels, near to far.
//
//     p = log2_o - s² - t²;   alpha = min(0.99, 2^p), 0 where p < log2(1/255);   w = T alpha;   image += w c;   T -= w
//
// A tile stops once the transmittance of every pixel is below 1e-4, or every pixel has ended (Settings::pixel_stop). Depth and features are
// composited as colours are. The median depth is that of the splat where T falls below one half, 0 if it never does.
#include "channels.h"
#include "isa.h"

namespace gsplat {
namespace GSPLAT_ISA {

template <class T, int MODE>
struct TileState {
    Plane<T> transmittance, red, green, blue, depth;
};

template <class T>
struct TileState<T, WITH_FEATURES> : TileState<T, WITH_DEPTH> {
    FeaturePlanes<T> features;
    FeatureGroup<T> group;
};

template <class T>
struct TileState<T, WITH_ALL> : TileState<T, WITH_FEATURES> {
    Plane<T> median;
};

template <class T>
struct TileState<T, WRAPPED> : TileState<T, WITH_ALL> {
    WrappedSplats<T> wrapped;
};

// Draws one splat; `weights` gets T alpha by pixel if there are features.
template <class T, int MODE, FalloffKind KIND>
GSPLAT_INLINE void draw(const CompositeArgs<T> &args, const AlphaClamp<T> &clamp, const Splat<T> &s, const TileBox &box,
                        const Batch<T> &batch, uint32_t i, TileState<T, MODE> &tile, [[maybe_unused]] T *weights) {
    using V = typename Vector<T>::V;
    const Rows<T> &rows = batch.rows;
    SteepRows<T> steep;
    Falloff<T, KIND> falloff{batch.steps, i, steep, clamp};
    falloff.begin_splat(s, box);
    const V red = splat(s.color[0]), green = splat(s.color[1]), blue = splat(s.color[2]);
    const auto blend = [&](Falloff<T, KIND> &along, int32_t row, int32_t first, int column) {
        const int at = row * TILE + column;
        V key;
        V alpha = along.alpha(row, key), t = load<V>(tile.transmittance.values + at);
        if constexpr (MODE >= WITH_FEATURES)
            if (args.settings.pixel_stop) end_pixels<T>(t, alpha);
        const V w = t * alpha;
        store(tile.red.values + at, load<V>(tile.red.values + at) + w * red);
        store(tile.green.values + at, load<V>(tile.green.values + at) + w * green);
        store(tile.blue.values + at, load<V>(tile.blue.values + at) + w * blue);
        if (MODE != COLORS) store(tile.depth.values + at, load<V>(tile.depth.values + at) + w * splat(s.depth));
        store(tile.transmittance.values + at, t - w);
        if constexpr (MODE >= WITH_FEATURES) store(weights + at, w);
        if constexpr (MODE >= WITH_ALL) {
            const V half = splat(T(0.5)), median = load<V>(tile.median.values + at);
            store(tile.median.values + at, ((t >= half) & (t - w < half)) ? splat(s.depth) : median);
        }
        along.step(row - first);
    };
    for (int strip = 0; strip < Strips<T>::COUNT; ++strip) {
        const int32_t first = rows.first[strip][i], last = rows.last[strip][i], column = strip * Strips<T>::WIDTH;
        const auto begin = [&](Falloff<T, KIND> &along, int32_t at) { along.begin_strip(s, at, iota<T>() + splat(T(at + box.x0) - s.x)); };
        if constexpr (KIND != STEEP && Strips<T>::COUNT > 1)
            if (strip % 2 == 0 && first == rows.first[strip + 1][i]) {  // one loop: the processor mispredicts one end instead of two
                const int32_t other = column + Strips<T>::WIDTH, end = vmax(last, rows.last[strip + 1][i]);
                Falloff<T, KIND> beside = falloff;
                begin(falloff, column), begin(beside, other);
                for (int32_t row = first; row <= end; ++row) blend(falloff, row, first, column), blend(beside, row, first, other);
                ++strip;
                continue;
            }
        if (first > last) continue;
        begin(falloff, column);
        for (int32_t row = first; row <= last; ++row) blend(falloff, row, first, column);
    }
}

// Whether any pixel still has a transmittance of T_STOP or more. Looks first where one had it the last time.
template <class T>
GSPLAT_INLINE bool lets_light_through(const Plane<T> &transmittance, int &where) {
    using V = typename Vector<T>::V;
    if (any_at_least(load<V>(transmittance.values + where), T(T_STOP))) return true;
    for (where = 0; where < TILE * TILE; where += Vector<T>::LANES)
        if (any_at_least(load<V>(transmittance.values + where), T(T_STOP))) return true;
    where = 0;
    return false;
}

// Writes the pixels of a tile, over the background.
template <class T, int MODE>
GSPLAT_INLINE void finish_tile(const CompositeArgs<T> &args, const TileBox &box, TileState<T, MODE> &tile) {
    using Q = typename Four<T>::V;
    const Images<T> &out = args.out;
    const double *bg = args.settings.background;
    for_each_four<T>(box, args.camera.W, [&](int from, int64_t pixel, int count) {
        Q t = load<Q>(tile.transmittance.values + from);
        if (MODE >= WITH_FEATURES) t = t < Q{} ? -t : t;
        const Q rgb[3] = {load<Q>(tile.red.values + from) + t * T(bg[0]), load<Q>(tile.green.values + from) + t * T(bg[1]),
                          load<Q>(tile.blue.values + from) + t * T(bg[2])};
        const size_t bytes = size_t(count) * sizeof(T);
        store_colors<T>(out.image + 3 * pixel, count, rgb);
        memcpy(out.transmittance + pixel, &t, bytes);
        if (MODE != COLORS && out.depth) memcpy(out.depth + pixel, tile.depth.values + from, bytes);
        if constexpr (MODE >= WITH_ALL)
            if (MODE == WITH_ALL || out.median) memcpy(out.median + pixel, tile.median.values + from, bytes);
        if constexpr (MODE >= WITH_FEATURES) tile.features.write(from, out.features + pixel * out.channels, count);
    });
}

template <class T, int MODE>
void composite_tile(const CompositeArgs<T> &args, int32_t index) {
    const TileBox box = tile_box(args.grid, args.camera, index);
    const AlphaClamp<T> clamp(args.settings);
    TileState<T, MODE> tile;
    memset(&tile, 0, sizeof(TileState<T, COLORS>));
    if constexpr (MODE >= WITH_FEATURES) tile.features.clear(args.out.channels);
    if constexpr (MODE >= WITH_ALL) memset(&tile.median, 0, sizeof tile.median);
    for (int y = 0; y < box.height; ++y)
        for (int x = 0; x < box.width; ++x) tile.transmittance.values[y * TILE + x] = 1;

    const uint32_t begin = args.tile_begin[index], end = args.tile_begin[index + 1];
    uint32_t k = begin;
    Batch<T> batch;
    const Rows<T> &rows = batch.rows;
    KeptRows<T> *kept = kept_rows(args, index);
    int bright = 0;
    for (; k < end; ++k) {
        const uint32_t i = (k - begin) % BATCH;
        if constexpr (MODE == WRAPPED) {
            if (i == 0) {
                const uint32_t count = tile.wrapped.take(args, args.pairs + k, end - k, box);
                batch.template begin<false>(tile.wrapped.splats, tile.wrapped.pairs, count, box, clamp, KEEPS_ROWS ? kept++ : nullptr);
            }
        } else {
            if (i == 0) batch.template begin<false>(args.splats, args.pairs + k, end - k, box, clamp, KEEPS_ROWS ? kept++ : nullptr);
        }
        if (rows.top[i] > rows.bottom[i]) continue;
        const uint32_t id = args.pairs[k].gaussian;
        const Splat<T> *s = args.splats + id;
        if constexpr (MODE == WRAPPED) s = tile.wrapped.splats + i;
        T *weights = nullptr;
        if constexpr (MODE >= WITH_FEATURES)
            weights = tile.group.take(args.features + int64_t(args.out.channels) * id, rows.top[i], rows.bottom[i]);
        // An instance for INSIDE makes the forward pass no faster: its stores bound it.
        rows.kind[i] == STEEP ? draw<T, MODE, STEEP>(args, clamp, *s, box, batch, i, tile, weights)
                              : draw<T, MODE, GENTLE>(args, clamp, *s, box, batch, i, tile, weights);
        if constexpr (MODE >= WITH_FEATURES)
            if (tile.group.count == tile.group.SIZE) tile.group.add_to(tile.features);
        if (!lets_light_through(tile.transmittance, bright)) {
            ++k;
            break;
        }
    }
    if constexpr (MODE >= WITH_FEATURES) tile.group.add_to(tile.features);
    args.done[index] = k - begin;
    finish_tile<T, MODE>(args, box, tile);
}

template <class T>
void composite(const CompositeArgs<T> &args, int32_t tile) {
    if (args.camera.wraps()) return composite_tile<T, WRAPPED>(args, tile);
    if (args.out.median) return composite_tile<T, WITH_ALL>(args, tile);
    if (args.out.features || args.settings.pixel_stop) return composite_tile<T, WITH_FEATURES>(args, tile);
    args.out.depth ? composite_tile<T, WITH_DEPTH>(args, tile) : composite_tile<T, COLORS>(args, tile);
}

template void composite<float>(const CompositeArgs<float> &, int32_t);
template void composite<double>(const CompositeArgs<double> &, int32_t);

}  // namespace GSPLAT_ISA
}  // namespace gsplat

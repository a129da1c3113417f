// composite_backward: the gradient of compositing, again near to far, so that T is not recovered by division.
//
// With g = dL/dimage, t = dL/dT_final and R = g . image + t T_final at the end, for each splat near to far:
//
//     cg = g . c;   w = T alpha;   R -= w cg;   dL/dalpha = T cg - R / (1 - alpha);   T -= w
//     h = alpha dL/dalpha, 0 where alpha was clamped
//
// Every pair writes its sums over the tile's pixels, w g and the moments of h about the splat's reference point, to its own
// slot; those of features and statistics to slots of their own.
#include "channels.h"
#include "isa.h"

namespace gsplat {
namespace GSPLAT_ISA {

template <class T, int MODE>
struct TileGradient {
    Plane<T> transmittance, rest, red, green, blue, depth;
};

template <class T>
struct TileGradient<T, WITH_FEATURES> : TileGradient<T, WITH_DEPTH> {
    FeaturePlanes<T> features;  // their gradients; no channels if there are none
    FeatureGroupBackward<T> group;
};

template <class T>
struct TileGradient<T, WITH_ALL> : TileGradient<T, WITH_FEATURES> {
    Plane<T> errors;
};

template <class T>
struct TileGradient<T, WRAPPED> : TileGradient<T, WITH_ALL> {
    WrappedSplats<T> wrapped;
};

// A pair, and where its sums go.
template <class T>
struct PairSlots {
    const Splat<T> &s;
    T *slot;
    T *feature_slot, *statistic_slot;
    int32_t channels;   // 0 if features have no gradient
};

template <class V>
GSPLAT_INLINE V absolute(V v) {
    return v < V{} ? -v : v;
}

// Writes the sums of one splat's statistics; p = log2_o - s² - t², so that dL/du = 2 ln 2 sx (h s), dL/dv = 2 ln 2 (sy (h s) + ty (h t)).
template <class T>
GSPLAT_INLINE void write_statistics(const Splat<T> &s, const typename Vector<T>::V *sums, T *slot) {
    const T two_ln2 = T(2 * 0.69314718055994531);
    for (int k = 0; k < WEIGHT_MAX; ++k) slot[k] = sum(sums[k]);
    slot[ABS_U] *= two_ln2 * (s.sx < 0 ? -s.sx : s.sx), slot[ABS_V] *= two_ln2;
    slot[WEIGHT_MAX] = 0;
    for (int l = 0; l < Vector<T>::LANES; ++l) slot[WEIGHT_MAX] = vmax(slot[WEIGHT_MAX], T(sums[WEIGHT_MAX][l]));
}

// Writes one splat's sums over the tile to its slot, and its weights to its place in the group of features.
template <class T, int MODE, FalloffKind KIND>
GSPLAT_INLINE void splat_backward(const Settings &settings, const AlphaClamp<T> &clamp, const PairSlots<T> &pair, const TileBox &box,
                                  const Batch<T> &batch, uint32_t i, TileGradient<T, MODE> &tile) {
    [[maybe_unused]] const uint32_t member = i % FeatureGroup<T>::SIZE;
    using V = typename Vector<T>::V;
    const Splat<T> &s = pair.s;
    const Rows<T> &rows = batch.rows;
    SteepRows<T> steep;
    Falloff<T, KIND> falloff{batch.steps, i, steep, clamp};
    falloff.begin_splat(s, box);
    const V red = splat(s.color[0]), green = splat(s.color[1]), blue = splat(s.color[2]);
    V sums[8] = {}, hyy = V{}, wz = V{};  // in the order of a slot
    V statistics[STATISTICS] = {};
    for (int strip = 0; strip < Strips<T>::COUNT; ++strip) {
        const int32_t first = rows.first[strip][i], last = rows.last[strip][i], column = strip * Strips<T>::WIDTH;
        if (first > last) continue;
        const V dx = iota<T>() + splat(T(column + box.x0) - s.x);
        falloff.begin_strip(s, column, dx);
        V wr = V{}, wg = V{}, wb = V{};
        V sum0 = V{}, sum1 = V{}, sum2 = V{};  // of h, of sum0 after each row, of sum1 after each row
        [[maybe_unused]] V dy = splat(T(first + box.y0) - s.y);
        for (int32_t row = first; row <= last; ++row) {
            const int at = row * TILE + column;
            V key;
            V alpha = falloff.alpha(row, key), t = load<V>(tile.transmittance.values + at);
            if constexpr (MODE >= WITH_FEATURES)
                if (settings.pixel_stop) end_pixels<T>(t, alpha);
            const V r = load<V>(tile.red.values + at), g = load<V>(tile.green.values + at), b = load<V>(tile.blue.values + at);
            V cg = r * red + g * green + b * blue;
            const V w = t * alpha;
            if (MODE != COLORS) {
                const V z = load<V>(tile.depth.values + at);
                cg += z * splat(s.depth);
                wz += w * z;
            }
            if constexpr (MODE >= WITH_FEATURES)
                if (pair.channels) {
                    cg += load<V>(tile.group.dots[member].values + at);
                    store(tile.group.weights[member].values + at, w);
                }
            const V drawn = w * cg, rest = load<V>(tile.rest.values + at) - drawn;
            const V h = falloff.where_open(key, drawn - rest * odds(alpha));
            store(tile.rest.values + at, rest);
            store(tile.transmittance.values + at, t - w);
            wr += w * r, wg += w * g, wb += w * b;
            sum0 += h, sum1 += sum0, sum2 += sum1;
            if constexpr (MODE >= WITH_ALL) {
                const V across = falloff.across + splat(s.sy) * dy, along = splat(s.t0) + splat(s.ty) * dy;
                statistics[ABS_U] += absolute(h * across), statistics[ABS_V] += absolute(h * (splat(s.sy) * across + splat(s.ty) * along));
                statistics[WEIGHT] += w, statistics[PIXELS] += w > V{} ? splat(T(1)) : V{};
                statistics[WEIGHTED_ERROR] += w * load<V>(tile.errors.values + at);
                statistics[WEIGHT_MAX] = w > statistics[WEIGHT_MAX] ? w : statistics[WEIGHT_MAX];
                dy += splat(T(1));
            }
            falloff.step(row - first);
        }
        // Row `last` counted once in sum1 and the row above it twice, so with m = 1 there, 2 above, ...: sum1 = sum of h m and
        // 2 sum2 - sum1 = sum of h m², while dy = end - m.
        const V end = splat(T(last + 1 + box.y0) - s.y), hdx = sum0 * dx, shifted = end * sum0 - sum1;
        sums[RED] += wr, sums[GREEN] += wg, sums[BLUE] += wb;
        sums[H] += sum0, sums[HX] += hdx, sums[HXX] += hdx * dx, sums[HY] += shifted, sums[HXY] += shifted * dx;
        hyy += end * (shifted - sum1) + (sum2 + sum2 - sum1);
    }
    sum8(sums, pair.slot);
    pair.slot[HYY] = sum(hyy), pair.slot[DEPTH] = MODE != COLORS ? sum(wz) : T(0);
    if constexpr (MODE >= WITH_ALL)
        if (MODE == WITH_ALL || pair.statistic_slot) write_statistics(s, statistics, pair.statistic_slot);
}

// Loads the inputs of a tile's pixels; returns the sum of g T_final through `background`.
template <class T, int MODE>
GSPLAT_INLINE void begin_tile(const CompositeBackwardArgs<T> &args, const TileBox &box, TileGradient<T, MODE> &tile, T *background) {
    using Q = typename Four<T>::V;
    const Images<T> &out = args.forward.out;
    const ImageGrads<T> &in = args.in;
    // A full tile of colours is written completely below.
    if (MODE != COLORS || box.width < TILE || box.height < TILE) memset(&tile, 0, sizeof(TileGradient<T, COLORS>));
    if constexpr (MODE >= WITH_FEATURES) tile.features.clear(in.features ? out.channels : 0);
    if constexpr (MODE >= WITH_ALL) memset(&tile.errors, 0, sizeof tile.errors);
    Q sums[3] = {};
    for_each_four<T>(box, args.forward.camera.W, [&](int to, int64_t pixel, int count) {
        Q g[3], drawn[3];
        load_colors(in.image + 3 * pixel, count, g);
        load_colors(out.image + 3 * pixel, count, drawn);
        const Q t = load_some(out.transmittance + pixel, count);
        Q rest = g[0] * drawn[0] + g[1] * drawn[1] + g[2] * drawn[2];
        if (in.transmittance) rest += load_some(in.transmittance + pixel, count) * t;
        if (MODE != COLORS && in.depth) {
            const Q gz = load_some(in.depth + pixel, count);
            store(tile.depth.values + to, gz);
            rest += gz * load_some(out.depth + pixel, count);
        }
        if constexpr (MODE >= WITH_ALL)
            if (args.errors) store(tile.errors.values + to, load_some(args.errors + pixel, count));
        if constexpr (MODE >= WITH_FEATURES)
            if (const int64_t channels = tile.features.channels)
                rest += tile.features.read(to, in.features + pixel * channels, out.features + pixel * channels, count);
        store(tile.rest.values + to, rest);
        store(tile.red.values + to, g[0]), store(tile.green.values + to, g[1]), store(tile.blue.values + to, g[2]);
        for (int i = 0; i < count; ++i) tile.transmittance.values[to + i] = 1;
        for (int k = 0; k < 3; ++k) sums[k] += g[k] * t;
    });
    for (int k = 0; k < 3; ++k) background[k] = (sums[k][0] + sums[k][2]) + (sums[k][1] + sums[k][3]);
}

template <class T, int MODE>
GSPLAT_INLINE PairSlots<T> slots_of(const CompositeBackwardArgs<T> &args, const Pair &pair, const Splat<T> &s) {
    const int64_t slot = pair.slot, channels = args.forward.out.channels;
    PairSlots<T> to{s, args.slots + SLOT * slot, nullptr, nullptr, 0};
    if (MODE >= WITH_FEATURES && args.feature_slots)
        to.feature_slot = args.feature_slots + channels * slot, to.channels = int32_t(channels);
    if (MODE == WITH_ALL || (MODE == WRAPPED && args.statistic_slots)) to.statistic_slot = args.statistic_slots + STATISTICS * slot;
    return to;
}

template <class T>
GSPLAT_INLINE void write_zeros(const PairSlots<T> &to) {
    for (int j = 0; j < SLOT; ++j) to.slot[j] = 0;
    if (to.feature_slot) memset(to.feature_slot, 0, size_t(to.channels) * sizeof(T));
    if (to.statistic_slot) memset(to.statistic_slot, 0, STATISTICS * sizeof(T));
}

// Takes the pairs from k on, which are those from i on in the batch, as far as they are of one group.
template <class T, int MODE>
GSPLAT_INLINE void begin_group(const CompositeBackwardArgs<T> &args, uint32_t k, uint32_t stop, const Rows<T> &rows, uint32_t i,
                               TileGradient<T, MODE> &tile) {
    const CompositeArgs<T> &forward = args.forward;
    for (uint32_t end = vmin(k + FeatureGroup<T>::SIZE, stop); k < end; ++k, ++i)
        tile.group.take(forward.features + int64_t(forward.out.channels) * forward.pairs[k].gaussian, rows.top[i], rows.bottom[i]);
    tile.group.fill();
    tile.group.multiply(tile.features);
}

// Writes the features' sums of the pairs [k, end).
template <class T, int MODE>
GSPLAT_INLINE void end_group(const CompositeBackwardArgs<T> &args, uint32_t k, uint32_t end, TileGradient<T, MODE> &tile) {
    T *slots[FeatureGroup<T>::SIZE];
    const int members = int(end - k);
    for (int j = 0; j < members; ++j)
        slots[j] = args.feature_slots + int64_t(tile.features.channels) * args.forward.pairs[k + uint32_t(j)].slot;
    tile.group.write(tile.features, slots, members);
}

template <class T, int MODE>
void tile_backward(const CompositeBackwardArgs<T> &args, int32_t index) {
    const CompositeArgs<T> &forward = args.forward;
    const TileBox box = tile_box(forward.grid, forward.camera, index);
    const TileBox next = tile_box(forward.grid, forward.camera, index + 1);  // its height is 0 or less after the last tile
    const AlphaClamp<T> clamp(forward.settings);
    TileGradient<T, MODE> tile;
    begin_tile<T, MODE>(args, box, tile, args.tile_background + 3 * index);
    const uint32_t begin = forward.tile_begin[index], end = forward.tile_begin[index + 1];
    const uint32_t stop = begin + forward.done[index];
    Batch<T> batch;
    const Rows<T> &rows = batch.rows;
    KeptRows<T> *kept = kept_rows(forward, index);
    for (uint32_t k = begin; k < end; ++k) {
        const uint32_t i = (k - begin) % BATCH;
        const Splat<T> *s = forward.splats + forward.pairs[k].gaussian;
        if constexpr (MODE == WRAPPED) s = tile.wrapped.splats + i;  // filled below
        const PairSlots<T> pair = slots_of<T, MODE>(args, forward.pairs[k], *s);
        if (k + 4 < end) __builtin_prefetch(args.slots + int64_t(SLOT) * forward.pairs[k + 4].slot, 1);
        fetch_row(args.in.image, 3, next, forward.camera.W, k - begin);
        fetch_row(forward.out.image, 3, next, forward.camera.W, k - begin);
        fetch_row(forward.out.transmittance, 1, next, forward.camera.W, k - begin);
        if constexpr (MODE >= WITH_FEATURES) {
            fetch_row(args.in.features, tile.features.channels, next, forward.camera.W, k - begin);
            fetch_row(forward.out.features, tile.features.channels, next, forward.camera.W, k - begin);
        }
        if constexpr (MODE == WRAPPED) {
            if (i == 0 && k < stop) {
                const uint32_t count = tile.wrapped.take(forward, forward.pairs + k, stop - k, box);
                batch.template begin<true>(tile.wrapped.splats, tile.wrapped.pairs, count, box, clamp, KEEPS_ROWS ? kept++ : nullptr);
            }
        } else if (i == 0 && k < stop)
            batch.template begin<true>(forward.splats, forward.pairs + k, stop - k, box, clamp, KEEPS_ROWS ? kept++ : nullptr);
        if constexpr (MODE >= WITH_FEATURES)
            if (k < stop && pair.channels && i % FeatureGroup<T>::SIZE == 0) begin_group(args, k, stop, rows, i, tile);
        if (k >= stop || rows.top[i] > rows.bottom[i])
            write_zeros(pair);
        else
            switch (rows.kind[i]) {
                case INSIDE:
                    splat_backward<T, MODE, INSIDE>(forward.settings, clamp, pair, box, batch, i, tile);
                    break;
                case GENTLE:
                    splat_backward<T, MODE, GENTLE>(forward.settings, clamp, pair, box, batch, i, tile);
                    break;
                default:
                    splat_backward<T, MODE, STEEP>(forward.settings, clamp, pair, box, batch, i, tile);
            }
        if constexpr (MODE >= WITH_FEATURES)
            if (k < stop && pair.channels && (i % FeatureGroup<T>::SIZE == FeatureGroup<T>::SIZE - 1 || k + 1 == stop))
                end_group(args, k - i % FeatureGroup<T>::SIZE, k + 1, tile);
    }
}

template <class T>
void composite_backward(const CompositeBackwardArgs<T> &args, int32_t tile) {
    if (args.forward.camera.wraps()) return tile_backward<T, WRAPPED>(args, tile);
    if (args.statistic_slots) return tile_backward<T, WITH_ALL>(args, tile);
    if (args.feature_slots || args.forward.settings.pixel_stop) return tile_backward<T, WITH_FEATURES>(args, tile);
    args.in.depth ? tile_backward<T, WITH_DEPTH>(args, tile) : tile_backward<T, COLORS>(args, tile);
}

template void composite_backward<float>(const CompositeBackwardArgs<float> &, int32_t);
template void composite_backward<double>(const CompositeBackwardArgs<double> &, int32_t);

}  // namespace GSPLAT_ISA
}  // namespace gsplat

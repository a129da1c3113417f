// Features of a tile: where they lie, and what a group of splats adds to them at once.
//
// A channel of a vector of pixels is loaded and stored once per group instead of once per splat: with one splat at a time,
// stores bound the time.
#pragma once

#include "tile.h"

namespace gsplat {
namespace GSPLAT_ISA {

// Features of a tile's pixels: all channels of a vector of pixels are neighbours, because a splat adds to all of them at once.
template <class T>
struct FeaturePlanes {
    using V = typename Vector<T>::V;
    using Q = typename Four<T>::V;
    static constexpr int LANES = Vector<T>::LANES;
    int32_t channels;
    alignas(64) T values[TILE * TILE * MOST_CHANNELS];

    GSPLAT_METHOD void clear(int32_t count) {
        channels = count;
        memset(values, 0, size_t(TILE * TILE) * size_t(count) * sizeof(T));
    }

    // The vectors of all channels at a place in a plane, where a vector begins.
    GSPLAT_METHOD T *at(int place) { return values + place * channels; }

    // One channel of four neighbouring pixels.
    GSPLAT_METHOD T *four(int place, int32_t k) { return values + place / LANES * LANES * channels + k * LANES + place % LANES; }
    GSPLAT_METHOD Q load_four(int place, int32_t k) {
        if (LANES >= 4) return load<Q>(four(place, k));
        return Q{*four(place, k), *four(place + 1, k), *four(place + 2, k), *four(place + 3, k)};
    }
    GSPLAT_METHOD void store_four(int place, int32_t k, Q q) {
        if (LANES >= 4) return store(four(place, k), q);
        for (int i = 0; i < 4; ++i) *four(place + i, k) = q[i];
    }

    // Copies `count` pixels, at most four, to an interleaved image.
    GSPLAT_METHOD void write(int place, T *to, int count) {
        int32_t k = 0;
        if (count == 4)
            for (; channels - k >= 4; k += 4) {
                Q m[4] = {load_four(place, k), load_four(place, k + 1), load_four(place, k + 2), load_four(place, k + 3)};
                transpose(m);
                for (int i = 0; i < 4; ++i) store(to + i * channels + k, m[i]);
            }
        for (; k < channels; ++k)
            for (int i = 0; i < count; ++i) to[i * channels + k] = *four(place + i, k);
    }

    // Copies them from an interleaved image; returns, by pixel, their dot product with the channels of another one.
    GSPLAT_METHOD Q read(int place, const T *from, const T *other, int count) {
        Q sum{};
        int32_t k = 0;
        if (count == 4) {
            Q parts[4] = {};
            for (; channels - k >= 4; k += 4) {
                Q m[4];
                for (int i = 0; i < 4; ++i) {
                    m[i] = load<Q>(from + i * channels + k);
                    parts[i] += m[i] * load<Q>(other + i * channels + k);
                }
                transpose(m);
                for (int j = 0; j < 4; ++j) store_four(place, k + j, m[j]);
            }
            transpose(parts);
            sum = (parts[0] + parts[1]) + (parts[2] + parts[3]);
        }
        for (; k < channels; ++k)
            for (int i = 0; i < count; ++i) {
                *four(place + i, k) = from[i * channels + k];
                sum[i] += from[i * channels + k] * other[i * channels + k];
            }
        return sum;
    }
};

// Up to SIZE neighbours in the order of depth, and their weights at the tile's pixels. Sums take them in their order, so the
// result does not depend on the groups.
template <class T>
struct FeatureGroup {
    using V = typename Vector<T>::V;
    static constexpr int SIZE = 4, LANES = Vector<T>::LANES;
    int count = 0;
    int32_t top = TILE, bottom = -1;  // rows that a splat of the group reaches
    const T *own[SIZE];               // features
    Plane<T> weights[SIZE];

    // Adds a splat that reaches the rows [first, last]; returns its weights, all of them 0.
    GSPLAT_METHOD T *take(const T *features, int32_t first, int32_t last) {
        own[count] = features;
        for (int at = 0; at < TILE * TILE; at += LANES) store(weights[count].values + at, V{});  // faster than memset
        top = vmin(top, first), bottom = vmax(bottom, last);
        return weights[count++].values;
    }

    // Fills up with splats without weight.
    GSPLAT_METHOD void fill() {
        while (count < SIZE) take(own[0], TILE, -1);
    }

    GSPLAT_METHOD void clear() { count = 0, top = TILE, bottom = -1; }

    // Composites the group.
    GSPLAT_METHOD void add_to(FeaturePlanes<T> &planes) {
        if (!count) return;
        fill();
        const int32_t channels = planes.channels;
        const T *a = own[0], *b = own[1], *c = own[2], *d = own[3];  // in registers: a store might change `own`
        for (int at = top * TILE; at < (bottom + 1) * TILE; at += LANES) {
            const V wa = load<V>(weights[0].values + at), wb = load<V>(weights[1].values + at);
            const V wc = load<V>(weights[2].values + at), wd = load<V>(weights[3].values + at);
            T *to = planes.at(at);
#pragma GCC unroll 4
            for (int32_t k = 0; k < channels; ++k, to += LANES)
                store(to, (((load<V>(to) + wa * splat(a[k])) + wb * splat(b[k])) + wc * splat(c[k])) + wd * splat(d[k]));
        }
        clear();
    }
};

// The same, backward: the sums of each splat's features times the gradients, by pixel, before its weights are known, and then
// the sums of its weights times the gradients, by channel.
template <class T>
struct FeatureGroupBackward : FeatureGroup<T> {
    using Group = FeatureGroup<T>;
    using V = typename Vector<T>::V;
    using Group::SIZE, Group::LANES, Group::own, Group::weights;
    Plane<T> dots[SIZE];

    GSPLAT_METHOD void multiply(FeaturePlanes<T> &gradients) {
        const int32_t channels = gradients.channels;
        const T *const f[SIZE] = {own[0], own[1], own[2], own[3]};
        for (int at = Group::top * TILE; at < (Group::bottom + 1) * TILE; at += LANES) {
            V even[SIZE] = {}, odd[SIZE] = {};  // two sums of each, because an addition waits for the one before
            const T *from = gradients.at(at);
            int32_t k = 0;
#pragma GCC unroll 2
            for (; k + 1 < channels; k += 2) {
                const V g = load<V>(from + k * LANES), h = load<V>(from + (k + 1) * LANES);
                for (int j = 0; j < SIZE; ++j) even[j] += g * splat(f[j][k]), odd[j] += h * splat(f[j][k + 1]);
            }
            if (k < channels)
                for (int j = 0; j < SIZE; ++j) even[j] += load<V>(from + k * LANES) * splat(f[j][k]);
            for (int j = 0; j < SIZE; ++j) store(dots[j].values + at, even[j] + odd[j]);
        }
    }

    // Writes the sums of all channels of splat j to slots[j].
    GSPLAT_METHOD void write(FeaturePlanes<T> &gradients, T *const *slots, int members) {
        const int32_t channels = gradients.channels;
        for (int32_t k = 0; k < channels; k += 2) {
            const int32_t next = vmin(k + 1, channels - 1);
            V sums[2 * SIZE] = {};
            for (int at = Group::top * TILE; at < (Group::bottom + 1) * TILE; at += LANES) {
                const T *from = gradients.at(at);
                const V g = load<V>(from + k * LANES), h = load<V>(from + next * LANES);
                for (int j = 0; j < SIZE; ++j) {
                    const V w = load<V>(weights[j].values + at);
                    sums[j] += w * g, sums[SIZE + j] += w * h;
                }
            }
            T total[2 * SIZE];
            sum8(sums, total);
            for (int j = 0; j < members; ++j) slots[j][k] = total[j], slots[j][next] = next > k ? total[SIZE + j] : total[j];
        }
        Group::clear();
    }
};

}  // namespace GSPLAT_ISA
}  // namespace gsplat

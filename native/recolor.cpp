// recolor: an image through one matrix of colours, y = A x + b + T s, and back. T is the transmittance, s the shift; see bindings.cpp.
//
// A falloff v scales the light of the object: v (y + o - T (o + c)) - o + T (o + c), with o = 0.055 and the background c. These are the
// premultiplied colours y - T c, with (1 - T) o added and subtracted as `gsplat_edu.ops.exposure` does for opaque ones.
//
// Where the photo is saturated (255), y above 1 counts as 1 and has no gradient: such a pixel says only that the scene is at least
// that bright, not how bright.
#include "isa.h"
#include "simd.h"

namespace gsplat {
namespace GSPLAT_ISA {

// Pixels that are processed together, in one plane per channel.
constexpr int GROUP = 64;

template <class T>
using Planes = T[3][GROUP];

// Planes of the pixels from `first`; what is missing at the end stays zero.
template <class T>
GSPLAT_INLINE void split(const T *pixels, int count, Planes<T> &planes) {
    for (int i = 0; i < count; ++i)
        for (int c = 0; c < 3; ++c) planes[c][i] = pixels[3 * i + c];
}

template <class T>
GSPLAT_INLINE void join(const Planes<T> &planes, int count, T *pixels) {
    for (int i = 0; i < count; ++i)
        for (int c = 0; c < 3; ++c) pixels[3 * i + c] = planes[c][i];
}

template <class T>
GSPLAT_INLINE void transform(const T *m, const Planes<T> &x, Planes<T> &y) {
    for (int c = 0; c < 3; ++c)
        for (int i = 0; i < GROUP; ++i) y[c][i] = m[4 * c] * x[0][i] + m[4 * c + 1] * x[1][i] + m[4 * c + 2] * x[2][i] + m[4 * c + 3];
}

// The corrected colours of the pixels from `first`, before the saturated ones are cut.
template <class T>
GSPLAT_INLINE void correct(const RecolorArgs<T> &args, int64_t first, int count, const Planes<T> &x, Planes<T> &y) {
    transform(args.matrix, x, y);
    for (int c = 0; args.transmittance && c < 3; ++c)
        for (int i = 0; i < count; ++i) y[c][i] += args.shift[c] * args.transmittance[first + i];
    for (int i = 0; args.falloff && i < count; ++i)
        for (int c = 0; c < 3; ++c) {
            const T through = args.transmittance ? args.transmittance[first + i] * (T(SRGB_OFFSET) + args.background[c]) : T(0);
            y[c][i] += (args.falloff[first + i] - 1) * (y[c][i] + T(SRGB_OFFSET) - through);
        }
}

template <class T>
void recolor(const RecolorArgs<T> &args, int64_t task) {
    const int64_t end = vmin(args.pixels, (task + 1) * RECOLOR_PIXELS);
    Planes<T> x = {}, y;
    for (int64_t first = task * RECOLOR_PIXELS; first < end; first += GROUP) {
        const int count = int(vmin<int64_t>(GROUP, end - first));
        split(args.image + 3 * first, count, x);
        correct(args, first, count, x, y);
        T *out = args.out + 3 * first;
        join(y, count, out);
        if (!args.photo) continue;
        const uint8_t *photo = args.photo + 3 * first;
        for (int i = 0; i < 3 * count; ++i) out[i] = photo[i] == 255 && out[i] > 1 ? T(1) : out[i];
    }
}

template <class T>
void recolor_backward(const RecolorArgs<T> &args, int64_t task) {
    using V = typename Vector<T>::V;
    constexpr int LANES = Vector<T>::LANES;
    const int64_t end = vmin(args.pixels, (task + 1) * RECOLOR_PIXELS);
    const T *m = args.matrix;
    Planes<T> x = {}, y, g = {};
    T through[GROUP] = {};
    V sums[RECOLOR_SUMS] = {};
    for (int64_t first = task * RECOLOR_PIXELS; first < end; first += GROUP) {
        const int count = int(vmin<int64_t>(GROUP, end - first));
        if (count < GROUP) memset(x, 0, sizeof(x)), memset(g, 0, sizeof(g)), memset(through, 0, sizeof(through));
        split(args.image + 3 * first, count, x);
        split(args.grad + 3 * first, count, g);
        if (args.photo) {
            const uint8_t *photo = args.photo + 3 * first;
            correct(args, first, count, x, y);
            for (int i = 0; i < count; ++i)
                for (int c = 0; c < 3; ++c) g[c][i] = photo[3 * i + c] == 255 && y[c][i] > 1 ? 0 : g[c][i];
        }
        T *grad_through = args.grad_transmittance ? args.grad_transmittance + first : nullptr;
        if (grad_through) {
            memcpy(through, args.transmittance + first, size_t(count) * sizeof(T));
            memset(grad_through, 0, size_t(count) * sizeof(T));
        }
        for (int c = 0; args.falloff && c < 3; ++c) {
            const T *falloff = args.falloff + first, of_transmittance = T(SRGB_OFFSET) + args.background[c];
            for (int i = 0; grad_through && i < count; ++i) grad_through[i] += g[c][i] * (1 - falloff[i]) * of_transmittance;
            for (int i = 0; i < count; ++i) g[c][i] *= falloff[i];
        }
        for (int i = 0; grad_through && i < count; ++i)
            grad_through[i] += args.shift[0] * g[0][i] + args.shift[1] * g[1][i] + args.shift[2] * g[2][i];
        for (int i = 0; args.sums && i < GROUP; i += LANES)
            for (int c = 0; c < 3; ++c) {
                const V of_channel = load<V>(&g[c][i]);
                for (int k = 0; k < 3; ++k) sums[4 * c + k] += of_channel * load<V>(&x[k][i]);
                sums[4 * c + 3] += of_channel;
                sums[RECOLOR_NUMBERS + c] += of_channel * load<V>(&through[i]);
            }
        for (int k = 0; k < 3; ++k)
            for (int i = 0; i < GROUP; ++i) y[k][i] = m[k] * g[0][i] + m[4 + k] * g[1][i] + m[8 + k] * g[2][i];
        join(y, count, args.out + 3 * first);
    }
    for (int k = 0; args.sums && k < RECOLOR_SUMS; ++k) args.sums[task * RECOLOR_SUMS + k] = double(sum(sums[k]));
}

template void recolor<float>(const RecolorArgs<float> &, int64_t);
template void recolor<double>(const RecolorArgs<double> &, int64_t);
template void recolor_backward<float>(const RecolorArgs<float> &, int64_t);
template void recolor_backward<double>(const RecolorArgs<double> &, int64_t);

}  // namespace GSPLAT_ISA
}  // namespace gsplat

// screen: centres, depths and covariances on the screen, and colours of harmonics, for rasterisers whose graph passes through them
// (src/gsplat_edu/compat). `project` computes the same on its way to records; here each step has its own gradient.
//
//     p = R m + t,   u = f p_k / z + c,   rows of J R: q = f / z (R_k - x R_2) with the clamped ratio x
//     sides q Rot s,   a, b, c their products,   det0 = |sides' cross product|²,   det = det0 + eps (a + c) + eps²
//
// R and t are those of any 3 x 4 matrix. Back, from da, db, dc, ddet0 to sides, to the rows q, to p, R, t, f and c. Lanes are Gaussians.
#include "gaussian_math.h"
#include "isa.h"

namespace gsplat {
namespace GSPLAT_ISA {

// WIDE Gaussians in a row, from `first` on; lanes beyond the last one repeat it.
struct Lanes {
    int64_t first, n;
    int count;
    GSPLAT_METHOD Lanes(int64_t at, int64_t end) : first(at), n(end), count(int(vmin(int64_t(WIDE), end - at))) {}
    template <class T>
    GSPLAT_METHOD VD read(const T *from, int width, int k) const {
        VD v;
        for (int l = 0; l < WIDE; ++l) v[l] = double(from[int64_t(width) * vmin(first + l, n - 1) + k]);
        return v;
    }
    template <class T>
    GSPLAT_METHOD void write(T *to, int width, int k, VD v) const {
        for (int l = 0; l < count; ++l) to[int64_t(width) * (first + l) + k] = T(v[l]);
    }
    template <class T>
    GSPLAT_METHOD void add(T *to, int width, int k, VD v) const {
        for (int l = 0; l < count; ++l) to[int64_t(width) * (first + l) + k] += T(v[l]);
    }
};

// Intermediate values of WIDE Gaussians.
struct OnScreen {
    VD mean[3], p[3], iz, ratio[2], clamped[2];
    MD before, held[2];                            // between near and far; whether each ratio was clamped
    VD row[2][3];                                  // of J R
    VD q[4], q_scale, inverse_q2, Rot[9], s[3];    // of raw parameters
    VD S[6];                                       // covariances given directly
    VD turned[2][3], cross[3], side[2][3];         // side: turned times s, or S row
    VD a, b, c, det0, det, floor;                  // floor: det, or 1 where a splat is too thin
    MD thick;
};

template <class T>
GSPLAT_INLINE void see(const ScreenArgs<T> &args, const Lanes &lanes, OnScreen &g) {
    const double *M = args.viewmat;
    for (int k = 0; k < 3; ++k) g.mean[k] = lanes.read(args.means, 3, k);
    for (int k = 0; k < 3; ++k)
        g.p[k] = splat(M[4 * k]) * g.mean[0] + splat(M[4 * k + 1]) * g.mean[1] + splat(M[4 * k + 2]) * g.mean[2] + splat(M[4 * k + 3]);
    g.before = (g.p[2] >= splat(args.z_near)) & (g.p[2] <= splat(args.z_far));
    g.iz = splat(1.0) / (g.before ? g.p[2] : splat(1.0));
    for (int k = 0; k < 2; ++k) {
        const double f = args.K[k], c = args.K[2 + k], size = args.size[k];
        const VD low = splat((-args.margin * size - c) / f), high = splat(((1 + args.margin) * size - c) / f);
        g.ratio[k] = g.p[k] * g.iz;
        g.held[k] = (g.ratio[k] < low) | (g.ratio[k] > high);
        g.clamped[k] = vmin(vmax(g.ratio[k], low), high);
        for (int j = 0; j < 3; ++j) g.row[k][j] = splat(f) * g.iz * (splat(M[4 * k + j]) - g.clamped[k] * splat(M[8 + j]));
    }
}

template <class T>
GSPLAT_INLINE void shape(const ScreenArgs<T> &args, const Lanes &lanes, OnScreen &g) {
    if (args.covars) {
        static constexpr int AT[9] = {0, 1, 2, 1, 3, 4, 2, 4, 5};
        for (int k = 0; k < 6; ++k) g.S[k] = lanes.read(args.covars, 6, k);
        for (int k = 0; k < 2; ++k)
            for (int j = 0; j < 3; ++j)
                g.side[k][j] = g.S[AT[j]] * g.row[k][0] + g.S[AT[3 + j]] * g.row[k][1] + g.S[AT[6 + j]] * g.row[k][2];
        g.a = dot3(g.row[0], g.side[0]), g.b = dot3(g.row[0], g.side[1]), g.c = dot3(g.row[1], g.side[1]);
        g.det0 = g.a * g.c - g.b * g.b;
    } else {
        VD largest = VD{}, normal[3];
        for (int k = 0; k < 4; ++k) g.q[k] = lanes.read(args.quats, 4, k), largest = vmax(largest, abs_(g.q[k]));
        g.q_scale = splat(1.0) / largest;  // squares of double may overflow
        for (int k = 0; k < 4; ++k) g.q[k] *= g.q_scale;
        g.inverse_q2 = splat(1.0) / (g.q[0] * g.q[0] + g.q[1] * g.q[1] + g.q[2] * g.q[2] + g.q[3] * g.q[3]);
        rotation(g.q, g.inverse_q2, g.Rot);
        for (int k = 0; k < 3; ++k) g.s[k] = lanes.read(args.scales, 3, k);
        for (int k = 0; k < 2; ++k)
            for (int j = 0; j < 3; ++j) {
                g.turned[k][j] = g.row[k][0] * g.Rot[j] + g.row[k][1] * g.Rot[3 + j] + g.row[k][2] * g.Rot[6 + j];
                g.side[k][j] = g.turned[k][j] * g.s[j];
            }
        cross3(g.turned[0], g.turned[1], g.cross);
        for (int k = 0; k < 3; ++k) normal[k] = g.cross[k] * g.s[(k + 1) % 3] * g.s[(k + 2) % 3];
        g.a = dot3(g.side[0], g.side[0]), g.b = dot3(g.side[0], g.side[1]), g.c = dot3(g.side[1], g.side[1]);
        g.det0 = dot3(normal, normal);  // a c - b² would cancel for a thin Gaussian
    }
    const VD eps = splat(args.eps2d);
    g.det = g.det0 + eps * (g.a + g.c) + eps * eps;
    g.thick = g.det > splat(THINNEST) * (g.a + g.c + eps + eps);
    g.floor = g.thick ? g.det : splat(1.0);
}

template <class T>
void screen(const ScreenArgs<T> &args, int64_t block) {
    const int64_t end = vmin(args.n, (block + 1) * BLOCK);
    for (int64_t first = block * BLOCK; first < end; first += WIDE) {
        const Lanes lanes(first, end);
        OnScreen g;
        see(args, lanes, g);
        shape(args, lanes, g);
        const VD inverse = splat(1.0) / g.floor, eps = splat(args.eps2d);
        for (int k = 0; k < 2; ++k) lanes.write(args.centres, 2, k, splat(args.K[k]) * g.ratio[k] + splat(args.K[2 + k]));
        lanes.write(args.depths, 1, 0, g.p[2]);
        lanes.write(args.conics, 3, 0, (g.c + eps) * inverse);
        lanes.write(args.conics, 3, 1, -g.b * inverse);
        lanes.write(args.conics, 3, 2, (g.a + eps) * inverse);
        lanes.write(args.compensations, 1, 0, sqrt_(vmax(g.det0, splat(DET_FLOOR)) * inverse));
        lanes.write(args.spreads, 3, 0, g.a), lanes.write(args.spreads, 3, 1, g.b), lanes.write(args.spreads, 3, 2, g.c);
        const MD drawable = g.before & g.thick;
        for (int l = 0; l < lanes.count; ++l) args.drawable[first + l] = drawable[l] != 0;
    }
}

// Gradients of the covariance's a, b (once for both entries) and c, of det0, and of the centre and the depth.
struct ScreenGradient {
    VD a, b, c, det0, centre[2], depth;
    MD any;  // whether something arrives; the values of what is not drawn may be infinite
};

template <class T>
GSPLAT_INLINE void arriving(const ScreenArgs<T> &args, const Lanes &lanes, const OnScreen &g, ScreenGradient &d) {
    const VD inverse = splat(1.0) / g.floor, eps = splat(args.eps2d);
    VD to_floor = VD{};
    d.a = d.b = d.c = d.det0 = d.centre[0] = d.centre[1] = d.depth = VD{};
    if (args.grad_centres)
        for (int k = 0; k < 2; ++k) d.centre[k] = lanes.read(args.grad_centres, 2, k);
    if (args.grad_depths) d.depth = lanes.read(args.grad_depths, 1, 0);
    d.any = (d.centre[0] != VD{}) | (d.centre[1] != VD{}) | (d.depth != VD{});
    if (args.grad_spreads) {
        d.a = lanes.read(args.grad_spreads, 3, 0), d.b = lanes.read(args.grad_spreads, 3, 1), d.c = lanes.read(args.grad_spreads, 3, 2);
        d.any |= (d.a != VD{}) | (d.b != VD{}) | (d.c != VD{});
    }
    if (args.grad_conics) {
        VD of[3];
        for (int k = 0; k < 3; ++k) of[k] = lanes.read(args.grad_conics, 3, k), d.any |= of[k] != VD{};
        d.c += of[0] * inverse, d.b -= of[1] * inverse, d.a += of[2] * inverse;
        to_floor -= (of[0] * (g.c + eps) - of[1] * g.b + of[2] * (g.a + eps)) * inverse * inverse;
    }
    if (args.grad_compensations) {
        const VD of = lanes.read(args.grad_compensations, 1, 0), above = vmax(g.det0, splat(DET_FLOOR));
        const VD half = splat(0.5) * of * sqrt_(above * inverse);
        d.any |= of != VD{};
        d.det0 += g.det0 > splat(DET_FLOOR) ? half / above : VD{};
        to_floor -= half * inverse;
    }
    to_floor = g.thick ? to_floor : VD{};
    d.det0 += to_floor, d.a += eps * to_floor, d.c += eps * to_floor;
}

// Propagates to covariances, or to quaternions and scales, and to the rows of J R.
template <class T>
GSPLAT_INLINE void shape_back(const ScreenArgs<T> &args, const Lanes &lanes, const OnScreen &g, const ScreenGradient &d, VD (*row)[3]) {
    const VD two = splat(2.0);
    const auto counted = [&](VD v) { return d.any ? v : VD{}; };
    if (args.covars) {
        const VD a = d.a + d.det0 * g.c, b = d.b - two * d.det0 * g.b, c = d.c + d.det0 * g.a;
        for (int i = 0, k = 0; i < 3; ++i) {
            row[0][i] = two * a * g.side[0][i] + b * g.side[1][i], row[1][i] = two * c * g.side[1][i] + b * g.side[0][i];
            for (int j = i; j < 3; ++j, ++k) {
                const VD mixed = g.row[0][i] * g.row[1][j] + g.row[0][j] * g.row[1][i];
                VD of = two * a * g.row[0][i] * g.row[0][j] + b * mixed + two * c * g.row[1][i] * g.row[1][j];
                if (i == j) of *= splat(0.5);  // an entry off the diagonal stands for two
                lanes.add(args.grad_covars, 6, k, counted(of));
            }
        }
        return;
    }
    VD turned[2][3], to_cross[3], part[3], dRot[9], dq[4];
    for (int k = 0; k < 3; ++k) {
        const VD area = g.s[(k + 1) % 3] * g.s[(k + 2) % 3];
        to_cross[k] = two * d.det0 * g.cross[k] * area * area;
    }
    cross3(g.turned[1], to_cross, turned[0]), cross3(to_cross, g.turned[0], turned[1]);
    for (int k = 0; k < 3; ++k) {
        const VD side0 = two * d.a * g.side[0][k] + d.b * g.side[1][k], side1 = two * d.c * g.side[1][k] + d.b * g.side[0][k];
        turned[0][k] += side0 * g.s[k], turned[1][k] += side1 * g.s[k];
        const int i = (k + 1) % 3, j = (k + 2) % 3;  // det0 has s_k in its terms i and j
        const VD others = g.cross[i] * g.cross[i] * g.s[j] * g.s[j] + g.cross[j] * g.cross[j] * g.s[i] * g.s[i];
        part[k] = side0 * g.turned[0][k] + side1 * g.turned[1][k] + two * d.det0 * g.s[k] * others;
        lanes.add(args.grad_scales, 3, k, counted(part[k]));
    }
    for (int i = 0; i < 3; ++i) {
        for (int k = 0; k < 2; ++k) row[k][i] = dot3(g.Rot + 3 * i, turned[k]);
        for (int j = 0; j < 3; ++j) dRot[3 * i + j] = g.row[0][i] * turned[0][j] + g.row[1][i] * turned[1][j];
    }
    rotation_backward(g.q, g.inverse_q2, dRot, dq);
    for (int k = 0; k < 4; ++k) lanes.add(args.grad_quats, 4, k, counted(dq[k] * g.q_scale));
}

// Propagates to the means and, into `sums`, to the matrix (12) and to fx, fy, cx, cy.
template <class T>
GSPLAT_INLINE void see_back(const ScreenArgs<T> &args, const Lanes &lanes, const OnScreen &g, const ScreenGradient &d, const VD (*row)[3],
                            VD *sums) {
    const double *M = args.viewmat;
    VD own[SCREEN_CAMERA] = {}, p[3] = {};
    for (int k = 0; k < 2; ++k) {
        const VD scale = splat(args.K[k]) * g.iz, along = dot3(row[k], g.row[k]);
        const double R2[3] = {M[8], M[9], M[10]};
        VD ahead = VD{};
        for (int j = 0; j < 3; ++j) {
            own[4 * k + j] += scale * row[k][j], own[8 + j] -= scale * g.clamped[k] * row[k][j];
            ahead += splat(R2[j]) * row[k][j];
        }
        const VD clamped = -scale * ahead, bound = g.held[k] ? clamped : VD{};
        const VD ratio = splat(args.K[k]) * d.centre[k] + (g.held[k] ? VD{} : clamped);
        own[12 + k] = (along - bound * g.clamped[k]) * splat(1 / args.K[k]) + g.ratio[k] * d.centre[k];
        own[14 + k] = d.centre[k] - bound * splat(1 / args.K[k]);
        p[k] = ratio * g.iz;
        p[2] -= g.before ? g.iz * (along + g.ratio[k] * ratio) : VD{};
    }
    p[2] += d.depth;
    for (int k = 0; k < 3; ++k) {
        for (int j = 0; j < 3; ++j) own[4 * k + j] += p[k] * g.mean[j];
        own[4 * k + 3] = p[k];
    }
    for (int j = 0; j < 3; ++j) {
        const VD mean = splat(M[j]) * p[0] + splat(M[4 + j]) * p[1] + splat(M[8 + j]) * p[2];
        lanes.add(args.grad_means, 3, j, d.any ? mean : VD{});
    }
    const MD counts = d.any & (iota<double>() < splat(double(lanes.count)));
    for (int k = 0; k < SCREEN_CAMERA; ++k) sums[k] += counts ? own[k] : VD{};
}

template <class T>
void screen_backward(const ScreenArgs<T> &args, int64_t block) {
    const int64_t end = vmin(args.n, (block + 1) * BLOCK);
    VD sums[SCREEN_CAMERA] = {};
    for (int64_t first = block * BLOCK; first < end; first += WIDE) {
        const Lanes lanes(first, end);
        OnScreen g;
        ScreenGradient d;
        VD row[2][3];
        see(args, lanes, g);
        shape(args, lanes, g);
        arriving(args, lanes, g, d);
        shape_back(args, lanes, g, d, row);
        see_back(args, lanes, g, d, row, sums);
    }
    for (int k = 0; k < SCREEN_CAMERA; ++k) args.camera_sums[SCREEN_CAMERA * block + k] = sum(sums[k]);
}

template <class T>
void radii(const RadiusArgs<T> &args, int64_t begin, int64_t end) {
    constexpr double MOST = 2147483520;  // exact in float
    for (int64_t i = begin; i < end; ++i) {
        bool drawn = args.drawable[i];
        double extent = args.extent, half[2];
        if (args.opacities && drawn) {
            const double bright = double(args.opacities[i]) * (args.compensations ? args.compensations[i] : 1.0);
            drawn = bright >= ALPHA_MIN;
            extent = vmin(extent, sqrt(2 * log(vmax(bright, ALPHA_MIN) / ALPHA_MIN)));
        }
        bool meets = true, large = false;
        for (int k = 0; k < 2; ++k) {
            const double at = args.centres[2 * i + k];
            half[k] = ceil(extent * sqrt(vmax(args.spreads[3 * i + 2 * k] + args.eps2d, 0.0)));
            meets &= at + half[k] > 0 && at - half[k] < args.size[k];
            large |= half[k] > args.radius_clip;
        }
        for (int k = 0; k < 2; ++k) args.radii[2 * i + k] = drawn && meets && large ? int32_t(vmin(half[k], MOST)) : 0;
    }
}

// Directions and basis of up to CHUNK directions with the given indices.
template <class T>
struct Directions {
    alignas(64) T dir[3][CHUNK], inverse[CHUNK], basis[16][CHUNK];
    GSPLAT_METHOD Directions(const HarmonicArgs<T> &args, const int64_t *indices, int count) {
        using V = typename Vector<T>::V;
        constexpr int LANES = Vector<T>::LANES;
        const int padded = (count + LANES - 1) / LANES * LANES;
        for (int l = 0; l < padded; ++l)
            for (int k = 0; k < 3; ++k) dir[k][l] = args.directions[3 * indices[l < count ? l : 0] + k];
        for (int l = 0; l < padded; l += LANES) {
            V d[3], b[16];
            for (int k = 0; k < 3; ++k) d[k] = load<V>(dir[k] + l);
            const V squared = dot3(d, d), one = splat(T(1)) / sqrt_(squared), i = squared > V{} ? one : V{};
            for (int k = 0; k < 3; ++k) d[k] *= i, store(dir[k] + l, d[k]);
            store(inverse + l, i);
            harmonics<T>(args.degree, d[0], d[1], d[2], b);
            for (int j = 0; j < args.used(); ++j) store(basis[j] + l, b[j]);
        }
    }
};

// Calls f(indices, count) for the drawn rows of a block, CHUNK at a time.
template <class T, class F>
GSPLAT_INLINE void for_each_chunk(const HarmonicArgs<T> &args, int64_t block, F f) {
    int64_t indices[CHUNK];
    int count = 0;
    for (int64_t row = block * BLOCK; row < vmin(args.rows, (block + 1) * BLOCK); ++row) {
        if (args.index_of[row] >= 0) indices[count++] = args.index_of[row];
        if (count == CHUNK) f(indices, count), count = 0;
    }
    if (count) f(indices, count);
}

template <int DEGREE, class T>
GSPLAT_INLINE void chunk_colors(const HarmonicArgs<T> &args, const int64_t *indices, int count) {
    using V = typename Channels<T>::V;
    constexpr int LAST = (DEGREE + 1) * (DEGREE + 1) - 1;
    const Directions<T> at(args, indices, count);
    for (int l = 0; l < count; ++l) {
        const T *sh = args.coefficients + 3 * args.stored * args.row_of[indices[l]];
        V color = V{};
#pragma GCC unroll 16
        for (int j = 0; j < LAST; ++j) color += load<V>(sh + 3 * j) * at.basis[j][l];
        color += channels(sh + 3 * LAST) * at.basis[LAST][l];  // a load of four could leave the array
        for (int k = 0; k < 3; ++k) args.colors[3 * indices[l] + k] = color[k];
    }
}

template <class T>
void harmonic_colors(const HarmonicArgs<T> &args, int64_t block) {
    with_degree(args.degree, [&]<int DEGREE>() {
        for_each_chunk(args, block, [&](const int64_t *indices, int count) { chunk_colors<DEGREE>(args, indices, count); });
    });
}

// Adds the products basis[j] color[k] in lane l to a row of coefficients, or replaces the row by them.
template <int DEGREE, class T>
GSPLAT_INLINE void to_coefficients(const HarmonicArgs<T> &args, const Directions<T> &at, int l, const T *color, T *row) {
    using V = typename Channels<T>::V;
    constexpr int LAST = (DEGREE + 1) * (DEGREE + 1) - 1;
    const V all = channels(color);
#pragma GCC unroll 16
    for (int j = 0; j < LAST; ++j) {  // the fourth number is the next one's first
        const V product = all * at.basis[j][l];
        store(row + 3 * j, args.overwrites ? product : load<V>(row + 3 * j) + product);
    }
    for (int k = 0; k < 3; ++k) row[3 * LAST + k] = at.basis[LAST][l] * color[k] + (args.overwrites ? T(0) : row[3 * LAST + k]);
    if (args.overwrites) memset(row + 3 * (LAST + 1), 0, 3 * size_t(args.stored - LAST - 1) * sizeof(T));
}

// Propagates the colours' gradients of a chunk to the coefficients and directions.
template <int DEGREE, class T>
GSPLAT_INLINE void chunk_backward(const HarmonicArgs<T> &args, const int64_t *indices, int count) {
    using V = typename Vector<T>::V;
    constexpr int USED = (DEGREE + 1) * (DEGREE + 1);
    const Directions<T> at(args, indices, count);
    alignas(64) T along_basis[16][CHUNK] = {}, to_direction[3][CHUNK];
    for (int l = 0; l < count; ++l) {
        const int64_t offset = 3 * args.stored * args.row_of[indices[l]];
        const T *sh = args.coefficients + offset, *of = args.grad_colors + 3 * indices[l];
#pragma GCC unroll 16
        for (int j = 0; j < USED; ++j) along_basis[j][l] = dot3(sh + 3 * j, of);
        to_coefficients<DEGREE>(args, at, l, of, args.grad_coefficients + offset);
    }
    for (int l = 0; l < count; l += Vector<T>::LANES) {
        V b[16], d[3], dir[3];
        for (int j = 0; j < USED; ++j) b[j] = load<V>(along_basis[j] + l);
        for (int k = 0; k < 3; ++k) dir[k] = load<V>(at.dir[k] + l);
        harmonics_backward<T>(DEGREE, dir[0], dir[1], dir[2], b, d);
        const V along = dot3(d, dir), inverse = load<V>(at.inverse + l);
        for (int k = 0; k < 3; ++k) store(to_direction[k] + l, (d[k] - along * dir[k]) * inverse);
    }
    for (int l = 0; l < count; ++l)
        for (int k = 0; k < 3; ++k) args.grad_directions[3 * indices[l] + k] = to_direction[k][l];
}

template <class T>
void harmonic_colors_backward(const HarmonicArgs<T> &args, int64_t block) {
    const int64_t width = 3 * args.stored, end = vmin(args.rows, (block + 1) * BLOCK);
    if (args.overwrites)
        for (int64_t row = block * BLOCK; row < end; ++row)
            if (args.index_of[row] < 0) memset(args.grad_coefficients + width * row, 0, size_t(width) * sizeof(T));
    with_degree(args.degree, [&]<int DEGREE>() {
        for_each_chunk(args, block, [&](const int64_t *indices, int count) { chunk_backward<DEGREE>(args, indices, count); });
    });
}

template void screen<float>(const ScreenArgs<float> &, int64_t);
template void screen<double>(const ScreenArgs<double> &, int64_t);
template void screen_backward<float>(const ScreenArgs<float> &, int64_t);
template void screen_backward<double>(const ScreenArgs<double> &, int64_t);
template void radii<float>(const RadiusArgs<float> &, int64_t, int64_t);
template void radii<double>(const RadiusArgs<double> &, int64_t, int64_t);
template void harmonic_colors<float>(const HarmonicArgs<float> &, int64_t);
template void harmonic_colors<double>(const HarmonicArgs<double> &, int64_t);
template void harmonic_colors_backward<float>(const HarmonicArgs<float> &, int64_t);
template void harmonic_colors_backward<double>(const HarmonicArgs<double> &, int64_t);

}  // namespace GSPLAT_ISA
}  // namespace gsplat

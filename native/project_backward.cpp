// project_backward: sum each Gaussian's slots in a fixed order and propagate the gradient to its raw parameters.
//
//     moments of h -> J W M -> (J W, quaternion, log scale) -> mean;   colour -> (coefficients, direction -> mean)
//     all of them -> camera, if it is wanted
//
// Lanes are Gaussians. `differentiate` finds the gradients of a chunk, `write` stores those of one Gaussian.
#include "gaussian_math.h"
#include "isa.h"

namespace gsplat {
namespace GSPLAT_ISA {

constexpr uint32_t MOST_FETCHED = 32;  // slots of a Gaussian, in advance

// Gradients of a chunk, an array for each number. Those of the harmonics' coefficients are products, basis[j] color[k].
template <class T>
struct Gradients {
    alignas(64) T mean[3][CHUNK], quat[4][CHUNK], log_scale[3][CHUNK], opacity[CHUNK];  // opacity: raw or direct
    double cov3d[9][CHUNK];
    T color[3][CHUNK], means2d_norm[CHUNK];
    Shade<T> shades;
    T drawn[CHUNK];  // 0 where all gradients are 0
};

// Sigma2d^-1 = L' L, y = L d of a pixel d px from the mean: y0 = sx dx + sy dy, y1 = ty dy. The moments of h are taken
// in y, where they are of order 1; in d they grow with the ellipse and cancel.
struct Whitened {
    VD sx, sy, ty;
    VD m0, m1;         // sum h y0, sum h y1
    VD m00, m01, m11;  // sum h y0², sum h y0 y1, sum h y1²; minus sum h on the diagonal with antialiasing or motion blur
};

// What the opacity's factor passes on besides det^(-1/2) of the drawn ellipse: sum h by the determinant whose root it has, and what
// that determinant's matrix has on the diagonal beside Sigma2d. Antialiasing has det0; motion blur without it, the dilated one.
struct Lit {
    VD h, dilation;
};

GSPLAT_INLINE Lit lit_by(const Camera &cam, const Settings &set, const Projected &g, VD h) {
    if (set.antialiased) return {g.det0 > splat(DET_FLOOR) ? h / g.det0 : VD{}, VD{}};
    if (cam.spread != 0) return {h * g.inverse_still, splat(set.dilation)};
    return {VD{}, VD{}};
}

// Computed from the moments of h about the splat's reference point.
template <class T>
GSPLAT_INLINE Whitened whiten(const Camera &cam, const Settings &set, const Projected &g, const VD *slot) {
    Whitened w;
    w.sx = sqrt_(g.c * g.inverse_det), w.sy = -g.b * g.inverse_c * w.sx, w.ty = sqrt_(g.inverse_c);
    const Position at = position<T>(g, cam);
    const VD dx = at.x - at.u, dy = at.y - at.v;
    const VD s = w.sx * dx + w.sy * dy, t = w.ty * dy;  // y of the reference point
    const VD along = w.sx * slot[HX] + w.sy * slot[HY], down = w.ty * slot[HY];
    w.m0 = s * slot[H] + along, w.m1 = t * slot[H] + down;
    w.m00 = s * (s * slot[H] + along + along) + w.sx * (w.sx * slot[HXX] + (w.sy + w.sy) * slot[HXY]) + w.sy * w.sy * slot[HYY];
    w.m01 = s * (t * slot[H] + down) + t * along + w.ty * (w.sx * slot[HXY] + w.sy * slot[HYY]);
    w.m11 = t * (t * slot[H] + down + down) + w.ty * w.ty * slot[HYY];
    if (set.antialiased || cam.spread != 0) w.m00 -= slot[H], w.m11 -= slot[H];  // the opacity's factor contains det^(-1/2)
    return w;
}

// Propagates gradients d of J W (two rows t; `total` is the sum of d . t) and of the image position to the mean in camera
// axes.
GSPLAT_INLINE void mean_gradient(const Projected &g, const Camera &cam, const VD *d0, const VD *d1, VD total, const VD *uv, VD *dp) {
    const VD iz = g.iz, x = g.p[0] * iz, y = g.p[1] * iz;  // x/z, y/z
    VD w0 = VD{}, w1 = VD{};                               // d . (row 2 of W)
    for (int k = 0; k < 3; ++k) w0 += d0[k] * splat(cam.R[6 + k]), w1 += d1[k] * splat(cam.R[6 + k]);
    // J W = f/z (W_row - x/z W_2): d/dx gives -f/z² W_2; d/dz gives -(J W)/z + f x/z³ W_2. A clamped x/z is a constant.
    w0 = g.clamped[0] ? VD{} : w0;
    w1 = g.clamped[1] ? VD{} : w1;
    const VD fx = splat(cam.fx) * iz, fy = splat(cam.fy) * iz;
    dp[0] = fx * uv[0] - fx * iz * w0;
    dp[1] = fy * uv[1] - fy * iz * w1;
    dp[2] = iz * (fx * x * w0 + fy * y * w1 - total) - x * fx * uv[0] - y * fy * uv[1];
}

// Propagates the moments to M = R S and J W, for raw parameters; returns d0 . t0 + d1 . t1. With r = (J W) M (two rows), w = L r and
// N the matrix of moments: dL/dSigma2d = L' N L / 2, dL/dr = L' N w; w is of order 1, however long the ellipse. `lit` is
// the opacity's part: its factor contains det0^(1/2), so dL/dr = sum h Sigma^-1 r, Sigma before the dilation or, with motion blur, after.
// `db` gets the gradient of the blur, a fourth column of r, if there is one.
template <class T>
GSPLAT_INLINE VD raw_gradient(const Projected &g, const Whitened &m, VD dilation, const Lit &lit, bool blurs, int l, Gradients<T> &out,
                              VD *d0, VD *d1, VD *db) {
    VD across0[3], across1[3], dR[9], dr0[3], dr1[3], dq[4], total = VD{};
    cross3(g.r1, g.n, across0), cross3(g.n, g.r0, across1);  // c0 r0 - b0 r1 and a0 r1 - b0 r0
    const VD sx_c = m.sx * g.inverse_c;
    for (int k = 0; k < 3; ++k) {
        // sx r0 + sy r1 = sx (r0 - b/c r1)
        VD w0 = sx_c * (dilation * g.r0[k] + across0[k]);
        const VD w1 = m.ty * g.r1[k];
        if (blurs) w0 -= sx_c * g.blur[1] * g.along[k];
        const VD dw0 = m.m00 * w0 + m.m01 * w1, dw1 = m.m01 * w0 + m.m11 * w1;
        VD extra0 = lit.h * across0[k], extra1 = lit.h * across1[k];
        if (blurs) extra0 += lit.h * lit.dilation * g.r0[k], extra1 += lit.h * lit.dilation * g.r1[k];
        dr0[k] = m.sx * dw0 + extra0, dr1[k] = m.sy * dw0 + m.ty * dw1 + extra1;
        const VD scale = w0 * dw0 + w1 * dw1 + g.r0[k] * extra0 + g.r1[k] * extra1;  // r0 . dr0 + r1 . dr1
        narrowed(out.log_scale[k] + l, scale);
        total += scale;
        dr0[k] *= g.s[k], dr1[k] *= g.s[k];
    }
    if (blurs) {  // w of the fourth column: sx (g0 - b/c g1) and ty g1
        const VD w0 = sx_c * (dilation * g.blur[0] + dot3(g.r1, g.along)), w1 = m.ty * g.blur[1];
        const VD dw0 = m.m00 * w0 + m.m01 * w1, dw1 = m.m01 * w0 + m.m11 * w1;
        db[0] = m.sx * dw0, db[1] = m.sy * dw0 + m.ty * dw1;
    }
    for (int k = 0; k < 3; ++k) {
        d0[k] = dot3(g.R + 3 * k, dr0), d1[k] = dot3(g.R + 3 * k, dr1);
        for (int j = 0; j < 3; ++j) dR[3 * k + j] = g.t0[k] * dr0[j] + g.t1[k] * dr1[j];
    }
    rotation_backward(g.q, g.inverse_q2, dR, dq);
    for (int k = 0; k < 4; ++k) narrowed(out.quat[k] + l, dq[k] * g.q_scale);
    return total;
}

// The same for covariances given directly: a = t0' S t0, b = t0' S t1, c = t1' S t1.
template <class T>
GSPLAT_INLINE VD direct_gradient(const Projected &g, const Whitened &m, const Lit &lit, bool blurs, int l, Gradients<T> &out, VD *d0,
                                 VD *d1, VD *db) {
    const VD half = splat(0.5);
    // Gradients of a, b (once for both entries) and c: L' N L / 2.
    VD a = half * m.sx * m.sx * m.m00, b = m.sx * (m.sy * m.m00 + m.ty * m.m01);
    VD c = half * (m.sy * (m.sy * m.m00 + (m.ty + m.ty) * m.m01) + m.ty * m.ty * m.m11);
    if (blurs) {
        db[0] = (a + a) * g.blur[0] + b * g.blur[1];
        db[1] = (c + c) * g.blur[1] + b * g.blur[0];
        a += half * lit.h * lit.dilation, c += half * lit.h * lit.dilation;
    }
    a += half * lit.h * g.c0, b -= lit.h * g.b0, c += half * lit.h * g.a0;
    VD total = VD{};
    for (int k = 0; k < 3; ++k) {
        d0[k] = (a + a) * g.r0[k] + b * g.r1[k];
        d1[k] = (c + c) * g.r1[k] + b * g.r0[k];
        total += d0[k] * g.t0[k] + d1[k] * g.t1[k];
        for (int j = 0; j < 3; ++j)
            store(out.cov3d[3 * k + j] + l,
                  a * g.t0[k] * g.t0[j] + c * g.t1[k] * g.t1[j] + half * b * (g.t0[k] * g.t1[j] + g.t1[k] * g.t0[j]));
    }
    return total;
}

// Adds up the slots of each Gaussian, in their order; a slot is 4 + 4 + 2 numbers.
template <class T>
GSPLAT_INLINE void sum_slots(const ProjectBackwardArgs<T> &args, const uint32_t *ids, int count, int padded, T (*sums)[CHUNK]) {
    using V = typename Channels<T>::V;
    static_assert(SLOT == 10);
    for (int l = 0; l < padded; ++l) {
        const uint32_t i = ids[l < count ? l : 0];
        const T *in = args.slots + int64_t(SLOT) * args.slot_begin[i];
        V low = V{}, high = V{};
        T last[2] = {};
        for (uint32_t k = args.pairs_of[i]; k; --k, in += SLOT) {
            low += load<V>(in), high += load<V>(in + 4);
            last[0] += in[8], last[1] += in[9];
        }
        for (int j = 0; j < 4; ++j) sums[j][l] = low[j], sums[4 + j][l] = high[j];
        sums[8][l] = last[0], sums[9][l] = last[1];
    }
}

// Propagates the colours' gradients to the harmonics: db[j] = dL/db_j.
template <int DEGREE, class T>
GSPLAT_INLINE void basis_gradient(const Scene<T> &scene, const uint32_t *ids, const Chunk<T> &in, const T (*sums)[CHUNK], Gradients<T> &out,
                                  T (*db)[CHUNK]) {
    for (int l = 0; l < in.padded; ++l) {
        const int64_t i = ids[l < in.count ? l : 0];
        T color[4], dc[4];
        store(color, color_of<DEGREE>(scene, out.shades, l, i));
        out.drawn[l] = is_color(color) ? T(1) : T(0);
        for (int k = 0; k < 3; ++k) out.color[k][l] = dc[k] = color[k] > 0 ? sums[k][l] : T(0);
        const T *sh = scene.sh_rest + 3 * int64_t(scene.rest) * i;
#pragma GCC unroll 16
        for (int j = 1; j < (DEGREE + 1) * (DEGREE + 1); ++j) db[j][l] = dot3(sh + 3 * (j - 1), dc);
    }
}

// Propagates the colours' gradients to the coefficients (as `out.color` and `out.basis`) and, through the viewing direction,
// to the mean: `dmean`, world axes.
template <class T>
GSPLAT_INLINE void color_gradient(const ProjectBackwardArgs<T> &args, const uint32_t *ids, const Chunk<T> &in, const T (*sums)[CHUNK],
                                  Gradients<T> &out, T (*dmean)[CHUNK]) {
    using V = typename Vector<T>::V;
    const int degree = args.settings.sh_degree, used = (degree + 1) * (degree + 1);
    alignas(64) T db[16][CHUNK];
    shade(in, args.camera, degree, out.shades);
    with_degree(degree, [&]<int DEGREE>() { basis_gradient<DEGREE>(args.scene, ids, in, sums, out, db); });
    for (int l = 0; l < in.padded; l += Vector<T>::LANES) {
        V b[16], d[3], dir[3];
        for (int j = 1; j < used; ++j) b[j] = load<V>(db[j] + l);
        for (int k = 0; k < 3; ++k) dir[k] = load<V>(out.shades.dir[k] + l);
        harmonics_backward<T>(degree, dir[0], dir[1], dir[2], b, d);
        const V along = dot3(d, dir), inverse = load<V>(out.shades.inverse_distance + l);
        for (int k = 0; k < 3; ++k) store(dmean[k] + l, (d[k] - along * dir[k]) * inverse);
    }
}

// Adds the camera's gradient of WIDE Gaussians to `sums`, lane by lane, for the lanes in `counts`. All formulas take
// R (mean - eye), so the eye's gradient is minus that of the means, `dmean`. Rows of J W: t0 = fx/z (R0 - x/z R2). A clamped
// x/z is a bound of the image, (constant - cx) / fx.
GSPLAT_INLINE void camera_gradient(const Projected &g, const Camera &cam, const VD *d0, const VD *d1, const VD *uv, const VD *dp,
                                   const VD *dmean, MD counts, VD *sums) {
    const VD fx = splat(cam.fx) * g.iz, fy = splat(cam.fy) * g.iz;
    VD d[CAMERA], w0 = VD{}, w1 = VD{};
    for (int k = 0; k < 3; ++k) {
        d[k] = dp[0] * g.offset[k] + fx * d0[k], d[3 + k] = dp[1] * g.offset[k] + fy * d1[k];
        d[6 + k] = dp[2] * g.offset[k] - fx * g.ratio[0] * d0[k] - fy * g.ratio[1] * d1[k];
        d[9 + k] = -dmean[k];
        w0 += d0[k] * splat(cam.R[6 + k]), w1 += d1[k] * splat(cam.R[6 + k]);
    }
    w0 = g.clamped[0] ? g.iz * w0 : VD{}, w1 = g.clamped[1] ? g.iz * w1 : VD{};
    d[12] = uv[0] * g.p[0] * g.iz + dot3(d0, g.t0) * splat(1 / cam.fx) + w0 * g.ratio[0];
    d[13] = uv[1] * g.p[1] * g.iz + dot3(d1, g.t1) * splat(1 / cam.fy) + w1 * g.ratio[1];
    d[14] = uv[0] + w0, d[15] = uv[1] + w1;
    for (int k = 0; k < CAMERA; ++k) sums[k] += counts ? d[k] : VD{};
}

// Gradients of the rows of J W, of the image position, and of the motion blur.
struct ThroughImage {
    const VD *d0, *d1, *uv, *blur;
};

// Propagates the gradients of J W, image position, depth and direction through a lens to the means and, if `WITH_CAMERA`, adds those of
// the camera for the lanes that are drawn.
template <bool WITH_CAMERA, class T>
GSPLAT_INLINE void lens_gradient(const Camera &cam, const Chunk<T> &in, int l, const Projected &g, const ThroughImage &through, VD depth,
                                 const T (*direction)[CHUNK], Gradients<T> &out, VD *camera) {
    SightGradient gradient;
    for (int k = 0; k < 3; ++k)
        gradient.d0[k] = through.d0[k], gradient.d1[k] = through.d1[k], gradient.direction[k] = widened(direction[k] + l);
    gradient.at[0] = through.uv[0], gradient.at[1] = through.uv[1], gradient.depth = depth;
    gradient.blur[0] = through.blur[0], gradient.blur[1] = through.blur[1];
    VD dmean[3], numbers[LENS_CAMERA];
    sight_adjoint(cam, g.offset, cam.moving ? load<VD>(in.time + l) : VD{}, gradient, dmean, WITH_CAMERA ? numbers : nullptr);
    for (int k = 0; k < 3; ++k) narrowed(out.mean[k] + l, dmean[k]);
    if (!WITH_CAMERA) return;
    const MD drawn = widened(out.drawn + l) != VD{};
    for (int k = 0; k < LENS_CAMERA; ++k) camera[k] += drawn ? numbers[k] : VD{};
}

// Propagates the sums of WIDE Gaussians to shape, mean and opacity, and to the camera if `WITH_CAMERA`.
template <bool WITH_CAMERA, class T>
GSPLAT_INLINE void shape_gradient(const ProjectBackwardArgs<T> &args, const Chunk<T> &in, int l, const T (*sums)[CHUNK],
                                  const T (*through_color)[CHUNK], Gradients<T> &out, VD *camera) {
    const Camera &cam = args.camera;
    const bool raw = args.scene.quats != nullptr;
    Projected g;
    project_shape(in, l, raw, cam, args.settings, g);
    VD slot[SLOT], d0[3], d1[3], dp[3], db[2] = {};
    const bool blurs = cam.spread != 0;
    for (int j = 0; j < SLOT; ++j) slot[j] = widened(sums[j] + l);
    const Whitened m = whiten<T>(cam, args.settings, g, slot);
    const VD uv[2] = {m.sx * m.m0, m.sy * m.m0 + m.ty * m.m1};
    const VD nx = uv[0] * splat(0.5 * cam.W), ny = uv[1] * splat(0.5 * cam.H);
    narrowed(out.means2d_norm + l, sqrt_(nx * nx + ny * ny));
    const Lit lit = lit_by(cam, args.settings, g, slot[H]);
    const VD total = raw ? raw_gradient(g, m, splat(args.settings.dilation), lit, blurs, l, out, d0, d1, db)
                         : direct_gradient(g, m, lit, blurs, l, out, d0, d1, db);
    narrowed(out.opacity + l, raw ? (splat(1.0) - g.opacity) * slot[H] : slot[H] / g.opacity);
    narrowed(out.drawn + l, g.valid ? widened(out.drawn + l) : VD{});
    VD dmean[3];
    if (cam.lens != PINHOLE) {
        lens_gradient<WITH_CAMERA>(cam, in, l, g, {d0, d1, uv, db}, slot[DEPTH], through_color, out, camera);
        return;
    }
    mean_gradient(g, cam, d0, d1, total, uv, dp);
    dp[2] += slot[DEPTH];
    for (int k = 0; k < 3; ++k) {
        dmean[k] = splat(cam.R[k]) * dp[0] + splat(cam.R[3 + k]) * dp[1] + splat(cam.R[6 + k]) * dp[2];
        dmean[k] += widened(through_color[k] + l);
        narrowed(out.mean[k] + l, dmean[k]);
    }
    if (WITH_CAMERA) camera_gradient(g, cam, d0, d1, uv, dp, dmean, widened(out.drawn + l) != VD{}, camera);
}

// The gradients of up to CHUNK Gaussians; `next` more follow in the list. Adds those of the camera to `camera`.
template <bool WITH_CAMERA, class T>
GSPLAT_INLINE void differentiate(const ProjectBackwardArgs<T> &args, const uint32_t *ids, int count, int next, Gradients<T> &out,
                                 VD *camera) {
    Chunk<T> in;
    alignas(64) T sums[SLOT][CHUNK], through_color[3][CHUNK] = {};
    gather(args.scene, ids, count, in);
    read_times(args.camera, in);
    sum_slots(args, ids, count, in.padded, sums);
    if (args.scene.quats) {
        color_gradient(args, ids, in, sums, out, through_color);
    } else {
        for (int l = 0; l < in.padded; ++l) {
            out.drawn[l] = is_color(args.scene.colors + 3 * int64_t(ids[l < count ? l : 0])) ? T(1) : T(0);
            for (int k = 0; k < 3; ++k) out.color[k][l] = sums[k][l];
        }
    }
    for (int l = count; l < in.padded; ++l) out.drawn[l] = 0;
    const int row = 3 * args.scene.rest;
    for (int l = 0; l < in.padded; l += WIDE) {
        for (int k = l; k < vmin(l + WIDE, count); ++k) fetch<1>(args.grads.sh_rest + row * (ids[k] - args.grads.first), row);
        for (int k = l; k < vmin(l + WIDE, next); ++k) {
            const uint32_t i = ids[count + k];
            fetch<0>(args.scene.sh_rest + int64_t(row) * i, row);
            fetch<0>(args.slots + int64_t(SLOT) * args.slot_begin[i], int(vmin(args.pairs_of[i], MOST_FETCHED)) * SLOT);
        }
        shape_gradient<WITH_CAMERA>(args, in, l, sums, through_color, out, camera);
    }
}

// Writes zeros for Gaussian i.
template <class T>
GSPLAT_INLINE void zero(const ProjectBackwardArgs<T> &args, int64_t i) {
    const SceneGrads<T> &grads = args.grads;
    grads.means2d_norm[i] = 0;
    i -= grads.first;
    memset(grads.means + 3 * i, 0, 3 * sizeof(T));
    if (args.scene.quats) {
        memset(grads.quats + 4 * i, 0, 4 * sizeof(T));
        memset(grads.log_scales + 3 * i, 0, 3 * sizeof(T));
        memset(grads.sh0 + 3 * i, 0, 3 * sizeof(T));
        if (args.scene.rest)  // otherwise there is no array, and memset must not get null
            memset(grads.sh_rest + 3 * int64_t(args.scene.rest) * i, 0, 3 * size_t(args.scene.rest) * sizeof(T));
        grads.logit_opacities[i] = 0;
    } else {
        memset(grads.cov3ds + 9 * i, 0, 9 * sizeof(double));
        memset(grads.colors + 3 * i, 0, 3 * sizeof(T));
        grads.opacities[i] = 0;
    }
}

// Writes the products basis[j] color[k] in lane l to row i.
template <int DEGREE, class T>
GSPLAT_INLINE void write_harmonics(const SceneGrads<T> &grads, int rest, const Gradients<T> &in, int l, int64_t i) {
    constexpr int USED = (DEGREE + 1) * (DEGREE + 1);
    const typename Channels<T>::V color = {in.color[0][l], in.color[1][l], in.color[2][l], T(0)};
    for (int k = 0; k < 3; ++k) grads.sh0[3 * i + k] = in.shades.basis[0][l] * color[k];
    if (USED == 1 && rest == 0) return;
    T *out = grads.sh_rest + 3 * int64_t(rest) * i;
#pragma GCC unroll 16
    for (int j = 1; j < USED - 1; ++j)
        store(out + 3 * (j - 1), color * in.shades.basis[j][l]);  // the next store overwrites the fourth number
    if (USED > 1)
        for (int k = 0; k < 3; ++k) out[3 * (USED - 2) + k] = in.shades.basis[USED - 1][l] * color[k];
    if (USED <= rest) memset(out + 3 * (USED - 1), 0, 3 * size_t(rest + 1 - USED) * sizeof(T));
}

// Writes the gradients in lane l to Gaussian i.
template <class T>
GSPLAT_INLINE void write(const ProjectBackwardArgs<T> &args, const Gradients<T> &in, int l, int64_t i) {
    const SceneGrads<T> &grads = args.grads;
    if (in.drawn[l] == 0) return zero(args, i);
    grads.means2d_norm[i] = in.means2d_norm[l];
    i -= grads.first;
    for (int k = 0; k < 3; ++k) grads.means[3 * i + k] = in.mean[k][l];
    if (!args.scene.quats) {
        for (int k = 0; k < 9; ++k) grads.cov3ds[9 * i + k] = in.cov3d[k][l];
        for (int k = 0; k < 3; ++k) grads.colors[3 * i + k] = in.color[k][l];
        grads.opacities[i] = in.opacity[l];
        return;
    }
    for (int k = 0; k < 4; ++k) grads.quats[4 * i + k] = in.quat[k][l];
    for (int k = 0; k < 3; ++k) grads.log_scales[3 * i + k] = in.log_scale[k][l];
    grads.logit_opacities[i] = in.opacity[l];
    with_degree(args.settings.sh_degree, [&]<int DEGREE>() { write_harmonics<DEGREE>(grads, args.scene.rest, in, l, i); });
}

template <bool WITH_CAMERA, class T>
GSPLAT_INLINE void propagate(const ProjectBackwardArgs<T> &args, int64_t block) {
    const int64_t begin = block * BLOCK, end = vmin(begin + BLOCK, args.scene.n);
    uint32_t ids[BLOCK];
    int drawn = 0;
    for (int64_t i = begin; i < end; ++i) {
        if (args.pairs_of[i])
            ids[drawn++] = uint32_t(i);
        else
            zero(args, i);
    }
    VD camera[LENS_CAMERA] = {};
    const int numbers = camera_numbers(args.camera);
    for (int first = 0; first < drawn; first += CHUNK) {
        const int count = vmin(CHUNK, drawn - first);
        Gradients<T> gradients;
        differentiate<WITH_CAMERA>(args, ids + first, count, drawn - first - count, gradients, camera);
        for (int l = 0; l < count; ++l) write(args, gradients, l, ids[first + l]);
    }
    if (!WITH_CAMERA) return;
    for (int k = 0; k < numbers; ++k) {
        double sum = 0;
        for (int l = 0; l < WIDE; ++l) sum += camera[k][l];
        args.camera_sums[block * numbers + k] = sum;
    }
}

template <class T>
void project_backward(const ProjectBackwardArgs<T> &args, int64_t block) {
    if (args.camera_sums)
        propagate<true>(args, block);
    else
        propagate<false>(args, block);
}

template void project_backward<float>(const ProjectBackwardArgs<float> &, int64_t);
template void project_backward<double>(const ProjectBackwardArgs<double> &, int64_t);

}  // namespace GSPLAT_ISA
}  // namespace gsplat

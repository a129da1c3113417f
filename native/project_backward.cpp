// project_backward: sum each Gaussian's slots in a fixed order and propagate the gradient to its raw parameters.
//
//     moments of h -> J W M -> (J W, quaternion, log scale) -> mean;   colour -> (coefficients, direction -> mean)
#include "gaussian_math.h"
#include "isa.h"

namespace gsplat {
namespace GSPLAT_ISA {

// Sigma2d^-1 = L' L, y = L d of a pixel d px from the mean: y0 = sx dx + sy dy, y1 = ty dy. The moments of h are taken
// in y, where they are of order 1; in d they grow with the ellipse and cancel.
struct Whitened {
    double sx, sy, ty;
    double m0, m1;         // sum h y0, sum h y1
    double m00, m01, m11;  // sum h y0², sum h y0 y1, sum h y1²; minus sum h on the diagonal with antialiasing
};

// Computed from the moments of h about the splat's reference point.
template <class T>
GSPLAT_INLINE Whitened whiten(const Camera &cam, const Settings &set, const Projected &g, const double *slot) {
    Whitened w;
    w.sx = sqrt_(g.c * g.inverse_det), w.sy = -g.b / g.c * w.sx, w.ty = sqrt_(1 / g.c);
    const Position<T> at = position<T>(g, cam);
    const double dx = double(at.x) - at.u, dy = double(at.y) - at.v;
    const double s = w.sx * dx + w.sy * dy, t = w.ty * dy;  // y of the reference point
    const double along = w.sx * slot[HX] + w.sy * slot[HY], down = w.ty * slot[HY];
    w.m0 = s * slot[H] + along, w.m1 = t * slot[H] + down;
    w.m00 = s * (s * slot[H] + 2 * along) + w.sx * (w.sx * slot[HXX] + 2 * w.sy * slot[HXY]) + w.sy * w.sy * slot[HYY];
    w.m01 = s * (t * slot[H] + down) + t * along + w.ty * (w.sx * slot[HXY] + w.sy * slot[HYY]);
    w.m11 = t * (t * slot[H] + 2 * down) + w.ty * w.ty * slot[HYY];
    if (set.antialiased) w.m00 -= slot[H], w.m11 -= slot[H];  // the opacity's factor contains det^(-1/2)
    return w;
}

// Propagates gradients d of J W (two rows t; `total` is the sum of d . t) and of the image position to the mean in camera
// axes.
GSPLAT_INLINE void mean_gradient(const Projected &g, const Camera &cam, const double *d0, const double *d1, double total, const double *uv,
                                 double *dp) {
    const double iz = g.iz, x = g.p[0] * iz, y = g.p[1] * iz;  // x/z, y/z
    double w0 = 0, w1 = 0;                                     // d . (row 2 of W)
    for (int k = 0; k < 3; ++k) w0 += d0[k] * cam.R[6 + k], w1 += d1[k] * cam.R[6 + k];
    // J W = f/z (W_row - x/z W_2): d/dx gives -f/z² W_2; d/dz gives -(J W)/z + f x/z³ W_2. A clamped x/z is a constant.
    if (g.clamped[0]) w0 = 0;
    if (g.clamped[1]) w1 = 0;
    const double fx = cam.fx * iz, fy = cam.fy * iz;
    dp[0] = fx * uv[0] - fx * iz * w0;
    dp[1] = fy * uv[1] - fy * iz * w1;
    dp[2] = -x * fx * uv[0] - y * fy * uv[1] - iz * total + iz * (fx * x * w0 + fy * y * w1);
}

// Propagates the colour gradient to the coefficients, and through the viewing direction to the mean (world axes, added).
template <class T>
GSPLAT_INLINE void color_gradient(const ProjectBackwardArgs<T> &args, int64_t i, const Shade<T> &shade, const T *slot, double *dmean) {
    const Scene<T> &scene = args.scene;
    T dc[3];
    for (int k = 0; k < 3; ++k) dc[k] = shade.color[k] > 0 ? slot[k] : T(0);
    const int degree = args.settings.sh_degree, used = (degree + 1) * (degree + 1);
    const T *sh = scene.sh_rest + 3 * int64_t(scene.rest) * i;
    T *out = args.grads.sh_rest + 3 * int64_t(scene.rest) * i;
    T db[16];
    db[0] = 0;
    for (int k = 0; k < 3; ++k) args.grads.sh0[3 * i + k] = shade.basis[0] * dc[k];
    for (int j = 1; j < used; ++j) {
        db[j] = dot3(sh + 3 * (j - 1), dc);
        for (int k = 0; k < 3; ++k) out[3 * (j - 1) + k] = shade.basis[j] * dc[k];
    }
    for (int j = used; j <= scene.rest; ++j)
        for (int k = 0; k < 3; ++k) out[3 * (j - 1) + k] = 0;
    T dd[3];
    harmonics_backward(degree, shade.dir[0], shade.dir[1], shade.dir[2], db, dd);
    const T along = dot3(dd, shade.dir);
    for (int k = 0; k < 3; ++k) dmean[k] += double((dd[k] - along * shade.dir[k]) / shade.distance);
}

// Propagates the moments to M = R S and J W, for raw parameters; returns d0 . t0 + d1 . t1. With r = (J W) M (two rows), w = L r and
// N the matrix of moments: dL/dSigma2d = L' N L / 2, dL/dr = L' N w; w is of order 1, however long the ellipse.
template <class T>
GSPLAT_INLINE double raw_gradient(const ProjectBackwardArgs<T> &args, int64_t i, const Projected &g, const Whitened &m, double h,
                                  double *d0, double *d1) {
    double across0[3], across1[3], dR[9], dr0[3], dr1[3], total = 0;
    cross3(g.r1, g.n, across0), cross3(g.n, g.r0, across1);  // c0 r0 - b0 r1 and a0 r1 - b0 r0
    // With antialiasing the opacity's factor contains det0^(1/2): dL/dr = sum h Sigma^-1 r, Sigma before the dilation.
    const double lit = args.settings.antialiased && g.det0 > DET_FLOOR ? h / g.det0 : 0;
    for (int k = 0; k < 3; ++k) {
        // sx r0 + sy r1 = sx (r0 - b/c r1)
        const double w0 = m.sx / g.c * (DILATION * g.r0[k] + across0[k]), w1 = m.ty * g.r1[k];
        const double dw0 = m.m00 * w0 + m.m01 * w1, dw1 = m.m01 * w0 + m.m11 * w1;
        const double extra0 = lit * across0[k], extra1 = lit * across1[k];
        dr0[k] = m.sx * dw0 + extra0, dr1[k] = m.sy * dw0 + m.ty * dw1 + extra1;
        const double scale = w0 * dw0 + w1 * dw1 + g.r0[k] * extra0 + g.r1[k] * extra1;  // r0 . dr0 + r1 . dr1
        args.grads.log_scales[3 * i + k] = T(scale);
        total += scale;
    }
    for (int k = 0; k < 3; ++k) {
        d0[k] = d1[k] = 0;
        for (int j = 0; j < 3; ++j) {
            d0[k] += g.R[3 * k + j] * g.s[j] * dr0[j], d1[k] += g.R[3 * k + j] * g.s[j] * dr1[j];
            dR[3 * k + j] = (g.t0[k] * dr0[j] + g.t1[k] * dr1[j]) * g.s[j];
        }
    }
    double dq[4];
    rotation_backward(g.q, dR, dq);
    const double along = dq[0] * g.q[0] + dq[1] * g.q[1] + dq[2] * g.q[2] + dq[3] * g.q[3];
    for (int k = 0; k < 4; ++k) args.grads.quats[4 * i + k] = T((dq[k] - along * g.q[k]) * g.inverse_q_norm);
    return total;
}

// The same for covariances given directly: a = t0' S t0, b = t0' S t1, c = t1' S t1.
template <class T>
GSPLAT_INLINE double direct_gradient(const ProjectBackwardArgs<T> &args, int64_t i, const Projected &g, const Whitened &m, double h,
                                     double *d0, double *d1) {
    // Gradients of a, b (once for both entries) and c: L' N L / 2.
    double a = m.sx * m.sx * m.m00 / 2, b = m.sx * (m.sy * m.m00 + m.ty * m.m01);
    double c = (m.sy * (m.sy * m.m00 + 2 * m.ty * m.m01) + m.ty * m.ty * m.m11) / 2;
    if (args.settings.antialiased && g.det0 > DET_FLOOR) a += h / 2 * g.c0 / g.det0, b -= h * g.b0 / g.det0, c += h / 2 * g.a0 / g.det0;
    double total = 0;
    for (int k = 0; k < 3; ++k) {
        d0[k] = 2 * a * g.r0[k] + b * g.r1[k];
        d1[k] = 2 * c * g.r1[k] + b * g.r0[k];
        total += d0[k] * g.t0[k] + d1[k] * g.t1[k];
        for (int j = 0; j < 3; ++j)
            args.grads.cov3ds[9 * i + 3 * k + j] =
                T(a * g.t0[k] * g.t0[j] + c * g.t1[k] * g.t1[j] + b / 2 * (g.t0[k] * g.t1[j] + g.t1[k] * g.t0[j]));
    }
    return total;
}

template <class T>
GSPLAT_INLINE void zero(const ProjectBackwardArgs<T> &args, int64_t i) {
    const SceneGrads<T> &grads = args.grads;
    memset(grads.means + 3 * i, 0, 3 * sizeof(T));
    grads.means2d_norm[i] = 0;
    if (args.scene.quats) {
        memset(grads.quats + 4 * i, 0, 4 * sizeof(T));
        memset(grads.log_scales + 3 * i, 0, 3 * sizeof(T));
        memset(grads.sh0 + 3 * i, 0, 3 * sizeof(T));
        if (args.scene.rest)  // otherwise there is no array, and memset must not get null
            memset(grads.sh_rest + 3 * int64_t(args.scene.rest) * i, 0, 3 * size_t(args.scene.rest) * sizeof(T));
        grads.logit_opacities[i] = 0;
    } else {
        memset(grads.cov3ds + 9 * i, 0, 9 * sizeof(T));
        memset(grads.colors + 3 * i, 0, 3 * sizeof(T));
        grads.opacities[i] = 0;
    }
}

template <class T>
void one(const ProjectBackwardArgs<T> &args, int64_t i) {
    T sums[SLOT] = {};
    const T *in = args.slots + int64_t(SLOT) * args.slot_begin[i];
    for (uint32_t k = 0; k < args.pairs_of[i]; ++k, in += SLOT)
        for (int j = 0; j < SLOT; ++j) sums[j] += in[j];
    Projected g;
    Shade<T> shade;
    if (!project_shape(args.scene, args.camera, args.settings, i, g) || !project_color(args.scene, args.settings, i, g, shade))
        return zero(args, i);

    double slot[SLOT];
    for (int j = 0; j < SLOT; ++j) slot[j] = double(sums[j]);
    const Whitened m = whiten<T>(args.camera, args.settings, g, slot);
    const double uv[2] = {m.sx * m.m0, m.sy * m.m0 + m.ty * m.m1};
    const double nx = uv[0] * args.camera.W / 2, ny = uv[1] * args.camera.H / 2;
    args.grads.means2d_norm[i] = T(sqrt_(nx * nx + ny * ny));

    double d0[3], d1[3], dp[3], dmean[3];
    const double total = args.scene.quats ? raw_gradient(args, i, g, m, slot[H], d0, d1) : direct_gradient(args, i, g, m, slot[H], d0, d1);
    mean_gradient(g, args.camera, d0, d1, total, uv, dp);
    dp[2] += slot[DEPTH];
    for (int k = 0; k < 3; ++k) dmean[k] = args.camera.R[k] * dp[0] + args.camera.R[3 + k] * dp[1] + args.camera.R[6 + k] * dp[2];
    if (args.scene.quats) {
        color_gradient(args, i, shade, sums, dmean);
        args.grads.logit_opacities[i] = T((1 - g.opacity) * slot[H]);
    } else {
        for (int k = 0; k < 3; ++k) args.grads.colors[3 * i + k] = sums[k];
        args.grads.opacities[i] = T(slot[H] / g.opacity);
    }
    for (int k = 0; k < 3; ++k) args.grads.means[3 * i + k] = T(dmean[k]);
}

template <class T>
void project_backward(const ProjectBackwardArgs<T> &args, int64_t block) {
    const int64_t end = vmin((block + 1) * BLOCK, args.scene.n);
    for (int64_t i = block * BLOCK; i < end; ++i) args.pairs_of[i] ? one(args, i) : zero(args, i);
}

template void project_backward<float>(const ProjectBackwardArgs<float> &, int64_t);
template void project_backward<double>(const ProjectBackwardArgs<double> &, int64_t);

}  // namespace GSPLAT_ISA
}  // namespace gsplat

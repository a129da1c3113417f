// project_backward: adds up each Gaussian's slots in fixed order and goes on to its raw parameters.
//
//     conic -> Sigma2d -> (J, W M) -> (quaternion, log scale), mean;   colour -> (coefficients, direction -> mean)
#include "gaussian_math.h"
#include "isa.h"

namespace gsplat {
namespace GSPLAT_ISA {

// Gradient of the covariance on the screen: of a, b (once for both places) and c.
struct ShapeGradient {
    double a, b, c;
};

// From the moments of h. With K = Sigma2d^-1, dL/dSigma2d = -K G K, G the gradient of K; and antialiasing's share.
GSPLAT_INLINE ShapeGradient shape_gradient(const Projected &g, const Settings &set, const double *slot) {
    const double A = g.c * g.inverse_det, B = -g.b * g.inverse_det, C = g.a * g.inverse_det;
    const double gA = -slot[HXX] / 2, gB = -slot[HXY] / 2, gC = -slot[HYY] / 2;  // gB: half of dL/dB, one of two places
    const double m00 = gA * A + gB * B, m01 = gA * B + gB * C, m10 = gB * A + gC * B, m11 = gB * B + gC * C;
    ShapeGradient d{-(A * m00 + B * m10), -2 * (A * m01 + B * m11), -(B * m01 + C * m11)};
    if (set.antialiased) {
        const double half = slot[H] / 2;  // dL/dlog(opacity factor) / 2: the factor is (det0 / det)^(1/2)
        d.a -= half * A, d.b -= half * 2 * B, d.c -= half * C;
        if (g.det0 > DET_FLOOR) {
            d.a += half * g.c0 / g.det0, d.b -= half * 2 * g.b0 / g.det0, d.c += half * g.a0 / g.det0;
        }
    }
    return d;
}

// From the gradients of J W (two rows) and of the image position to the mean in camera axes.
GSPLAT_INLINE void mean_gradient(const Projected &g, const Camera &cam, const double *d0, const double *d1, const double *uv,
                                 double *dp) {
    const double iz = g.iz, x = g.p[0] * iz, y = g.p[1] * iz;  // x/z, y/z
    double w0 = 0, w1 = 0, s0 = 0, s1 = 0;                     // d . (row of W), d . (row of J W)
    for (int k = 0; k < 3; ++k) {
        w0 += d0[k] * cam.R[6 + k], w1 += d1[k] * cam.R[6 + k];
        s0 += d0[k] * g.t0[k], s1 += d1[k] * g.t1[k];
    }
    // J W = f/z (W_row - x/z W_2): d/dx gives -f/z² W_2; d/dz gives -(J W)/z + f x/z³ W_2. A clamped x/z is a constant.
    if (g.clamped[0]) w0 = 0;
    if (g.clamped[1]) w1 = 0;
    const double fx = cam.fx * iz, fy = cam.fy * iz;
    dp[0] = fx * uv[0] - fx * iz * w0;
    dp[1] = fy * uv[1] - fy * iz * w1;
    dp[2] = -x * fx * uv[0] - y * fy * uv[1] - iz * (s0 + s1) + iz * (fx * x * w0 + fy * y * w1);
}

// From the colour to the coefficients, and through the viewing direction to the mean (world axes, added).
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

// From Sigma2d to M = R S and J W, for raw parameters: a = |r0|², b = r0 . r1, c = |r1|², r = (J W) M.
template <class T>
GSPLAT_INLINE void raw_gradient(const ProjectBackwardArgs<T> &args, int64_t i, const Projected &g, const ShapeGradient &d, double *d0,
                                double *d1) {
    double dr0[3], dr1[3], dR[9];
    for (int k = 0; k < 3; ++k) {
        dr0[k] = 2 * d.a * g.r0[k] + d.b * g.r1[k];
        dr1[k] = 2 * d.c * g.r1[k] + d.b * g.r0[k];
    }
    for (int k = 0; k < 3; ++k) {
        d0[k] = d1[k] = 0;
        for (int j = 0; j < 3; ++j) {
            d0[k] += g.R[3 * k + j] * g.s[j] * dr0[j], d1[k] += g.R[3 * k + j] * g.s[j] * dr1[j];
            dR[3 * k + j] = (g.t0[k] * dr0[j] + g.t1[k] * dr1[j]) * g.s[j];
        }
    }
    for (int j = 0; j < 3; ++j)
        args.grads.log_scales[3 * i + j] = T(g.R[j] * dR[j] + g.R[3 + j] * dR[3 + j] + g.R[6 + j] * dR[6 + j]);
    double dq[4];
    rotation_backward(g.q, dR, dq);
    const double along = dq[0] * g.q[0] + dq[1] * g.q[1] + dq[2] * g.q[2] + dq[3] * g.q[3];
    for (int k = 0; k < 4; ++k) args.grads.quats[4 * i + k] = T((dq[k] - along * g.q[k]) * g.inverse_q_norm);
}

// The same for covariances given as they are: a = t0' S t0, b = t0' S t1, c = t1' S t1.
template <class T>
GSPLAT_INLINE void direct_gradient(const ProjectBackwardArgs<T> &args, int64_t i, const Projected &g, const ShapeGradient &d, double *d0,
                                   double *d1) {
    for (int k = 0; k < 3; ++k) {
        d0[k] = 2 * d.a * g.r0[k] + d.b * g.r1[k];
        d1[k] = 2 * d.c * g.r1[k] + d.b * g.r0[k];
        for (int j = 0; j < 3; ++j)
            args.grads.cov3ds[9 * i + 3 * k + j] = T(d.a * g.t0[k] * g.t0[j] + d.c * g.t1[k] * g.t1[j] +
                                                     d.b / 2 * (g.t0[k] * g.t1[j] + g.t1[k] * g.t0[j]));
    }
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
        if (args.scene.rest)  // else there is no array, and memset takes no null
            memset(grads.sh_rest + 3 * int64_t(args.scene.rest) * i, 0, 3 * size_t(args.scene.rest) * sizeof(T));
        grads.logit_opacities[i] = 0;
    } else {
        memset(grads.cov3ds + 9 * i, 0, 9 * sizeof(T));
        memset(grads.colors + 3 * i, 0, 3 * sizeof(T));
        grads.opacities[i] = 0;
    }
}

// Moves the moments of h from the reference point to the mean, e away: sum h (x + e)² = sum h x² + 2 e sum h x + e² sum h.
template <class T>
GSPLAT_INLINE void moments_about_mean(const Camera &cam, const Projected &g, const T *sums, double *slot) {
    const Position<T> at = position<T>(g, cam);
    const double ex = double(at.x) - at.u, ey = double(at.y) - at.v;
    for (int j = 0; j < SLOT; ++j) slot[j] = double(sums[j]);
    slot[HXX] += ex * (2 * slot[HX] + ex * slot[H]);
    slot[HYY] += ey * (2 * slot[HY] + ey * slot[H]);
    slot[HXY] += ey * slot[HX] + ex * slot[HY] + ex * ey * slot[H];
    slot[HX] += ex * slot[H], slot[HY] += ey * slot[H];
}

template <class T>
void one(const ProjectBackwardArgs<T> &args, int64_t i) {
    T sums[SLOT] = {};
    const T *in = args.slots + int64_t(SLOT) * args.slot_begin[i];
    for (uint32_t k = 0; k < args.pairs_of[i]; ++k, in += SLOT)
        for (int j = 0; j < SLOT; ++j) sums[j] += in[j];
    Projected g;
    Shade<T> shade;
    if (!project_shape(args.scene, args.camera, args.settings, i, g) ||
        !project_color(args.scene, args.settings, i, g, shade))
        return zero(args, i);

    double slot[SLOT];
    moments_about_mean(args.camera, g, sums, slot);
    const double A = g.c * g.inverse_det, B = -g.b * g.inverse_det, C = g.a * g.inverse_det;
    const double uv[2] = {A * slot[HX] + B * slot[HY], B * slot[HX] + C * slot[HY]};
    const double nx = uv[0] * args.camera.W / 2, ny = uv[1] * args.camera.H / 2;
    args.grads.means2d_norm[i] = T(sqrt_(nx * nx + ny * ny));

    const ShapeGradient d = shape_gradient(g, args.settings, slot);
    double d0[3], d1[3], dp[3], dmean[3];
    args.scene.quats ? raw_gradient(args, i, g, d, d0, d1) : direct_gradient(args, i, g, d, d0, d1);
    mean_gradient(g, args.camera, d0, d1, uv, dp);
    dp[2] += slot[DEPTH];
    for (int k = 0; k < 3; ++k)
        dmean[k] = args.camera.R[k] * dp[0] + args.camera.R[3 + k] * dp[1] + args.camera.R[6 + k] * dp[2];
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

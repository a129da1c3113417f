// The mathematics of one Gaussian, forward and backward: quaternion, covariance, projection, harmonics.
// Mirrors src/gsplat_edu/gaussian_math.py and sh.py. Compiled once per instruction set, like simd.h.
#pragma once

#include "kernels.h"
#include "simd.h"

namespace gsplat {
namespace GSPLAT_ISA {

// libm functions by type.
GSPLAT_INLINE float exp_(float x) { return expf(x); }
GSPLAT_INLINE double exp_(double x) { return exp(x); }
GSPLAT_INLINE float log_(float x) { return logf(x); }
GSPLAT_INLINE double log_(double x) { return log(x); }
GSPLAT_INLINE float sqrt_(float x) { return sqrtf(x); }
GSPLAT_INLINE double sqrt_(double x) { return sqrt(x); }
GSPLAT_INLINE float ceil_(float x) { return ceilf(x); }
GSPLAT_INLINE double ceil_(double x) { return ceil(x); }
GSPLAT_INLINE float floor_(float x) { return floorf(x); }
GSPLAT_INLINE double floor_(double x) { return floor(x); }

// x - x is 0 for finite x only.
template <class T>
GSPLAT_INLINE bool finite(T x) {
    return x - x == T(0);
}

// Finite, and at most COLOR_LIMIT, which no photo needs.
template <class T>
GSPLAT_INLINE bool is_color(const T *c) {
    const T limit = T(COLOR_LIMIT);
    return c[0] <= limit && c[1] <= limit && c[2] <= limit && c[0] >= -limit && c[1] >= -limit && c[2] >= -limit;
}

// Bound on the rounding error of a rim, px, if it is computed from numbers whose magnitudes add up to `size`.
template <class T>
GSPLAT_INLINE T rim_slack(T size) {
    return T(RIM_SLACK) + T(sizeof(T) == sizeof(float) ? 0x1p-21 : 0x1p-50) * size;
}

GSPLAT_INLINE float abs_(float x) { return fabsf(x); }
GSPLAT_INLINE double abs_(double x) { return fabs(x); }

template <class T>
GSPLAT_INLINE T dot3(const T *a, const T *b) {
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

GSPLAT_INLINE void cross3(const double *a, const double *b, double *out) {
    out[0] = a[1] * b[2] - a[2] * b[1], out[1] = a[2] * b[0] - a[0] * b[2], out[2] = a[0] * b[1] - a[1] * b[0];
}

// R(q) of a unit quaternion (w, x, y, z), row-major.
template <class T>
GSPLAT_INLINE void rotation(const T *q, T *R) {
    const T w = q[0], x = q[1], y = q[2], z = q[3];
    R[0] = 1 - 2 * (y * y + z * z), R[1] = 2 * (x * y - w * z), R[2] = 2 * (x * z + w * y);
    R[3] = 2 * (x * y + w * z), R[4] = 1 - 2 * (x * x + z * z), R[5] = 2 * (y * z - w * x);
    R[6] = 2 * (x * z - w * y), R[7] = 2 * (y * z + w * x), R[8] = 1 - 2 * (x * x + y * y);
}

// dL/dq of a unit quaternion from G = dL/dR.
template <class T>
GSPLAT_INLINE void rotation_backward(const T *q, const T *G, T *dq) {
    const T w = q[0], x = q[1], y = q[2], z = q[3];
    dq[0] = 2 * (x * (G[7] - G[5]) + y * (G[2] - G[6]) + z * (G[3] - G[1]));
    dq[1] = 2 * (y * (G[1] + G[3]) + z * (G[2] + G[6]) + w * (G[7] - G[5]) - 2 * x * (G[4] + G[8]));
    dq[2] = 2 * (x * (G[1] + G[3]) + z * (G[5] + G[7]) + w * (G[2] - G[6]) - 2 * y * (G[0] + G[8]));
    dq[3] = 2 * (x * (G[2] + G[6]) + y * (G[5] + G[7]) + w * (G[3] - G[1]) - 2 * z * (G[0] + G[4]));
}

// The real spherical harmonics up to `degree` in direction (x, y, z): b has (degree + 1)² entries.
template <class T>
GSPLAT_INLINE void harmonics(int degree, T x, T y, T z, T *b) {
    b[0] = T(C0);
    if (degree < 1) return;
    b[1] = T(-C1) * y, b[2] = T(C1) * z, b[3] = T(-C1) * x;
    if (degree < 2) return;
    const T xx = x * x, yy = y * y, zz = z * z;
    b[4] = T(C2[0]) * x * y, b[5] = T(C2[1]) * y * z, b[6] = T(C2[2]) * (2 * zz - xx - yy);
    b[7] = T(C2[3]) * x * z, b[8] = T(C2[4]) * (xx - yy);
    if (degree < 3) return;
    b[9] = T(C3[0]) * y * (3 * xx - yy), b[10] = T(C3[1]) * x * y * z;
    b[11] = T(C3[2]) * y * (4 * zz - xx - yy), b[12] = T(C3[3]) * z * (2 * zz - 3 * xx - 3 * yy);
    b[13] = T(C3[4]) * x * (4 * zz - xx - yy), b[14] = T(C3[5]) * z * (xx - yy);
    b[15] = T(C3[6]) * x * (xx - 3 * yy);
}

// dL/d(x, y, z) from g_i = dL/db_i.
template <class T>
GSPLAT_INLINE void harmonics_backward(int degree, T x, T y, T z, const T *g, T *d) {
    d[0] = d[1] = d[2] = 0;
    if (degree < 1) return;
    d[0] = T(-C1) * g[3], d[1] = T(-C1) * g[1], d[2] = T(C1) * g[2];
    if (degree < 2) return;
    const T p = T(C2[0]), q = T(C2[2]), r = T(C2[4]);
    d[0] += p * y * g[4] - 2 * q * x * g[6] - p * z * g[7] + 2 * r * x * g[8];
    d[1] += p * x * g[4] - p * z * g[5] - 2 * q * y * g[6] - 2 * r * y * g[8];
    d[2] += -p * y * g[5] + 4 * q * z * g[6] - p * x * g[7];
    if (degree < 3) return;
    const T xx = x * x, yy = y * y, zz = z * z;
    const T a = T(C3[6]), b = T(C3[1]), c = T(C3[4]), e = T(C3[3]), f = T(C3[5]);
    d[0] += 6 * a * x * y * g[9] + b * y * z * g[10] - 2 * c * x * y * g[11] - 6 * e * x * z * g[12] + c * (4 * zz - 3 * xx - yy) * g[13] +
            2 * f * x * z * g[14] + 3 * a * (xx - yy) * g[15];
    d[1] += 3 * a * (xx - yy) * g[9] + b * x * z * g[10] + c * (4 * zz - xx - 3 * yy) * g[11] - 6 * e * y * z * g[12] -
            2 * c * x * y * g[13] - 2 * f * y * z * g[14] - 6 * a * x * y * g[15];
    d[2] += b * x * y * g[10] + 8 * c * y * z * g[11] + 3 * e * (2 * zz - xx - yy) * g[12] + 8 * c * x * z * g[13] + f * (xx - yy) * g[14];
}

// Intermediate values of one Gaussian's projection, kept for the backward pass. Always in double: distant cameras, long
// lenses and thin ellipses lose digits here that float cannot spare, and the cost is once per Gaussian
// (docs/PRECISION.md).
struct Projected {
    double offset[3], p[3];                   // mean - eye in world axes; mean in camera axes
    double iz, ratio[2];                      // 1/z; x/z and y/z, clamped for the Jacobian
    bool clamped[2];                          // whether each was clamped
    double t0[3], t1[3];                      // rows of J W
    double q[4], inverse_q_norm, R[9], s[3];  // unit quaternion, 1 / its original length, rotation, scales
    double r0[3], r1[3], n[3];                // rows of J W M, M = R S, and their cross product
    double a0, b0, c0, det0;                  // screen covariance before the dilation
    double a, b, c, det, inverse_det;         // and after it
    double opacity, compensation;             // opacity before antialiasing's compensation, and that factor
};

// Intermediate values of its colour.
template <class T>
struct Shade {
    T dir[3], distance;          // viewing direction
    T basis[16], color[3];       // harmonics; colour before the floor at 0
};

// The unit quaternion and 1 / |q|. False if q has zero length.
template <class T>
GSPLAT_INLINE bool unit_quaternion(const T *q, Projected &g) {
    double scale = 1, norm = 0;
    if (sizeof(T) == sizeof(double)) {  // squares of float neither overflow nor underflow in double; those of double may
        double largest = 0;
        for (int k = 0; k < 4; ++k) largest = vmax(largest, double(q[k] < 0 ? -q[k] : q[k]));
        scale = 1 / largest;
        if (!finite(scale)) return false;
    }
    for (int k = 0; k < 4; ++k) g.q[k] = double(q[k]) * scale, norm += g.q[k] * g.q[k];
    const double inverse = 1 / sqrt_(norm);
    if (!finite(inverse)) return false;
    for (int k = 0; k < 4; ++k) g.q[k] *= inverse;
    g.inverse_q_norm = inverse * scale;
    return true;
}

// Sigma2d = (J W M)(J W M)' + 0.3 I, and opacity. False if the Gaussian is behind the camera, too faint or not finite.
template <class T>
GSPLAT_INLINE bool project_shape(const Scene<T> &scene, const Camera &cam, const Settings &set, int64_t i, Projected &g) {
    for (int k = 0; k < 3; ++k) g.offset[k] = double(scene.means[3 * i + k]) - cam.eye[k];
    for (int k = 0; k < 3; ++k) g.p[k] = dot3(cam.R + 3 * k, g.offset);
    const double z = g.p[2];
    if (!(z > set.z_near)) return false;
    g.iz = 1 / z;
    const double x_z = g.p[0] * g.iz, y_z = g.p[1] * g.iz;
    g.clamped[0] = x_z < cam.x_low || x_z > cam.x_high, g.clamped[1] = y_z < cam.y_low || y_z > cam.y_high;
    g.ratio[0] = vmin(vmax(x_z, cam.x_low), cam.x_high), g.ratio[1] = vmin(vmax(y_z, cam.y_low), cam.y_high);
    for (int k = 0; k < 3; ++k) {
        g.t0[k] = cam.fx * g.iz * (cam.R[k] - g.ratio[0] * cam.R[6 + k]);
        g.t1[k] = cam.fy * g.iz * (cam.R[3 + k] - g.ratio[1] * cam.R[6 + k]);
    }
    if (scene.quats) {
        if (!unit_quaternion(scene.quats + 4 * i, g)) return false;
        rotation(g.q, g.R);
        for (int k = 0; k < 3; ++k) {
            g.s[k] = double(exp_(scene.log_scales[3 * i + k]));
            g.r0[k] = (g.t0[0] * g.R[k] + g.t0[1] * g.R[3 + k] + g.t0[2] * g.R[6 + k]) * g.s[k];
            g.r1[k] = (g.t1[0] * g.R[k] + g.t1[1] * g.R[3 + k] + g.t1[2] * g.R[6 + k]) * g.s[k];
        }
        g.a0 = dot3(g.r0, g.r0), g.b0 = dot3(g.r0, g.r1), g.c0 = dot3(g.r1, g.r1);
        // |n|² = a0 c0 - b0² without cancellation. n is not computed from r0 and r1, which are almost parallel for a needle.
        double flat[3];
        cross3(g.t0, g.t1, flat);
        for (int k = 0; k < 3; ++k)
            g.n[k] = g.s[(k + 1) % 3] * g.s[(k + 2) % 3] * (g.R[k] * flat[0] + g.R[3 + k] * flat[1] + g.R[6 + k] * flat[2]);
        g.det0 = dot3(g.n, g.n);
        g.opacity = double(1 / (1 + exp_(-scene.logit_opacities[i])));
    } else {
        double S[9];
        for (int k = 0; k < 9; ++k) S[k] = double(scene.cov3ds[9 * i + k]);
        for (int k = 0; k < 3; ++k) {  // r = t S here
            g.r0[k] = g.t0[0] * S[k] + g.t0[1] * S[3 + k] + g.t0[2] * S[6 + k];
            g.r1[k] = g.t1[0] * S[k] + g.t1[1] * S[3 + k] + g.t1[2] * S[6 + k];
        }
        g.a0 = dot3(g.r0, g.t0), g.b0 = dot3(g.r0, g.t1), g.c0 = dot3(g.r1, g.t1);
        g.det0 = vmax(g.a0 * g.c0 - g.b0 * g.b0, 0.0);
        g.opacity = double(scene.opacities[i]);
    }
    const double d = DILATION;
    g.a = g.a0 + d, g.b = g.b0, g.c = g.c0 + d;
    g.det = g.det0 + d * (g.a0 + g.c0) + d * d, g.inverse_det = 1 / g.det;
    g.compensation = set.antialiased ? sqrt_(vmax(g.det0, DET_FLOOR) * g.inverse_det) : 1.0;
    // The mean must be finite in the scene's type, the type of its gradients; so must z², so that weighted depths can be added.
    return finite(T(g.p[0] + g.p[1] + z * z)) && g.a + g.c <= SPLAT_LIMIT * SPLAT_LIMIT && finite(g.det) && g.det > 0 &&
           g.opacity * g.compensation >= ALPHA_MIN;
}

// The mean on the screen, u = fx x/z + cx and v, and the nearest point of the image, in the splat's type.
template <class T>
struct Position {
    double u, v;
    T x, y;
};

template <class T>
GSPLAT_INLINE Position<T> position(const Projected &g, const Camera &cam) {
    Position<T> at;
    at.u = cam.fx * g.p[0] * g.iz + cam.cx, at.v = cam.fy * g.p[1] * g.iz + cam.cy;
    at.x = T(vmin(vmax(at.u, 0.0), double(cam.W - 1))), at.y = T(vmin(vmax(at.v, 0.0), double(cam.H - 1)));
    return at;
}

// colour = sum_i b_i sh_i + 0.5, before the floor. False if it is not finite.
template <class T>
GSPLAT_INLINE bool project_color(const Scene<T> &scene, const Settings &set, int64_t i, const Projected &g, Shade<T> &shade) {
    if (!scene.quats) {
        for (int k = 0; k < 3; ++k) shade.color[k] = scene.colors[3 * i + k];
        return is_color(shade.color);
    }
    for (int k = 0; k < 3; ++k) shade.dir[k] = T(g.offset[k]);
    shade.distance = sqrt_(dot3(shade.dir, shade.dir));
    for (int k = 0; k < 3; ++k) shade.dir[k] /= shade.distance;
    harmonics(set.sh_degree, shade.dir[0], shade.dir[1], shade.dir[2], shade.basis);
    const int rest = (set.sh_degree + 1) * (set.sh_degree + 1) - 1;
    const T *sh = scene.sh_rest + 3 * int64_t(scene.rest) * i;
    for (int k = 0; k < 3; ++k) shade.color[k] = shade.basis[0] * scene.sh0[3 * i + k] + T(SH_OFFSET);
    for (int j = 0; j < rest; ++j)
        for (int k = 0; k < 3; ++k) shade.color[k] += shade.basis[j + 1] * sh[3 * j + k];
    return is_color(shade.color);
}

}  // namespace GSPLAT_ISA
}  // namespace gsplat

// The mathematics of a Gaussian, forward and backward: quaternion, covariance, projection, harmonics; a lane for each
// Gaussian. Mirrors src/gsplat_edu/scene/gaussian_math.py and sh.py. Compiled once per instruction set, like simd.h.
#pragma once

#include "kernels.h"
#include "lanes.h"
#include "sight.h"

namespace gsplat {
namespace GSPLAT_ISA {

// libm functions by type.
GSPLAT_INLINE float sqrt_(float x) { return sqrtf(x); }
GSPLAT_INLINE double sqrt_(double x) { return sqrt(x); }
GSPLAT_INLINE float ceil_(float x) { return ceilf(x); }
GSPLAT_INLINE double ceil_(double x) { return ceil(x); }
GSPLAT_INLINE float floor_(float x) { return floorf(x); }
GSPLAT_INLINE double floor_(double x) { return floor(x); }

// Finite, and at most COLOR_LIMIT, which no photo needs.
template <class T>
GSPLAT_INLINE bool is_color(const T *c) {
    const T limit = T(COLOR_LIMIT);
    return c[0] <= limit && c[1] <= limit && c[2] <= limit && c[0] >= -limit && c[1] >= -limit && c[2] >= -limit;
}

// Bound on the rounding error of a rim, px, if it is computed from numbers whose magnitudes add up to `size`.
GSPLAT_INLINE float rim_slack(float size) { return float(RIM_SLACK) + 0x1p-21f * size; }
GSPLAT_INLINE double rim_slack(double size) { return RIM_SLACK + 0x1p-50 * size; }
GSPLAT_INLINE VF rim_slack(VF size) { return splat(float(RIM_SLACK)) + splat(0x1p-21f) * size; }
GSPLAT_INLINE VD rim_slack(VD size) { return splat(RIM_SLACK) + splat(0x1p-50) * size; }

GSPLAT_INLINE float abs_(float x) { return fabsf(x); }
GSPLAT_INLINE double abs_(double x) { return fabs(x); }

template <class T>
GSPLAT_INLINE T dot3(const T *a, const T *b) {
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

template <class T>
GSPLAT_INLINE void cross3(const T *a, const T *b, T *out) {
    out[0] = a[1] * b[2] - a[2] * b[1], out[1] = a[2] * b[0] - a[0] * b[2], out[2] = a[0] * b[1] - a[1] * b[0];
}

// R(q) of the quaternion (w, x, y, z) of any length, row-major; `inverse` is 1 / |q|².
template <class V>
GSPLAT_INLINE void rotation(const V *q, V inverse, V *R) {
    const V w = q[0], x = q[1], y = q[2], z = q[3], one = V{} + 1, k = inverse + inverse;
    R[0] = one - k * (y * y + z * z), R[1] = k * (x * y - w * z), R[2] = k * (x * z + w * y);
    R[3] = k * (x * y + w * z), R[4] = one - k * (x * x + z * z), R[5] = k * (y * z - w * x);
    R[6] = k * (x * z - w * y), R[7] = k * (y * z + w * x), R[8] = one - k * (x * x + y * y);
}

// dL/dq of that quaternion from G = dL/dR: the gradient for a unit quaternion, less its part along q.
GSPLAT_INLINE void rotation_backward(const VD *q, VD inverse, const VD *G, VD *dq) {
    const VD w = q[0], x = q[1], y = q[2], z = q[3], k = inverse + inverse;
    dq[0] = k * (x * (G[7] - G[5]) + y * (G[2] - G[6]) + z * (G[3] - G[1]));
    dq[1] = k * (y * (G[1] + G[3]) + z * (G[2] + G[6]) + w * (G[7] - G[5]) - (x + x) * (G[4] + G[8]));
    dq[2] = k * (x * (G[1] + G[3]) + z * (G[5] + G[7]) + w * (G[2] - G[6]) - (y + y) * (G[0] + G[8]));
    dq[3] = k * (x * (G[2] + G[6]) + y * (G[5] + G[7]) + w * (G[3] - G[1]) - (z + z) * (G[0] + G[4]));
    const VD along = inverse * (dq[0] * w + dq[1] * x + dq[2] * y + dq[3] * z);
    for (int k = 0; k < 4; ++k) dq[k] -= along * q[k];
}

// The real spherical harmonics up to `degree` in direction (x, y, z): b has (degree + 1)² entries.
template <class T, class V>
GSPLAT_INLINE void harmonics(int degree, V x, V y, V z, V *b) {
    b[0] = splat(T(C0));
    if (degree < 1) return;
    b[1] = splat(T(-C1)) * y, b[2] = splat(T(C1)) * z, b[3] = splat(T(-C1)) * x;
    if (degree < 2) return;
    const V xx = x * x, yy = y * y, zz = z * z, zz2 = zz + zz;
    b[4] = splat(T(C2[0])) * x * y, b[5] = splat(T(C2[1])) * y * z, b[6] = splat(T(C2[2])) * (zz2 - xx - yy);
    b[7] = splat(T(C2[3])) * x * z, b[8] = splat(T(C2[4])) * (xx - yy);
    if (degree < 3) return;
    const V xx3 = splat(T(3)) * xx, yy3 = splat(T(3)) * yy, ring = zz2 + zz2 - xx - yy;
    b[9] = splat(T(C3[0])) * y * (xx3 - yy), b[10] = splat(T(C3[1])) * x * y * z, b[11] = splat(T(C3[2])) * y * ring;
    b[12] = splat(T(C3[3])) * z * (zz2 - xx3 - yy3), b[13] = splat(T(C3[4])) * x * ring;
    b[14] = splat(T(C3[5])) * z * (xx - yy), b[15] = splat(T(C3[6])) * x * (xx - yy3);
}

// dL/d(x, y, z) from g_i = dL/db_i.
template <class T, class V>
GSPLAT_INLINE void harmonics_backward(int degree, V x, V y, V z, const V *g, V *d) {
    d[0] = d[1] = d[2] = V{};
    if (degree < 1) return;
    const V c1 = splat(T(C1));
    d[0] = -c1 * g[3], d[1] = -c1 * g[1], d[2] = c1 * g[2];
    if (degree < 2) return;
    const V p = splat(T(C2[0])), q2 = splat(T(2 * C2[2])), r2 = splat(T(2 * C2[4]));
    d[0] += p * y * g[4] - q2 * x * g[6] - p * z * g[7] + r2 * x * g[8];
    d[1] += p * x * g[4] - p * z * g[5] - q2 * y * g[6] - r2 * y * g[8];
    d[2] += (q2 + q2) * z * g[6] - p * y * g[5] - p * x * g[7];
    if (degree < 3) return;
    const V xx = x * x, yy = y * y, zz4 = splat(T(4)) * z * z, three = splat(T(3));
    const V a3 = splat(T(3 * C3[6])), b = splat(T(C3[1])), c = splat(T(C3[4])), e3 = splat(T(3 * C3[3])), f = splat(T(C3[5]));
    const V xy2 = (x + x) * y, xz2 = (x + x) * z, yz2 = (y + y) * z, saddle = xx - yy;
    d[0] += a3 * xy2 * g[9] + b * y * z * g[10] - c * xy2 * g[11] - e3 * xz2 * g[12] + c * (zz4 - three * xx - yy) * g[13] +
            f * xz2 * g[14] + a3 * saddle * g[15];
    d[1] += a3 * saddle * g[9] + b * x * z * g[10] + c * (zz4 - xx - three * yy) * g[11] - e3 * yz2 * g[12] - c * xy2 * g[13] -
            f * yz2 * g[14] - a3 * xy2 * g[15];
    const V c8 = splat(T(8)) * c * z;
    d[2] += b * x * y * g[10] + c8 * y * g[11] + e3 * (splat(T(0.5)) * zz4 - xx - yy) * g[12] + c8 * x * g[13] + f * saddle * g[14];
}

// Gaussians that a kernel processes at a time: an array on the stack for each of their numbers. A multiple of every vector width.
constexpr int CHUNK = 64;

// The parameters of up to CHUNK Gaussians. Lanes of the last vector that have none of their own repeat the first Gaussian.
template <class T>
struct Chunk {
    int count, padded;
    alignas(64) T mean[3][CHUNK];
    T quat[4][CHUNK], scale[3][CHUNK];  // raw parameters; scales after exp
    double cov3d[9][CHUNK];             // covariances given directly
    T opacity[CHUNK];                   // after the sigmoid
    double time[CHUNK];                 // at which a rolling shutter sees them, see sight.h
};

template <class T>
GSPLAT_INLINE void gather(const Scene<T> &scene, const uint32_t *ids, int count, Chunk<T> &in) {
    using V = typename Vector<T>::V;
    constexpr int LANES = Vector<T>::LANES;
    in.count = count, in.padded = (count + LANES - 1) / LANES * LANES;
    for (int l = 0; l < in.padded; ++l) {
        const int64_t i = ids[l < count ? l : 0];
        for (int k = 0; k < 3; ++k) in.mean[k][l] = scene.means[3 * i + k];
        if (scene.quats) {
            for (int k = 0; k < 4; ++k) in.quat[k][l] = scene.quats[4 * i + k];
            for (int k = 0; k < 3; ++k) in.scale[k][l] = scene.log_scales[3 * i + k];
            in.opacity[l] = scene.logit_opacities[i];
        } else {
            for (int k = 0; k < 9; ++k) in.cov3d[k][l] = scene.cov3ds[9 * i + k];
            in.opacity[l] = scene.opacities[i];
        }
    }
    if (!scene.quats) return;
    const V one = splat(T(1));
    for (int l = 0; l < in.padded; l += LANES) {
        for (int k = 0; k < 3; ++k) store(in.scale[k] + l, exp_(load<V>(in.scale[k] + l)));
        store(in.opacity + l, one / (one + exp_(-load<V>(in.opacity + l))));
    }
}

// The times at which a rolling shutter sees a chunk; nothing for other cameras.
template <class T>
GSPLAT_INLINE void read_times(const Camera &cam, Chunk<T> &in) {
    if (!cam.moving) return;
    for (int l = 0; l < in.padded; l += WIDE) {
        VD offset[3], at_rest[3];
        for (int k = 0; k < 3; ++k) offset[k] = widened(in.mean[k] + l) - splat(cam.eye[k]);
        VD time;
        rotated(cam.R, offset, at_rest);
        time_of(cam, at_rest, time);
        store(in.time + l, time);
    }
}

// Fetches `count` numbers into the first cache while others are computed; `WRITE`: in order to write them.
template <int WRITE, class T>
GSPLAT_INLINE void fetch(const T *from, int count) {
    const char *byte = reinterpret_cast<const char *>(from);
    const int bytes = count * int(sizeof(T));
    for (int offset = 0; offset < bytes; offset += 64) __builtin_prefetch(byte + offset, WRITE);
    if (bytes) __builtin_prefetch(byte + bytes - 1, WRITE);
}

// Intermediate values of a projection, kept for the backward pass. Always in double: distant cameras, long lenses and thin
// ellipses lose digits here that float cannot spare, and the cost is once per Gaussian (docs/PRECISION.md).
struct Projected {
    VD offset[3], p[3];                   // mean - eye in world axes; mean in camera axes
    VD u, v, depth;                       // where it is seen, and its depth; of a pinhole, only the depth
    VD iz, ratio[2];                      // 1/z; x/z and y/z, clamped for the Jacobian
    MD clamped[2];                        // whether each was clamped
    VD t0[3], t1[3];                      // rows of J W
    VD q[4], inverse_q2, q_scale;         // quaternion times q_scale, 1 / |q|²
    VD R[9], s[3];                        // rotation, scales
    VD r0[3], r1[3], n[3];                // rows of J W M, M = R S, and their cross product
    VD a0, b0, c0, det0;                  // screen covariance before the dilation
    VD blur[2], along[3];                 // motion blur g, px, and g0 r1 - g1 r0; set if the camera has an exposure
    VD inverse_still;                     // 1 / determinant after the dilation, before the blur; the same
    VD a, b, c, inverse_c, inverse_det;   // and after both
    VD opacity, compensation;             // opacity before the factor of antialiasing and blur, and that factor
    MD valid;                             // before the camera, bright enough and finite
};

// The quaternion and 1 / |q|². Clears `valid` where q has zero length.
template <class T>
GSPLAT_INLINE void quaternion(const Chunk<T> &in, int l, Projected &g) {
    for (int k = 0; k < 4; ++k) g.q[k] = widened(in.quat[k] + l);
    g.q_scale = splat(1.0);
    if (sizeof(T) == sizeof(double)) {  // squares of float neither overflow nor underflow in double; those of double may
        VD largest = VD{};
        for (int k = 0; k < 4; ++k) largest = vmax(largest, abs_(g.q[k]));
        g.q_scale = splat(1.0) / largest;
        g.valid &= finite(g.q_scale);
        for (int k = 0; k < 4; ++k) g.q[k] *= g.q_scale;
    }
    g.inverse_q2 = splat(1.0) / (g.q[0] * g.q[0] + g.q[1] * g.q[1] + g.q[2] * g.q[2] + g.q[3] * g.q[3]);
    g.valid &= finite(g.inverse_q2);
}

// Mean in camera axes, and J W.
template <class T>
GSPLAT_INLINE void project_mean(const Chunk<T> &in, int l, const Camera &cam, const Settings &set, Projected &g) {
    const double *R = cam.R;
    for (int k = 0; k < 3; ++k) g.offset[k] = widened(in.mean[k] + l) - splat(cam.eye[k]);
    if (cam.lens != PINHOLE) {
        Sight seen;
        sight(cam, g.offset, cam.moving ? load<VD>(in.time + l) : VD{}, set.z_near, seen);
        for (int k = 0; k < 3; ++k) g.p[k] = seen.p[k], g.t0[k] = seen.t0[k], g.t1[k] = seen.t1[k];
        g.u = seen.u, g.v = seen.v, g.depth = seen.depth, g.valid = seen.valid;
        g.blur[0] = seen.blur[0], g.blur[1] = seen.blur[1];
        return;
    }
    for (int k = 0; k < 3; ++k)
        g.p[k] = splat(R[3 * k]) * g.offset[0] + splat(R[3 * k + 1]) * g.offset[1] + splat(R[3 * k + 2]) * g.offset[2];
    g.depth = g.p[2];
    g.valid = g.p[2] > splat(set.z_near);
    g.iz = splat(1.0) / g.p[2];
    const double low[2] = {cam.x_low, cam.y_low}, high[2] = {cam.x_high, cam.y_high};
    for (int k = 0; k < 2; ++k) {
        const VD r = g.p[k] * g.iz, least = splat(low[k]), most = splat(high[k]);
        g.clamped[k] = (r < least) | (r > most);
        g.ratio[k] = vmin(vmax(r, least), most);
    }
    const VD fx = splat(cam.fx) * g.iz, fy = splat(cam.fy) * g.iz;
    for (int k = 0; k < 3; ++k) {
        g.t0[k] = fx * (splat(R[k]) - g.ratio[0] * splat(R[6 + k]));
        g.t1[k] = fy * (splat(R[3 + k]) - g.ratio[1] * splat(R[6 + k]));
    }
}

// Sigma2d before the dilation, (J W M)(J W M)'.
template <class T>
GSPLAT_INLINE void project_covariance(const Chunk<T> &in, int l, bool raw, Projected &g) {
    if (raw) {
        quaternion(in, l, g);
        rotation(g.q, g.inverse_q2, g.R);
        for (int k = 0; k < 3; ++k) {
            g.s[k] = widened(in.scale[k] + l);
            g.r0[k] = (g.t0[0] * g.R[k] + g.t0[1] * g.R[3 + k] + g.t0[2] * g.R[6 + k]) * g.s[k];
            g.r1[k] = (g.t1[0] * g.R[k] + g.t1[1] * g.R[3 + k] + g.t1[2] * g.R[6 + k]) * g.s[k];
        }
        g.a0 = dot3(g.r0, g.r0), g.b0 = dot3(g.r0, g.r1), g.c0 = dot3(g.r1, g.r1);
        // |n|² = a0 c0 - b0² without cancellation. n is not computed from r0 and r1, which are almost parallel for a needle.
        VD flat[3];
        cross3(g.t0, g.t1, flat);
        for (int k = 0; k < 3; ++k)
            g.n[k] = g.s[(k + 1) % 3] * g.s[(k + 2) % 3] * (g.R[k] * flat[0] + g.R[3 + k] * flat[1] + g.R[6 + k] * flat[2]);
        g.det0 = dot3(g.n, g.n);
    } else {
        VD S[9];
        for (int k = 0; k < 9; ++k) S[k] = load<VD>(in.cov3d[k] + l);
        for (int k = 0; k < 3; ++k) {  // r = t S here
            g.r0[k] = g.t0[0] * S[k] + g.t0[1] * S[3 + k] + g.t0[2] * S[6 + k];
            g.r1[k] = g.t1[0] * S[k] + g.t1[1] * S[3 + k] + g.t1[2] * S[6 + k];
        }
        g.a0 = dot3(g.r0, g.t0), g.b0 = dot3(g.r0, g.t1), g.c0 = dot3(g.r1, g.t1);
        g.det0 = vmax(g.a0 * g.c0 - g.b0 * g.b0, VD{});
    }
}

// Adds motion blur, g g', to the dilated covariance; returns its determinant from that before. No term of the difference,
// g' adj(Sigma2d + d I) g, is negative.
GSPLAT_INLINE VD blurred(bool raw, VD dilation, VD det, Projected &g) {
    const VD x = g.blur[0], y = g.blur[1];
    VD more = dilation * (x * x + y * y);
    if (raw) {
        for (int k = 0; k < 3; ++k) g.along[k] = x * g.r1[k] - y * g.r0[k];
        more += dot3(g.along, g.along);
    } else {
        more += vmax(x * x * g.c0 - (x + x) * y * g.b0 + y * y * g.a0, VD{});
    }
    g.a += x * x, g.b += x * y, g.c += y * y;
    g.inverse_still = splat(1.0) / det;
    return det + more;
}

// Sigma2d = (J W M)(J W M)' + d I + g g' with the dilation d and the blur g, and opacity, of the Gaussians in lanes l and up.
template <class T>
GSPLAT_INLINE void project_shape(const Chunk<T> &in, int l, bool raw, const Camera &cam, const Settings &set, Projected &g) {
    project_mean(in, l, cam, set, g);
    project_covariance(in, l, raw, g);
    g.opacity = widened(in.opacity + l);
    const VD d = splat(set.dilation);
    g.a = g.a0 + d, g.b = g.b0, g.c = g.c0 + d;
    VD det = g.det0 + d * (g.a0 + g.c0) + splat(set.dilation2);
    const VD still = det;
    if (cam.spread != 0) det = blurred(raw, d, det, g);
    const VD inverse = splat(1.0) / (g.c * det);  // one division for two
    g.inverse_c = inverse * det, g.inverse_det = inverse * g.c;
    g.compensation = splat(1.0);
    if (set.antialiased)
        g.compensation = sqrt_(vmax(g.det0, splat(DET_FLOOR)) * g.inverse_det);
    else if (cam.spread != 0)
        g.compensation = sqrt_(still * g.inverse_det);
    // The mean must be finite in the scene's type, the type of its gradients; so must z², so that weighted depths can be added.
    g.valid &= finite(rounded<T>(g.p[0] + g.p[1] + g.depth * g.depth)) & (g.a + g.c <= splat(SPLAT_LIMIT * SPLAT_LIMIT)) & finite(det) &
               (det > splat(THINNEST) * (g.a + g.c)) & (g.opacity * g.compensation >= splat(ALPHA_MIN));
}

// The mean on the screen, u = fx x/z + cx and v, and the nearest point of the image, rounded to the splat's type.
struct Position {
    VD u, v, x, y;
};

template <class T>
GSPLAT_INLINE Position position(const Projected &g, const Camera &cam) {
    Position at;
    if (cam.lens == PINHOLE)
        at.u = splat(cam.fx) * g.p[0] * g.iz + splat(cam.cx), at.v = splat(cam.fy) * g.p[1] * g.iz + splat(cam.cy);
    else
        at.u = g.u, at.v = g.v;
    at.x = rounded<T>(vmin(vmax(at.u, VD{}), splat(double(cam.W - 1))));
    at.y = rounded<T>(vmin(vmax(at.v, VD{}), splat(double(cam.H - 1))));
    return at;
}

// Viewing directions and harmonics of a chunk.
template <class T>
struct Shade {
    alignas(64) T dir[3][CHUNK], inverse_distance[CHUNK];
    T basis[16][CHUNK];
};

template <class T>
GSPLAT_INLINE void shade(const Chunk<T> &in, const Camera &cam, int degree, Shade<T> &out) {
    using V = typename Vector<T>::V;
    for (int l = 0; l < in.padded; l += WIDE)
        for (int k = 0; k < 3; ++k) {
            VD offset = widened(in.mean[k] + l) - splat(cam.eye[k]);
            if (cam.moving) offset -= load<VD>(in.time + l) * splat(cam.shift[k]);
            if (cam.lens == ORTHOGRAPHIC) offset = splat(cam.R[6 + k]);
            narrowed(out.dir[k] + l, offset);
        }
    for (int l = 0; l < in.padded; l += Vector<T>::LANES) {
        V d[3], b[16];
        for (int k = 0; k < 3; ++k) d[k] = load<V>(out.dir[k] + l);
        const V inverse = splat(T(1)) / sqrt_(dot3(d, d));
        for (int k = 0; k < 3; ++k) d[k] *= inverse, store(out.dir[k] + l, d[k]);
        store(out.inverse_distance + l, inverse);
        harmonics<T>(degree, d[0], d[1], d[2], b);
        for (int j = 0; j < (degree + 1) * (degree + 1); ++j) store(out.basis[j] + l, b[j]);
    }
}

// Four numbers: the three channels, and one that is not used.
template <class T>
struct Channels;

template <>
struct Channels<float> {
    typedef float V __attribute__((vector_size(16)));
};

template <>
struct Channels<double> {
    typedef double V __attribute__((vector_size(32)));
};

template <class T>
GSPLAT_INLINE typename Channels<T>::V channels(const T *rgb) {
    return typename Channels<T>::V{rgb[0], rgb[1], rgb[2], T(0)};
}

// colour = sum_i b_i(direction) sh_i + 0.5, before the floor, of Gaussian i in lane l.
template <int DEGREE, class T>
GSPLAT_INLINE typename Channels<T>::V color_of(const Scene<T> &scene, const Shade<T> &shade, int l, int64_t i) {
    using V = typename Channels<T>::V;
    constexpr int LAST = (DEGREE + 1) * (DEGREE + 1) - 1;
    V even = channels(scene.sh0 + 3 * i) * shade.basis[0][l] + T(SH_OFFSET), odd = V{};
    if (LAST == 0) return even;
    const T *sh = scene.sh_rest + 3 * int64_t(scene.rest) * i;
#pragma GCC unroll 16
    for (int j = 1; j < LAST; ++j) (j % 2 ? odd : even) += load<V>(sh + 3 * j - 3) * shade.basis[j][l];
    return even + odd + channels(sh + 3 * LAST - 3) * shade.basis[LAST][l];  // a load of four could leave the array
}

// Calls f with the degree as a constant: f.template operator()<DEGREE>().
template <class F>
GSPLAT_INLINE void with_degree(int degree, F f) {
    if (degree == 0) f.template operator()<0>();
    if (degree == 1) f.template operator()<1>();
    if (degree == 2) f.template operator()<2>();
    if (degree == 3) f.template operator()<3>();
}

}  // namespace GSPLAT_ISA
}  // namespace gsplat

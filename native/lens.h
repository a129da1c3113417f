// Projections other than the pinhole: place on the plane, Jacobian, and their adjoints; a lane for each Gaussian.
//
//     (u, v) = f D(C(p)) + c,   C: core (perspective, fisheye, equirectangular, orthographic),   D: distortion
//
// Mirrors src/gsplat_edu/scene/projection_formulas.py, which has the formulas of the values; the adjoints are written here. A
// cotangent of a Jacobian needs second derivatives. Compiled once per instruction set, like simd.h; all in double.
#pragma once

#include "kernels.h"
#include "lanes.h"

namespace gsplat {
namespace GSPLAT_ISA {

constexpr double PI = 3.14159265358979323846;
constexpr int SERIES = 12;  // last power of the series of theta / r

// atan(√t) / √t for 0 <= t <= NEAR_AXIS, and its first two derivatives.
GSPLAT_INLINE void arc_series(VD t, VD &value, VD &slope, VD &curve) {
    value = slope = curve = VD{};
    for (int n = SERIES; n >= 0; --n) {
        curve = curve * t + (slope + slope);
        slope = slope * t + value;
        value = value * t + splat((n % 2 ? -1.0 : 1.0) / (2 * n + 1));
    }
}

// atan2(y, x) for y >= 0, in [0, pi]. The ratio is halved in angle twice, to at most tan(pi / 16), for the series.
GSPLAT_INLINE VD angle_of(VD y, VD x) {
    const VD one = splat(1.0), across = x < VD{} ? -x : x;
    const MD steep = y > across;
    VD t = (steep ? across : y) / (steep ? y : across);
    t = y + across > VD{} ? t : VD{};  // 0 / 0
    for (int k = 0; k < 2; ++k) t = t / (one + sqrt_(one + t * t));
    VD value, slope, curve;
    arc_series(t * t, value, slope, curve);
    VD angle = splat(4.0) * t * value;
    angle = steep ? splat(PI / 2) - angle : angle;
    return x < VD{} ? splat(PI) - angle : angle;
}

// atan2(y, x) in (-pi, pi].
GSPLAT_INLINE VD signed_angle(VD y, VD x) {
    const VD angle = angle_of(y < VD{} ? -y : y, x);
    return y < VD{} ? -angle : angle;
}

// A point's place (a, b), and J = d(a, b) / dp, two rows. Of an equirectangular projection, `ellipse` is the first row with the
// bound at the poles; otherwise it is not used.
struct OnPlane {
    VD a, b;
    VD J[2][3];
    VD ellipse[3];
};

// theta / r, and its derivatives by s = r² and z.
struct Arc {
    VD A, s1, z1, s2, sz, z2;
};

GSPLAT_INLINE Arc arc_of(VD s, VD z) {
    const VD one = splat(1.0), half = splat(0.5);
    const MD near = (z > VD{}) & (s < splat(NEAR_AXIS) * z * z);
    const VD away = near ? one : s, depth = near ? z : one;
    const VD iz = one / depth, iz2 = iz * iz;
    VD value, slope, curve;
    arc_series((near ? s : VD{}) * iz2, value, slope, curve);
    const VD r = sqrt_(away), p2 = s + z * z, inverse = one / p2;
    const VD far = angle_of(r, z) / r, twice = half / away;
    const VD far_s = (z * inverse - far) * twice;
    Arc arc;
    arc.A = near ? value * iz : far;
    arc.s1 = near ? slope * iz2 * iz : far_s;
    arc.s2 = near ? curve * iz2 * iz2 * iz : -(z * inverse * inverse + splat(3.0) * far_s) * twice;
    arc.z1 = -inverse, arc.sz = inverse * inverse, arc.z2 = (z + z) * arc.sz;
    return arc;
}

GSPLAT_INLINE void core(const Camera &cam, const VD *p, OnPlane &out) {
    const VD x = p[0], y = p[1], z = p[2], zero = VD{}, one = splat(1.0);
    if (cam.lens == PERSPECTIVE) {
        const VD iz = one / z;
        out.a = x * iz, out.b = y * iz;
        out.J[0][0] = out.J[1][1] = iz, out.J[0][1] = out.J[1][0] = zero;
        out.J[0][2] = -out.a * iz, out.J[1][2] = -out.b * iz;
    } else if (cam.lens == FISHEYE) {
        const Arc arc = arc_of(x * x + y * y, z);
        const VD two = arc.s1 + arc.s1;
        out.a = x * arc.A, out.b = y * arc.A;
        out.J[0][0] = arc.A + two * x * x, out.J[1][1] = arc.A + two * y * y, out.J[0][1] = out.J[1][0] = two * x * y;
        out.J[0][2] = x * arc.z1, out.J[1][2] = y * arc.z1;
    } else if (cam.lens == EQUIRECTANGULAR) {
        const VD h2 = x * x + z * z, p2 = h2 + y * y, h = sqrt_(h2), pole = splat(POLE) * sqrt_(p2);
        const VD along = one / (h * vmax(h, pole)), plain = one / h2, down = y / (p2 * h);
        out.a = signed_angle(x, z), out.b = signed_angle(y, h);
        out.J[0][0] = z * plain, out.J[0][1] = zero, out.J[0][2] = -x * plain;
        out.ellipse[0] = z * along, out.ellipse[1] = zero, out.ellipse[2] = -x * along;
        out.J[1][0] = -x * down, out.J[1][1] = h / p2, out.J[1][2] = -z * down;
    } else {
        out.a = x, out.b = y;
        out.J[0][0] = out.J[1][1] = one;
        out.J[0][1] = out.J[0][2] = out.J[1][0] = out.J[1][2] = zero;
    }
}

// Adds to dp what the core's Jacobian passes on of its cotangent G, by second derivatives; `ellipse`: that of the row of that name.
GSPLAT_INLINE void core_curvature(const Camera &cam, const VD *p, const VD (*G)[3], const VD *ellipse, VD *dp) {
    const VD x = p[0], y = p[1], z = p[2], one = splat(1.0), two = splat(2.0);
    if (cam.lens == PERSPECTIVE) {
        const VD iz = one / z, iz2 = iz * iz;
        dp[0] -= G[0][2] * iz2, dp[1] -= G[1][2] * iz2;
        dp[2] += iz2 * (two * iz * (x * G[0][2] + y * G[1][2]) - G[0][0] - G[1][1]);
    } else if (cam.lens == FISHEYE) {
        const Arc arc = arc_of(x * x + y * y, z);
        const VD mixed = G[0][1] + G[1][0], trace = G[0][0] + G[1][1];
        const VD by_s = two * (x * x * G[0][0] + x * y * mixed + y * y * G[1][1]), by_z = x * G[0][2] + y * G[1][2];
        const VD e = two * (trace * arc.s1 + by_s * arc.s2 + by_z * arc.sz);
        dp[0] += arc.s1 * (splat(4.0) * x * G[0][0] + two * y * mixed) + arc.z1 * G[0][2] + x * e;
        dp[1] += arc.s1 * (splat(4.0) * y * G[1][1] + two * x * mixed) + arc.z1 * G[1][2] + y * e;
        dp[2] += trace * arc.z1 + by_s * arc.sz + by_z * arc.z2;
    } else if (cam.lens == EQUIRECTANGULAR) {
        const VD h2 = x * x + z * z, p2 = h2 + y * y, h = sqrt_(h2), p_ = sqrt_(p2);
        const VD ih = one / h, ih2 = ih * ih, ip2 = one / p2, ip4 = ip2 * ip2;
        // The longitude: (z, 0, -x) E, with E = 1 / h², or 1 / (h max(h, POLE p)).
        const MD bounded = h < splat(POLE) * p_;
        const VD E = ih2, F = bounded ? ih / (splat(POLE) * p_) : ih2;
        const VD dE = -(two * E * ih2) * (G[0][0] * z - G[0][2] * x);  // by x and z, times x and z
        const VD dF = -F * (ellipse[0] * z - ellipse[2] * x), spread = bounded ? ih2 + ip2 : two * ih2;
        dp[0] += -G[0][2] * E - ellipse[2] * F + x * (dE + dF * spread);
        dp[2] += G[0][0] * E + ellipse[0] * F + z * (dE + dF * spread);
        dp[1] += bounded ? y * dF * ip2 : VD{};
        // The latitude: (f_h x / h, f_y, f_h z / h), with f = atan2(y, h).
        const VD n = (x * G[1][0] + z * G[1][2]) * ih;
        const VD f_h = -y * ip2, f_hh = two * h * y * ip4, f_hy = (y * y - h2) * ip4;
        const VD by_h = f_hh * n + f_hy * G[1][1];
        const VD cross = (z * G[1][0] - x * G[1][2]) * ih2 * ih;  // G . d(x / h, z / h): z cross, -x cross
        dp[0] += by_h * x * ih + f_h * z * cross;
        dp[2] += by_h * z * ih - f_h * x * cross;
        dp[1] += f_hy * n - f_hh * G[1][1];
    }
}

// R(q) = N / D of a distortion, and its derivatives.
struct Radial {
    VD R, first, second, inverse, below1;  // 1 / D, D'
};

GSPLAT_INLINE Radial radial_of(const double *c, VD q) {
    VD N = VD{}, N1 = VD{}, N2 = VD{}, D = VD{}, D1 = VD{}, D2 = VD{};
    for (int i = 5; i >= 0; --i) N2 = N2 * q + (N1 + N1), N1 = N1 * q + N, N = N * q + splat(c[i]);
    N2 = N2 * q + (N1 + N1), N1 = N1 * q + N, N = N * q + splat(1.0);
    for (int i = 2; i >= 0; --i) D2 = D2 * q + (D1 + D1), D1 = D1 * q + D, D = D * q + splat(c[6 + i]);
    D2 = D2 * q + (D1 + D1), D1 = D1 * q + D, D = D * q + splat(1.0);
    Radial r;
    r.inverse = splat(1.0) / D, r.below1 = D1;
    r.R = N * r.inverse, r.first = (N1 - r.R * D1) * r.inverse;
    r.second = (N2 - r.R * D2 - (r.first + r.first) * D1) * r.inverse;
    return r;
}

// Decentring and prism at (A, B): the shift m, and its Jacobian.
struct Decentred {
    VD m[2], E[2][2];
};

GSPLAT_INLINE Decentred decentred_of(const double *c, VD A, VD B) {
    const VD p1 = splat(c[9]), p2 = splat(c[10]), s1 = splat(c[11]), s2 = splat(c[12]), s3 = splat(c[13]), s4 = splat(c[14]);
    const VD two = splat(2.0), Q = A * A + B * B, first = two * (s1 + two * s2 * Q), second = two * (s3 + two * s4 * Q);
    Decentred d;
    d.m[0] = two * p1 * A * B + p2 * (Q + two * A * A) + Q * (s1 + s2 * Q);
    d.m[1] = p1 * (Q + two * B * B) + two * p2 * A * B + Q * (s3 + s4 * Q);
    const VD mixed = two * (p1 * A + p2 * B), six = splat(6.0);
    d.E[0][0] = two * p1 * B + six * p2 * A + first * A, d.E[0][1] = mixed + first * B;
    d.E[1][0] = mixed + second * A, d.E[1][1] = six * p1 * B + two * p2 * A + second * B;
    return d;
}

// (a', b') and K = d(a', b') / d(a, b).
GSPLAT_INLINE void distort(const Camera &cam, VD a, VD b, VD *place, VD (*K)[2]) {
    const double *c = cam.coefficients;
    const Radial r = radial_of(c, a * a + b * b);
    const VD two = r.first + r.first;
    const VD k00 = r.R + two * a * a, k01 = two * a * b, k11 = r.R + two * b * b;
    const VD A = cam.radial_first ? r.R * a : a, B = cam.radial_first ? r.R * b : b;
    const Decentred d = decentred_of(c, A, B);
    place[0] = r.R * a + d.m[0], place[1] = r.R * b + d.m[1];
    if (cam.radial_first) {
        K[0][0] = k00 + d.E[0][0] * k00 + d.E[0][1] * k01, K[0][1] = k01 + d.E[0][0] * k01 + d.E[0][1] * k11;
        K[1][0] = k01 + d.E[1][0] * k00 + d.E[1][1] * k01, K[1][1] = k11 + d.E[1][0] * k01 + d.E[1][1] * k11;
    } else {
        K[0][0] = k00 + d.E[0][0], K[0][1] = k01 + d.E[0][1], K[1][0] = k01 + d.E[1][0], K[1][1] = k11 + d.E[1][1];
    }
}

// Adds to (da, db) and, if not null, to the coefficients' dc what decentring passes on of the cotangents g of its shift and G of its
// Jacobian.
GSPLAT_INLINE void decentred_adjoint(const double *c, VD A, VD B, const VD *g, const VD (*G)[2], VD *dA, VD *dc) {
    const VD p1 = splat(c[9]), p2 = splat(c[10]), s2 = splat(c[12]), s4 = splat(c[14]), two = splat(2.0), six = splat(6.0);
    const VD Q = A * A + B * B, eight = splat(8.0);
    const VD first = two * (splat(c[11]) + two * s2 * Q), second = two * (splat(c[13]) + two * s4 * Q);
    const Decentred d = decentred_of(c, A, B);
    const VD x2 = eight * s2, x4 = eight * s4, AA = A * A, AB = A * B, BB = B * B;
    dA[0] += d.E[0][0] * g[0] + d.E[1][0] * g[1] + G[0][0] * (six * p2 + first + x2 * AA) + G[0][1] * (two * p1 + x2 * AB) +
             G[1][0] * (two * p1 + second + x4 * AA) + G[1][1] * (two * p2 + x4 * AB);
    dA[1] += d.E[0][1] * g[0] + d.E[1][1] * g[1] + G[0][0] * (two * p1 + x2 * AB) + G[0][1] * (two * p2 + first + x2 * BB) +
             G[1][0] * (two * p2 + x4 * AB) + G[1][1] * (six * p1 + second + x4 * BB);
    if (!dc) return;
    const VD mixed = G[0][1] + G[1][0], row0 = G[0][0] * A + G[0][1] * B, row1 = G[1][0] * A + G[1][1] * B, four = splat(4.0);
    dc[9] += two * AB * g[0] + (Q + two * BB) * g[1] + two * (G[0][0] * B + mixed * A) + six * G[1][1] * B;
    dc[10] += (Q + two * AA) * g[0] + two * AB * g[1] + six * G[0][0] * A + two * (mixed * B + G[1][1] * A);
    dc[11] += Q * g[0] + two * row0, dc[12] += Q * (Q * g[0] + four * row0);
    dc[13] += Q * g[1] + two * row1, dc[14] += Q * (Q * g[1] + four * row1);
}

// The same for the radial factor: places R a, R b with the cotangents g, and their Jacobian with G.
GSPLAT_INLINE void radial_adjoint(const double *c, VD a, VD b, const VD *g, const VD (*G)[2], VD *da, VD *dc) {
    const VD q = a * a + b * b, two = splat(2.0);
    const Radial r = radial_of(c, q);
    const VD mixed = G[0][1] + G[1][0], quadratic = two * (G[0][0] * a * a + mixed * a * b + G[1][1] * b * b);
    const VD by_R = g[0] * a + g[1] * b + G[0][0] + G[1][1];
    const VD by_q = two * (r.first * by_R + r.second * quadratic);
    da[0] += r.R * g[0] + two * r.first * (two * G[0][0] * a + mixed * b) + a * by_q;
    da[1] += r.R * g[1] + two * r.first * (two * G[1][1] * b + mixed * a) + b * by_q;
    if (!dc) return;
    VD lower = splat(1.0);  // q^(i - 1)
    for (int i = 1; i <= 6; ++i, lower *= q) {
        const VD value = lower * q * r.inverse, slope = (splat(double(i)) * lower - value * r.below1) * r.inverse;
        dc[i - 1] += by_R * value + quadratic * slope;
        if (i > 3) continue;
        const VD below = -r.R * value;  // dR / dd_i
        const VD below_slope = (-r.R * splat(double(i)) * lower - below * r.below1 - r.first * lower * q) * r.inverse;
        dc[5 + i] += by_R * below + quadratic * below_slope;
    }
}

// Adds the cotangents of (a, b) and, if not null, of the coefficients.
GSPLAT_INLINE void distort_adjoint(const Camera &cam, VD a, VD b, const VD *g, const VD (*G)[2], VD *da, VD *dc) {
    const double *c = cam.coefficients;
    if (!cam.radial_first) {
        radial_adjoint(c, a, b, g, G, da, dc);
        decentred_adjoint(c, a, b, g, G, da, dc);
        return;
    }
    // K = (I + E) K_r at (A, B) = (R a, R b)
    const Radial r = radial_of(c, a * a + b * b);
    const VD two = r.first + r.first, A = r.R * a, B = r.R * b;
    const VD k[2][2] = {{r.R + two * a * a, two * a * b}, {two * a * b, r.R + two * b * b}};
    const Decentred d = decentred_of(c, A, B);
    VD of_E[2][2], of_radial[2][2], through[2] = {g[0], g[1]};
    for (int i = 0; i < 2; ++i)
        for (int j = 0; j < 2; ++j) {
            of_E[i][j] = G[i][0] * k[j][0] + G[i][1] * k[j][1];
            of_radial[i][j] = G[i][j] + d.E[0][i] * G[0][j] + d.E[1][i] * G[1][j];
        }
    decentred_adjoint(c, A, B, g, of_E, through, dc);
    radial_adjoint(c, a, b, through, of_radial, da, dc);
}

// The image point of p, and two Jacobians by camera axes, px: the true one, and that of the ellipse, which differs at the poles of an
// equirectangular projection only.
struct Image {
    VD at[2];
    VD J[2][3], ellipse[2][3];
};

GSPLAT_INLINE void image_of(const Camera &cam, const VD *p, Image &out) {
    OnPlane on;
    core(cam, p, on);
    VD place[2] = {on.a, on.b};
    const VD f[2] = {splat(cam.fx), splat(cam.fy)};
    if (cam.distorted) {
        VD K[2][2];
        distort(cam, on.a, on.b, place, K);
        for (int i = 0; i < 2; ++i)
            for (int k = 0; k < 3; ++k) out.J[i][k] = f[i] * (K[i][0] * on.J[0][k] + K[i][1] * on.J[1][k]);
    } else {
        for (int i = 0; i < 2; ++i)
            for (int k = 0; k < 3; ++k) out.J[i][k] = f[i] * on.J[i][k];
    }
    for (int i = 0; i < 2; ++i)
        for (int k = 0; k < 3; ++k) out.ellipse[i][k] = out.J[i][k];
    if (cam.lens == EQUIRECTANGULAR)
        for (int k = 0; k < 3; ++k) out.ellipse[0][k] = f[0] * on.ellipse[k];
    out.at[0] = f[0] * place[0] + splat(cam.cx), out.at[1] = f[1] * place[1] + splat(cam.cy);
}

// The point at which the ellipse of a perspective lens takes its Jacobian: x/z and y/z of p are moved into the camera's bounds.
struct Clamped {
    VD p[3];
    MD moved[2];
};

GSPLAT_INLINE void clamp_point(const Camera &cam, const VD *p, Clamped &out) {
    const double low[2] = {cam.x_low, cam.y_low}, high[2] = {cam.x_high, cam.y_high};
    for (int k = 0; k < 2; ++k) {
        const VD least = splat(low[k]) * p[2], most = splat(high[k]) * p[2];
        const MD below = p[k]<least, above = p[k]> most;
        out.p[k] = below ? least : above ? most : p[k];
        out.moved[k] = below | above;
    }
    out.p[2] = p[2];
}

// Adds to dp what the clamped point passes on of its cotangent d. A moved coordinate is the bound, a constant, times z.
GSPLAT_INLINE void clamp_adjoint(const Clamped &at, const VD *d, VD *dp) {
    dp[2] += d[2];
    for (int k = 0; k < 2; ++k) {
        dp[k] += at.moved[k] ? VD{} : d[k];
        dp[2] += at.moved[k] ? d[k] * (at.p[k] / at.p[2]) : VD{};
    }
}

// Cotangents of an `Image`: of the point, of J and of `ellipse`.
struct ImageGradient {
    VD at[2];
    VD J[2][3], ellipse[2][3];
};

// Adds to dp; and, if not null, to `lens`: fx, fy, cx, cy and the coefficients.
GSPLAT_INLINE void image_adjoint(const Camera &cam, const VD *p, const ImageGradient &in, VD *dp, VD *lens) {
    OnPlane on;
    core(cam, p, on);
    const VD f[2] = {splat(cam.fx), splat(cam.fy)};
    const bool bounded = cam.lens == EQUIRECTANGULAR;
    VD G[2][3], first[3];  // cotangents of the Jacobian before the focal lengths; of the bounded row
    for (int k = 0; k < 3; ++k) {
        first[k] = bounded ? in.ellipse[0][k] * f[0] : VD{};
        G[0][k] = f[0] * (bounded ? in.J[0][k] : in.J[0][k] + in.ellipse[0][k]), G[1][k] = f[1] * (in.J[1][k] + in.ellipse[1][k]);
    }
    const VD g[2] = {f[0] * in.at[0], f[1] * in.at[1]};
    VD place[2] = {on.a, on.b}, K[2][2] = {{splat(1.0), VD{}}, {VD{}, splat(1.0)}};
    VD da[2] = {g[0], g[1]}, of_core[2][3];
    if (cam.distorted) {
        distort(cam, on.a, on.b, place, K);
        VD of_K[2][2];
        for (int i = 0; i < 2; ++i)
            for (int j = 0; j < 2; ++j) of_K[i][j] = G[i][0] * on.J[j][0] + G[i][1] * on.J[j][1] + G[i][2] * on.J[j][2];
        da[0] = da[1] = VD{};
        distort_adjoint(cam, on.a, on.b, g, of_K, da, lens ? lens + 4 : nullptr);
    }
    for (int j = 0; j < 2; ++j)
        for (int k = 0; k < 3; ++k) of_core[j][k] = K[0][j] * G[0][k] + K[1][j] * G[1][k];
    for (int k = 0; k < 3; ++k) dp[k] += on.J[0][k] * da[0] + on.J[1][k] * da[1];
    core_curvature(cam, p, of_core, first, dp);
    if (!lens) return;
    for (int i = 0; i < 2; ++i) {
        VD by_f = in.at[i] * place[i];
        for (int k = 0; k < 3; ++k) {
            const VD row = K[i][0] * on.J[0][k] + K[i][1] * on.J[1][k];
            by_f += (bounded && i == 0 ? in.J[0][k] : in.J[i][k] + in.ellipse[i][k]) * row;
            if (bounded && i == 0) by_f += in.ellipse[0][k] * on.ellipse[k];
        }
        lens[i] += by_f, lens[2 + i] += in.at[i];
    }
}

}  // namespace GSPLAT_ISA
}  // namespace gsplat

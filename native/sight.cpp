// sight: where a camera with any projection, at rest or with a rolling shutter, sees Gaussians; and the adjoint.
//
//     p(t) = C(w t) R (x - eye - V t),   (u, v) = image(p),   t = pace (q - middle),   q: v, or u of columns that are read in turn
//     rows of J W:   R' C' B,   B = J + k w_image (J of q),   w_image = J dp/dt,   k = pace / (1 - pace w_image of q)
//
//     blur:  exposure / sqrt(12) w_image / (1 - pace w_image of q)
//
// B of a perspective lens is that of the clamped point, whose J, dp/dt and k it takes; so does the blur. t is tau - 1/2, and pace is 0
// for a global shutter. Mirrors src/gsplat_edu/scene/sight.py, which names the symbols. The adjoint follows the implicit function theorem:
// with S, the cotangent of t at fixed parameters, the image position q gets k S in addition.
#include "sight.h"

#include "isa.h"
#include "lens.h"

namespace gsplat {
namespace GSPLAT_ISA {

constexpr int SHUTTER_STEPS = 3;
constexpr double SETTLED = 0.1;  // largest distance between a point's row and the row at whose time it is seen, px
constexpr double FASTEST = 0.5;  // largest fraction of the readout's speed at which a point moves along it

GSPLAT_INLINE void cross_(const VD *a, const VD *b, VD *out) {
    const VD x = a[1] * b[2] - a[2] * b[1], y = a[2] * b[0] - a[0] * b[2], z = a[0] * b[1] - a[1] * b[0];
    out[0] = x, out[1] = y, out[2] = z;
}

GSPLAT_INLINE VD dot_(const VD *a, const VD *b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

GSPLAT_INLINE void rotated_back(const double *R, const VD *v, VD *out) {
    for (int k = 0; k < 3; ++k) out[k] = splat(R[k]) * v[0] + splat(R[3 + k]) * v[1] + splat(R[6 + k]) * v[2];
}

// Cayley's map of half the turn h, or of -h: v + f (h x v + h x (h x v)).
template <bool BACK>
GSPLAT_INLINE void turned(const VD *h, VD f, const VD *v, VD *out) {
    VD once[3], twice[3];
    cross_(h, v, once), cross_(h, once, twice);
    for (int k = 0; k < 3; ++k) out[k] = v[k] + f * (BACK ? twice[k] - once[k] : twice[k] + once[k]);
}

// A camera's view of a point at a time.
struct Moment {
    VD time, h[3], f;     // t, w t / 2, 2 / (1 + |h|²)
    VD from[3], p[3];     // R (x - eye - V t), and turned
    VD shift[3];          // C R V
    VD rate[3];           // dp/dt
    VD speed[2];          // w_image
    Image image;
};

// What the ellipse takes of a moment, at the clamped point if the camera has bounds.
struct Shear {
    Clamped at;
    VD rate[3], speed[2], follows, k;  // 1 / (1 - pace w_image of q), and pace times that
    Image image;
};

GSPLAT_INLINE void moment_of(const Camera &cam, const VD *at_rest, VD time, Moment &m) {
    VD shift[3], spin[3], half_turn[3];
    m.time = time;
    for (int k = 0; k < 3; ++k) m.h[k] = splat(0.5 * cam.turn[k]) * time;
    m.f = splat(2.0) / (splat(1.0) + dot_(m.h, m.h));
    for (int k = 0; k < 3; ++k) {
        shift[k] = splat(cam.R[3 * k] * cam.shift[0] + cam.R[3 * k + 1] * cam.shift[1] + cam.R[3 * k + 2] * cam.shift[2]);
        m.from[k] = at_rest[k] - time * shift[k];
        half_turn[k] = splat(0.5 * cam.turn[k]) * m.f;
    }
    turned<false>(m.h, m.f, m.from, m.p), turned<false>(m.h, m.f, shift, m.shift);
    cross_(half_turn, m.p, spin);
    for (int k = 0; k < 3; ++k) m.rate[k] = spin[k] - m.shift[k];
    image_of(cam, m.p, m.image);
    for (int i = 0; i < 2; ++i) m.speed[i] = dot_(m.image.J[i], m.rate);
}

GSPLAT_INLINE void shear_of(const Camera &cam, const Moment &m, Shear &s) {
    if (cam.bounded) {
        VD half_turn[3], spin[3];
        clamp_point(cam, m.p, s.at);
        for (int k = 0; k < 3; ++k) half_turn[k] = splat(0.5 * cam.turn[k]) * m.f;
        cross_(half_turn, s.at.p, spin);
        for (int k = 0; k < 3; ++k) s.rate[k] = spin[k] - m.shift[k];
        image_of(cam, s.at.p, s.image);
        for (int i = 0; i < 2; ++i) s.speed[i] = dot_(s.image.J[i], s.rate);
    } else {
        for (int k = 0; k < 3; ++k) s.at.p[k] = m.p[k], s.rate[k] = m.rate[k];
        for (int i = 0; i < 2; ++i) s.speed[i] = m.speed[i];
        s.image = m.image;
    }
    s.follows = splat(1.0) / (splat(1.0) - splat(cam.pace) * s.speed[cam.axis]);
    s.k = splat(cam.pace) / (splat(1.0) - splat(cam.pace) * s.speed[cam.axis]);
}

void time_of(const Camera &cam, const VD *at_rest, VD &time) {
    Image image;
    image_of(cam, at_rest, image);
    const VD pace = splat(cam.pace), middle = splat(cam.middle), one = splat(1.0);
    VD q = image.at[cam.axis];
    for (int step = 0; step < SHUTTER_STEPS; ++step) {
        Moment m;
        moment_of(cam, at_rest, pace * (q - middle), m);
        q += (m.image.at[cam.axis] - q) / (one - pace * m.speed[cam.axis]);
    }
    time = pace * (q - middle);
}

void sight(const Camera &cam, const VD *offset, const VD &time, double z_near, Sight &out) {
    VD at_rest[3], B[2][3];
    rotated(cam.R, offset, at_rest);
    Image image;
    MD slow = VD{} == VD{};
    if (cam.moving) {
        Moment m;
        moment_of(cam, at_rest, time, m);
        Shear own;
        shear_of(cam, m, own);
        const VD limit = splat(FASTEST), w = splat(cam.pace) * m.speed[cam.axis], w_own = splat(cam.pace) * own.speed[cam.axis];
        slow = (w < limit) & (w > -limit) & (w_own < limit) & (w_own > -limit);
        if (cam.pace != 0) {
            const VD off = m.image.at[cam.axis] - (time * splat(1.0 / cam.pace) + splat(cam.middle)), settled = splat(SETTLED);
            slow &= (off < settled) & (off > -settled);
        }
        for (int i = 0; i < 2; ++i) out.blur[i] = splat(cam.spread) * own.follows * own.speed[i];
        for (int k = 0; k < 3; ++k) out.p[k] = m.p[k];
        for (int i = 0; i < 2; ++i) {
            VD row[3];
            for (int k = 0; k < 3; ++k) row[k] = own.image.ellipse[i][k] + own.k * own.speed[i] * own.image.ellipse[cam.axis][k];
            turned<true>(m.h, m.f, row, B[i]);
        }
        image = m.image;
    } else {
        for (int k = 0; k < 3; ++k) out.p[k] = at_rest[k];
        image_of(cam, at_rest, image);
        Image bounded = image;
        if (cam.bounded) {
            Clamped at;
            clamp_point(cam, at_rest, at);
            image_of(cam, at.p, bounded);
        }
        for (int k = 0; k < 3; ++k) B[0][k] = bounded.ellipse[0][k], B[1][k] = bounded.ellipse[1][k];
    }
    rotated_back(cam.R, B[0], out.t0), rotated_back(cam.R, B[1], out.t1);
    out.u = image.at[0], out.v = image.at[1];
    const VD x = out.p[0], y = out.p[1], z = out.p[2], s = x * x + y * y, distance = sqrt_(s + z * z);
    out.depth = cam.along_ray ? distance : z;
    out.valid = slow & (out.depth > splat(z_near)) & finite(out.u + out.v);
    if (cam.lens == FISHEYE) out.valid &= z >= distance * splat(cam.widest);
    if (cam.lens == PERSPECTIVE) out.valid &= s <= splat(cam.widest) * z * z;
    if (cam.lens == EQUIRECTANGULAR) out.valid &= x * x + z * z > VD{};
}

// Adds to `half` and `scale` the cotangents of h and f through Cayley's map of v, whose result has the cotangent c.
GSPLAT_INLINE void turned_adjoint(const VD *h, VD f, const VD *v, const VD *c, VD *half, VD &scale) {
    VD once[3], twice[3], a[3], b[3], back[3], d[3];
    cross_(h, v, once), cross_(h, once, twice);
    cross_(v, c, a), cross_(once, c, b), cross_(c, h, back), cross_(v, back, d);
    for (int k = 0; k < 3; ++k) {
        half[k] += f * (a[k] + b[k] + d[k]);
        scale += c[k] * (once[k] + twice[k]);
    }
}

GSPLAT_INLINE void add_outer(const VD *a, const VD *b, VD *R) {
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) R[3 * i + j] += a[i] * b[j];
}

void sight_adjoint(const Camera &cam, const VD *offset, const VD &time, const SightGradient &in, VD *dmean, VD *camera) {
    const bool flat = cam.lens == ORTHOGRAPHIC;
    VD at_rest[3], dp[3] = {}, lens[4 + COEFFICIENTS] = {};
    const VD *d[2] = {in.d0, in.d1};
    if (camera)
        for (int k = 0; k < LENS_CAMERA; ++k) camera[k] = VD{};
    rotated(cam.R, offset, at_rest);
    // With bounds, `image` is at the clamped point and has no cotangent of its place; `place` is at the true point.
    ImageGradient image{}, place{};
    for (int i = 0; i < 2; ++i) (cam.bounded ? place : image).at[i] = in.at[i];
    const auto add_place = [&](const Image &at) {
        for (int k = 0; k < 3; ++k) dp[k] += at.J[0][k] * place.at[0] + at.J[1][k] * place.at[1];
    };
    const auto add_depth = [&](const VD *p) {
        if (cam.along_ray) {
            const VD k = in.depth / sqrt_(dot_(p, p));
            for (int i = 0; i < 3; ++i) dp[i] += k * p[i];
        } else {
            dp[2] += in.depth;
        }
    };
    if (!cam.moving) {
        for (int i = 0; i < 2; ++i) rotated(cam.R, d[i], image.ellipse[i]);
        VD *to = camera ? lens : nullptr, unused[3] = {};
        Image drawn;
        if (cam.bounded) {
            VD inside[3] = {};
            Clamped at;
            clamp_point(cam, at_rest, at);
            image_of(cam, at_rest, drawn);
            add_place(drawn);
            image_adjoint(cam, at.p, image, inside, to);
            clamp_adjoint(at, inside, dp);
            image_of(cam, at.p, drawn);
            if (camera) image_adjoint(cam, at_rest, place, unused, lens);
        } else {
            image_adjoint(cam, at_rest, image, dp, to);
            if (camera) image_of(cam, at_rest, drawn);
        }
        add_depth(at_rest);
        rotated_back(cam.R, dp, dmean);
        if (camera) {
            add_outer(dp, offset, camera);
            for (int i = 0; i < 2; ++i) add_outer(drawn.ellipse[i], d[i], camera);
        }
    } else {
        Moment m;
        moment_of(cam, at_rest, time, m);
        Shear own;
        shear_of(cam, m, own);
        const int q = cam.axis;
        VD rows[2][3], B[2][3], in_camera[2][3], by_speed[2], y[3] = {}, by_k = VD{};
        for (int i = 0; i < 2; ++i) {
            rotated(cam.R, d[i], in_camera[i]);
            turned<false>(m.h, m.f, in_camera[i], rows[i]);
            const VD along = dot_(own.image.ellipse[q], rows[i]);
            by_speed[i] = own.k * along, by_k += own.speed[i] * along;
            for (int k = 0; k < 3; ++k) B[i][k] = own.image.ellipse[i][k] + own.k * own.speed[i] * own.image.ellipse[q][k];
        }
        by_speed[q] += own.k * own.k * by_k;
        if (cam.spread != 0) {
            const VD scale = splat(cam.spread) * own.follows;
            const VD by_follows = splat(cam.spread) * (in.blur[0] * own.speed[0] + in.blur[1] * own.speed[1]);
            by_speed[0] += scale * in.blur[0], by_speed[1] += scale * in.blur[1];
            by_speed[q] += own.follows * own.k * by_follows;  // d follows / d speed = pace follows²
        }
        for (int i = 0; i < 2; ++i)
            for (int k = 0; k < 3; ++k) {
                image.ellipse[i][k] += rows[i][k];
                image.ellipse[q][k] += own.k * own.speed[i] * rows[i][k];
                image.J[i][k] = by_speed[i] * own.rate[k];
                y[k] += by_speed[i] * own.image.J[i][k];
            }
        VD inside[3] = {}, *of_shape = cam.bounded ? inside : dp;
        image_adjoint(cam, own.at.p, image, of_shape, nullptr);
        if (cam.bounded) add_place(m.image);
        add_depth(m.p);
        VD turn[3], spin[3], term[3], other[3];
        for (int k = 0; k < 3; ++k) turn[k] = splat(cam.turn[k]);
        cross_(y, turn, term);
        for (int k = 0; k < 3; ++k) of_shape[k] += splat(0.5) * m.f * term[k];
        if (cam.bounded) clamp_adjoint(own.at, inside, dp);
        // S, the cotangent of t: through p, dp/dt, the rows and the direction
        const VD half_f = splat(0.5) * m.f, df = -m.f * m.f * splat(0.5) * dot_(m.h, turn);
        cross_(turn, own.at.p, spin), cross_(turn, m.shift, other);
        VD S = dot_(dp, m.rate) + splat(0.5) * df * dot_(y, spin) - half_f * dot_(y, other);
        for (int i = 0; i < 2; ++i) cross_(turn, rows[i], term), S += half_f * dot_(B[i], term);
        if (!flat)
            for (int k = 0; k < 3; ++k) S -= in.direction[k] * splat(cam.shift[k]);
        const VD more = splat(cam.pace) / (splat(1.0) - splat(cam.pace) * m.speed[q]) * S;
        for (int k = 0; k < 3; ++k) dp[k] += more * m.image.J[q][k];
        VD back[3];
        turned<true>(m.h, m.f, dp, back);
        rotated_back(cam.R, back, dmean);
        if (camera) {
            (cam.bounded ? place : image).at[q] += more;
            VD unused[3] = {}, still[3], shift[3], row[3], half[3] = {}, scale = splat(0.5) * dot_(y, spin), minus[3];
            image_adjoint(cam, own.at.p, image, unused, lens);
            if (cam.bounded) image_adjoint(cam, m.p, place, unused, lens);
            VD *R = camera, *by_turn = camera + 16 + COEFFICIENTS, *by_shift = by_turn + 3;
            for (int k = 0; k < 3; ++k) still[k] = offset[k] - time * splat(cam.shift[k]), shift[k] = splat(cam.shift[k]);
            add_outer(back, still, R);
            for (int k = 0; k < 3; ++k) by_shift[k] -= time * dmean[k];
            for (int k = 0; k < 3; ++k) minus[k] = -y[k];
            turned<true>(m.h, m.f, minus, row);
            add_outer(row, shift, R);
            rotated_back(cam.R, row, other);
            for (int k = 0; k < 3; ++k) by_shift[k] += other[k] - (flat ? VD{} : time * in.direction[k]);
            rotated(cam.R, shift, other);
            turned_adjoint(m.h, m.f, m.from, dp, half, scale), turned_adjoint(m.h, m.f, other, minus, half, scale);
            for (int i = 0; i < 2; ++i) {
                turned<true>(m.h, m.f, B[i], row);
                add_outer(row, d[i], R);
                turned_adjoint(m.h, m.f, in_camera[i], B[i], half, scale);
            }
            cross_(own.at.p, y, term);
            for (int k = 0; k < 3; ++k) {
                half[k] -= m.f * m.f * scale * m.h[k];
                by_turn[k] = half_f * term[k] + splat(0.5) * time * half[k];
            }
        }
    }
    if (!flat)
        for (int k = 0; k < 3; ++k) dmean[k] += in.direction[k];
    if (!camera) return;
    for (int k = 0; k < 3; ++k) {
        if (flat) camera[6 + k] += in.direction[k];
        camera[9 + k] = -dmean[k];
    }
    for (int k = 0; k < 4 + COEFFICIENTS; ++k) camera[12 + k] = lens[k];
}

}  // namespace GSPLAT_ISA
}  // namespace gsplat

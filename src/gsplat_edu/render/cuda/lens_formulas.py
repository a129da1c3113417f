"""Projections other than the pinhole, for blocks of Gaussians: image point and Jacobian, and their adjoints.

    (u, v) = f D(C(p)) + c,   C: core (perspective, fisheye, equirectangular, orthographic),   D: distortion

Formulas and names are those of `native/lens.h`. Vectors are tuples; a cotangent of a Jacobian needs second derivatives.
Every function works in the type of its arguments, float32 or float64.
"""

from __future__ import annotations

import math
from typing import no_type_check

import triton
import triton.language as tl

from gsplat_edu.base import constants

PERSPECTIVE, FISHEYE, EQUIRECTANGULAR = tl.constexpr(0), tl.constexpr(1), tl.constexpr(2)
"""`OPTICS` modulo 4; 3 is orthographic."""

DISTORTED, RADIAL_FIRST, MOVING, BY_COLUMNS, BOUNDED, BLURRED = (
    tl.constexpr(bit) for bit in (4, 8, 16, 32, 64, 128)
)
"""Bits of `OPTICS`: whether there are coefficients, whether radial ones come first; two of a rolling shutter; whether
the ellipse of a perspective lens has bounds."""

BOUNDS = tl.constexpr(44)
"""Place of the bounds of x/z and y/z in a lens' row: low, high, low, high."""

FOCAL, MIDDLE, COEFFICIENTS = tl.constexpr(12), tl.constexpr(14), tl.constexpr(16)
"""Places in a lens' row; R and the eye come before. The gradient has the same places."""

PI = tl.constexpr(math.pi)
POLE, NEAR_AXIS = tl.constexpr(constants.POLE), tl.constexpr(constants.NEAR_AXIS_F32)

SERIES = tl.constexpr(16)
"""Last power of the series, even; the first that is left out is 0.1^17."""


@triton.jit
@no_type_check
def dot(a, b):
    """Return the dot product of two vectors."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@triton.jit
@no_type_check
def plus(a, b):
    """Return the sum of two vectors."""
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@triton.jit
@no_type_check
def scaled(a, k):
    """Return a vector times a number."""
    return a[0] * k, a[1] * k, a[2] * k


@triton.jit
@no_type_check
def mixed_of(a, k, b, m):
    """Return k a + m b."""
    return a[0] * k + b[0] * m, a[1] * k + b[1] * m, a[2] * k + b[2] * m


@triton.jit
@no_type_check
def arc_series(t):
    """Return atan(√t) / √t for small t, and its first two derivatives."""
    value, slope, curve = 0.0 * t, 0.0 * t, 0.0 * t
    for k in tl.static_range(SERIES + 1):
        curve = curve * t + 2 * slope
        slope = slope * t + value
        value = value * t + (1.0 - 2.0 * (k % 2)) / (2.0 * (SERIES - k) + 1.0)
    return value, slope, curve


@triton.jit
@no_type_check
def angle_of(y, x):
    """Return atan2(y, x) for y >= 0, in [0, pi]. The angle is halved twice, to at most pi / 16, for the series."""
    across = tl.abs(x)
    low, high = tl.minimum(y, across), tl.maximum(y, across)
    t = low / tl.where(high > 0, high, 1.0)
    for _step in tl.static_range(2):
        t = t / (1 + tl.sqrt(1 + t * t))
    value, _, _ = arc_series(t * t)
    angle = 4 * t * value
    angle = tl.where(y > across, 0.5 * PI - angle, angle)
    return tl.where(x < 0, PI - angle, angle)


@triton.jit
@no_type_check
def signed_angle(y, x):
    """Return atan2(y, x) in (-pi, pi]."""
    angle = angle_of(tl.abs(y), x)
    return tl.where(y < 0, -angle, angle)


@triton.jit
@no_type_check
def arc_of(s, z):
    """Return A = theta / r, and dA/ds, dA/dz, d²A/ds², d²A/dsdz, d²A/dz², with s = r²."""
    near = (z > 0) & (s < NEAR_AXIS * z * z)
    away, depth = tl.where(near, 1.0, s), tl.where(near, z, 1.0)
    iz = 1 / depth
    value, slope, curve = arc_series(tl.where(near, s, 0.0) * iz * iz)
    inverse, r, twice = 1 / (s + z * z), tl.sqrt(away), 0.5 / away
    far = angle_of(r, z) / r
    far_s = (z * inverse - far) * twice
    A = tl.where(near, value * iz, far)
    s1 = tl.where(near, slope * iz * iz * iz, far_s)
    s2 = tl.where(near, curve * iz * iz * iz * iz * iz, -(z * inverse * inverse + 3 * far_s) * twice)
    return A, s1, -inverse, s2, inverse * inverse, 2 * z * inverse * inverse


@triton.jit
@no_type_check
def core_of(p, OPTICS: tl.constexpr):
    """Return the place on the plane, the rows of its Jacobian, and the first row as an ellipse needs it at a pole."""
    x, y, z = p
    zero = 0.0 * z
    if OPTICS % 4 == PERSPECTIVE:
        iz = 1 / z
        a, b = x * iz, y * iz
        J0, J1 = (iz, zero, -a * iz), (zero, iz, -b * iz)
        e0 = J0
    elif OPTICS % 4 == FISHEYE:
        A, s1, z1, _, _, _ = arc_of(x * x + y * y, z)
        a, b, both = x * A, y * A, 2 * s1 * x * y
        J0, J1 = (A + 2 * s1 * x * x, both, x * z1), (both, A + 2 * s1 * y * y, y * z1)
        e0 = J0
    elif OPTICS % 4 == EQUIRECTANGULAR:
        h2 = x * x + z * z
        p2, h = h2 + y * y, tl.sqrt(h2)
        along, down = 1 / (h * tl.maximum(h, POLE * tl.sqrt(p2))), y / (p2 * h)
        a, b = signed_angle(x, z), signed_angle(y, h)
        J0, J1 = (z / h2, zero, -x / h2), (-x * down, h / p2, -z * down)
        e0 = (z * along, zero, -x * along)
    else:
        a, b = x, y
        J0, J1 = (zero + 1, zero, zero), (zero, zero + 1, zero)
        e0 = J0
    return a, b, J0, J1, e0


@triton.jit
@no_type_check
def core_curvature(p, G0, G1, bounded, OPTICS: tl.constexpr):
    """Return what the core's Jacobian passes on to p; `bounded`: the cotangent of a panorama's row for the ellipse."""
    x, y, z = p
    if OPTICS % 4 == PERSPECTIVE:
        iz = 1 / z
        iz2 = iz * iz
        dp = (-G0[2] * iz2, -G1[2] * iz2, iz2 * (2 * iz * (x * G0[2] + y * G1[2]) - G0[0] - G1[1]))
    elif OPTICS % 4 == FISHEYE:
        _, s1, z1, s2, sz, z2 = arc_of(x * x + y * y, z)
        both, trace = G0[1] + G1[0], G0[0] + G1[1]
        by_s = 2 * (x * x * G0[0] + x * y * both + y * y * G1[1])
        by_z = x * G0[2] + y * G1[2]
        e = 2 * (trace * s1 + by_s * s2 + by_z * sz)
        dp = (
            s1 * (4 * x * G0[0] + 2 * y * both) + z1 * G0[2] + x * e,
            s1 * (4 * y * G1[1] + 2 * x * both) + z1 * G1[2] + y * e,
            trace * z1 + by_s * sz + by_z * z2,
        )
    elif OPTICS % 4 == EQUIRECTANGULAR:
        dp = plus(_longitude_curvature(x, y, z, G0, bounded), _latitude_curvature(x, y, z, G1))
    else:
        zero = 0.0 * z
        dp = (zero, zero, zero)
    return dp


@triton.jit
@no_type_check
def _longitude_curvature(x, y, z, G, bounded):
    """Of the rows (z, 0, -x) E with E = 1 / h², and (z, 0, -x) F with F = 1 / (h max(h, POLE |p|))."""
    h2 = x * x + z * z
    p2, h = h2 + y * y, tl.sqrt(h2)
    least = POLE * tl.sqrt(p2)
    close = h < least
    E, F = 1 / h2, 1 / (h * tl.maximum(h, least))
    dE = -2 * E * (G[0] * z - G[2] * x) / h2
    dF = -F * (bounded[0] * z - bounded[2] * x)
    spread = dE + dF * (1 / h2 + tl.where(close, 1 / p2, 1 / h2))
    return (
        -G[2] * E - bounded[2] * F + x * spread,
        tl.where(close, y * dF / p2, 0.0),
        G[0] * E + bounded[0] * F + z * spread,
    )


@triton.jit
@no_type_check
def _latitude_curvature(x, y, z, G):
    """Of the row (f_h x / h, f_y, f_h z / h), with f = atan2(y, h)."""
    h2 = x * x + z * z
    h, p2 = tl.sqrt(h2), h2 + y * y
    n = (x * G[0] + z * G[2]) / h
    f_hh, f_hy = 2 * h / p2 * (y / p2), (y * y - h2) / p2 / p2
    by_h = (f_hh * n + f_hy * G[1]) / h
    turn = -y / p2 * ((z * G[0] - x * G[2]) / h2) / h
    return by_h * x + turn * z, f_hy * n - f_hh * G[1], by_h * z - turn * x


@triton.jit
@no_type_check
def radial_of(lens, q):
    """Return R = N / D of a distortion, R', R'', 1 / D and D'."""
    N, N1, N2 = 0.0 * q, 0.0 * q, 0.0 * q
    D, D1, D2 = 0.0 * q, 0.0 * q, 0.0 * q
    for k in tl.static_range(7):
        N2, N1 = N2 * q + 2 * N1, N1 * q + N
        N = N * q + (tl.load(lens + COEFFICIENTS + 5 - k) if k < 6 else 1.0)
    for k in tl.static_range(4):
        D2, D1 = D2 * q + 2 * D1, D1 * q + D
        D = D * q + (tl.load(lens + COEFFICIENTS + 8 - k) if k < 3 else 1.0)
    inverse = 1 / D
    R = N * inverse
    first = (N1 - R * D1) * inverse
    return R, first, (N2 - R * D2 - 2 * first * D1) * inverse, inverse, D1


@triton.jit
@no_type_check
def _decentring(lens):
    """Return p1, p2, s1, s2, s3, s4."""
    at = lens + COEFFICIENTS
    return (
        tl.load(at + 9), tl.load(at + 10), tl.load(at + 11), tl.load(at + 12), tl.load(at + 13), tl.load(at + 14)
    )  # fmt: skip


@triton.jit
@no_type_check
def decentred_of(lens, A, B):
    """Return the shift by decentring and prism at (A, B), and the rows of its Jacobian."""
    p1, p2, s1, s2, s3, s4 = _decentring(lens)
    Q, both = A * A + B * B, 2 * (p1 * A + p2 * B)
    first, second = 2 * (s1 + 2 * s2 * Q), 2 * (s3 + 2 * s4 * Q)
    shift = (
        2 * p1 * A * B + p2 * (Q + 2 * A * A) + Q * (s1 + s2 * Q),
        p1 * (Q + 2 * B * B) + 2 * p2 * A * B + Q * (s3 + s4 * Q),
    )
    E0 = (2 * p1 * B + 6 * p2 * A + first * A, both + first * B)
    return shift, E0, (both + second * A, 6 * p1 * B + 2 * p2 * A + second * B)


@triton.jit
@no_type_check
def distorted(lens, a, b, OPTICS: tl.constexpr):
    """Return the distorted place, and the rows of K = d(a', b') / d(a, b)."""
    R, first, _, _, _ = radial_of(lens, a * a + b * b)
    k00, k01, k11 = R + 2 * first * a * a, 2 * first * a * b, R + 2 * first * b * b
    if RADIAL_FIRST & OPTICS:
        shift, E0, E1 = decentred_of(lens, R * a, R * b)
        K0 = (k00 + E0[0] * k00 + E0[1] * k01, k01 + E0[0] * k01 + E0[1] * k11)
        K1 = (k01 + E1[0] * k00 + E1[1] * k01, k11 + E1[0] * k01 + E1[1] * k11)
    else:
        shift, E0, E1 = decentred_of(lens, a, b)
        K0, K1 = (k00 + E0[0], k01 + E0[1]), (k01 + E1[0], k11 + E1[1])
    return R * a + shift[0], R * b + shift[1], K0, K1


@triton.jit
@no_type_check
def decentred_gradient(lens, A, B, g, G0, G1):
    """Return the gradient of decentring's place from the cotangents of its shift and Jacobian."""
    p1, p2, s1, s2, s3, s4 = _decentring(lens)
    Q, AB, x2, x4 = A * A + B * B, A * B, 8 * s2, 8 * s4
    first, second = 2 * (s1 + 2 * s2 * Q), 2 * (s3 + 2 * s4 * Q)
    _, E0, E1 = decentred_of(lens, A, B)
    dA = E0[0] * g[0] + E1[0] * g[1] + G0[0] * (6 * p2 + first + x2 * A * A) + G0[1] * (2 * p1 + x2 * AB)
    dB = E0[1] * g[0] + E1[1] * g[1] + G0[0] * (2 * p1 + x2 * AB) + G0[1] * (2 * p2 + first + x2 * B * B)
    dA += G1[0] * (2 * p1 + second + x4 * A * A) + G1[1] * (2 * p2 + x4 * AB)
    dB += G1[0] * (2 * p2 + x4 * AB) + G1[1] * (6 * p1 + second + x4 * B * B)
    return dA, dB


@triton.jit
@no_type_check
def _parts(lens, a, b, g, G0, G1, OPTICS: tl.constexpr):
    """Return the place of decentring, the cotangents of its Jacobian (E), of the radial Jacobian (T), and of R a."""
    if RADIAL_FIRST & OPTICS:  # K = (I + E) K_r with E at R a
        R, first, _, _, _ = radial_of(lens, a * a + b * b)
        k00, k01, k11 = R + 2 * first * a * a, 2 * first * a * b, R + 2 * first * b * b
        at = (R * a, R * b)
        _, D0, D1 = decentred_of(lens, at[0], at[1])
        E0 = (G0[0] * k00 + G0[1] * k01, G0[0] * k01 + G0[1] * k11)
        E1 = (G1[0] * k00 + G1[1] * k01, G1[0] * k01 + G1[1] * k11)
        T0 = (G0[0] + D0[0] * G0[0] + D1[0] * G1[0], G0[1] + D0[0] * G0[1] + D1[0] * G1[1])
        T1 = (G1[0] + D0[1] * G0[0] + D1[1] * G1[0], G1[1] + D0[1] * G0[1] + D1[1] * G1[1])
        more = decentred_gradient(lens, at[0], at[1], g, E0, E1)
        through = (g[0] + more[0], g[1] + more[1])
    else:
        at, E0, E1, T0, T1, through = (a, b), G0, G1, G0, G1, g
    return at, E0, E1, T0, T1, through


@triton.jit
@no_type_check
def distorted_gradient(lens, a, b, g, G0, G1, OPTICS: tl.constexpr):
    """Return the gradient of the place before the distortion, from the cotangents of that after it and of K."""
    _, _, _, T0, T1, t = _parts(lens, a, b, g, G0, G1, OPTICS)
    R, first, second, _, _ = radial_of(lens, a * a + b * b)
    both = T0[1] + T1[0]
    quadratic = 2 * (T0[0] * a * a + both * a * b + T1[1] * b * b)
    by_q = 2 * (first * (t[0] * a + t[1] * b + T0[0] + T1[1]) + second * quadratic)
    da = R * t[0] + 2 * first * (2 * T0[0] * a + both * b) + a * by_q
    db = R * t[1] + 2 * first * (2 * T1[1] * b + both * a) + b * by_q
    if not (RADIAL_FIRST & OPTICS):
        more = decentred_gradient(lens, a, b, g, G0, G1)
        da, db = da + more[0], db + more[1]
    return da, db


@triton.jit
@no_type_check
def image_of(lens, p, OPTICS: tl.constexpr):
    """Return the image point of p, px, the rows of its Jacobian by camera axes, and the first row of the ellipse's."""
    a, b, J0, J1, e0 = core_of(p, OPTICS)
    if DISTORTED & OPTICS:
        a, b, K0, K1 = distorted(lens, a, b, OPTICS)
        J0, J1 = mixed_of(J0, K0[0], J1, K0[1]), mixed_of(J0, K1[0], J1, K1[1])
        e0 = J0
    fx, fy = tl.load(lens + FOCAL), tl.load(lens + FOCAL + 1)
    at = (fx * a + tl.load(lens + MIDDLE), fy * b + tl.load(lens + MIDDLE + 1))
    return at, scaled(J0, fx), scaled(J1, fy), scaled(e0, fx)


@triton.jit
@no_type_check
def clamped_point(lens, p, OPTICS: tl.constexpr):
    """Return the point at which a perspective ellipse takes its Jacobian: x/z and y/z of p, moved into the bounds."""
    x, y, z = p
    if BOUNDED & OPTICS:
        left, right = tl.load(lens + BOUNDS) * z, tl.load(lens + BOUNDS + 1) * z
        top, bottom = tl.load(lens + BOUNDS + 2) * z, tl.load(lens + BOUNDS + 3) * z
        x = tl.where(x < left, left, tl.where(x > right, right, x))
        y = tl.where(y < top, top, tl.where(y > bottom, bottom, y))
    return x, y, z


@triton.jit
@no_type_check
def clamp_gradient(lens, p, d, OPTICS: tl.constexpr):
    """Propagate from `clamped_point` to p: a moved coordinate is a bound, which is constant, times z."""
    x, y, z = p
    dx, dy, dz = d
    if BOUNDED & OPTICS:
        left, right = tl.load(lens + BOUNDS), tl.load(lens + BOUNDS + 1)
        top, bottom = tl.load(lens + BOUNDS + 2), tl.load(lens + BOUNDS + 3)
        dz += tl.where(x < left * z, left * dx, tl.where(x > right * z, right * dx, 0.0))
        dz += tl.where(y < top * z, top * dy, tl.where(y > bottom * z, bottom * dy, 0.0))
        dx = tl.where((x < left * z) | (x > right * z), 0.0, dx)
        dy = tl.where((y < top * z) | (y > bottom * z), 0.0, dy)
    return dx, dy, dz


@triton.jit
@no_type_check
def _before_focal(lens, at, J0, J1, e0, e1, OPTICS: tl.constexpr):
    """Return the cotangents before the focal lengths: of the place, of the rows, and of a panorama's bounded row."""
    fx, fy = tl.load(lens + FOCAL), tl.load(lens + FOCAL + 1)
    g, G1, of_e0 = (fx * at[0], fy * at[1]), scaled(plus(J1, e1), fy), scaled(e0, fx)
    if OPTICS % 4 == EQUIRECTANGULAR:
        G0, bounded = scaled(J0, fx), of_e0
    else:
        G0, bounded = plus(scaled(J0, fx), of_e0), scaled(e0, 0.0)
    return g, G0, G1, bounded


@triton.jit
@no_type_check
def image_gradient(lens, p, at, J0, J1, e0, e1, OPTICS: tl.constexpr):
    """Return the gradient of p from the cotangents of an image point, its Jacobian, and the ellipse's rows."""
    a, b, C0, C1, _ = core_of(p, OPTICS)
    g, G0, G1, bounded = _before_focal(lens, at, J0, J1, e0, e1, OPTICS)
    da = g
    if DISTORTED & OPTICS:
        _, _, K0, K1 = distorted(lens, a, b, OPTICS)
        da = distorted_gradient(lens, a, b, g, (dot(G0, C0), dot(G0, C1)), (dot(G1, C0), dot(G1, C1)), OPTICS)
        G0, G1 = mixed_of(G0, K0[0], G1, K1[0]), mixed_of(G0, K0[1], G1, K1[1])
    return plus(mixed_of(C0, da[0], C1, da[1]), core_curvature(p, G0, G1, bounded, OPTICS))


@triton.jit
@no_type_check
def store_sum(sums, value, touched):
    """Store a block's sum of a number of the camera's gradient; Gaussians that were not drawn have none."""
    tl.store(sums, tl.sum(tl.where(touched, value, 0.0), 0))


@triton.jit
@no_type_check
def store_lens_gradient(lens, sums, p, at, J0, J1, e0, e1, touched, OPTICS: tl.constexpr):
    """Store the sums for fx, fy, cx, cy and the coefficients; arguments are those of `image_gradient`."""
    a, b, C0, C1, bounded_row = core_of(p, OPTICS)
    g, G0, G1, bounded = _before_focal(lens, at, J0, J1, e0, e1, OPTICS)
    u, v, row0, row1 = a, b, C0, C1
    if DISTORTED & OPTICS:
        u, v, K0, K1 = distorted(lens, a, b, OPTICS)
        row0, row1 = mixed_of(C0, K0[0], C1, K0[1]), mixed_of(C0, K1[0], C1, K1[1])
        of_K = ((dot(G0, C0), dot(G0, C1)), (dot(G1, C0), dot(G1, C1)))
        _store_coefficients(lens, sums + COEFFICIENTS, a, b, g, of_K[0], of_K[1], touched, OPTICS)
    else:
        for k in tl.static_range(15):
            store_sum(sums + COEFFICIENTS + k, 0.0 * a, touched)
    fx, fy = tl.load(lens + FOCAL), tl.load(lens + FOCAL + 1)
    store_sum(sums + FOCAL, at[0] * u + (dot(G0, row0) + dot(bounded, bounded_row)) / fx, touched)
    store_sum(sums + FOCAL + 1, at[1] * v + dot(G1, row1) / fy, touched)
    store_sum(sums + MIDDLE, at[0], touched)
    store_sum(sums + MIDDLE + 1, at[1], touched)


@triton.jit
@no_type_check
def _store_coefficients(lens, sums, a, b, g, G0, G1, touched, OPTICS: tl.constexpr):
    """Store the sums for the coefficients."""
    at, E0, E1, T0, T1, t = _parts(lens, a, b, g, G0, G1, OPTICS)
    q = a * a + b * b
    R, first, _, inverse, below1 = radial_of(lens, q)
    quadratic = 2 * (T0[0] * a * a + (T0[1] + T1[0]) * a * b + T1[1] * b * b)
    by_R = t[0] * a + t[1] * b + T0[0] + T1[1]
    lower = 0.0 * q + 1
    for i in tl.static_range(1, 7):
        value = lower * q * inverse
        slope = (i * lower - value * below1) * inverse
        store_sum(sums + i - 1, by_R * value + quadratic * slope, touched)
        if i <= 3:
            below = -R * value
            below_slope = (-R * i * lower - below * below1 - first * lower * q) * inverse
            store_sum(sums + 5 + i, by_R * below + quadratic * below_slope, touched)
        lower = lower * q
    A, B = at
    Q, AB, both = A * A + B * B, A * B, E0[1] + E1[0]
    row0, row1 = E0[0] * A + E0[1] * B, E1[0] * A + E1[1] * B
    by_p1 = 2 * AB * g[0] + (Q + 2 * B * B) * g[1] + 2 * (E0[0] * B + both * A) + 6 * E1[1] * B
    by_p2 = (Q + 2 * A * A) * g[0] + 2 * AB * g[1] + 6 * E0[0] * A + 2 * (both * B + E1[1] * A)
    store_sum(sums + 9, by_p1, touched)
    store_sum(sums + 10, by_p2, touched)
    store_sum(sums + 11, Q * g[0] + 2 * row0, touched)
    store_sum(sums + 12, Q * (Q * g[0] + 4 * row0), touched)
    store_sum(sums + 13, Q * g[1] + 2 * row1, touched)
    store_sum(sums + 14, Q * (Q * g[1] + 4 * row1), touched)

"""The mathematics of a Gaussian, forward and backward, for blocks of Gaussians.

Mirrors `native/gaussian_math.h`: lanes are Gaussians, and loops over axes are unrolled.
"""

from __future__ import annotations

from typing import no_type_check

import triton
import triton.language as tl

from gsplat_edu.base import constants

C0 = tl.constexpr(constants.C0)
C1 = tl.constexpr(constants.C1)
C2_0, C2_1, C2_2, C2_3, C2_4 = (tl.constexpr(value) for value in constants.C2)
C3_0, C3_1, C3_2, C3_3, C3_4, C3_5, C3_6 = (tl.constexpr(value) for value in constants.C3)
THINNEST = tl.constexpr(constants.THINNEST)
DET_FLOOR = tl.constexpr(constants.DET_FLOOR)

# Offsets in a camera's row of values, see `camera_row`.
EYE_AT, FOCAL_AT, MIDDLE_AT, SIZE_AT, BOUNDS_AT, NEAR_AT, EYE_REST_AT = (
    tl.constexpr(place) for place in (9, 12, 14, 16, 18, 22, 23)
)


@triton.jit
@no_type_check
def dot3(a0, a1, a2, b0, b1, b2):
    """Return the dot product of two vectors."""
    return a0 * b0 + a1 * b1 + a2 * b2


@triton.jit
@no_type_check
def load3(pointer, i, mask):
    """Load row i of an (N, 3) array."""
    return (
        tl.load(pointer + 3 * i, mask=mask, other=0.0),
        tl.load(pointer + 3 * i + 1, mask=mask, other=0.0),
        tl.load(pointer + 3 * i + 2, mask=mask, other=0.0),
    )


@triton.jit
@no_type_check
def store3(pointer, i, v0, v1, v2, mask):
    """Store row i of an (N, 3) array."""
    tl.store(pointer + 3 * i, v0, mask=mask)
    tl.store(pointer + 3 * i + 1, v1, mask=mask)
    tl.store(pointer + 3 * i + 2, v2, mask=mask)


@triton.jit
@no_type_check
def unit_quaternion(quats, i, mask):
    """Load and normalise quaternions; those of zero length become NaN."""
    w = tl.load(quats + 4 * i, mask=mask, other=1.0)
    x = tl.load(quats + 4 * i + 1, mask=mask, other=0.0)
    y = tl.load(quats + 4 * i + 2, mask=mask, other=0.0)
    z = tl.load(quats + 4 * i + 3, mask=mask, other=0.0)
    # Dividing by the largest entry first keeps the length from overflowing or underflowing.
    largest = tl.maximum(tl.maximum(tl.abs(w), tl.abs(x)), tl.maximum(tl.abs(y), tl.abs(z)))
    length = tl.sqrt(
        (w / largest) * (w / largest)
        + dot3(x / largest, y / largest, z / largest, x / largest, y / largest, z / largest)
    )
    return (
        w / largest / length,
        x / largest / length,
        y / largest / length,
        z / largest / length,
        largest * length,
    )


@triton.jit
@no_type_check
def rotation(w, x, y, z):
    """Return R(q) of a unit quaternion, row by row."""
    return (
        1 - 2 * (y * y + z * z),
        2 * (x * y - w * z),
        2 * (x * z + w * y),
        2 * (x * y + w * z),
        1 - 2 * (x * x + z * z),
        2 * (y * z - w * x),
        2 * (x * z - w * y),
        2 * (y * z + w * x),
        1 - 2 * (x * x + y * y),
    )


@triton.jit
@no_type_check
def into_camera(means, camera, i, mask):
    """Return mean - eye in world and in camera axes; the eye is given as float32 plus its rounding error."""
    m0, m1, m2 = load3(means, i, mask)
    o0 = m0 - tl.load(camera + EYE_AT) - tl.load(camera + EYE_REST_AT)
    o1 = m1 - tl.load(camera + EYE_AT + 1) - tl.load(camera + EYE_REST_AT + 1)
    o2 = m2 - tl.load(camera + EYE_AT + 2) - tl.load(camera + EYE_REST_AT + 2)
    x = dot3(tl.load(camera), tl.load(camera + 1), tl.load(camera + 2), o0, o1, o2)
    y = dot3(tl.load(camera + 3), tl.load(camera + 4), tl.load(camera + 5), o0, o1, o2)
    z = dot3(tl.load(camera + 6), tl.load(camera + 7), tl.load(camera + 8), o0, o1, o2)
    return o0, o1, o2, x, y, z


@triton.jit
@no_type_check
def jacobian_row(camera, axis: tl.constexpr, p, z):
    """Return a row of J W, and p/z after clamping: f/z (W_row - p/z W_2)."""
    low, high = tl.load(camera + BOUNDS_AT + 2 * axis), tl.load(camera + BOUNDS_AT + 2 * axis + 1)
    ratio = tl.minimum(tl.maximum(p / z, low), high)
    scale = tl.load(camera + FOCAL_AT + axis) / z
    t0 = scale * (tl.load(camera + 3 * axis) - ratio * tl.load(camera + 6))
    t1 = scale * (tl.load(camera + 3 * axis + 1) - ratio * tl.load(camera + 7))
    t2 = scale * (tl.load(camera + 3 * axis + 2) - ratio * tl.load(camera + 8))
    return t0, t1, t2, ratio


@triton.jit
@no_type_check
def onto_axes(t0, t1, t2, R, s0, s1, s2):
    """Return t M with M = R S: a row of J W in the Gaussian's own axes."""
    r0 = dot3(t0, t1, t2, R[0], R[3], R[6]) * s0
    r1 = dot3(t0, t1, t2, R[1], R[4], R[7]) * s1
    r2 = dot3(t0, t1, t2, R[2], R[5], R[8]) * s2
    return r0, r1, r2


@triton.jit
@no_type_check
def shape_on_screen(r, q, DILATION: tl.constexpr):
    """Return a, b, c and the determinant of r r', r q', q q' before dilation, and the dilated determinant."""
    a = dot3(r[0], r[1], r[2], r[0], r[1], r[2])
    b = dot3(r[0], r[1], r[2], q[0], q[1], q[2])
    c = dot3(q[0], q[1], q[2], q[0], q[1], q[2])
    # |r x q|² = a c - b² without cancellation.
    n0, n1, n2 = r[1] * q[2] - r[2] * q[1], r[2] * q[0] - r[0] * q[2], r[0] * q[1] - r[1] * q[0]
    det0 = dot3(n0, n1, n2, n0, n1, n2)
    return a, b, c, det0, det0 + (a + c) * DILATION + DILATION * DILATION


@triton.jit
@no_type_check
def harmonic(j: tl.constexpr, x, y, z):
    """Return real harmonic j, 1 to 15, in the direction (x, y, z)."""
    xx, yy, zz = x * x, y * y, z * z
    if j == 1:
        b = y * (-C1)
    elif j == 2:
        b = z * C1
    elif j == 3:
        b = x * (-C1)
    elif j == 4:
        b = x * y * C2_0
    elif j == 5:
        b = y * z * C2_1
    elif j == 6:
        b = (2 * zz - xx - yy) * C2_2
    elif j == 7:
        b = x * z * C2_3
    elif j == 8:
        b = (xx - yy) * C2_4
    elif j == 9:
        b = y * (3 * xx - yy) * C3_0
    elif j == 10:
        b = x * y * z * C3_1
    elif j == 11:
        b = y * (4 * zz - xx - yy) * C3_2
    elif j == 12:
        b = z * (2 * zz - 3 * xx - 3 * yy) * C3_3
    elif j == 13:
        b = x * (4 * zz - xx - yy) * C3_4
    elif j == 14:
        b = z * (xx - yy) * C3_5
    else:
        b = x * (xx - 3 * yy) * C3_6
    return b


@triton.jit
@no_type_check
def harmonic_slope(j: tl.constexpr, x, y, z):
    """Return the gradient of harmonic j with respect to x, y and z."""
    xx, yy, zz, zero = x * x, y * y, z * z, 0.0 * x
    if j == 1:
        d = (zero, zero - C1, zero)
    elif j == 2:
        d = (zero, zero, zero + C1)
    elif j == 3:
        d = (zero - C1, zero, zero)
    elif j == 4:
        d = (y * C2_0, x * C2_0, zero)
    elif j == 5:
        d = (zero, z * C2_1, y * C2_1)
    elif j == 6:
        d = (x * (-2 * C2_2), y * (-2 * C2_2), z * (4 * C2_2))
    elif j == 7:
        d = (z * C2_3, zero, x * C2_3)
    elif j == 8:
        d = (x * (2 * C2_4), y * (-2 * C2_4), zero)
    elif j == 9:
        d = (x * y * (6 * C3_0), (xx - yy) * (3 * C3_0), zero)
    elif j == 10:
        d = (y * z * C3_1, x * z * C3_1, x * y * C3_1)
    elif j == 11:
        d = (x * y * (-2 * C3_2), (4 * zz - xx - 3 * yy) * C3_2, y * z * (8 * C3_2))
    elif j == 12:
        d = (x * z * (-6 * C3_3), y * z * (-6 * C3_3), (2 * zz - xx - yy) * (3 * C3_3))
    elif j == 13:
        d = ((4 * zz - 3 * xx - yy) * C3_4, x * y * (-2 * C3_4), x * z * (8 * C3_4))
    elif j == 14:
        d = (x * z * (2 * C3_5), y * z * (-2 * C3_5), (xx - yy) * C3_5)
    else:
        d = ((xx - yy) * (3 * C3_6), x * y * (-6 * C3_6), zero)
    return d

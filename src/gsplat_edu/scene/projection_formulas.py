"""The formulas of the projections: place on the image plane and its Jacobian, for NumPy arrays and torch tensors alike.

Every function works element by element with the operators that arrays and tensors share; `Operations` names the rest.
torch differentiates them again, so no branch divides by zero where it is not taken.

Source: Kannala and Brandt 2006 for the fisheye; the derivatives are ours.

Chapter: 04_splatting.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from gsplat_edu.base.constants import NEAR_AXIS as NEAR_AXIS, POLE as POLE

Numbers = Any
"""A NumPy array or a torch tensor."""

Row = tuple[Numbers, Numbers, Numbers]

SERIES = 12
"""Terms of the series of a fisheye's theta / r up to `NEAR_AXIS`, exact to rounding."""


RADIAL = 9
"""Number of radial coefficients of a distortion, which come first: k1 to k6 and d1 to d3."""


class Operations(NamedTuple):
    """Functions that NumPy and torch name differently."""

    sqrt: Callable[[Numbers], Numbers]
    atan2: Callable[[Numbers, Numbers], Numbers]
    where: Callable[[Numbers, Numbers, Numbers], Numbers]
    maximum: Callable[[Numbers, Numbers], Numbers]


NUMPY = Operations(np.sqrt, np.arctan2, np.where, np.maximum)


class OnPlane(NamedTuple):
    """A point's place on the plane, and its derivatives by x, y and z."""

    a: Numbers
    b: Numbers
    da: Row
    db: Row


def perspective(x: Numbers, y: Numbers, z: Numbers) -> OnPlane:
    """Return (x / z, y / z)."""
    a, b, zero = x / z, y / z, 0 * z
    return OnPlane(a, b, (1 / z, zero, -a / z), (zero, 1 / z, -b / z))


def orthographic(x: Numbers, y: Numbers, z: Numbers) -> OnPlane:
    """Return (x, y)."""
    zero = 0 * z
    return OnPlane(x, y, (zero + 1, zero, zero), (zero, zero + 1, zero))


def fisheye(x: Numbers, y: Numbers, z: Numbers, do: Operations) -> OnPlane:
    """Return (x, y) A with A = theta / r, theta = atan2(r, z), r² = s = x² + y².

    With p² = s + z²: dA/dz = -1 / p²,  dA/ds = (z / p² - A) / 2 s. Near the axis, with t = s / z²:
    A = (1 - t/3 + t²/5 - ...) / z.
    """
    s = x * x + y * y
    near = (z > 0) & (s < NEAR_AXIS * z * z)
    away, depth = do.where(near, 1 + 0 * s, s), do.where(near, z, 1 + 0 * z)
    t = do.where(near, s, 0 * s) / (depth * depth)
    value, slope = _series(t)
    p2 = do.where(near, 1 + 0 * s, s + z * z)
    r = do.sqrt(away)
    far = do.atan2(r, z) / r
    A = do.where(near, value / depth, far)
    A_s = do.where(near, slope / (depth * depth * depth), (z / p2 - far) / (2 * away))
    A_z = -1 / (s + z * z)
    return OnPlane(
        x * A,
        y * A,
        (A + 2 * x * x * A_s, 2 * x * y * A_s, x * A_z),
        (2 * x * y * A_s, A + 2 * y * y * A_s, y * A_z),
    )


def _series(t: Numbers) -> tuple[Numbers, Numbers]:
    """Return atan(√t) / √t and its derivative by t, for small t."""
    value, slope = 0 * t, 0 * t
    for n in range(SERIES, -1, -1):
        slope = slope * t + value
        value = value * t + (-1.0) ** n / (2 * n + 1)
    return value, slope


def equirectangular(x: Numbers, y: Numbers, z: Numbers, do: Operations, pole: float = 0.0) -> OnPlane:
    """Return longitude atan2(x, z) and latitude atan2(y, h), h² = x² + z².

    Args:
        x: To the right.
        y: Down.
        z: Forward.
        do: The operations.
        pole: Lower bound of h / p in the derivatives of the longitude, p² = h² + y²; `POLE` for a Gaussian's ellipse.
    """
    h2 = x * x + z * z
    h, p2 = do.sqrt(h2), h2 + y * y
    bounded = do.maximum(h, pole * do.sqrt(p2)) if pole else h
    along, down = h * bounded, y / (p2 * h)
    return OnPlane(
        do.atan2(x, z),
        do.atan2(y, h),
        (z / along, 0 * y, -x / along),
        (-x * down, h / p2, -z * down),
    )


def radial_factor(q: Numbers, c: Sequence[Numbers]) -> Numbers:
    """Return R(q) of a `Distortion`; NaN where its denominator is not positive is up to the caller."""
    k1, k2, k3, k4, k5, k6, d1, d2, d3 = (c[i] for i in range(RADIAL))
    below = 1 + q * (d1 + q * (d2 + q * d3))
    return (1 + q * (k1 + q * (k2 + q * (k3 + q * (k4 + q * (k5 + q * k6)))))) / below


def radial_image(r: Numbers, c: Sequence[Numbers]) -> tuple[Numbers, Numbers]:
    """Return r R(r²) and its derivative by r.

    Args:
        r: Radii on the plane.
        c: Coefficients, as for `distort`.
    """
    q = r * r
    R, R_q = _radial(q, c)
    return r * R, R + 2 * q * R_q


def _radial(q: Numbers, c: Sequence[Numbers]) -> tuple[Numbers, Numbers]:
    """Return R(q) and its derivative by q."""
    k1, k2, k3, k4, k5, k6, d1, d2, d3 = (c[i] for i in range(RADIAL))
    below = 1 + q * (d1 + q * (d2 + q * d3))
    R = radial_factor(q, c)
    slope = k1 + q * (2 * k2 + q * (3 * k3 + q * (4 * k4 + q * (5 * k5 + q * 6 * k6))))
    return R, (slope - R * (d1 + q * (2 * d2 + q * 3 * d3))) / below


def distort(
    a: Numbers, b: Numbers, c: Sequence[Numbers], radial_first: bool
) -> tuple[tuple[Numbers, Numbers], tuple[tuple[Numbers, Numbers], tuple[Numbers, Numbers]]]:
    """Distort places on the plane; return them and the Jacobian K = d(a', b') / d(a, b).

    Args:
        a: Columns on the plane.
        b: Rows on the plane.
        c: Coefficients, as `gsplat_edu.scene.projection.COEFFICIENTS`.
        radial_first: As in `Distortion`.
    """
    p1, p2, s1, s2, s3, s4 = (c[i] for i in range(RADIAL, 15))
    R, R_q = _radial(a * a + b * b, c)
    radial = ((R + 2 * R_q * a * a, 2 * R_q * a * b), (2 * R_q * a * b, R + 2 * R_q * b * b))
    A, B = (R * a, R * b) if radial_first else (a, b)
    Q = A * A + B * B
    moved = (
        2 * p1 * A * B + p2 * (Q + 2 * A * A) + Q * (s1 + s2 * Q),
        p1 * (Q + 2 * B * B) + 2 * p2 * A * B + Q * (s3 + s4 * Q),
    )
    first, second = 2 * (s1 + 2 * s2 * Q), 2 * (s3 + 2 * s4 * Q)
    extra = (
        (2 * p1 * B + 6 * p2 * A + first * A, 2 * p1 * A + 2 * p2 * B + first * B),
        (2 * p1 * A + 2 * p2 * B + second * A, 6 * p1 * B + 2 * p2 * A + second * B),
    )
    (r00, r01), (r10, r11) = radial
    (e00, e01), (e10, e11) = extra
    place = (R * a + moved[0], R * b + moved[1])
    if not radial_first:
        return place, ((r00 + e00, r01 + e01), (r10 + e10, r11 + e11))
    # K = (I + extra) radial
    return place, (
        (r00 + e00 * r00 + e01 * r10, r01 + e00 * r01 + e01 * r11),
        (r10 + e10 * r00 + e11 * r10, r11 + e10 * r01 + e11 * r11),
    )

"""The formulas of all lens models: where a ray meets the image.

A ray through (x, y, 1) meets the image at (a, b), and the pixel is u = fx a + cx, v = fy b + cy. With r = |(x, y)| and
theta = atan r, each model is one radial function and sometimes an offset. A position is NaN where a model has no image:
beyond the radius up to which its formula is defined, or where a denominator vanishes.

Source: COLMAP's documentation, "Camera Models"; the models' papers are named at their functions.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

PERSPECTIVE = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
"""Coefficients of a perspective lens in OpenCV's order; k4 to k6 belong to the denominator."""

FISHEYE = ("k1", "k2", "k3", "k4")
"""Coefficients of a fisheye lens in OpenCV's order: theta (1 + k1 theta² + k2 theta⁴ + ...)."""

SMALL = 1e-9
"""Radius or field of view below which a quotient is replaced by its limit."""

Plane = Float64[np.ndarray, "*n"]
Coefficients = Float64[np.ndarray, " c"]
Positions = tuple[Plane, Plane]


class Formula(NamedTuple):
    """A lens model.

    Args:
        names: Names of its coefficients.
        image: Maps x and y of rays, and the coefficients, to positions (a, b).
    """

    names: tuple[str, ...]
    image: Callable[[Plane, Plane, Coefficients], Positions]


def _perspective(x: Plane, y: Plane, c: Coefficients) -> Positions:
    """Distort by a rational polynomial in r², and by a decentred element.

    s = (1 + k1 r² + k2 r⁴ + k3 r⁶) / (1 + k4 r² + k5 r⁴ + k6 r⁶)
    a = s x + 2 p1 x y + p2 (r² + 2 x²),   b = s y + p1 (r² + 2 y²) + 2 p2 x y

    Source: Brown 1966; OpenCV's documentation, "Camera Calibration and 3D Reconstruction".
    """
    k1, k2, p1, p2, k3, k4, k5, k6 = c
    q = x * x + y * y
    s = (1 + q * (k1 + q * (k2 + q * k3))) / _positive(1 + q * (k4 + q * (k5 + q * k6)))
    return s * x + 2 * p1 * x * y + p2 * (q + 2 * x * x), s * y + p1 * (q + 2 * y * y) + 2 * p2 * x * y


def _fisheye(x: Plane, y: Plane, c: Coefficients) -> Positions:
    """Replace the tangent by a polynomial of the angle: |(a, b)| = theta (1 + k1 theta² + ... + k4 theta⁸).

    Source: Kannala and Brandt 2006.
    """
    a, b = _equidistant(x, y)
    q = a * a + b * b
    s = 1 + q * (c[0] + q * (c[1] + q * (c[2] + q * c[3])))
    return s * a, s * b


def _field_of_view(x: Plane, y: Plane, c: Coefficients) -> Positions:
    """Use the lens whose image radius is |(a, b)| = atan(2 r tan(omega / 2)) / omega.

    Its limit for omega to 0 is the pinhole.

    Source: Devernay and Faugeras 2001, "Straight lines have to be straight", section 2.1.
    """
    omega = abs(float(c[0]))  # a quotient of two odd functions: its sign does not count
    if omega < SMALL:
        return x, y
    r = np.hypot(x, y)
    slope = 2 * math.tan(omega / 2)
    s = np.where(r > SMALL, np.arctan(r * slope) / np.maximum(r * omega, SMALL**2), slope / omega)
    return s * x, s * y


def _thin_prism(x: Plane, y: Plane, c: Coefficients) -> Positions:
    """Distort the equidistant image (h, w) by a radial polynomial, decentring and a thin prism.

    With q = h² + w² and R = k1 q + k2 q² + k3 q³ + k4 q⁴:
    a = h + h R + 2 p1 h w + p2 (q + 2 h²) + sx1 q,   b = w + w R + 2 p2 h w + p1 (q + 2 w²) + sy1 q

    Source: Weng et al. 1992; the angle instead of its tangent as in ETH3D (Schöps et al. 2017).
    """
    k1, k2, p1, p2, k3, k4, sx, sy = c
    h, w = _equidistant(x, y)
    q = h * h + w * w
    s = 1 + q * (k1 + q * (k2 + q * (k3 + q * k4)))
    a = s * h + 2 * p1 * h * w + p2 * (q + 2 * h * h) + sx * q
    return a, s * w + 2 * p2 * h * w + p1 * (q + 2 * w * w) + sy * q


def _radial_tangential_prism(x: Plane, y: Plane, c: Coefficients) -> Positions:
    """Distort the image of a fisheye with six radial coefficients by decentring and by a prism of two orders.

    (h, w) is the equidistant image times 1 + k0 theta² + ... + k5 theta¹², and q = h² + w²:
    a = h + p0 (q + 2 h²) + 2 p1 h w + s0 q + s1 q²,   b = w + p1 (q + 2 w²) + 2 p0 h w + s2 q + s3 q²

    Source: Project Aria's documentation, "Camera Intrinsic Models", FisheyeRadTanThinPrism.
    """
    k0, k1, k2, k3, k4, k5, p0, p1, s0, s1, s2, s3 = c
    h, w = _equidistant(x, y)
    t = h * h + w * w
    s = 1 + t * (k0 + t * (k1 + t * (k2 + t * (k3 + t * (k4 + t * k5)))))
    h, w = s * h, s * w
    q = h * h + w * w
    a = h + p0 * (q + 2 * h * h) + 2 * p1 * h * w + q * (s0 + s1 * q)
    return a, w + p1 * (q + 2 * w * w) + 2 * p0 * h * w + q * (s2 + s3 * q)


def _division(x: Plane, y: Plane, c: Coefficients) -> Positions:
    """Solve r = d / (1 + k d²) for the image radius d: d = 2 r / (1 + sqrt(1 - 4 k r²)).

    For k > 0 there is no image beyond r² = 1 / (4 k).

    Source: Fitzgibbon 2001, "Simultaneous linear estimation of multiple view geometry and lens distortion".
    """
    (k,) = c
    inside = 1 - 4 * k * (x * x + y * y)
    s = 2 / (1 + np.sqrt(np.where(inside >= 0, inside, np.nan)))
    return s * x, s * y


def _enhanced_unified(x: Plane, y: Plane, c: Coefficients) -> Positions:
    """Project onto an ellipsoid and from there by a shifted pinhole: (a, b) = (x, y) / (alpha d + 1 - alpha).

    Here d = sqrt(beta r² + 1). For alpha > 1/2 and some beta the ray may have no image; there the denominator is not
    positive, or beta r² + 1 is negative.

    Source: Khomutenko et al. 2016, "An enhanced unified camera model".
    """
    alpha, beta = c
    under = beta * (x * x + y * y) + 1
    d = _positive(alpha * np.sqrt(np.where(under >= 0, under, np.nan)) + 1 - alpha)
    return x / d, y / d


def _equidistant(x: Plane, y: Plane) -> Positions:
    """Return (x, y) theta / r."""
    r = np.hypot(x, y)
    s = np.where(r > SMALL, np.arctan(r) / np.maximum(r, SMALL), 1.0)
    return s * x, s * y


def _positive(values: Plane) -> Plane:
    return np.where(values > 0, values, np.nan)


FORMULAS: dict[str, Formula] = {
    "perspective": Formula(PERSPECTIVE, _perspective),
    "fisheye": Formula(FISHEYE, _fisheye),
    "field of view": Formula(("omega",), _field_of_view),
    "thin prism fisheye": Formula(("k1", "k2", "p1", "p2", "k3", "k4", "sx1", "sy1"), _thin_prism),
    "radial tangential prism fisheye": Formula(
        ("k0", "k1", "k2", "k3", "k4", "k5", "p0", "p1", "s0", "s1", "s2", "s3"),
        _radial_tangential_prism,
    ),
    "division": Formula(("k",), _division),
    "enhanced unified": Formula(("alpha", "beta"), _enhanced_unified),
}
"""The lens models by name."""

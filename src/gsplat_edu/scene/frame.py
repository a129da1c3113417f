"""Where a scene lies: the origin of its coordinates in double, and rotations that take its up direction elsewhere.

Coordinates of maps and of the whole earth have six or seven digits before the point, of which float32 keeps only those.
Captures, scenes and meshes therefore carry an origin in double beside coordinates that are small:

    position = coordinates + origin

Whatever moves or compares positions computes in double before it rounds. `origin_of` is the one rule for which origin
is subtracted.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Float64

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.validation import ArrayLike, float64_array

Vector = tuple[float, float, float]

ORIGIN: Vector = (0.0, 0.0, 0.0)

UNITS = ("m", "cm", "mm")
"""Units that a scene's coordinates may have."""

FARTHEST_ORIGIN = 1e30
"""World units: the largest origin, so that float32 coordinates stay finite after the subtraction."""

FAR = 1e4
"""Distance of the middle from zero beyond which an origin is subtracted, world units: float32 resolves it to 1e-3."""

FAR_SPREADS = 100.0
"""The same as a multiple of the median distance to the middle: float32 resolves the middle to 1e-5 of that distance."""

OPPOSITE = -1.0 + 1e-9
"""Cosine below which two directions are opposite."""


def origin_of(positions: Float[np.ndarray, "N 3"]) -> Float64[np.ndarray, "3"]:
    """Return the origin to subtract from positions: their middle in whole units if float32 would blur them, else zero.

    The middle is the median along each axis, which a few stray positions do not move.

    Args:
        positions: (N, 3) world units; those that are not finite or beyond `FARTHEST_ORIGIN` do not count.

    Returns:
        (3,) whole numbers, so that float32 positions lose nothing by the subtraction.
    """
    if not len(positions) or max(positions.max(), -positions.min()) <= FAR_SPREADS:  # false if one is NaN
        return np.zeros(3)
    usable = np.abs(positions).max(axis=1) <= FARTHEST_ORIGIN
    if not usable.any():
        return np.zeros(3)
    middle = np.array([np.median(axis[usable]) for axis in positions.T], dtype=np.float64)
    spread = float(
        np.median(sum((axis[usable] - m) ** 2 for axis, m in zip(positions.T, middle, strict=True))) ** 0.5
    )
    reach = float(np.abs(middle).max())
    if reach <= min(FAR, FAR_SPREADS * max(spread, 1.0)):
        return np.zeros(3)
    origin: Float64[np.ndarray, "3"] = np.round(middle) + 0.0  # no -0.0
    return origin


def as_origin(name: str, value: ArrayLike) -> Vector:
    """Check an origin.

    Args:
        name: Its name, for messages.
        value: Three numbers.

    Raises:
        ShapeError: the shape differs from (3,).
        ArgumentError: a number is NaN, infinite or beyond `FARTHEST_ORIGIN`.
    """
    x, y, z = float64_array(name, value, (3,)).tolist()
    if not max(abs(x), abs(y), abs(z)) <= FARTHEST_ORIGIN:
        raise ArgumentError(f"{name}: is not finite or beyond {FARTHEST_ORIGIN:g}; give another origin")
    return x, y, z


def rotation_between(first: ArrayLike, second: ArrayLike) -> Float64[np.ndarray, "3 3"]:
    """Return the shortest rotation that takes one direction to another.

    R = I + [v]x + [v]x² / (1 + c),  v = a x b,  c = a . b

    a and b are the directions with length 1. Opposite directions turn about the x axis, or about z if they lie on x.

    Args:
        first: (3,) the direction a, not zero.
        second: (3,) the direction b, not zero.
    """
    a, b = (float64_array("direction", value, (3,)) for value in (first, second))
    a, b = a / np.linalg.norm(a), b / np.linalg.norm(b)
    cosine = float(a @ b)
    if cosine < OPPOSITE:
        axis = np.array([1.0, 0.0, 0.0]) if abs(a[0]) < 0.9 else np.array([0.0, 0.0, 1.0])
        axis -= (axis @ a) * a
        axis /= np.linalg.norm(axis)
        half_turn: Float64[np.ndarray, "3 3"] = 2.0 * np.outer(axis, axis) - np.eye(3)
        return half_turn
    x, y, z = np.cross(a, b)
    across = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    turn: Float64[np.ndarray, "3 3"] = np.eye(3) + across + across @ across / (1.0 + cosine)
    return turn

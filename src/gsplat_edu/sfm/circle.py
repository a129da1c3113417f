"""Find the round image of a circular fisheye: a circle with black around it.

The photos of one camera are combined first, so that a dark corner of one scene does not look like the edge of the lens.
The circle is then found from the outermost edge along rays from the middle, by three points at a time (RANSAC) and by
least squares over the points that agree.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8

BLACK = 28.0
"""Brightest value of the area around the circle, 0 to 255: black, the noise of a sensor and what JPEG adds."""

BRIGHT = 0.9
"""Quantile of the photos at each pixel: a single photo with a lens flare in a corner does not count."""

CORNER = 0.02
"""Side of the patches that are examined in the corners, as a fraction of the photo's shorter side."""

ANGLES = 720
"""Rays along which the edge is searched."""

STEP = 0.5
"""Distance of samples along a ray, px."""

CUT = 2.0
"""An edge nearer to the border of the photo is no edge of the lens, but of the photo, px."""

NEAR_EDGE, FAR_FROM_EDGE = 0.02, 0.06
"""The area inside and outside of the edge whose brightness is compared, as fractions of the radius."""

SHARP = 0.35
"""Largest ratio of the brightness outside of the edge to that inside. Vignetting is a slope, and no edge."""

AGREED = 0.01
"""Largest distance of a point from the circle, as a fraction of the radius."""

AGREEING = 0.75
"""Smallest fraction of the rays that have to end at the circle, of those that do not end at the photo's border."""

FEWEST = 60
"""Smallest number of these rays."""

DRAWS = 300
"""Triples of points that are tried."""

OUTSIDE = 0.99
"""Smallest fraction of the pixels outside of the circle that have to be black."""

SMALLEST, LARGEST = 0.25, 0.55
"""Bounds of the radius: of the shorter side, and of the diagonal."""

OFF_CENTRE = 0.15
"""Largest distance of the circle's middle from the photo's, as a fraction of the longer side."""

ROUNDS = 3
"""Rounds: each starts its rays at the middle found by the last one."""


class Circle(NamedTuple):
    """A circle in a photo; pixel centres have integer coordinates."""

    x: float  # column of the middle, px
    y: float  # row of the middle, px
    radius: float  # px

    def scaled(self, factor: float) -> Circle:
        """Return the circle in a photo whose sides are `factor` times as long."""
        return Circle(factor * (self.x + 0.5) - 0.5, factor * (self.y + 0.5) - 0.5, factor * self.radius)

    def inside(self, W: int, H: int, margin: float = 0.0) -> Bool[np.ndarray, "H W"]:
        """Return which pixels lie inside, at least `margin` px from the edge."""
        columns, rows = np.arange(W) - self.x, np.arange(H)[:, None] - self.y
        return np.asarray(columns**2 + rows**2 <= max(0.0, self.radius - margin) ** 2)


def black_corners(picture: UInt8[np.ndarray, "H W"]) -> bool:
    """Return whether all four corners of a grey picture are black."""
    H, W = picture.shape
    side = max(2, round(CORNER * min(H, W)))
    patches = [picture[rows, columns] for rows in _ends(side) for columns in _ends(side)]
    return max(float(patch.mean()) for patch in patches) <= BLACK


def find_circle(pictures: Sequence[UInt8[np.ndarray, "H W"]]) -> Circle | None:
    """Find the circle that grey photos of one camera have in common; None if they have none.

    Args:
        pictures: The photos, of one size; at least one.
    """
    if not pictures or min(pictures[0].shape) < 32:
        return None
    stack = np.stack(pictures)
    bright = (
        np.quantile(stack, BRIGHT, axis=0).astype(np.float32)
        if len(stack) > 1
        else stack[0].astype(np.float32)
    )
    H, W = bright.shape
    if not black_corners(np.rint(bright).astype(np.uint8)):
        return None
    lit = bright > BLACK
    if not lit.any():
        return None
    rows, columns = np.nonzero(lit)
    x, y = float(columns.mean()), float(rows.mean())
    found: Circle | None = None
    for _ in range(ROUNDS):
        points, uncut = _edges(bright, x, y)
        found = _fitted(points, uncut)
        if found is None or max(abs(found.x - x), abs(found.y - y)) > max(W, H):
            return None
        x, y = found.x, found.y
    return found if found is not None and _plausible(found, bright) else None


def _ends(side: int) -> tuple[slice, slice]:
    return slice(None, side), slice(-side, None)


def _edges(bright: Float32[np.ndarray, "H W"], x: float, y: float) -> tuple[Float64[np.ndarray, "n 2"], int]:
    """Find the outermost sharp edge along each ray from a point.

    Returns:
        The edges, px; and the number of rays that do not reach the photo's border with light.
    """
    H, W = bright.shape
    radii = np.arange(0.0, np.hypot(W, H), STEP)
    angles = 2 * np.pi * np.arange(ANGLES) / ANGLES
    cos, sin = np.cos(angles)[:, None], np.sin(angles)[:, None]
    u, v = (x + cos * radii).astype(np.float32), (y + sin * radii).astype(np.float32)
    inside = (u >= 0) & (u <= W - 1) & (v >= 0) & (v <= H - 1)
    light = cv2.remap(bright, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    light[~inside] = 0.0
    found, uncut = list[tuple[float, float]](), 0
    last = inside.shape[1] - 1 - np.argmax(inside[:, ::-1], axis=1)
    for ray in range(ANGLES):
        lit = np.flatnonzero(light[ray] > BLACK)
        if not len(lit) or radii[last[ray]] - radii[lit[-1]] < CUT:
            continue
        uncut += 1
        radius = _half_way(light[ray], int(lit[-1]), int(last[ray]))
        if radius is not None:
            found.append((x + float(cos[ray, 0]) * radius, y + float(sin[ray, 0]) * radius))
    return np.array(found, np.float64).reshape(-1, 2), uncut


def _half_way(light: Float32[np.ndarray, " n"], outermost: int, last: int) -> float | None:
    """Return the radius at which the light along a ray falls to half, px; None if it does not fall sharply."""
    near, far = (max(2, round(share * outermost)) for share in (NEAR_EDGE, FAR_FROM_EDGE))
    inner = float(light[max(0, outermost - far) : max(1, outermost - near)].mean())
    beyond = light[outermost + near : min(outermost + far, last + 1)]
    outer = float(beyond.mean()) if len(beyond) else 0.0
    if inner < BLACK or outer > SHARP * inner:
        return None
    half = 0.5 * (inner + outer)
    above = np.flatnonzero(light[: min(outermost + far, last + 1)] >= half)
    i = int(above[-1])
    if i + 1 >= len(light) or light[i] <= light[i + 1]:
        return None
    return STEP * (i + float((light[i] - half) / (light[i] - light[i + 1])))


def _fitted(points: Float64[np.ndarray, "n 2"], uncut: int) -> Circle | None:
    """Fit a circle to points of which some may be wrong; None if too few agree or they lie on one side."""
    if len(points) < max(FEWEST, AGREEING * uncut):
        return None
    rng, best = np.random.default_rng(0), np.zeros(len(points), np.bool_)
    for _ in range(DRAWS):
        drawn = _through(points[rng.choice(len(points), 3, replace=False)])
        if drawn is None:
            continue
        agree = _off(points, drawn) <= AGREED * drawn.radius
        if agree.sum() > best.sum():
            best = agree
    circle: Circle | None = None
    for _ in range(ROUNDS):
        if best.sum() < max(FEWEST, AGREEING * uncut):
            return None
        circle = _through(points[best])
        if circle is None:
            return None
        best = _off(points, circle) <= AGREED * circle.radius
    if circle is None:
        return None
    right, below = points[best, 0] > circle.x, points[best, 1] > circle.y
    sides = [int((right == a)[below == b].sum()) for a in (False, True) for b in (False, True)]
    return circle if min(sides) >= FEWEST / 8 else None


def _through(points: Float64[np.ndarray, "n 2"]) -> Circle | None:
    """Return the circle with the least algebraic distance from points (Kåsa 1976); None if they are collinear."""
    middle = points.mean(axis=0)
    x, y = (points - middle).T
    rows = np.stack([2 * x, 2 * y, np.ones(len(x))], axis=1)
    (a, b, c), _, rank, _ = np.linalg.lstsq(rows, x * x + y * y, rcond=1e-9)
    square = c + a * a + b * b
    if rank < 3 or not square > 0:
        return None
    return Circle(float(middle[0] + a), float(middle[1] + b), float(np.sqrt(square)))


def _off(points: Float64[np.ndarray, "n 2"], circle: Circle) -> Float64[np.ndarray, " n"]:
    return np.asarray(np.abs(np.hypot(points[:, 0] - circle.x, points[:, 1] - circle.y) - circle.radius))


def _plausible(circle: Circle, bright: Float32[np.ndarray, "H W"]) -> bool:
    """Return whether the circle has a lens's size and place, and everything around it is black."""
    H, W = bright.shape
    if not SMALLEST * min(W, H) <= circle.radius <= LARGEST * np.hypot(W, H):
        return False
    if max(abs(circle.x - (W - 1) / 2), abs(circle.y - (H - 1) / 2)) > OFF_CENTRE * max(W, H):
        return False
    around = ~circle.inside(W, H, -max(2.0, NEAR_EDGE * circle.radius))
    return bool(around.any() and (bright[around] <= BLACK).mean() >= OUTSIDE)

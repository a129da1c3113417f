"""Cameras with other lenses than the pinhole, made from those of a path, and the plan of a scene from above.

A fisheye is a circle in a square image, with the angle to the axis proportional to the radius. A panorama stays level,
because its viewers put the middle of the image on the horizon. A plan looks straight down, to scale.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.validation import in_range
from gsplat_edu.paths.orbits import weighted_quantile
from gsplat_edu.scene.camera import Camera, look_at
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.scene.projection import STEEPEST_FISHEYE, Projection
from gsplat_edu.scene.shells import far_shell

WIDEST_FISHEYE = 2 * math.degrees(STEEPEST_FISHEYE)
"""Largest field of view of a fisheye, degrees."""

PANORAMA_SIDES = 4
"""The width of a panorama is a multiple of this many px: it is twice the height, and videos have even sides."""

EXTENT = (0.01, 0.99)
"""Quantiles of opacity between which a plan shows the scene,"""

FENCE = 1.5
"""but at most this multiple of the distance between the quartiles beyond them, as in Tukey's box plots: the
background of an outdoor capture would make the subject tiny."""

PLAN_MARGIN = 0.1
"""Margin of a plan on each side, as a fraction of the extent."""

SLACK = 1e-4
"""How much higher than what is drawn a plan ends, as a fraction of the scene: the highest splat is in it."""

LEVEL = 1e-3
"""Smallest sine of the angle between a view and the vertical at which the view has a horizontal direction."""


@dataclass(frozen=True)
class Plan:
    """A camera that looks straight down on a scene, to scale.

    Args:
        camera: Orthographic; its focal length is the number of px per world unit.
        width: Width of the image, world units.
        height: Height of the image, world units.
        top: Height of the scene above its floor, world units: 99 % of the opacity is lower.
        cut: Height above which nothing is drawn, world units; None if all is drawn.
    """

    camera: Camera
    width: float
    height: float
    top: float
    cut: float | None


def fisheye(camera: Camera, degrees: float, size: int) -> Camera:
    """Return the fisheye at a camera's place that sees a cone of the given angle, as a circle in a square image.

    Args:
        camera: The camera.
        degrees: Field of view, the diameter of the circle: above 0, up to `WIDEST_FISHEYE`.
        size: Side of the image, px.

    Raises:
        ArgumentError: the angle is out of range.
    """
    focal = size / math.radians(in_range("degrees", degrees, 0.0, WIDEST_FISHEYE, open_low=True))
    middle = (size - 1) / 2
    plain = Camera(camera.R, camera.eye, focal, focal, middle, middle, size, size)
    return plain.through(Projection("fisheye"))


def circle(size: int) -> Bool[np.ndarray, "H W"]:
    """Return which pixels of a square image lie in its circle.

    Args:
        size: Side of the image, px.
    """
    squares = np.square(np.arange(size) - (size - 1) / 2)
    return np.asarray(squares[:, None] + squares <= size * size / 4)


def panorama(camera: Camera, up: Sequence[float], size: int) -> Camera:
    """Return the level equirectangular camera at a camera's place; the middle of its image is where that one looks.

    Args:
        camera: The camera.
        up: (3,) the scene's up direction.
        size: Width of the image, px, a multiple of `PANORAMA_SIDES`; it is twice the height.

    Raises:
        ArgumentError: the width is no such multiple.
    """
    if size % PANORAMA_SIDES or size <= 0:
        raise ArgumentError(
            f"size: is {size}, but the width of a panorama is a multiple of {PANORAMA_SIDES} px"
        )
    forward = _horizontal(np.asarray(up, np.float64), camera.R[2], -camera.R[1], camera.R[0])
    return Camera.panorama(look_at(np.zeros(3), forward, up), camera.eye, size // 2, size)


def orthographic(camera: Camera, depth: float) -> Camera:
    """Return the orthographic camera that shows what lies at a depth as large as a camera does.

    Args:
        camera: The camera.
        depth: World units, above 0.

    Raises:
        ArgumentError: the depth is not positive.
    """
    depth = in_range("depth", depth, 0.0, open_low=True)
    focals = camera.fx / depth, camera.fy / depth
    plain = Camera(camera.R, camera.eye, *focals, camera.cx, camera.cy, camera.H, camera.W)
    return plain.through(Projection("orthographic"))


def floor_plan(
    gaussians: Gaussians, up: Sequence[float], size: int, z_near: float, cut: float | None = None
) -> Plan:
    """Look straight down on a scene. The top of the image is the world's +z (+x, where that is up).

    The extent of each horizontal axis holds 98 % of the opacity, but ends at most 1.5 times the distance between the
    quartiles beyond them. The floor is the height above which 99 % of the opacity lies. A far shell, such as a sky, has
    no say.

    Args:
        gaussians: N Gaussians, at least one that is finite.
        up: (3,) the scene's up direction.
        size: Longer side of the image, px.
        z_near: Smallest depth that is drawn, world units.
        cut: Leave out what is higher above the floor, such as a ceiling, world units; None for nothing.

    Raises:
        ArgumentError: there is nothing to look at.
    """
    means = gaussians.means.double().numpy(force=True)
    weights = gaussians.opacities.double().numpy(force=True)
    near = np.isfinite(means).all(axis=1) & (weights > 0) & ~far_shell(means)
    if not near.any():
        raise ArgumentError("gaussians: none has a place and an opacity; there is nothing to look at")
    means, weights = means[near], weights[near]
    vertical = np.asarray(up, np.float64) / np.linalg.norm(up)
    north = _horizontal(vertical, np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0]))
    R = look_at(np.zeros(3), -vertical, north)
    heights = means @ vertical
    floor = weighted_quantile(heights, weights, EXTENT[0])
    highest, top = float(heights.max()), weighted_quantile(heights, weights, EXTENT[1])
    end = highest if cut is None else min(floor + cut, highest)
    shown = heights <= end
    (left, right), (back, front) = (_extent((means @ axis)[shown], weights[shown]) for axis in R[:2])
    width, height = right - left, front - back
    if max(width, height) == 0.0:  # a single place: three standard deviations to each side
        width = height = 6.0 * float(gaussians.scales.detach().max())
    longest = max(width, height)
    focal = size / longest
    W, H = (max(1, math.ceil(side * focal - 1e-9)) for side in (width, height))
    middle = 0.5 * (left + right) * R[0] + 0.5 * (back + front) * R[1]
    eye = middle + (end + z_near + SLACK * longest) * vertical
    plain = Camera(R, eye, focal, focal, (W - 1) / 2, (H - 1) / 2, H, W)
    camera = plain.through(Projection("orthographic"))
    return Plan(camera, W / focal, H / focal, top - floor, None if end == highest else cut)


def _extent(places: Float64[np.ndarray, " N"], weights: Float64[np.ndarray, " N"]) -> tuple[float, float]:
    """Return the ends of an axis of a plan, with its margin."""
    low, first, third, high = (
        weighted_quantile(places, weights, q) for q in (EXTENT[0], 0.25, 0.75, EXTENT[1])
    )
    fence = FENCE * (third - first)
    if fence > 0:
        low, high = max(low, first - fence), min(high, third + fence)
    half, middle = (high - low) * (0.5 + PLAN_MARGIN), 0.5 * (low + high)
    return middle - half, middle + half


def _horizontal(
    up: Float64[np.ndarray, "3"], *directions: Float64[np.ndarray, "3"]
) -> Float64[np.ndarray, "3"]:
    """Return the horizontal part, of length 1, of the first direction that is not vertical."""
    up = up / np.linalg.norm(up)
    for direction in directions:
        flat = direction - (direction @ up) * up
        if (length := float(np.linalg.norm(flat))) > LEVEL:
            return np.asarray(flat / length)
    raise ArgumentError("directions: are all vertical")

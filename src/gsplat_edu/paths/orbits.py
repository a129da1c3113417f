"""Orbits around scenes without cameras, and the common up direction of cameras."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.validation import ArrayLike, float64_array, whole_number
from gsplat_edu.scene.camera import WORLD_UP, Camera, as_camera
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.scene.shells import far_shell

Vector = Float64[np.ndarray, "3"]

LEAST_SPREAD_OF_RIGHT_AXES = 0.01
"""The cameras' right axes define up only if their mean square along the second principal direction exceeds this, which
corresponds to directions that differ by 6 degrees (root mean square)."""

STEEPEST = math.radians(80.0)
"""Largest elevation of an orbit: straight above, the image's up direction is undefined."""

ORBIT_FOV = math.radians(50.0)
"""Field of view of an orbit around a scene without cameras."""

ORBIT_ELEVATION = math.radians(15.0)
"""Elevation of such an orbit: high enough to show the ground under a subject."""

BOX = (0.1, 0.9)
"""Quantiles of opacity along each axis; the orbit's centre is midway between them. This finds the middle of an object
however unevenly its Gaussians are distributed."""

EXTENT_QUANTILE = 0.95
"""Fraction of the opacity that an orbit keeps in view; the rest may be floaters."""

ORBIT_MARGIN = 1.1
"""Margin around the extent that an orbit keeps in view, as a factor."""

MOST_EXTENT = 2.0
"""An orbit's extent is at most this multiple of the median distance; the background of a capture lies beyond."""


def orbit_of_scene(gaussians: Gaussians, frames: int, size: int, up: ArrayLike = WORLD_UP) -> list[Camera]:
    """Make a closed orbit around a scene without cameras.

    The centre is the middle of the box that holds 10 to 90 % of the opacity along each axis. The extent is the radius
    of the sphere that holds 95 % of the opacity, at most twice the radius of the one that holds half. The orbit's
    radius lets this sphere fill a field of view of 50 degrees, with a margin of 10 %. A far shell, such as a sky, is
    ignored.

    Args:
        gaussians: N Gaussians, at least one.
        frames: Number of cameras, at least one.
        size: Height and width of the images, px.
        up: (3,) the scene's up direction.

    Raises:
        ShapeError: up is not of shape (3,).
        ArgumentError: there are no Gaussians, or frames or size is not a whole number of at least 1.
    """
    if not len(gaussians):
        raise ArgumentError("gaussians: is empty; there is nothing to look at")
    frames, size = whole_number("frames", frames, 1), whole_number("size", size, 1)
    means = gaussians.means.double().numpy(force=True)
    near = ~far_shell(means)
    means, weights = means[near], gaussians.opacities.double().numpy(force=True)[near]
    centre = np.array([sum(weighted_quantile(column, weights, q) for q in BOX) / 2 for column in means.T])
    distances = np.linalg.norm(means - centre, axis=1)
    outer, middle = (weighted_quantile(distances, weights, q) for q in (EXTENT_QUANTILE, 0.5))
    extent = min(outer, MOST_EXTENT * middle) or outer
    if extent == 0.0:  # one Gaussian: three standard deviations of it
        extent = 3.0 * float(gaussians.scales.detach().max())
    radius = ORBIT_MARGIN * extent / math.sin(ORBIT_FOV / 2)
    focal = size / 2 / math.tan(ORBIT_FOV / 2)
    up = _unit(float64_array("up", up, (3,)), np.array(WORLD_UP))
    start = _unit(_level(np.array([0.0, 0.0, -1.0]), up), _level(np.array([1.0, 0.0, 0.0]), up))
    eyes = _circle(centre, up, start, radius, ORBIT_ELEVATION, frames)
    return [Camera.looking_at(eye, centre, focal, focal, size, size, up) for eye in eyes]


def resized(camera: Camera, longest: int) -> Camera:
    """Scale the camera's image so that its longer side has the given length; the field of view stays the same.

    Args:
        camera: The camera.
        longest: Longer side, px.

    Raises:
        ArgumentError: longest is not a whole number of at least 1.
    """
    camera, longest = as_camera("camera", camera), whole_number("longest", longest, 1)
    share = longest / max(camera.W, camera.H)
    W, H = (max(1, round(side * share)) for side in (camera.W, camera.H))
    return camera.scaled(W, H)


def common_up(cameras: Sequence[Camera]) -> Float64[np.ndarray, "3"]:
    """Find the up direction of cameras that are held level.

    The mean of their up axes would be tilted where cameras on one side look down.

    Args:
        cameras: At least one.

    Returns:
        (3,) of length 1.
    """
    mean = _unit(np.sum([-camera.R[1] for camera in cameras], axis=0), -cameras[0].R[1])
    rights = np.stack([camera.R[0] for camera in cameras])
    values, vectors = np.linalg.eigh(rights.T @ rights / len(cameras))
    up: Vector = vectors[:, 0] if vectors[:, 0] @ mean > 0 else -vectors[:, 0]
    # The right axes must span a plane, and that plane must be the ground: some cameras may be held in portrait.
    return (
        up
        if values[1] > LEAST_SPREAD_OF_RIGHT_AXES and values[1] > 4 * values[0] and up @ mean > 0.7
        else mean
    )


def _circle(
    centre: Vector, up: Vector, start: Vector, radius: float, elevation: float, frames: int
) -> Float64[np.ndarray, "frames 3"]:
    """Place eyes on a circle: e(t) = c + r (cos(el) (cos t a + sin t (up × a)) + sin(el) up), with a = start."""
    elevation = min(max(elevation, -STEEPEST), STEEPEST)
    angles = 2.0 * np.pi * np.arange(frames) / frames
    ring = np.cos(angles)[:, None] * start + np.sin(angles)[:, None] * np.cross(up, start)
    eyes: Float64[np.ndarray, "frames 3"] = centre + radius * (
        np.cos(elevation) * ring + np.sin(elevation) * up
    )
    return eyes


def _level(vector: Vector, up: Vector) -> Vector:
    flat: Vector = vector - (vector @ up) * up
    return flat


def _unit(vector: Vector, otherwise: Vector) -> Vector:
    """Return the direction of a vector, or of `otherwise` if the vector is nearly zero."""
    length = float(np.linalg.norm(vector))
    chosen = vector / length if length > 1e-6 else otherwise / np.linalg.norm(otherwise)
    return np.asarray(chosen, dtype=np.float64)


def weighted_quantile(
    values: Float64[np.ndarray, " N"], weights: Float64[np.ndarray, " N"], share: float
) -> float:
    """Return the smallest value at or below which a share of the weight lies.

    Args:
        values: (N,) at least one.
        weights: (N,) of them, at least 0.
        share: 0 to 1.
    """
    order = np.argsort(values, kind="stable")
    mass = np.cumsum(weights[order])
    index = int(np.searchsorted(mass, share * mass[-1]))
    return float(values[order[min(index, len(values) - 1)]])

"""Orbits around a scene that came without cameras, and what cameras have in common."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64

from gsplat_edu.camera import WORLD_UP, Camera, scaled_intrinsics
from gsplat_edu.errors import ArgumentError
from gsplat_edu.gaussians import Gaussians
from gsplat_edu.validation import ArrayLike, float64_array, whole_number

Vector = Float64[np.ndarray, "3"]

PARALLEL = 1e-3
"""Smallest eigenvalue of mean(I - f f') that still fixes a point: below it (about 1.8 degrees between axes) where the
optical axes cross is noise."""

SPREAD = 0.01
"""Mean square of the right axes along their second direction (a spread of 6 degrees) from which they fix up."""

STEEPEST = math.radians(80.0)
"""Orbits stay this far from straight above, where up in the image is not defined."""

ORBIT_FOV = math.radians(50.0)
"""Field of view of an orbit around a bare scene."""

ORBIT_ELEVATION = math.radians(15.0)
"""Height of an orbit around a bare scene: enough to see what a subject stands on."""

BOX = (0.1, 0.9)
"""Shares of a bare scene's opacity, along each axis, between which an orbit has its centre: the middle of an object,
however unevenly its splats are spread."""

EXTENT_QUANTILE = 0.95
"""Share of a bare scene's opacity that an orbit keeps in the picture; the rest may be floaters."""

ORBIT_MARGIN = 1.1
"""Room around what an orbit keeps in the picture."""

MOST_EXTENT = 2.0
"""An orbit's extent is at most this many medians of the distance: beyond lies the background of a capture."""


def orbit_of_scene(gaussians: Gaussians, frames: int, size: int, up: ArrayLike = WORLD_UP) -> list[Camera]:
    """Make a closed orbit around a scene that came without cameras.

    The centre is the middle of the box that holds 10 to 90 % of the opacity along each axis. The radius lets the
    sphere that holds 95 % of the opacity, but at most twice as large as the one that holds half, fill a field of
    view of 50 degrees but for a margin.

    Args:
        gaussians: N Gaussians, at least one.
        frames: Cameras of the orbit, at least one.
        size: Height and width of the images, px.
        up: (3,) direction that is up in the scene.

    Raises:
        ShapeError: up is not of shape (3,).
        ArgumentError: there are no Gaussians, or frames or size is not a whole number of at least 1.
    """
    if not len(gaussians):
        raise ArgumentError("gaussians: is empty; there is nothing to look at")
    frames, size = whole_number("frames", frames, 1), whole_number("size", size, 1)
    means = gaussians.means.double().numpy(force=True)
    weights = gaussians.opacities.double().numpy(force=True)
    centre = np.array([sum(_weighted_quantile(column, weights, q) for q in BOX) / 2 for column in means.T])
    distances = np.linalg.norm(means - centre, axis=1)
    outer, middle = (_weighted_quantile(distances, weights, q) for q in (EXTENT_QUANTILE, 0.5))
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
    """Return the camera with an image whose longer side has the given length; what it sees stays the same.

    Args:
        camera: The camera.
        longest: Longer side, px.

    Raises:
        ArgumentError: longest is not a whole number of at least 1.
    """
    longest = whole_number("longest", longest, 1)
    share = longest / max(camera.W, camera.H)
    W, H = (max(1, round(side * share)) for side in (camera.W, camera.H))
    intrinsics = (camera.fx, camera.fy, camera.cx, camera.cy)
    return Camera(camera.R, camera.eye, *scaled_intrinsics(*intrinsics, W / camera.W, H / camera.H), H, W)


def common_up(cameras: Sequence[Camera]) -> Float64[np.ndarray, "3"]:
    """Find the direction that is up for cameras held level; their mean up leans where they look down on one side.

    Args:
        cameras: At least one.

    Returns:
        (3,) of length 1.
    """
    mean = _unit(np.sum([-camera.R[1] for camera in cameras], axis=0), -cameras[0].R[1])
    rights = np.stack([camera.R[0] for camera in cameras])
    values, vectors = np.linalg.eigh(rights.T @ rights / len(cameras))
    up: Vector = vectors[:, 0] if vectors[:, 0] @ mean > 0 else -vectors[:, 0]
    # the right axes have to span a plane, and the plane has to be the ground: some cameras may be held upright
    return up if values[1] > SPREAD and values[1] > 4 * values[0] and up @ mean > 0.7 else mean


def _circle(
    centre: Vector, up: Vector, start: Vector, radius: float, elevation: float, frames: int
) -> Float64[np.ndarray, "frames 3"]:
    """Walk around the centre: e(t) = c + r (cos(el) (cos t a + sin t (up × a)) + sin(el) up), a the start."""
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
    """Return the direction of a vector, or of the second one where the first is (nearly) nothing."""
    length = float(np.linalg.norm(vector))
    chosen = vector / length if length > 1e-6 else otherwise / np.linalg.norm(otherwise)
    return np.asarray(chosen, dtype=np.float64)


def _weighted_quantile(
    values: Float64[np.ndarray, " N"], weights: Float64[np.ndarray, " N"], share: float
) -> float:
    order = np.argsort(values, kind="stable")
    mass = np.cumsum(weights[order])
    index = int(np.searchsorted(mass, share * mass[-1]))
    return float(values[order[min(index, len(values) - 1)]])

"""Camera paths to show a scene: orbits around what the cameras looked at."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64

from gsplat_edu.camera import WORLD_UP, Camera, look_at, point_nearest_axes, scaled_intrinsics
from gsplat_edu.errors import ArgumentError
from gsplat_edu.gaussians import Gaussians
from gsplat_edu.validation import ArrayLike, float64_array, in_range, whole_number

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


def orbit_path(cameras: Sequence[Camera], frames: int, depth: float = 1.0) -> list[Camera]:
    """Make a closed orbit around what cameras look at, in whatever frame they stand.

    The centre c is the point closest to all optical axes, min_c sum_i |(I - f_i f_i') (c - e_i)|^2. Up is the
    direction most level for all cameras, min_u sum_i (r_i . u)^2 with r their right axes, or the mean of their up
    directions where those do not fix it. Radius and elevation are the cameras' medians.

    Args:
        cameras: At least one. The first lends intrinsics and size, and the side from which the orbit starts.
        frames: Cameras of the orbit, at least one; the first is not repeated at the end.
        depth: Distance of the centre in front of the mean camera, world units, where the axes fix no point: one
            camera, parallel ones, or cameras that look outwards.

    Returns:
        The cameras of the orbit; each has the centre at its principal point.

    Raises:
        ArgumentError: there is no camera, frames is not a whole number of at least 1, or depth is not positive.
    """
    if not cameras:
        raise ArgumentError("cameras: is empty; give at least one")
    frames = whole_number("frames", frames, 1)
    depth = in_range("depth", depth, 0.0, open_low=True)
    eyes = np.stack([camera.eye for camera in cameras])
    up = common_up(cameras)
    centre = _point_looked_at(cameras, depth)
    offsets = eyes - centre
    distances = np.linalg.norm(offsets, axis=1)
    radius = float(np.median(distances))  # not 0: most cameras have the centre in front of them
    away = distances > 0
    sines = np.clip(offsets[away] @ up / distances[away], -1.0, 1.0)
    elevation = float(np.median(np.arcsin(sines)))
    # the orbit starts where the first camera stands; where that is straight above, on the side of its levellest axis
    levellest = cameras[0].R[int(np.argmin(np.abs(cameras[0].R @ up)))]
    start = _unit(_level(offsets[0] / radius, up), _level(levellest, up))
    eyes_on_orbit = _circle(centre, up, start, radius, elevation, frames)
    first = cameras[0]
    intrinsics = (first.fx, first.fy, first.cx, first.cy, first.H, first.W)
    return [Camera(look_at(eye, centre, up), eye, *intrinsics) for eye in eyes_on_orbit]


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


def _point_looked_at(cameras: Sequence[Camera], depth: float) -> Vector:
    forwards = np.stack([camera.R[2] for camera in cameras])
    eyes = np.stack([camera.eye for camera in cameras])
    point = point_nearest_axes(cameras, PARALLEL)
    if point is not None:
        ahead = np.sum((point - eyes) * forwards, axis=1)
        # most cameras have it in front, and do not stand in it
        if np.median(ahead) > 1e-9 * np.abs(eyes).max():
            return point
    in_front: Vector = eyes.mean(axis=0) + depth * _unit(forwards.sum(axis=0), forwards[0])
    return in_front


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

"""Several cameras together: an orbit, where they look, and how far they spread."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from jaxtyping import Float64

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.validation import float64_array, in_range
from gsplat_edu.scene.camera import Camera

PARALLEL = 1e-3
"""Smallest eigenvalue of mean(I - d d') at which the intersection of the optical axes d is well defined. Below it
(about 1.8 degrees between axes) the intersection is noise."""

EXTENT_MARGIN = 1.1
"""Factor between the cameras' spread and the extent (the code of Kerbl et al. 2023)."""


def orbit_camera(azimuth: float, elevation: float, size: int, fx: float, radius: float = 3.0) -> Camera:
    """Make a square camera on a sphere around the origin, looking at the origin.

    eye = radius (cos e sin a, sin e, -cos e cos a)

    Args:
        azimuth: Angle around the vertical axis, radians; 0 looks along +z.
        elevation: Angle from the horizon, radians; positive is +y, which is down.
        size: Height and width of the image, px.
        fx: Focal length of both axes, px.
        radius: Distance of the camera from the origin, world units.

    Raises:
        ArgumentError: the radius or focal length is not positive, the size is below 1, or the camera is straight above
            or below the origin, where up is undefined.
    """
    radius = in_range("radius", radius, 0.0, open_low=True)
    azimuth, elevation = (
        float(float64_array(n, a, ())) for n, a in (("azimuth", azimuth), ("elevation", elevation))
    )
    direction = (np.cos(elevation) * np.sin(azimuth), np.sin(elevation), -np.cos(elevation) * np.cos(azimuth))
    return Camera.looking_at(radius * np.array(direction), (0.0, 0.0, 0.0), fx, fx, size, size)


def point_nearest_axes(cameras: Sequence[Camera]) -> Float64[np.ndarray, "3"] | None:
    """Find the point nearest to all optical axes in the least-squares sense.

    p minimises sum_i |(I - d_i d_i') (p - e_i)|²,  e_i: centre of camera i,  d_i: its viewing direction

    Args:
        cameras: At least one.

    Returns:
        (3,) world units; None if the axes are so nearly parallel that their intersection is noise.
    """
    eyes = np.stack([camera.eye for camera in cameras])
    axes = np.stack([camera.R[2] for camera in cameras])
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    A, mean = across.mean(axis=0), eyes.mean(axis=0)
    if np.linalg.eigvalsh(A)[0] < PARALLEL:
        return None
    b = (across @ (eyes - mean)[:, :, None]).mean(axis=0)[:, 0]
    return np.asarray(mean + np.linalg.solve(A, b))


def stand_in(camera: Camera) -> Camera:
    """Return the pinhole at rest that shows the middle of a camera's image, at most 90 degrees of it along each side.

    A fisheye's focal length, px per radian, is that of the pinhole that has its resolution in the middle.

    Args:
        camera: Any camera; a pinhole is returned as it is.
    """
    if camera.pinhole:
        return camera
    if camera.projection.kind == "perspective":
        return camera.through()
    fx, fy = max(camera.fx, camera.W / 2), max(camera.fy, camera.H / 2)
    if camera.projection.kind == "equirectangular":
        fx = fy = max(fx, fy)
    return Camera(camera.R, camera.eye, fx, fy, (camera.W - 1) / 2, (camera.H - 1) / 2, camera.H, camera.W)


def through_lenses(cameras: Iterable[Camera]) -> bool:
    """Return whether a camera is no pinhole at rest: of a scene's own cameras, whether it was trained through lenses.

    Args:
        cameras: Any number of cameras.
    """
    return not all(camera.pinhole for camera in cameras)


def scene_extent(cameras: Sequence[Camera]) -> float:
    """Measure the scale of a scene by the spread of its cameras.

    1.1 max_i |e_i - mean e|,  e_i: centre of camera i

    Args:
        cameras: At least one.

    Returns:
        World units; 1 if all cameras are at the same place, which does not determine the size.

    Raises:
        ArgumentError: there is no camera.

    Source: the code of Kerbl et al. 2023.
    """
    if not cameras:
        raise ArgumentError("cameras: is empty; the extent of a scene needs at least one camera")
    eyes = np.stack([camera.eye for camera in cameras])
    spread = float(np.linalg.norm(eyes - eyes.mean(axis=0), axis=1).max())
    # Differences within rounding count as the same place.
    return EXTENT_MARGIN * spread if spread > 1e-9 * max(1.0, float(np.abs(eyes).max())) else 1.0

"""Several cameras together: an orbit, where they look, and how far they spread."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from jaxtyping import Bool, Float64

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.validation import float64_array, in_range
from gsplat_edu.scene.camera import Camera

PARALLEL = 1e-3
"""Smallest eigenvalue of mean(I - d d') at which the intersection of the optical axes d is well defined. Below it
(about 1.8 degrees between axes) the intersection is noise."""

EXTENT_MARGIN = 1.1
"""Factor between the cameras' spread and the extent (the code of Kerbl et al. 2023)."""

SAME_PLACE = 1e-9
"""Cameras within this fraction of their largest coordinate, or of 1, are at the same place: rounding error."""

FAR_AWAY = 8.0
"""A camera is far away if its distance from the median position exceeds this multiple of the 75th percentile of all.
The ratio is 1.4 at the ends of a straight path and 1 on an orbit."""

COMPANY = 3
"""Far cameras with at least this many others within half of that distance are no strays, but part of the capture, such
as the photos of a drone."""


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


def far_ratios(eyes: Float64[np.ndarray, "C 3"]) -> Float64[np.ndarray, " C"]:
    """Return the cameras' distances from their median position, in units of the 75th percentile of these distances.

    Args:
        eyes: (C, 3) centres of the cameras, world units; at least one.

    Returns:
        (C,) ratios; 0 if three quarters of the cameras are at one place.
    """
    distances = np.linalg.norm(eyes - np.median(eyes, axis=0), axis=1)
    usual = float(np.quantile(distances, 0.75))
    if usual <= SAME_PLACE * max(1.0, float(np.quantile(np.abs(eyes), 0.75))):
        return np.zeros(len(eyes))
    return np.asarray(distances / usual)


def stray_eyes(eyes: Float64[np.ndarray, "C 3"]) -> Bool[np.ndarray, " C"]:
    """Return which cameras stand alone and far from all others, as those whose pose is wrong do.

    A camera is a stray if its distance from the median position exceeds `FAR_AWAY` times the 75th percentile of all
    distances, and fewer than `COMPANY` other cameras are within half of its distance.

    Args:
        eyes: (C, 3) centres of the cameras, world units; at least one.

    Returns:
        (C,) true for strays; at most a quarter of the cameras are.
    """
    stray = far_ratios(eyes) > FAR_AWAY
    if stray.any():
        offsets = eyes - np.median(eyes, axis=0)
        for index in np.flatnonzero(stray):
            near = 0.5 * np.linalg.norm(offsets[index])
            within = np.linalg.norm(offsets - offsets[index], axis=1) <= near
            stray[index] = int(within.sum()) - 1 < COMPANY  # each camera is within its own radius
    return stray


def settled_eyes(cameras: Sequence[Camera]) -> Float64[np.ndarray, "n 3"]:
    """Return the centres of the cameras that are no strays (`stray_eyes`): those that measure a scene.

    Args:
        cameras: At least one.

    Returns:
        (n, 3) world units, in the order of the cameras.
    """
    eyes = np.stack([camera.eye for camera in cameras])
    return np.asarray(eyes[~stray_eyes(eyes)])


def scene_extent(cameras: Sequence[Camera]) -> float:
    """Measure the scale of a scene by the spread of its cameras. Strays (`stray_eyes`) do not count.

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
    eyes = settled_eyes(cameras)
    spread = float(np.linalg.norm(eyes - eyes.mean(axis=0), axis=1).max())
    # Differences within rounding count as the same place.
    return EXTENT_MARGIN * spread if spread > SAME_PLACE * max(1.0, float(np.abs(eyes).max())) else 1.0

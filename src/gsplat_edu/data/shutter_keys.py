"""Rolling shutters and motion blur in transforms.json, by the keys of 3dgs-deblur's captures.

`rolling_shutter_time` T is the time from the first row to the last, s, and `exposure_time` E the time for which each is
exposed. `camera_linear_velocity` v and
`camera_angular_velocity` w are those of the camera itself, along and about its own OpenGL axes, world units and radians
per second. `transform_matrix` is the pose at half time. With F = diag(1, -1, -1), which leads from OpenGL's axes to
OpenCV's,

    shift = R' F v T,    turn = -F w T,    exposure = E / T

Without T all rows are exposed at once (`gsplat_edu.scene.shutter.AT_ONCE`): E takes the place of T, and the exposure is
1.

The sign differs because `gsplat_edu.scene.shutter.RollingShutter` turns the points that the camera sees, and the
camera itself turns the other way. Each key may be given once for the file or in a frame.

Source: Seiskari et al. 2024, "Gaussian Splatting on the Move", and the converters published with it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float64

from gsplat_edu.base.errors import ArgumentError, DatasetError
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.shutter import AT_ONCE, READOUTS, RollingShutter

TIME, EXPOSURE = "rolling_shutter_time", "exposure_time"
LINEAR, ANGULAR = "camera_linear_velocity", "camera_angular_velocity"

READOUT = "rolling_shutter_readout"
"""Key for the direction of the readout, one of `gsplat_edu.scene.shutter.READOUTS`; only this package has it."""

SHUTTER_KEYS = frozenset((TIME, EXPOSURE, LINEAR, ANGULAR, READOUT))
"""All keys of a shutter."""

WRITTEN_TIME = 2.0**-6
"""Readout time of the files that are written, s: near that of a phone, and a power of two, so that no digit is lost."""

LEAST_TIME, MOST_TIME = 1e-9, 1e6
"""Plausible times of a shutter, s; others would overflow where they are multiplied."""

MOST_VELOCITY = 1e15
"""Largest plausible velocity, world units or radians per second."""

FLIP = np.array([1.0, -1.0, -1.0])
"""The diagonal of F."""


def shutter_from_keys(
    where: str, values: Mapping[str, Any], R: Float64[np.ndarray, "3 3"]
) -> RollingShutter | None:
    """Read the shutter of a frame.

    Args:
        where: File and frame, for messages.
        values: The keys of the file and of the frame, which win.
        R: World-to-camera rotation at half time, OpenCV axes.

    Returns:
        The shutter; None if there is neither a readout time nor an exposure time, or the camera is at rest.

    Raises:
        DatasetError: a value is no number, a time is negative, the camera turns by more than a radian in one of them,
            or the direction is unknown.
    """
    times = {key: float(_finite(where, values, key, ())) for key in (TIME, EXPOSURE)}
    for key, seconds in times.items():
        if seconds < 0:
            raise DatasetError(f"{where}: {key} is {seconds:g}, but must be at least 0 seconds")
        if seconds and not LEAST_TIME <= seconds <= MOST_TIME:
            between = f"0, or from {LEAST_TIME:g} to {MOST_TIME:g} seconds"
            raise DatasetError(f"{where}: {key} is {seconds:g}, but must be {between}")
    linear, angular = (_finite(where, values, key, (3,)) for key in (LINEAR, ANGULAR))
    for key, velocity in ((LINEAR, linear), (ANGULAR, angular)):
        if np.abs(velocity).max() > MOST_VELOCITY:
            raise DatasetError(f"{where}: {key} is {velocity.tolist()}, but no camera is that fast")
    readout = values.get(READOUT, READOUTS[0])
    if readout not in READOUTS:
        raise DatasetError(
            f"{where}: {READOUT} is {str(readout)[:40]}, but must be one of {', '.join(READOUTS)}"
        )
    if not any(times.values()) or not (np.any(linear) or np.any(angular)):
        return None
    unit, exposure = times[TIME], 1.0
    if unit:
        exposure = times[EXPOSURE] / unit
    else:
        unit, readout = times[EXPOSURE], AT_ONCE
    try:
        return RollingShutter(-unit * FLIP * angular, unit * (FLIP * linear) @ R, readout, exposure)
    except ArgumentError:
        key = max(times, key=lambda name: times[name])
        angle = times[key] * np.linalg.norm(angular)
        what = "read" if key == TIME else "exposed"
        raise DatasetError(
            f"{where}: the camera turns by {angle:.3g} radians while the photo is {what}, but at most 1 is possible; "
            f"{ANGULAR} is in radians per second and {key} in seconds"
        ) from None


def keys_of_shutter(camera: Camera) -> dict[str, Any]:
    """Return the keys that describe a camera's shutter; none if it is global and there is no motion blur.

    Args:
        camera: The camera.
    """
    shutter = camera.shutter
    if shutter is None or (shutter.readout == AT_ONCE and not shutter.exposure):
        return {}
    keys: dict[str, Any] = {
        TIME: 0.0 if shutter.readout == AT_ONCE else WRITTEN_TIME,
        LINEAR: (FLIP * (camera.R @ shutter.shift) / WRITTEN_TIME).tolist(),
        ANGULAR: (-FLIP * shutter.turn / WRITTEN_TIME).tolist(),
    }
    if shutter.exposure:
        keys[EXPOSURE] = shutter.exposure * WRITTEN_TIME
    return keys if shutter.readout in (AT_ONCE, READOUTS[0]) else keys | {READOUT: shutter.readout}


def _finite(
    where: str, values: Mapping[str, Any], key: str, shape: tuple[int, ...]
) -> Float64[np.ndarray, "..."]:
    """Return a number or a vector; zero if it is missing."""
    value = values.get(key)
    if value is None:
        return np.zeros(shape)
    entries = value if isinstance(value, list) else [value]
    try:
        found = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        found = np.full(1, np.nan)
    wrong = any(isinstance(entry, bool | str) for entry in entries)
    if wrong or found.shape != shape or not np.isfinite(found).all():
        what = "three numbers" if shape else "a number"
        raise DatasetError(f"{where}: {key} is {str(value)[:60]}, but must be {what}")
    return found

"""OpenSfM's and OpenDroneMap's reconstruction.json.

A shot's `rotation` is the axis of a rotation times its angle in radians, and with `translation` it takes world to
camera coordinates: x_cam = R x + t, OpenCV axes. Focal lengths and principal points are fractions of the photo's longer
side; principal points are relative to its middle. The world is metres east, north and up of `reference_lla`, unless
that is zero, which OpenSfM writes for photos without GPS.

Source: OpenSfM's documentation, "Geometric Models"; `camera_from_json` in its io.py; camera_distortions_functions.h.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from gsplat_edu.base.errors import DatasetError
from gsplat_edu.base.records import Number, Text
from gsplat_edu.data.lens import FISHEYE, PINHOLE_LIKE, Lens
from gsplat_edu.data.notes import OtherReconstructions
from gsplat_edu.data.readers.pose_file import (
    Foreign,
    PoseProgram,
    Poses,
    Shot,
    Size,
    Triple,
    cloud_of,
    each_of,
    json_of,
    no_lens,
    panorama,
    sized,
)
from gsplat_edu.scene.earth import Earth
from gsplat_edu.scene.gaussian_math import quat_to_R

NAME = "reconstruction.json"

PRISM = "thin prism fisheye"

MODEL_OF = {
    "perspective": PINHOLE_LIKE,
    "simple_radial": PINHOLE_LIKE,
    "radial": PINHOLE_LIKE,
    "brown": PINHOLE_LIKE,
    "fisheye": FISHEYE,
    "fisheye_opencv": FISHEYE,
    "fisheye62": PRISM,
    "fisheye624": PRISM,
}
"""Our models of OpenSfM's projections, except for panoramas."""

PANORAMAS = ("spherical", "equirectangular")

WITHOUT_MODEL = ("k5", "k6", "s1", "s3")
"""Coefficients of fisheye62 and fisheye624 that `PRISM` lacks; all other coefficients have a place in it."""


class CameraEntry(Foreign, frozen=True):
    """A camera; missing numbers are zero."""

    projection_type: str = "perspective"
    width: Size | None = None
    height: Size | None = None
    focal: Number | None = None
    focal_x: Number | None = None
    focal_y: Number | None = None
    c_x: Number = 0.0
    c_y: Number = 0.0
    k1: Number = 0.0
    k2: Number = 0.0
    k3: Number = 0.0
    k4: Number = 0.0
    k5: Number = 0.0
    k6: Number = 0.0
    p1: Number = 0.0
    p2: Number = 0.0
    s0: Number = 0.0
    s1: Number = 0.0
    s2: Number = 0.0
    s3: Number = 0.0


class ShotEntry(Foreign, frozen=True):
    """A posed photo."""

    camera: str
    rotation: Triple
    translation: Triple = (0.0, 0.0, 0.0)


class PointEntry(Foreign, frozen=True):
    """A point with its colour, 0 to 255."""

    coordinates: Triple
    color: Triple = (128.0, 128.0, 128.0)


class Reference(Foreign, frozen=True):
    """A place: degrees, and metres above the ellipsoid."""

    latitude: Number = 0.0
    longitude: Number = 0.0
    altitude: Number = 0.0


class Reconstruction(Foreign, frozen=True):
    """Photos that see one another: `CameraEntry`, `ShotEntry` and `PointEntry` by their names."""

    cameras: dict[str, Any]
    shots: dict[Text, Any]
    points: dict[str, Any] = {}  # noqa: RUF012 - msgspec copies the default
    reference_lla: Reference | None = None


def holds(path: Path, head: bytes) -> bool:
    """Return whether a file is a reconstruction.json."""
    return path.name.lower() == NAME and head.lstrip()[:1] == b"["


def read(path: Path) -> Poses:
    """Read the largest reconstruction of a file.

    Raises:
        DatasetError: the file is damaged, or has no photo.
    """
    found: list[Reconstruction] = json_of(path, list[Reconstruction])
    largest = max(found, key=lambda each: len(each.shots), default=None)
    if largest is None or not largest.shots:
        raise DatasetError(f"{path}: has no posed photo; run `opensfm reconstruct`, or choose another file")
    others = tuple(len(each.shots) for each in found if each is not largest)
    notes = (OtherReconstructions(path, len(largest.shots), others),) if others else ()
    cameras: dict[str, CameraEntry] = each_of(path, "camera", largest.cameras, CameraEntry)
    lenses = {name: _lens(camera) for name, camera in cameras.items()}
    shots, entries = [], each_of(path, "shot", largest.shots, ShotEntry)
    for name, shot in entries.items():
        R = rotation(shot.rotation)
        lens = lenses.get(shot.camera) or no_lens("its camera is not in the file")
        shots.append(Shot(name, R, -R.T @ np.array(shot.translation), lens))
    points = each_of(path, "point", largest.points, PointEntry).values()
    cloud = cloud_of([point.coordinates for point in points], [point.color for point in points])
    place = largest.reference_lla
    earth = None
    if place is not None and (place.latitude or place.longitude):
        earth = Earth.at_place(place.latitude, place.longitude, place.altitude)
    return Poses(path, shots, cloud, notes, earth=earth)


def rotation(axis: Triple) -> np.ndarray:
    """Return the matrix of a rotation given as its axis times its angle, radians."""
    vector = np.array(axis)
    angle = float(np.linalg.norm(vector))
    if not angle:
        return np.eye(3)
    return quat_to_R(np.concatenate([[np.cos(angle / 2)], np.sin(angle / 2) * vector / angle]))


def _lens(camera: CameraEntry) -> Callable[[Path], Lens]:
    kind = camera.projection_type
    size = (camera.width, camera.height) if camera.width and camera.height else None
    if kind in PANORAMAS and size is not None:
        return panorama(size)
    if kind not in MODEL_OF or size is None:
        what = f"the projection {kind!r} has no model here" if size else "its camera has no size"
        return no_lens(f"{what}; undistort with `opensfm undistort`")
    if MODEL_OF[kind] == PRISM and any(getattr(camera, name) for name in WITHOUT_MODEL):
        used = ", ".join(name for name in WITHOUT_MODEL if getattr(camera, name))
        return no_lens(
            f"the projection {kind!r} with {used} has no model here; undistort with `opensfm undistort`"
        )
    focal = camera.focal if camera.focal_x is None else camera.focal_x
    if focal is None:
        return no_lens("its camera has no focal length")
    longer = max(size)
    values = {name: getattr(camera, name) for name in ("k1", "k2", "k3", "k4", "p1", "p2")}
    values |= {"cx": camera.c_x * longer, "cy": camera.c_y * longer, "sx1": camera.s0, "sy1": camera.s2}
    values |= {"fx": focal * longer, "fy": (camera.focal_y or focal) * longer}
    if MODEL_OF[kind] == PINHOLE_LIKE:
        del values["k4"]  # of OpenCV's denominator; these projections have none
    return sized(values, size, MODEL_OF[kind])


OPENSFM = PoseProgram("OpenSfM", holds, read)

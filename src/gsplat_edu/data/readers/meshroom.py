"""Meshroom's cameras.sfm, AliceVision's JSON.

Its numbers are texts. A pose has the world-to-camera rotation by columns, OpenCV axes, and the camera's centre. Since
version 1.2.1 of the file the principal point is relative to the middle of the image. Since 1.2.2 the focal length is in
mm, of a sensor of `sensorWidth`; until 1.2.4 `pixelRatio` is fx / fy, later fy / fx. k1 to k3, t1 and t2 are OpenCV's.

Source: AliceVision's sfmDataIO/jsonIO.cpp and CHANGELOG.md.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from gsplat_edu.base.errors import DatasetError
from gsplat_edu.base.records import Text
from gsplat_edu.base.text import printable, shortened
from gsplat_edu.data.lens import FISHEYE, MAX_SIDE, PINHOLE_LIKE, Lens
from gsplat_edu.data.readers.pose_file import (
    AGAIN,
    Foreign,
    PoseProgram,
    Poses,
    Shot,
    cloud_of,
    json_of,
    no_lens,
    numbers_of,
    sized,
)

Value = str | float
"""A number, which the program writes as text."""

MIDDLE, MILLIMETRES, RATIO = (1, 2, 1), (1, 2, 2), (1, 2, 5)
"""First versions whose principal point is relative to the middle, whose focal length is in mm, and whose pixel ratio
is fy / fx."""

COEFFICIENTS: dict[str, tuple[str, ...]] = {
    "none": (),
    "pinhole": (),
    "radial1": ("k1",),
    "radialk1": ("k1",),
    "radial3": ("k1", "k2", "k3"),
    "radialk3": ("k1", "k2", "k3"),
    "brown": ("k1", "k2", "k3", "p1", "p2"),
    "fisheye4": ("k1", "k2", "k3", "k4"),
}
"""Coefficients of each model of distortion, in the order of the file."""

UNDISTORT = "export undistorted photos with ExportImages"


class ViewRecord(Foreign, frozen=True, rename="camel"):
    """A photo."""

    path: Text
    pose_id: str = ""
    intrinsic_id: str = ""
    rig_id: str | None = None
    is_pose_independant: str | bool = True


class Intrinsic(Foreign, frozen=True, rename="camel"):
    """A lens."""

    intrinsic_id: str
    width: Value
    height: Value
    type: str
    principal_point: list[Value]
    sensor_width: Value = 36.0
    distortion_type: str = ""
    distortion_params: list[Value] | str = ""
    px_focal_length: list[Value] | Value | None = None
    focal_length: Value | None = None
    pixel_ratio: Value = 1.0


class Transform(Foreign, frozen=True, rename="camel"):
    """A rotation and a centre."""

    rotation: list[Value]
    center: list[Value]


class Placed(Foreign, frozen=True, rename="camel"):
    """The content of a pose."""

    transform: Transform


class Pose(Foreign, frozen=True, rename="camel"):
    """A pose."""

    pose_id: str
    pose: Placed


class Landmark(Foreign, frozen=True, rename="camel"):
    """A point."""

    X: list[Value]
    color: list[Value]


class Sfm(Foreign, frozen=True, rename="camel"):
    """The file."""

    version: list[Value]
    views: list[ViewRecord]
    intrinsics: list[Intrinsic] = []  # noqa: RUF012 - msgspec copies the default
    poses: list[Pose] = []  # noqa: RUF012
    structure: list[Landmark] = []  # noqa: RUF012


def holds(path: Path, head: bytes) -> bool:
    """Return whether a file is AliceVision's."""
    return path.suffix.lower() == ".sfm" and b'"version"' in head


def read(path: Path) -> Poses:
    """Read the views that have a pose.

    Raises:
        DatasetError: the file is damaged, or no view has a pose.
    """
    contents: Sfm = json_of(path, Sfm)
    version = tuple(_numbers(f"{path}, version", contents.version, 3).tolist())
    lenses = {each.intrinsic_id: _lens(f"{path}, intrinsic", each, version) for each in contents.intrinsics}
    poses = {each.pose_id: each.pose.transform for each in contents.poses}
    shots, without = list[Shot](), list[tuple[str, str]]()
    for view in contents.views:
        pose = poses.get(view.pose_id)
        if pose is None:
            continue
        if view.rig_id is not None and view.is_pose_independant in ("false", "0", False):
            without.append((view.path, "its pose is that of a rig; align without rigs"))
            continue
        where = f"{path}, pose {shortened(printable(view.pose_id))}"
        columns = _numbers(f"{where}, rotation", pose.rotation, 9).reshape(3, 3)
        lens = lenses.get(view.intrinsic_id) or no_lens("its intrinsic is not in the file")
        shots.append(Shot(view.path, columns.T, _numbers(f"{where}, center", pose.center, 3), lens))
    if not shots and not without:
        raise DatasetError(f"{path}: has no posed view; give the cameras.sfm of StructureFromMotion")
    points = [_numbers(f"{path}, point", each.X, 3) for each in contents.structure]
    colors = [_numbers(f"{path}, point", each.color, 3) for each in contents.structure]
    return Poses(path, shots, cloud_of(points, colors), without=tuple(without))


def _numbers(where: str, values: Sequence[Value], count: int | None = None) -> Float64[np.ndarray, " n"]:
    return numbers_of(where, " ".join(map(str, values)), count)


def _lens(where: str, intrinsic: Intrinsic, version: tuple[float, ...]) -> Callable[[Path], Lens]:
    where = f"{where} {shortened(printable(intrinsic.intrinsic_id))}"
    W, H = _numbers(f"{where}, size", (intrinsic.width, intrinsic.height), 2).tolist()
    if not all(1 <= side <= MAX_SIDE and side == round(side) for side in (W, H)):
        raise DatasetError(f"{where}: its size {W:g}x{H:g} is no photo's; {AGAIN}")
    kind = intrinsic.distortion_type or intrinsic.type
    if kind not in COEFFICIENTS or intrinsic.type == "equidistant":
        return no_lens(f"the lens {shortened(printable(kind))!r} has no model here; {UNDISTORT}")
    names = COEFFICIENTS[kind]
    found = _numbers(f"{where}, distortionParams", list(intrinsic.distortion_params)).tolist()
    if len(found) != len(names) and any(found):
        return no_lens(f"the lens {kind!r} has {len(found)} coefficients, not {len(names)}; {AGAIN}")
    fx, fy = _focal(where, intrinsic, version, W)
    cx, cy = _numbers(f"{where}, principalPoint", intrinsic.principal_point, 2).tolist()
    if version < MIDDLE:
        cx, cy = cx - W / 2, cy - H / 2
    values = {"fx": fx, "fy": fy, "cx": cx, "cy": cy, **dict(zip(names, found, strict=False))}
    return sized(values, (int(W), int(H)), FISHEYE if kind == "fisheye4" else PINHOLE_LIKE)


def _focal(where: str, intrinsic: Intrinsic, version: tuple[float, ...], W: float) -> tuple[float, float]:
    """Return both focal lengths, px."""
    if version < MILLIMETRES:
        given = intrinsic.px_focal_length
        if given is None:
            raise DatasetError(f"{where}: lacks 'pxFocalLength'; {AGAIN}")
        found = _numbers(f"{where}, pxFocalLength", given if isinstance(given, list) else [given]).tolist()
        if len(found) not in (1, 2):
            raise DatasetError(f"{where}: pxFocalLength has {len(found)} numbers; {AGAIN}")
        return found[0], found[-1]
    if intrinsic.focal_length is None:
        raise DatasetError(f"{where}: lacks 'focalLength'; {AGAIN}")
    numbers = (intrinsic.focal_length, intrinsic.sensor_width, intrinsic.pixel_ratio)
    f, width, ratio = _numbers(f"{where}, focalLength, sensorWidth, pixelRatio", numbers, 3).tolist()
    if not (width > 0 and ratio > 0):
        raise DatasetError(f"{where}: sensorWidth and pixelRatio have to be above 0; {AGAIN}")
    fx = f / width * W
    return fx, fx * ratio if version >= RATIO else fx / ratio


MESHROOM = PoseProgram("Meshroom", holds, read)

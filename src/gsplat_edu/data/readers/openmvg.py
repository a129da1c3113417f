"""OpenMVG's sfm_data.json.

A pose has the world-to-camera rotation by rows, OpenCV axes, and the camera's centre. Focal length and principal point
are in px, and the distortion is OpenCV's. The file names the class of an intrinsic where it first occurs, with a
number that has `FIRST` set; later ones have the number only.

Source: OpenMVG's sfm_data_io_cereal.cpp and cameras/Camera_Pinhole_*_io.hpp.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from gsplat_edu.base.errors import DatasetError
from gsplat_edu.base.records import Number, Text
from gsplat_edu.base.text import printable, shortened
from gsplat_edu.data.lens import FISHEYE, PINHOLE_LIKE, Lens
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

GREY = (128.0, 128.0, 128.0)
"""Colour of points, 0 to 255; the file has none."""

FIRST = 1 << 31
"""Bit of a class's number where its name is given."""

SPHERE = "spherical"

COEFFICIENTS: dict[str, tuple[str, tuple[str, ...]]] = {
    "pinhole": ("", ()),
    "pinhole_radial_k1": ("disto_k1", ("k1",)),
    "pinhole_radial_k3": ("disto_k3", ("k1", "k2", "k3")),
    "pinhole_brown_t2": ("disto_t2", ("k1", "k2", "k3", "p1", "p2")),
    "fisheye": ("fisheye", ("k1", "k2", "k3", "k4")),
}
"""Key of the coefficients of each class of intrinsics, and their names here."""


class Entry(Foreign, frozen=True):
    """An entry of a list: a number and what belongs to it."""

    key: int
    value: Any


class Data(Foreign, frozen=True):
    """The data of a view or an intrinsic."""

    data: Any


class Wrapped(Foreign, frozen=True):
    """A view or an intrinsic."""

    ptr_wrapper: Data
    polymorphic_id: int = 0
    polymorphic_name: str = ""


class ViewEntry(Foreign, frozen=True):
    """A photo."""

    filename: Text
    id_intrinsic: int
    id_pose: int
    local_path: Text = ""


class Extent(Foreign, frozen=True):
    """Width and height, where an intrinsic has them in an object of their own."""

    width: Size
    height: Size


class Intrinsic(Foreign, frozen=True):
    """A lens."""

    width: Size | None = None
    height: Size | None = None
    focal_length: Number | None = None
    principal_point: tuple[Number, Number] | None = None
    disto_k1: tuple[Number] | None = None
    disto_k3: tuple[Number, Number, Number] | None = None
    disto_t2: tuple[Number, Number, Number, Number, Number] | None = None
    fisheye: tuple[Number, Number, Number, Number] | None = None
    value0: Extent | None = None


class Pose(Foreign, frozen=True):
    """A pose."""

    rotation: tuple[Triple, Triple, Triple]
    center: Triple


class Landmark(Foreign, frozen=True):
    """A point."""

    X: Triple


class SfmData(Foreign, frozen=True):
    """The file."""

    views: list[Entry]
    intrinsics: list[Entry]
    extrinsics: list[Entry]
    structure: list[Entry] = []  # noqa: RUF012 - msgspec copies the default


def holds(path: Path, head: bytes) -> bool:
    """Return whether a file is an sfm_data.json."""
    return path.suffix.lower() == ".json" and b'"sfm_data_version"' in head


def read(path: Path) -> Poses:
    """Read the views that have a pose.

    Raises:
        DatasetError: the file is damaged, or no view has a pose.
    """
    contents: SfmData = json_of(path, SfmData)
    seen = _wrapped(path, "view", contents.views)
    views: dict[str, ViewEntry] = each_of(
        path, "view", {k: v.ptr_wrapper.data for k, v in seen.items()}, ViewEntry
    )
    wrapped = _wrapped(path, "intrinsic", contents.intrinsics)
    inner = each_of(path, "intrinsic", {k: v.ptr_wrapper.data for k, v in wrapped.items()}, Intrinsic)
    kinds = {v.polymorphic_id & ~FIRST: v.polymorphic_name for v in wrapped.values() if v.polymorphic_name}
    lenses = {
        key: _lens(kinds.get(each.polymorphic_id & ~FIRST, ""), inner[key]) for key, each in wrapped.items()
    }
    poses = each_of(path, "pose", {str(each.key): each.value for each in contents.extrinsics}, Pose)
    points = each_of(path, "point", {str(each.key): each.value for each in contents.structure}, Landmark)
    shots = []
    for view in views.values():
        pose = poses.get(str(view.id_pose))
        if pose is None:
            continue
        name = f"{view.local_path}/{view.filename}" if view.local_path else view.filename
        lens = lenses.get(str(view.id_intrinsic)) or no_lens("its intrinsic is not in the file")
        shots.append(Shot(name, np.array(pose.rotation), np.array(pose.center), lens))
    if not shots:
        raise DatasetError(f"{path}: has no posed view; give the sfm_data.json of the reconstruction")
    where = [point.X for point in points.values()]
    return Poses(path, shots, cloud_of(where, [GREY] * len(where)))


def _wrapped(path: Path, what: str, entries: list[Entry]) -> dict[str, Wrapped]:
    """Return views or intrinsics by their numbers."""
    found: dict[str, Wrapped] = each_of(path, what, {str(each.key): each.value for each in entries}, Wrapped)
    return found


def _lens(kind: str, intrinsic: Intrinsic) -> Callable[[Path], Lens]:
    width, height = intrinsic.width, intrinsic.height
    if intrinsic.value0 is not None:
        width, height = intrinsic.value0.width, intrinsic.value0.height
    if width is None or height is None:
        return no_lens("its intrinsic has no size")
    if kind == SPHERE:
        return panorama((width, height))
    if kind not in COEFFICIENTS:
        return no_lens(
            f"the intrinsic {shortened(printable(kind))!r} has no model here; undistort with "
            "openMVG_main_ExportUndistortedImages"
        )
    key, names = COEFFICIENTS[kind]
    given = getattr(intrinsic, key) if key else ()
    if intrinsic.focal_length is None or intrinsic.principal_point is None or given is None:
        return no_lens(f"its intrinsic lacks focal_length, principal_point{f' or {key}' if key else ''}")
    f, (cx, cy) = intrinsic.focal_length, intrinsic.principal_point
    values = {"fx": f, "fy": f, "cx": cx - width / 2, "cy": cy - height / 2}
    values |= dict(zip(names, given, strict=True))
    return sized(values, (width, height), FISHEYE if kind == "fisheye" else PINHOLE_LIKE)


OPENMVG = PoseProgram("OpenMVG", holds, read)

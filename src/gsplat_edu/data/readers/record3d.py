"""Record3D's metadata: of an unpacked .r3d file, with photos in rgbd, or of an EXR + RGB export, with photos in rgb.

K is the matrix of intrinsics by columns, px, and `perFrameIntrinsicCoeffs` has fx, fy, cx and cy of each frame, if
they change. A pose is a quaternion x, y, z, w and a position in metres, camera to world, of a camera that looks along
-z, with +y up. The photo N.jpg is frame N.

Source: Record3D's documentation of the .r3d format; nerfstudio's record3d_utils.py.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gsplat_edu.base.errors import DatasetError
from gsplat_edu.base.records import Number
from gsplat_edu.data.capture import PHOTO_ENDINGS, entries, is_folder
from gsplat_edu.data.readers.bundler import OPENGL
from gsplat_edu.data.readers.pose_file import (
    AGAIN,
    Foreign,
    PoseProgram,
    Poses,
    Shot,
    Size,
    json_of,
    quaternion,
    sized,
)

NAMES = ("metadata", "metadata.json")

ARCHIVE = ".r3d"

IMAGES = ("rgbd", "rgb")
"""Folders beside the metadata that may have the photos."""

Four = tuple[Number, Number, Number, Number]


class Metadata(Foreign, frozen=True, rename={"per_frame": "perFrameIntrinsicCoeffs"}):
    """The file."""

    w: Size
    h: Size
    K: tuple[Number, Number, Number, Number, Number, Number, Number, Number, Number]
    poses: list[tuple[Number, Number, Number, Number, Number, Number, Number]]
    per_frame: list[Four] | None = None


def holds(path: Path, head: bytes) -> bool:
    """Return whether a file is Record3D's metadata, or the archive that has it."""
    archive = path.suffix.lower() == ARCHIVE and head.startswith(b"PK")
    return archive or (path.name.lower() in NAMES and head.lstrip().startswith(b"{"))


def read(path: Path) -> Poses:
    """Read the poses of the photos beside the metadata.

    Raises:
        DatasetError: the file is damaged or packed, or has no photos or poses.
    """
    if path.suffix.lower() == ARCHIVE:
        raise DatasetError(f"{path}: is packed; unzip it, and give the folder with its metadata and rgbd")
    contents: Metadata = json_of(path, Metadata)
    if contents.per_frame is not None and len(contents.per_frame) != len(contents.poses):
        raise DatasetError(
            f"{path}: has {len(contents.poses)} poses, but {len(contents.per_frame)} intrinsics; {AGAIN}"
        )
    shots = []
    for number, name in _photos(path):
        if number >= len(contents.poses):
            continue
        *q, x, y, z = contents.poses[number]
        R = OPENGL @ quaternion(f"{path}, pose {number}", q).T
        K = contents.K
        fx, fy, cx, cy = contents.per_frame[number] if contents.per_frame else (K[0], K[4], K[6], K[7])
        W, H = contents.w, contents.h
        values = {"fx": fx, "fy": fy, "cx": cx - W / 2, "cy": cy - H / 2}
        shots.append(Shot(name, R, np.array([x, y, z]), sized(values, (W, H))))
    if not shots:
        raise DatasetError(f"{path}: has {len(contents.poses)} poses, but none of a photo; {AGAIN}")
    return Poses(path, shots)


def _photos(path: Path) -> list[tuple[int, str]]:
    """Return the numbers and names of the photos."""
    folder = next((path.parent / name for name in IMAGES if is_folder(path.parent / name)), None)
    if folder is None:
        raise DatasetError(f"{path}: lacks its photos; put the folder rgbd or rgb beside it")
    names = [each for each in entries(folder) if each.suffix.lower() in PHOTO_ENDINGS]
    found = [(int(each.stem), each) for each in names if each.stem.isascii() and each.stem.isdigit()]
    before = "" if folder.name == "rgbd" else f"{path.parent.name}/"
    return [(number, f"{before}{folder.name}/{each.name}") for number, each in sorted(found)]


RECORD3D = PoseProgram("Record3D", holds, read)

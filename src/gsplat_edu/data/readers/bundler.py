"""Bundler's bundle.out with its list of photos.

A camera is its focal length in px, k1 and k2, the rows of a rotation and a translation, world to camera:
x_cam = R x + t. It looks along -z, with +y up: x = -X / Z, y = -Y / Z, and the image is f (1 + k1 r² + k2 r⁴) (x, y),
from the middle of the photo, with y up. A camera without a pose has the focal length 0.

Source: Snavely's "Bundler v0.4 User's Manual", section "Output format and scene representation".
"""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np

from gsplat_edu.base.errors import DatasetError
from gsplat_edu.data.capture import is_file
from gsplat_edu.data.readers.pose_file import (
    AGAIN,
    PoseProgram,
    Poses,
    Shot,
    cloud_of,
    numbers_of,
    sized,
    text_of,
)

FIRST_LINE = b"# Bundle file v0.3"

CAMERA_LINES, POINT_LINES = 5, 3

OPENGL = np.diag([1.0, -1.0, -1.0])
"""From axes with y up that look along -z to OpenCV's."""


def holds(path: Path, head: bytes) -> bool:
    """Return whether a file is Bundler's, of version 0.3 or later."""
    return path.suffix.lower() == ".out" and head.startswith(FIRST_LINE)


def read(path: Path) -> Poses:
    """Read a bundle file and the list of photos beside it.

    Raises:
        DatasetError: one of them is damaged or missing, or they do not belong together.
    """
    names = _names(path)
    lines = [line for line in text_of(path).splitlines()[1:] if line.strip()]
    cameras, points = _counts(path, lines[0] if lines else "")
    if len(lines) != 1 + CAMERA_LINES * cameras + POINT_LINES * points:
        raise DatasetError(
            f"{path}: has {len(lines)} lines for {cameras} cameras and {points} points; {AGAIN}"
        )
    if cameras != len(names):
        raise DatasetError(
            f"{path}: has {cameras} cameras, but its list {len(names)} photos; give both files of one export"
        )
    shots = []
    for number, name in enumerate(names):
        at = 1 + CAMERA_LINES * number
        where = f"{path}, camera {number} ({name})"
        f, k1, k2 = numbers_of(where, lines[at], 3)
        if not f:
            continue
        turn = numbers_of(where, " ".join(lines[at + 1 : at + 4]), 9).reshape(3, 3)
        R, t = OPENGL @ turn, OPENGL @ numbers_of(where, lines[at + 4], 3)
        values = {"fx": float(f), "fy": float(f), "cx": 0.0, "cy": 0.0, "k1": float(k1), "k2": float(k2)}
        shots.append(Shot(name, R, -R.T @ t, sized(values, None)))
    rest = lines[1 + CAMERA_LINES * cameras :]
    places = [numbers_of(f"{path}, a point", line, 3) for line in rest[::POINT_LINES]]
    colors = [numbers_of(f"{path}, a colour", line, 3) for line in rest[1::POINT_LINES]]
    return Poses(path, shots, cloud_of(places, colors))


def _counts(path: Path, line: str) -> tuple[int, int]:
    cameras, points = numbers_of(f"{path}, line 2", line, 2)
    if min(cameras, points) < 0 or cameras % 1 or points % 1:
        raise DatasetError(f"{path}, line 2: {line!r} is not a number of cameras and of points; {AGAIN}")
    return int(cameras), int(points)


def _names(path: Path) -> list[str]:
    """Read the list of photos: NAME.list.txt of NAME.out or NAME.bundle.out, else list.txt or the one above."""
    stem = path.stem.removesuffix(".bundle")
    places = [path.with_name(f"{stem}.list.txt"), path.with_name("list.txt"), path.parent.parent / "list.txt"]
    found = next(filter(is_file, places), None)
    if found is None:
        raise DatasetError(f"{path}: lacks its list of photos; put list.txt beside it")
    lines = (line.strip() for line in text_of(found).splitlines())
    return [_name(line) for line in lines if line]


def _name(line: str) -> str:
    """Return the photo of a line "NAME", or "NAME 0 FOCAL" with Bundler's guess of the focal length."""
    words = line.split()
    return " ".join(itertools.takewhile(lambda word: word != "0", words)) if len(words) > 2 else line


BUNDLER = PoseProgram("Bundler", holds, read)

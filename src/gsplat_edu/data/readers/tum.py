"""A trajectory in TUM's format, as RGB-D SLAM data sets and many SLAM programs write it.

A line is "time tx ty tz qx qy qz qw": seconds, metres, and the camera-to-world rotation, OpenCV axes. rgb.txt beside it
lists photos as "time name"; without it, the photos of rgb or images have a time as their name, or are as many as the
poses and in their order. A photo has the pose that is nearest in time, at most `APART` away.

The lens is in calibration.txt beside it: "fx fy cx cy", px, and perhaps k1 k2 p1 p2 k3 of OpenCV, where the centre of
the first pixel is at (0, 0).

Source: TUM's "File Formats" of the RGB-D SLAM data set, and its associate.py.
"""

from __future__ import annotations

import bisect
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np

from gsplat_edu.base.errors import DatasetError
from gsplat_edu.data.capture import PHOTO_ENDINGS, entries, is_file, is_folder
from gsplat_edu.data.lens import Lens
from gsplat_edu.data.readers.pose_file import (
    PoseProgram,
    Poses,
    Shot,
    numbers_of,
    quaternion,
    sized,
    text_of,
)
from gsplat_edu.photos.decoding import image_size

APART = 0.02
"""Largest difference in time of a photo and its pose, s."""

PHOTOS, LENS, FOLDERS = "rgb.txt", "calibration.txt", ("rgb", "images")

COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3")

UNIT = 0.01
"""Difference of the length of a rotation's quaternion from 1 by which a trajectory is told from other tables."""


def holds(path: Path, head: bytes) -> bool:
    """Return whether a file is a trajectory: the first line has eight numbers, the last four of length 1."""
    if path.suffix.lower() != ".txt":
        return False
    words = next((line.split() for line in head.splitlines() if line.strip() and line[:1] != b"#"), [])
    try:
        row = [float(word) for word in words]
    except ValueError:
        return False
    return len(row) == 8 and abs(math.hypot(*row[4:]) - 1) < UNIT


def read(path: Path) -> Poses:
    """Read a trajectory, the list of its photos and their lens.

    Raises:
        DatasetError: a file is damaged or missing, or photos and poses do not belong together.
    """
    rows = np.array([numbers_of(f"{path}, line {n}", text, 8) for n, text in _lines(path)])
    rows = rows[np.argsort(rows[:, 0], kind="stable")]
    lens, shots, without = _lens(path), list[Shot](), list[tuple[str, str]]()
    times = rows[:, 0].tolist()
    for time, name in _photos(path, times):
        at = bisect.bisect_left(times, time)
        best = min(range(max(0, at - 1), min(len(times), at + 1)), key=lambda i: abs(times[i] - time))
        if abs(times[best] - time) > APART:
            without.append((name, f"no pose is within {APART:g} s of it"))
            continue
        R = quaternion(f"{path}, time {times[best]!r}", rows[best, 4:].tolist()).T
        shots.append(Shot(name, R, rows[best, 1:4], lens))
    return Poses(path, shots, without=tuple(without))


def _lines(path: Path) -> list[tuple[int, str]]:
    """Return the lines of a file that are no comments, with their numbers."""
    lines = enumerate(text_of(path).splitlines(), 1)
    return [(number, line) for number, line in lines if line.strip() and not line.startswith("#")]


def _photos(path: Path, times: list[float]) -> list[tuple[float, str]]:
    """Return times and names of the photos."""
    listed = path.parent / PHOTOS
    if is_file(listed):
        pairs = [(n, *line.strip().partition(" ")[::2]) for n, line in _lines(listed)]
        return [
            (float(numbers_of(f"{listed}, line {n}", time, 1)[0]), name.strip()) for n, time, name in pairs
        ]
    folder = next((path.parent / name for name in FOLDERS if is_folder(path.parent / name)), None)
    photos = [] if folder is None else [e for e in entries(folder) if e.suffix.lower() in PHOTO_ENDINGS]
    names = [f"{each.parent.name}/{each.name}" for each in photos]
    if len(photos) == len(times):
        return list(zip(times, names, strict=True))
    try:
        return [(float(each.stem), name) for each, name in zip(photos, names, strict=True)]
    except ValueError:
        raise DatasetError(
            f"{path}: has {len(times)} poses for {len(photos)} photos; put {PHOTOS} beside it, with the time and name "
            "of each photo"
        ) from None


def _lens(path: Path) -> Callable[[Path], Lens]:
    file = path.with_name(LENS)
    if not is_file(file):
        raise DatasetError(
            f"{path}: has no lens; write fx fy cx cy, px, and any k1 k2 p1 p2 k3 into {LENS} beside it"
        )
    found = numbers_of(str(file), " ".join(line for _, line in _lines(file))).tolist()
    if not 4 <= len(found) <= 4 + len(COEFFICIENTS):
        raise DatasetError(f"{file}: has {len(found)} numbers; write fx fy cx cy and any k1 k2 p1 p2 k3")
    fx, fy, cx, cy, *k = found

    def lens(photo: Path) -> Lens:
        W, H = image_size(photo)
        values = {"fx": fx, "fy": fy, "cx": cx + 0.5 - W / 2, "cy": cy + 0.5 - H / 2}
        return sized({**values, **dict(zip(COEFFICIENTS, k, strict=False))}, (W, H))(photo)

    return lens


TUM = PoseProgram("TUM", holds, read)

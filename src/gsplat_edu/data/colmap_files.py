"""The files of COLMAP's sparse models, read entry by entry: they may be larger than memory.

Source: COLMAP's documentation, "Output Format" and "Camera Models".
"""

from __future__ import annotations

import array
import io
import math
import os
import re
import struct
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np
from jaxtyping import Float64, Int64

from gsplat_edu.base.errors import DatasetError
from gsplat_edu.base.files import unreadable
from gsplat_edu.base.reading import open_file
from gsplat_edu.base.text import decode_file_name

MODELS: tuple[tuple[str, str], ...] = (
    ("SIMPLE_PINHOLE", "f cx cy"),
    ("PINHOLE", "fx fy cx cy"),
    ("SIMPLE_RADIAL", "f cx cy k1"),
    ("RADIAL", "f cx cy k1 k2"),
    ("OPENCV", "fx fy cx cy k1 k2 p1 p2"),
    ("OPENCV_FISHEYE", "fx fy cx cy k1 k2 k3 k4"),
    ("FULL_OPENCV", "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6"),
    ("FOV", "fx fy cx cy omega"),
    ("SIMPLE_RADIAL_FISHEYE", "f cx cy k1"),
    ("RADIAL_FISHEYE", "f cx cy k1 k2"),
    ("THIN_PRISM_FISHEYE", "fx fy cx cy k1 k2 p1 p2 k3 k4 sx1 sy1"),
    ("RAD_TAN_THIN_PRISM_FISHEYE", "fx fy cx cy k0 k1 k2 k3 k4 k5 p0 p1 s0 s1 s2 s3"),
    ("SIMPLE_DIVISION", "f cx cy k"),
    ("DIVISION", "fx fy cx cy k"),
    ("SIMPLE_FISHEYE", "f cx cy"),
    ("FISHEYE", "fx fy cx cy"),
    ("EUCM", "fx fy cx cy alpha beta"),
    ("EQUIRECTANGULAR", "w h"),
)
"""COLMAP's camera models by number, with their parameters."""

LONGEST_LINE = 2**26
"""Characters of a line of text beyond which the file is none of COLMAP's; a photo's 100,000 points take 4 million."""

LONGEST_NAME = 2**16
"""Bytes of an image's name beyond which the file is damaged; no system has longer paths."""

UNIT_SLACK = 1e-3
"""Largest distance from 1 of the length of a quaternion that marks a line of images.txt as an image."""

NOT_A_NUMBER = re.compile(r"[+-]?(nan(\([\w]*\))?|1\.#\w+)", re.IGNORECASE)
"""NaN and infinity as C++ libraries spell them and Python does not read them."""


class Pose(NamedTuple):
    """An image of a model."""

    name: str
    camera: int
    quat: tuple[float, ...]  # (w, x, y, z), world to camera
    shift: tuple[float, ...]  # world units


class Observed(NamedTuple):
    """The points that an image of a model sees."""

    name: str
    points: Int64[np.ndarray, " n"]  # numbers of the points


class Tracked(NamedTuple):
    """The points of a model, with what the images' observations refer to."""

    numbers: Int64[np.ndarray, " N"]
    positions: Float64[np.ndarray, "N 3"]  # world units
    errors: Float64[np.ndarray, " N"]  # mean reprojection error, px; negative if it was not computed


def _name(raw: bytes) -> str:
    """Decode a file name for the system's functions, with slashes."""
    return decode_file_name(raw).replace("\\", "/")


class _Binary:
    """Little-endian numbers of an open file that may be truncated.

    Args:
        path: The file, for messages.
        file: It, open at its beginning, which is a number of entries.
        smallest: Bytes that an entry takes at least.
    """

    def __init__(self, path: Path, file: IO[bytes], smallest: int) -> None:
        self.path, self.file, self.where = path, file, "its header"
        self.left = os.fstat(file.fileno()).st_size
        (self.count,) = self.take(_COUNT)
        if self.count * smallest > self.left:
            raise self.corrupt(f"its header declares {self.count} entries, more than the file can contain")

    def take(self, layout: struct.Struct) -> tuple[Any, ...]:
        """Read the numbers of a struct layout."""
        return layout.unpack(self.read(layout.size))

    def read(self, count: int) -> bytes:
        """Read `count` bytes."""
        data = self.file.read(count)
        if len(data) < count:
            raise self.corrupt(f"it ends inside {self.where}")
        self.left -= count
        return data

    def skip(self, count: int, size: int) -> None:
        """Skip `count` entries of `size` bytes."""
        if count * size > self.left:
            raise self.corrupt(f"it ends inside {self.where}")
        self.file.seek(count * size, os.SEEK_CUR)
        self.left -= count * size

    def word(self) -> str:
        """Read a zero-terminated name."""
        raw = bytearray()
        while byte := self.read(1)[0]:
            raw.append(byte)
            if len(raw) > LONGEST_NAME:
                raise self.corrupt(f"{self.where} has a name of more than {LONGEST_NAME:,} bytes")
        return _name(bytes(raw))

    def corrupt(self, what: str) -> DatasetError:
        """Return the error for a damaged file."""
        return DatasetError(f"{self.path}: {what}; the file is truncated or corrupt, copy it again")


@contextmanager
def _binary(path: Path, smallest: int) -> Iterator[_Binary]:
    """Open a file of entries that take at least `smallest` bytes."""
    try:
        with open_file(path) as file:
            yield _Binary(path, file, smallest)
    except OSError as error:
        raise DatasetError(unreadable(path, error)) from None


_CAMERA = struct.Struct("<IiQQ")
_IMAGE = struct.Struct("<I7dI")
_POINT = np.dtype(
    [
        ("number", "<u8"),
        ("position", "<f8", 3),
        ("color", "u1", 3),
        ("error", "<f8"),
        ("track", "<u8"),
    ]
)
_MARK = np.dtype([("x", "<f8"), ("y", "<f8"), ("point", "<i8")])
_COUNT = struct.Struct("<Q")
CameraRow = tuple[str, int, str, int, int, tuple[float, ...]]


def cameras_bin(path: Path) -> Iterator[CameraRow]:
    """Read cameras.bin: where each camera stands, its number, model, width, height and parameters."""
    with _binary(path, _CAMERA.size) as file:
        for _ in range(file.count):
            file.where = "a camera"
            camera, kind, W, H = file.take(_CAMERA)
            file.where = f"camera {camera}"
            where = f"{path}, camera {camera}"
            if not 0 <= kind < len(MODELS):
                raise DatasetError(
                    f"{where}: camera model number {kind} is unknown; run `colmap image_undistorter` and load its "
                    "output"
                )
            model, names = MODELS[kind]
            values = file.take(struct.Struct(f"<{len(names.split())}d"))
            yield where, camera, model, W, H, values


def count_bin(path: Path) -> int:
    """Return the number of images that the header of images.bin declares."""
    with _binary(path, _IMAGE.size + 1 + _COUNT.size) as file:
        return int(file.count)


def images_bin(path: Path) -> list[Pose]:
    """Read images.bin, without the points seen in the images."""
    poses = []
    with _binary(path, _IMAGE.size + 1 + _COUNT.size) as file:
        for number in range(file.count):
            file.where = f"image {number + 1} of {file.count}"
            _, *pose, camera = file.take(_IMAGE)
            name = file.word()
            file.skip(file.take(_COUNT)[0], 24)
            poses.append(Pose(name, camera, tuple(pose[:4]), tuple(pose[4:])))
    return poses


def observations_bin(path: Path) -> Iterator[Observed]:
    """Read images.bin: the name of each image, and the numbers of the points seen in it."""
    with _binary(path, _IMAGE.size + 1 + _COUNT.size) as file:
        for number in range(file.count):
            file.where = f"image {number + 1} of {file.count}"
            file.take(_IMAGE)
            name, (count,) = file.word(), file.take(_COUNT)
            if count * _MARK.itemsize > file.left:
                raise file.corrupt(f"it ends inside {file.where}")
            marks = np.frombuffer(file.read(count * _MARK.itemsize), _MARK)["point"]
            yield Observed(name, marks[marks >= 0].astype(np.int64))


def tracked_bin(path: Path) -> Tracked:
    """Read numbers, positions and errors of the points of points3D.bin."""
    table = _point_table(path)
    return Tracked(
        table["number"].astype(np.int64),
        table["position"].astype(np.float64),
        table["error"].astype(np.float64),
    )


def points_bin(path: Path) -> tuple[Float64[np.ndarray, "N 3"], Float64[np.ndarray, "N 3"]]:
    """Read the points of points3D.bin, of which a model of thousands of photos has millions.

    Returns:
        Positions, world units, and colours, 0 to 255.
    """
    table = _point_table(path)
    return table["position"].astype(np.float64), table["color"].astype(np.float64)


def _point_table(path: Path) -> np.ndarray:
    """Read the rows of points3D.bin without the tracks."""
    rows, size = bytearray(), _POINT.itemsize
    with _binary(path, size) as file:
        for number in range(file.count):
            file.where = f"point {number + 1} of {file.count}"
            row = file.read(size)
            file.skip(int.from_bytes(row[-8:], "little"), 8)
            rows += row
    return np.frombuffer(rows, _POINT)


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    """Yield the lines of a text file with their numbers, one at a time."""
    try:
        with open_file(path) as file, io.TextIOWrapper(file, "utf-8-sig", "surrogateescape") as text:
            number = 0
            while line := text.readline(LONGEST_LINE):
                number += 1
                if len(line) == LONGEST_LINE:
                    raise _malformed(path, number, f"lines shorter than {LONGEST_LINE:,} characters")
                yield number, line
    except OSError as error:
        raise DatasetError(unreadable(path, error)) from None


def _malformed(path: Path, number: int, expected: str) -> DatasetError:
    return DatasetError(f"{path}, line {number}: expected {expected}; the file is malformed, export it again")


def cameras_txt(path: Path) -> Iterator[CameraRow]:
    """Read cameras.txt; see `cameras_bin`."""
    for number, line in _lines(path):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        try:
            camera, model, W, H, *values = words
            yield (
                f"{path}, line {number}",
                int(camera),
                model,
                int(W),
                int(H),
                tuple(_float(v) for v in values),
            )
        except ValueError:
            raise _malformed(path, number, "CAMERA_ID MODEL WIDTH HEIGHT PARAMS") from None


def images_txt(path: Path) -> list[Pose]:
    """Read images.txt, without the points seen in the images."""
    return [pose for pose, _ in _images_and_points(path)]


def observations_txt(path: Path) -> Iterator[Observed]:
    """Read images.txt; see `observations_bin`."""
    for pose, points in _images_and_points(path):
        yield Observed(pose.name, points[points >= 0])


def _images_and_points(path: Path) -> Iterator[tuple[Pose, Int64[np.ndarray, " n"]]]:
    """Yield the images of images.txt with the numbers of their points, -1 for marks without a point.

    COLMAP writes a line of points after each image, empty if it has none. Some programs leave the line out, so a line
    after an image is one of points only if it reads as such.
    """
    pose: Pose | None = None
    nothing = np.zeros(0, np.int64)
    for number, line in _lines(path):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        points = None if pose is None or _names_an_image(words) else _point_numbers(words)
        if pose is not None:
            yield pose, nothing if points is None else points
        expected = "" if pose is None else "the image's points as X Y POINT3D_ID, or the next image as "
        pose = _image(path, number, line, expected) if points is None else None
    if pose is not None:
        yield pose, nothing


def _image(path: Path, number: int, line: str, expected: str) -> Pose:
    """Read the line of an image."""
    try:
        _, *pose, camera, name = line.split(maxsplit=9)
        values = [_float(word) for word in pose]
        if len(values) != 7:
            raise ValueError
        file = _name(name.strip().encode("utf-8", "surrogateescape"))
        return Pose(file, int(camera), tuple(values[:4]), tuple(values[4:]))
    except ValueError:
        layout = "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"
        raise _malformed(path, number, f"{expected}{layout}") from None


def _names_an_image(words: Sequence[str]) -> bool:
    """Return whether a line that may also read as points is an image: an id, a unit quaternion and a camera's id.

    A name may consist of numbers. Marks in an image have no such quaternion, unless two lie in its corner pixel.
    """
    try:
        _, camera, quat = int(words[0]), int(words[8]), [float(word) for word in words[1:5]]
    except (ValueError, IndexError):
        return False
    return len(words) > 9 and camera >= 0 and abs(math.hypot(*quat) - 1.0) < UNIT_SLACK


def _point_numbers(words: Sequence[str]) -> Int64[np.ndarray, " n"] | None:
    """Return the point of each mark of a line X Y POINT3D_ID ..., -1 for none; None if the line is no such line."""
    if len(words) % 3:
        return None
    try:
        values = np.array([_float(word) for word in words]).reshape(-1, 3)
    except ValueError:
        return None
    numbers = values[:, 2]
    if not np.array_equal(numbers, np.floor(numbers)):  # false for NaN
        return None
    return np.where((numbers >= 0) & (numbers < 2.0**53), numbers, -1).astype(np.int64)


def _float(word: str) -> float:
    """Return a number; those that C++ cannot represent are spelled in many ways, such as -nan(ind) and 1.#QNAN.

    Raises:
        ValueError: the word is no number.
    """
    try:
        return float(word)
    except ValueError:
        if not NOT_A_NUMBER.fullmatch(word):
            raise
        return math.nan


def tracked_txt(path: Path) -> Tracked:
    """Read the points of points3D.txt; see `tracked_bin`."""
    values = array.array("d")
    for number, line in _lines(path):
        words = line.split(maxsplit=8)
        if not words or words[0].startswith("#"):
            continue
        try:
            if len(words) < 8:
                raise ValueError
            values.extend([_float(words[i]) for i in (0, 1, 2, 3, 7)])
        except ValueError:
            raise _malformed(path, number, "POINT3D_ID X Y Z R G B ERROR TRACK") from None
    table = np.frombuffer(values, np.float64).reshape(-1, 5)
    return Tracked(table[:, 0].astype(np.int64), table[:, 1:4].copy(), table[:, 4].copy())


def points_txt(path: Path) -> tuple[Float64[np.ndarray, "N 3"], Float64[np.ndarray, "N 3"]]:
    """Read the points of points3D.txt; see `points_bin`."""
    values = array.array("d")
    for number, line in _lines(path):
        words = line.split(maxsplit=7)
        if not words or words[0].startswith("#"):
            continue
        try:
            if len(words) < 8:
                raise ValueError
            values.extend([_float(v) for v in words[1:7]])
        except ValueError:
            raise _malformed(path, number, "POINT3D_ID X Y Z R G B ERROR TRACK") from None
    table = np.frombuffer(values, np.float64).reshape(-1, 6)
    return table[:, :3].copy(), table[:, 3:]

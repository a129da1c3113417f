"""Support of each camera's pose: the number of the capture's points observed in its photo."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from gsplat_edu.base.errors import DatasetError
from gsplat_edu.base.reading import open_file, read_bytes
from gsplat_edu.base.text import decode_file_name, legible
from gsplat_edu.data.colmap import find_model

_IMAGE = struct.Struct("<I7dI")
_POINT = struct.Struct("<Q3d3Bd")
_COUNT = struct.Struct("<Q")
_OBSERVED = np.dtype([("x", "<f8"), ("y", "<f8"), ("point", "<i8")])


def observed_points(capture: Path) -> dict[str, int]:
    """Count the points that COLMAP observed in each photo.

    Args:
        capture: Folder with a COLMAP model.

    Returns:
        Counts by frame name; empty if there is no model, it cannot be read, or its tracks were computed from the poses
        (`gsplat_edu.data.tracks`), so that they are no evidence for them.
    """
    model = find_model(capture)
    if model is None:
        return {}
    try:
        if not _is_measured(model):
            return {}
        if (model / "images.bin").is_file():
            return dict(_binary(read_bytes(model / "images.bin")))
        return dict(_text(read_bytes(model / "images.txt")))
    except (OSError, ValueError, IndexError, struct.error, DatasetError):
        return {}  # the reader of the poses reports the problem


def _is_measured(model: Path) -> bool:
    """Return whether the model's first point has a reprojection error; a mapper gives all points one, or none."""
    if (points := model / "points3D.bin").is_file():
        with open_file(points) as file:
            data = file.read(_COUNT.size + _POINT.size)
        return len(data) < _COUNT.size + _POINT.size or _POINT.unpack_from(data, _COUNT.size)[-1] >= 0
    if (points := model / "points3D.txt").is_file():
        with open_file(points) as file:
            first = next((line for line in file if line.strip() and not line.startswith(b"#")), b"")
        fields = first.split(maxsplit=8)
        return len(fields) < 8 or float(fields[7]) >= 0
    return True


def _binary(data: bytes) -> Iterator[tuple[str, int]]:
    at = _COUNT.size
    for _ in range(_COUNT.unpack_from(data)[0]):
        at += _IMAGE.size
        end = data.index(b"\0", at)
        name, at = data[at:end], end + 1
        (count,) = _COUNT.unpack_from(data, at)
        observed = np.frombuffer(data, _OBSERVED, count, at + _COUNT.size)
        at += _COUNT.size + observed.nbytes
        yield _name(name), int((observed["point"] >= 0).sum())


def _text(data: bytes) -> Iterator[tuple[str, int]]:
    lines = iter(data.splitlines())
    for line in lines:
        fields = line.split(maxsplit=9)
        if fields and not fields[0].startswith(b"#"):
            observed = next(lines, b"")
            yield _name(fields[9].strip()), sum(int(point) >= 0 for point in observed.split()[2::3])


def _name(raw: bytes) -> str:
    return legible(decode_file_name(raw).replace("\\", "/"))

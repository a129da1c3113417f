"""What fixes each camera's pose: how many points of the capture its photo was found to show."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from gsplat_edu.data.colmap import find_model
from gsplat_edu.errors import DatasetError

_IMAGE = struct.Struct("<I7dI")
_COUNT = struct.Struct("<Q")
_OBSERVED = np.dtype([("x", "<f8"), ("y", "<f8"), ("point", "<i8")])


def observed_points(capture: Path) -> dict[str, int]:
    """Count the points that COLMAP found in each photo.

    Args:
        capture: Folder with a COLMAP model.

    Returns:
        The counts by the names in the model; none where there is no model or it cannot be read.
    """
    model = find_model(capture)
    if model is None:
        return {}
    try:
        if (model / "images.bin").is_file():
            return dict(_binary((model / "images.bin").read_bytes()))
        return dict(_text((model / "images.txt").read_text(encoding="utf-8", errors="replace")))
    except (OSError, ValueError, struct.error, DatasetError):
        return {}  # what is wrong with the file is told by who reads the poses


def _binary(data: bytes) -> Iterator[tuple[str, int]]:
    at = _COUNT.size
    for _ in range(_COUNT.unpack_from(data)[0]):
        at += _IMAGE.size
        end = data.index(b"\0", at)
        name, at = data[at:end], end + 1
        (count,) = _COUNT.unpack_from(data, at)
        observed = np.frombuffer(data, _OBSERVED, count, at + _COUNT.size)
        at += _COUNT.size + observed.nbytes
        yield name.decode("utf-8", "replace").replace("\\", "/"), int((observed["point"] >= 0).sum())


def _text(text: str) -> Iterator[tuple[str, int]]:
    lines = [line for line in text.splitlines() if not line.startswith("#")]
    for pose, observed in zip(lines[::2], [*lines[1::2], ""], strict=False):
        if fields := pose.split(maxsplit=9)[9:]:
            yield fields[0].strip(), sum(int(point) >= 0 for point in observed.split()[2::3])

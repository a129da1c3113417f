"""The region of interest of a capture: the file region.json in its folder, a box in the capture's coordinates.

    {"center": [x, y, z], "rotation": [[...], [...], [...]], "half": [x, y, z]}

The columns of the rotation are the directions of the box's edges, and `half` is half its extent along each. A box in an
edits file is written in the same way.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import TypeAlias

import numpy as np

from gsplat_edu.base.errors import ArgumentError, DatasetError
from gsplat_edu.base.files import written_aside
from gsplat_edu.base.reading import open_file, parse_json
from gsplat_edu.base.records import Number, Record, record_of
from gsplat_edu.data.capture import capture_folder, is_file
from gsplat_edu.scene.region import Region

REGION = "region.json"
"""Name of the file."""

MOST_BYTES = 1 << 16
"""Size of the largest file that is read."""


Numbers: TypeAlias = tuple[Number, Number, Number]


class _Box(Record, frozen=True):
    center: Numbers
    rotation: tuple[Numbers, Numbers, Numbers]
    half: Numbers


def read_region(capture: Path) -> Region | None:
    """Return the region of a capture; None if it has none.

    Args:
        capture: The capture's folder, or its transforms.json.

    Raises:
        DatasetError: the file cannot be read, or describes no box.
    """
    path = _file_of(capture)
    if not is_file(path):
        return None
    try:
        with open_file(path) as opened:
            content = opened.read(MOST_BYTES + 1)
        if len(content) > MOST_BYTES:
            raise ArgumentError(f"is larger than {MOST_BYTES} bytes")
        return parse_region(content)
    except OSError as error:
        reason = error.strerror or str(error)
    except ArgumentError as error:
        reason = str(error)
    raise DatasetError(f"{path}: {reason}; draw the box again, or delete the file")


def parse_region(content: bytes) -> Region:
    """Return the region that a file's content describes.

    Args:
        content: JSON in UTF-8.

    Raises:
        ArgumentError: it describes no box; the message names the field.
    """
    try:
        found = parse_json(content)
    except ValueError:
        raise ArgumentError("is not JSON") from None
    return region_of(found)


def requested_region(given: object) -> Region | None:
    """Return the region of a request of the page of a capture; None if it is to be removed.

    Args:
        given: {"region": box}, with a box as `region_of` takes it or None.

    Raises:
        ArgumentError: it is no such request.
    """
    if not isinstance(given, dict) or list(given) != ["region"]:
        raise ArgumentError("give region, a box or null")
    return None if given["region"] is None else region_of(given["region"])


def region_of(found: object) -> Region:
    """Return the region that parsed JSON describes.

    Raises:
        ArgumentError: it describes no box; the message names the field.
    """
    box: _Box = record_of("", found, _Box)
    return Region(np.array(box.center), np.array(box.rotation), np.array(box.half))


def document_of(region: Region) -> dict[str, list[float] | list[list[float]]]:
    """Return the content of the file of a region, for JSON."""
    return {
        "center": region.center.tolist(),
        "rotation": region.rotation.tolist(),
        "half": region.half.tolist(),
    }


def write_region(capture: Path, region: Region | None) -> None:
    """Write the region of a capture; without one, the file is removed.

    The file is replaced as a whole, in one step. Of two writers at once, the later one wins.

    Args:
        capture: The capture's folder, or its transforms.json.
        region: The region, in the capture's coordinates.

    Raises:
        OSError: the folder cannot be written to.
    """
    path = _file_of(capture)
    if region is None:
        path.unlink(missing_ok=True)
        return
    with written_aside(path) as aside:
        aside.write_text(json.dumps(document_of(region), indent=1) + "\n", encoding="utf-8")


def _file_of(capture: Path) -> Path:
    return capture_folder(capture) / REGION

"""Support of each camera's pose: the number of the capture's points observed in its photo."""

from __future__ import annotations

import codecs
import struct
from pathlib import Path

from gsplat_edu.base.errors import DatasetError
from gsplat_edu.base.reading import open_file
from gsplat_edu.base.text import legible
from gsplat_edu.data.chosen_poses import chosen_poses
from gsplat_edu.data.colmap import find_model
from gsplat_edu.data.colmap_files import observations_bin, observations_txt

_POINT = struct.Struct("<Q3d3Bd")
_COUNT = struct.Struct("<Q")


def observed_points(capture: Path) -> dict[str, int]:
    """Count the points that COLMAP observed in each photo.

    Args:
        capture: Folder with a COLMAP model, or the file that lists the model's images.

    Returns:
        Counts by frame name; empty if no model is read, it cannot be read, or its tracks were computed from the poses
        (`gsplat_edu.data.tracks`), so that they are no evidence for them.
    """
    try:
        model = find_model(chosen_poses(capture))
        if model is None or not _is_measured(model):
            return {}
        listed = model / "images.bin"
        images = observations_bin(listed) if listed.is_file() else observations_txt(model / "images.txt")
        return {legible(image.name): len(image.points) for image in images}
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
            lines = (line.removeprefix(codecs.BOM_UTF8) for line in file)
            first = next((line for line in lines if line.strip() and not line.startswith(b"#")), b"")
        fields = first.split(maxsplit=8)
        return len(fields) < 8 or float(fields[7]) >= 0
    return True

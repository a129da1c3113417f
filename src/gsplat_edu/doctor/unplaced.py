"""What photos show before anyone knows where they were taken: whether they are enough, and which are blurred.

Each photo is compared with those taken before and after it, by the doctor's own measure of blur. How photos overlap,
and whether their exposures agree, needs points that several of them show: the doctor of a capture says it.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from gsplat_edu.doctor.appearance import blur_findings, chance
from gsplat_edu.doctor.files import too_few
from gsplat_edu.photos.decoding import image_size
from gsplat_edu.survey.finding import Finding
from gsplat_edu.survey.geometry import NEIGHBOURS
from gsplat_edu.survey.photos import detail_of_file


class Measured(NamedTuple):
    """A photo and what was measured of it."""

    name: str
    """Its name."""
    size: tuple[int, int]
    """Width and height as stored, px."""
    detail: list[float]
    """Eight logarithms; see `gsplat_edu.survey.photos.detail_of`."""


def measured(name: str, path: Path) -> Measured:
    """Measure a photo at a reduced size.

    Args:
        name: Its name.
        path: Its file.

    Raises:
        DatasetError: it cannot be decoded.
    """
    size = image_size(path)
    return Measured(name, size, detail_of_file(path, size).tolist())


def examine_unplaced(photos: Sequence[Measured], total: int) -> list[Finding]:
    """Examine photos without poses.

    Args:
        photos: The readable ones, in the order they were taken.
        total: Number of all photos.
    """
    found = too_few(len(photos), total)
    if len(photos) < 2:
        return found
    near = NEIGHBOURS // 2
    indices = np.arange(len(photos))
    neighbours = [indices[(abs(indices - i) <= near) & (indices != i)] for i in indices]
    details = np.array([photo.detail for photo in photos])
    chances = [chance(photo.size) for photo in photos]
    return [*found, *blur_findings([photo.name for photo in photos], details, neighbours, chances)]

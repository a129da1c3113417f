"""VisualSFM's .nvm.

A camera is a line: photo, focal length in px, quaternion (w, x, y, z) from world to camera, centre, radial distortion
and 0. Axes are OpenCV's. The distortion r goes the other way than ours: a position d in the photo, from its middle and
divided by the focal length, belongs to the ray d (1 + r |d|²).

Source: VisualSFM's documentation, "NVM format".
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from gsplat_edu.base.errors import DatasetError
from gsplat_edu.base.text import whole_of
from gsplat_edu.data.lens import Lens, lens_of
from gsplat_edu.data.readers.pose_file import AGAIN, PoseProgram, Poses, Shot, cloud_of, numbers_of, text_of
from gsplat_edu.photos.decoding import image_size
from gsplat_edu.scene.gaussian_math import quat_to_R

FIRST_WORD = b"NVM_V3"

CAMERA_NUMBERS, POINT_NUMBERS = 10, 6

SERIES = (1.0, 1.0, 3.0, 12.0, 55.0, 273.0, 1428.0)
"""C(3 n, n) / (2 n + 1): d = u (1 - r u² + 3 r² u⁴ - 12 r³ u⁶ + ...) solves d (1 + r d²) = u (Lagrange's inversion)."""


def holds(path: Path, head: bytes) -> bool:
    """Return whether a file is an NVM of version 3."""
    return path.suffix.lower() == ".nvm" and head.startswith(FIRST_WORD)


def read(path: Path) -> Poses:
    """Read the first model of a file; the others have photos that could not be connected to it.

    Raises:
        DatasetError: the file is damaged.
    """
    lines = [line for line in text_of(path).splitlines() if line.strip()]
    fixed = _fixed(path, lines[0].split()[1:])
    cameras = _section(path, lines[1:], "cameras")
    rest = lines[2 + len(cameras) :]
    points = _section(path, rest, "points") if rest else []
    shots = [_shot(f"{path}, camera {number}", line, fixed) for number, line in enumerate(cameras)]
    found = [
        numbers_of(f"{path}, a point", " ".join(line.split()[:POINT_NUMBERS]), POINT_NUMBERS)
        for line in points
    ]
    return Poses(path, shots, cloud_of([each[:3] for each in found], [each[3:] for each in found]))


class Fixed(NamedTuple):
    """What the calibration in the first line says about all cameras."""

    aspect: float  # of the focal lengths, y / x
    cx: float  # px
    cy: float  # px


def radial(r: float) -> dict[str, float]:
    """Return OpenCV's coefficients of a lens whose position d in the photo belongs to the ray d (1 + r d²).

    Solved for d, this is a series in r u² with fixed coefficients, whose Padé approximant of order 3 over 3 is OpenCV's
    rational polynomial. It is off by less than 1e-6 for |r| u² up to 0.1.

    Args:
        r: The distortion.
    """
    above, below = PADE
    named = {f"k{i}": above[i] * r**i for i in (1, 2, 3)}
    return named | {f"k{3 + i}": below[i] * r**i for i in (1, 2, 3)}


def _pade() -> tuple[list[float], list[float]]:
    """Return the coefficients of numerator and denominator of the approximant of `SERIES` in r u²."""
    c = np.array(SERIES) * (-1.0) ** np.arange(7)
    below = np.concatenate([[1.0], np.linalg.solve([c[n - 1 : n - 4 : -1] for n in (4, 5, 6)], -c[4:])])
    return np.convolve(c, below)[:4].tolist(), below.tolist()


PADE = _pade()


def _shot(where: str, line: str, fixed: Fixed | None) -> Shot:
    name, _, numbers = line.partition("\t")
    if not numbers:
        name, *words = line.split()
        numbers = " ".join(words)
    f, w, x, y, z, *eye, r, _ = numbers_of(where, numbers, CAMERA_NUMBERS).tolist()
    if not any((w, x, y, z)):
        raise DatasetError(f"{where}: its quaternion is 0; {AGAIN}")

    def lens(photo: Path) -> Lens:
        W, H = image_size(photo)
        aspect, cx, cy = fixed or Fixed(1.0, W / 2, H / 2)
        return lens_of({"fx": f, "fy": f * aspect, "cx": cx, "cy": cy, **radial(r)}, W, H)

    return Shot(name.strip().replace('"', " "), quat_to_R((w, x, y, z)), np.array(eye), lens)


def _fixed(path: Path, words: list[str]) -> Fixed | None:
    """Read the calibration "FixedK fx cx fy cy [r]" of the first line."""
    if not words or words[0] != "FixedK":
        return None
    fx, cx, fy, cy = numbers_of(f"{path}, line 1", " ".join(words[1:5]), 4).tolist()
    if fx <= 0 or fy <= 0:
        raise DatasetError(f"{path}, line 1: its focal lengths have to be positive; {AGAIN}")
    return Fixed(fy / fx, cx, cy)


def _section(path: Path, lines: list[str], what: str) -> list[str]:
    """Return the lines that follow their number."""
    count = whole_of(lines[0].strip()) if lines else None
    if count is None or count > len(lines) - 1:
        raise DatasetError(
            f"{path}: has {max(len(lines) - 1, 0)} lines for its {what}, which are more; {AGAIN}"
        )
    return lines[1 : 1 + count]


VISUALSFM = PoseProgram("VisualSFM", holds, read)

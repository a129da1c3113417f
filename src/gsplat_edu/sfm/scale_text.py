"""Parse `--scale`: two points and their distance. Imports nothing heavy, because the command line checks it first."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

from gsplat_edu.base.constants import AUTO
from gsplat_edu.base.errors import ArgumentError

NONE = "none"
"""Value of `--scale` that keeps the reconstruction's unit."""

MARKS = '"A.jpg:120,340;B.jpg:300,310 A.jpg:520,340;B.jpg:700,310 1.20m"'
"""Example of two points marked in photos."""

POINTS = '"0.5,1,2 0.5,1,3.1 1.20m"'
"""Example of two points of a scene."""

NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_LENGTH = re.compile(rf"\s*({NUMBER})\s*(m|cm|mm)\s*")
_MARK = re.compile(rf"\s*([^:;]+):({NUMBER}),({NUMBER})(\s*;|\s+|$)")
_POINT = re.compile(rf"({NUMBER}),({NUMBER}),({NUMBER})")


@dataclass(frozen=True)
class Mark:
    """A pixel of a photo, upright as programs show it; the photo's left and upper edges are at 0."""

    photo: str
    x: float
    y: float


@dataclass(frozen=True)
class MarkedDistance:
    """Two points marked in photos, and the distance between them.

    Args:
        a: Marks of the first point.
        b: Marks of the second point.
        length: Their distance, in `unit`.
        unit: "m", "cm" or "mm".
    """

    a: tuple[Mark, ...]
    b: tuple[Mark, ...]
    length: float
    unit: str


@dataclass(frozen=True)
class SceneDistance:
    """The distance of two points of a scene.

    Args:
        apart: Their distance in the scene's units.
        length: Their true distance, in `unit`.
        unit: "m", "cm" or "mm".
    """

    apart: float
    length: float
    unit: str


def marks_of(text: str) -> MarkedDistance:
    """Parse two points marked in at least two photos each, and their distance.

    Raises:
        ArgumentError: it cannot be read.
    """
    rest, length, unit = _length(text, MARKS)
    points, at = [list[Mark]()], 0
    while at < len(rest):
        found = _MARK.match(rest, at)
        if found is None:
            raise ArgumentError(f"--scale: {rest[at:].strip()!r} is not PHOTO:X,Y; give for example {MARKS}")
        name, x, y, after = found.groups()
        points[-1].append(Mark(name.strip(), float(x), float(y)))
        at = found.end()
        if not after.strip() and at < len(rest):
            points.append([])
    if len(points) != 2:
        raise ArgumentError(f"--scale: has {len(points)} points, but needs two; give for example {MARKS}")
    for letter, marks in zip("AB", points, strict=True):
        if len({mark.photo for mark in marks}) < 2:
            raise ArgumentError(
                f"--scale: point {letter} is marked in one photo, but needs two; for example {MARKS}"
            )
    return MarkedDistance(tuple(points[0]), tuple(points[1]), length, unit)


def points_of(text: str) -> SceneDistance:
    """Parse the coordinates of two points of a scene, and their distance.

    Raises:
        ArgumentError: it cannot be read, or the points are one.
    """
    rest, length, unit = _length(text, POINTS)
    found = [_POINT.fullmatch(word) for word in rest.split()]
    if len(found) != 2 or not all(found):
        raise ArgumentError(f"--scale: {text!r} cannot be read; give two points and their distance, {POINTS}")
    a, b = (tuple(float(number) for number in one.groups()) for one in found if one)
    if not 0.0 < (apart := math.dist(a, b)) < math.inf:
        raise ArgumentError(f"--scale: the two points of {text!r} are one")
    return SceneDistance(apart, length, unit)


def check_scale(text: str) -> None:
    """Check the option of `sfm` and `train`: "auto", "none" or marks.

    Raises:
        ArgumentError: it cannot be read.
    """
    if text not in (AUTO, NONE):
        marks_of(text)


def _length(text: str, example: str) -> tuple[str, float, str]:
    """Split the distance off; return the rest, the distance and its unit."""
    rest, _, last = text.strip().rpartition(" ")
    found = _LENGTH.fullmatch(last)
    if found is None or not rest.strip():
        raise ArgumentError(
            f"--scale: {text!r} does not end with a distance in m, cm or mm; give for example {example}"
        )
    length = float(found[1])
    if not 0.0 < length < 1e9:
        raise ArgumentError(f"--scale: a distance of {last} is not possible")
    return rest.strip(), length, found[2]

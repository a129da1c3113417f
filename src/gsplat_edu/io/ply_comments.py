"""Scene metadata stored as comments in a PLY header, which other readers ignore.

    comment SplatRenderMode: mip
    comment antialiased 1
    comment gsplat_edu up 0.0 -1.0 0.0
    comment gsplat_edu unit m
    comment gsplat_edu origin 500000.0 4649776.0 120.0
    comment gsplat_edu earth EPSG:32633 1.0 0.0 0.0 0.0 0.0 1.0 0.0 0.0 0.0 0.0 1.0 0.0

The origin has to be added, in double, to the coordinates of the vertices; other readers see the scene near zero. The
last line says where on earth their sum is (`gsplat_edu.scene.earth`).

Each line is written if its value is known. There is no standard spelling for antialiasing: Brush writes and reads the
first line ("default" without antialiasing), Postshot writes the second, PlayCanvas' splat-transform reads both since
3.2. Both are written here. They are read in any letter case, with or without our former prefix "gsplat_edu"; the last
one wins, as in Brush and splat-transform.
"""

from __future__ import annotations

import re
from pathlib import Path

from gsplat_edu.base.errors import ArgumentError, SceneFormatError
from gsplat_edu.io.scene import Scene, SceneFrame, direction
from gsplat_edu.scene.earth import Earth
from gsplat_edu.scene.frame import ORIGIN, UNITS, as_origin

OURS = "gsplat_edu"
"""First word of comments that are specific to this package."""

RENDER_MODES = {"mip": True, "default": False}
"""Brush's render modes, and whether each uses antialiasing."""

ANTIALIASED = re.compile(rf"(?:{OURS} )?(?:splatrendermode: ?(mip|default)|antialiased ([01]))")
"""Lower-case comment that specifies antialiasing; an unknown mode specifies nothing."""


def comments(scene: Scene) -> list[str]:
    """Return the header lines for the known metadata of a scene."""
    lines = []
    if scene.antialiased is not None:
        mode = next(mode for mode, antialiased in RENDER_MODES.items() if antialiased == scene.antialiased)
        lines += [f"comment SplatRenderMode: {mode}", f"comment antialiased {int(scene.antialiased)}"]
    if scene.up is not None:
        lines.append(f"comment {OURS} up {' '.join(repr(float(x)) for x in scene.up)}")
    if scene.unit is not None:
        lines.append(f"comment {OURS} unit {scene.unit}")
    if scene.origin != ORIGIN:
        lines.append(f"comment {OURS} origin {' '.join(repr(float(x)) for x in scene.origin)}")
    if scene.earth is not None:
        lines.append(f"comment {OURS} earth {scene.earth}")
    return lines


def read_comments(path: Path, said: tuple[tuple[str, ...], ...]) -> tuple[bool | None, SceneFrame, bool]:
    """Parse the comments of a header: whether the scene is antialiased, its frame, and whether the origin is stated.

    Args:
        path: The file, for messages.
        said: Words of each comment.

    Raises:
        SceneFormatError: one of our comments is malformed.
    """
    antialiased, frame, placed = None, SceneFrame(), False
    for words in said:
        if found := ANTIALIASED.fullmatch(" ".join(words).lower()):
            mode, number = found.groups()
            antialiased = RENDER_MODES[mode] if mode else number == "1"
        elif words[:2] == (OURS, "up"):
            frame = frame._replace(up=direction(_numbers(words[2:])))
            if frame.up is None:
                raise _malformed(path, words, "a direction")
        elif words[:2] == (OURS, "origin"):
            try:
                frame, placed = frame._replace(origin=as_origin("origin", _numbers(words[2:]) or ())), True
            except ArgumentError:
                raise _malformed(path, words, "an origin") from None
        elif words[:2] == (OURS, "unit") and len(words) == 3 and words[2] in UNITS:
            frame = frame._replace(unit=words[2])
        elif words[:2] == (OURS, "earth"):
            try:
                frame = frame._replace(earth=Earth.parsed(" ".join(words[2:])))
            except ArgumentError:
                raise _malformed(path, words, "a place on earth") from None
    return antialiased, frame, placed


def _numbers(words: tuple[str, ...]) -> list[float] | None:
    try:
        return [float(word) for word in words]
    except ValueError:
        return None


def _malformed(path: Path, words: tuple[str, ...], what: str) -> SceneFormatError:
    return SceneFormatError(f"{path}: comment {' '.join(words)[:60]!r} is not {what}; correct or remove it")

"""What a scene PLY has no property for, in comments of its header, which other readers ignore.

    comment SplatRenderMode: mip
    comment antialiased 1
    comment gsplat_edu up 0.0 -1.0 0.0

Each is written where it is known. Whether to render with antialiasing has no standard spelling. Brush writes and reads
the first one ("default" where there is none), Postshot writes the second, PlayCanvas' splat-transform reads both
since 3.2. Both are written here, and read in any case of letters, with or without our own earlier prefix "gsplat_edu".
The last one wins, as in Brush and splat-transform.
"""

from __future__ import annotations

import math
import re
from pathlib import Path

from gsplat_edu.errors import SceneFormatError
from gsplat_edu.io.scene import Scene

OURS = "gsplat_edu"
"""First word of comments that only this package writes."""

RENDER_MODES = {"mip": True, "default": False}
"""Brush's modes, and whether each renders with antialiasing."""

ANTIALIASED = re.compile(rf"(?:{OURS} )?(?:splatrendermode: ?(mip|default)|antialiased ([01]))")
"""A comment, in lower case, that says whether to render with antialiasing; a mode unknown here says nothing."""


def comments(scene: Scene) -> list[str]:
    """Return the header lines for what is known of a scene besides its Gaussians."""
    lines = []
    if scene.antialiased is not None:
        mode = next(mode for mode, antialiased in RENDER_MODES.items() if antialiased == scene.antialiased)
        lines += [f"comment SplatRenderMode: {mode}", f"comment antialiased {int(scene.antialiased)}"]
    if scene.up is not None:
        lines.append(f"comment {OURS} up {' '.join(repr(float(x)) for x in scene.up)}")
    return lines


def read_comments(
    path: Path, said: tuple[tuple[str, ...], ...]
) -> tuple[bool | None, tuple[float, float, float] | None]:
    """Return what the comments of a header say: whether antialiased, and what is up.

    Args:
        path: The file, for messages.
        said: Words of each comment.

    Raises:
        SceneFormatError: a comment of ours cannot be read.
    """
    antialiased, up = None, None
    for words in said:
        if found := ANTIALIASED.fullmatch(" ".join(words).lower()):
            mode, number = found.groups()
            antialiased = RENDER_MODES[mode] if mode else number == "1"
        elif words[:2] == (OURS, "up"):
            up = _direction(list(words[2:]))
            if up is None:
                raise SceneFormatError(
                    f"{path}: comment {' '.join(words)[:60]!r} is no direction; correct or remove it"
                )
    return antialiased, up


def _direction(numbers: list[str]) -> tuple[float, float, float] | None:
    try:
        x, y, z = (float(number) for number in numbers)
    except ValueError:
        return None
    length = math.hypot(x, y, z)
    return (x / length, y / length, z / length) if 0.0 < length < math.inf else None

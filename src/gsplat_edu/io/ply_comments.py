"""What a PLY has no property for, in comments of its header, which other readers leave aside.

    comment gsplat_edu antialiased 1
    comment gsplat_edu up 0.0 -1.0 0.0

Each stands there where it is known.
"""

from __future__ import annotations

import math
from pathlib import Path

from gsplat_edu.errors import SceneFormatError
from gsplat_edu.io.scene import Scene

OURS = "gsplat_edu"
"""First word of our comments."""


def comments(scene: Scene) -> list[str]:
    """Return the header lines for what is known of a scene besides its Gaussians."""
    lines = []
    if scene.antialiased is not None:
        lines.append(f"comment {OURS} antialiased {int(scene.antialiased)}")
    if scene.up is not None:
        lines.append(f"comment {OURS} up {' '.join(repr(float(x)) for x in scene.up)}")
    return lines


def read_comments(
    path: Path, said: tuple[tuple[str, ...], ...]
) -> tuple[bool | None, tuple[float, float, float] | None]:
    """Return what the comments of a header say: whether antialiased, and what is up.

    Raises:
        SceneFormatError: a comment of ours cannot be read.
    """
    antialiased, up = None, None
    for words in said:
        match words:
            case [first, "antialiased", "0" | "1" as number] if first == OURS:
                antialiased = number == "1"
            case [first, "up", *numbers] if first == OURS:
                up = _direction(numbers)
                if up is None:
                    raise SceneFormatError(
                        f"{path}: comment {' '.join(words)[:60]!r} is no direction; mend or remove it"
                    )
    return antialiased, up


def _direction(numbers: list[str]) -> tuple[float, float, float] | None:
    try:
        x, y, z = (float(number) for number in numbers)
    except ValueError:
        return None
    length = math.hypot(x, y, z)
    return (x / length, y / length, z / length) if 0.0 < length < math.inf else None

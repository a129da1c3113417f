"""Pictures as bytes and as PNG, and how notebooks show values: a picture or a curve, with a line of facts."""

from __future__ import annotations

import base64
import html
import importlib
import io
import math
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType

import numpy as np
from jaxtyping import Float64, UInt8

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.files import written_aside
from gsplat_edu.base.printing import say
from gsplat_edu.base.validation import ArrayLike, check_shape, float64_array

CURVE_WIDTH, CURVE_HEIGHT = 480, 160
"""Size of a curve, px."""

MOST_CORNERS = 480
"""Most corners of a curve: longer ones are drawn by means of as many pieces."""

_scenes: list[str] = []


def to_bytes(image: ArrayLike) -> UInt8[np.ndarray, "H W 3"]:
    """Round an image to bytes: floor(255 x + 0.5), with x clamped to 0..1. A uint8 image is returned unchanged.

    Args:
        image: (H, W, 3) array or tensor.

    Raises:
        ShapeError: not (H, W, 3).
        ArgumentError: a value is NaN or infinite.
    """
    pixels = as_array(image)
    if pixels.dtype == np.uint8:
        check_shape("image", pixels.shape, ("H", "W", 3), {})
        return pixels
    return levels(np.clip(float64_array("image", pixels, ("H", "W", 3)), 0.0, 1.0)).astype(np.uint8)


def levels(values: Float64[np.ndarray, "H W 3"]) -> Float64[np.ndarray, "H W 3"]:
    """Round values from 0 to 1 to whole levels from 0 to 255."""
    rounded = 255.0 * values
    rounded += 0.5
    return np.asarray(np.floor(rounded, out=rounded))


def as_array(image: ArrayLike) -> np.ndarray:
    """Return an array, or that of a tensor of any device, with gradients or without."""
    of_tensor = getattr(image, "numpy", None)
    return np.asarray(image if of_tensor is None else of_tensor(force=True))


def png(image: ArrayLike) -> bytes:
    """Return an image as an 8-bit PNG.

    Args:
        image: (H, W, 3) uint8, or float from 0 to 1, clamped and rounded.

    Raises:
        ShapeError: not (H, W, 3).
        ArgumentError: a value is NaN or infinite.
    """
    from PIL import Image  # here, because it takes long to import

    buffer = io.BytesIO()
    Image.fromarray(to_bytes(image)).save(buffer, format="PNG")
    return buffer.getvalue()


def write_png(path: str | Path, image: ArrayLike) -> None:
    """Write an image as an 8-bit PNG.

    Args:
        path: Output file, which ends in .png; parent folders are created.
        image: As for `png`.

    Raises:
        ShapeError, ArgumentError: as for `png`, or the file has another ending.
        OSError: the file cannot be written. An existing file stays unchanged.
    """
    path = Path(path)
    if path.suffix.lower() != ".png":
        raise ArgumentError(f"path: is {path}, but has to end in .png")
    data = png(image)
    with written_aside(path) as aside:
        aside.write_bytes(data)


def picture_html(data: bytes, facts: str) -> str:
    """Return HTML of a PNG and a line below it.

    Args:
        data: The PNG.
        facts: The line; plain text.
    """
    encoded = base64.b64encode(data).decode("ascii")
    return (
        f'<div><img src="data:image/png;base64,{encoded}" alt=""><br><code>{html.escape(facts)}</code></div>'
    )


def curve_html(values: Sequence[float], facts: str) -> str:
    """Return HTML of a curve on a logarithmic scale and a line below it.

    Args:
        values: Numbers from left to right; those that are not above 0 and finite are left out.
        facts: The line; plain text.
    """
    heights = [math.log10(value) for value in values if 0.0 < value < math.inf]
    pieces = np.array_split(np.array(heights), min(len(heights), MOST_CORNERS)) if heights else []
    means = [float(piece.mean()) for piece in pieces]
    drawing = ""
    if means:
        low, high = min(means), max(means)
        x, y = CURVE_WIDTH / max(len(means) - 1, 1), (CURVE_HEIGHT - 4) / ((high - low) or 1.0)
        corners = " ".join(f"{x * i:.1f},{2 + y * (high - mean):.1f}" for i, mean in enumerate(means))
        drawing = (
            f'<svg width="{CURVE_WIDTH}" height="{CURVE_HEIGHT}" role="img" aria-label="{html.escape(facts)}">'
            f'<polyline points="{corners}" fill="none" stroke="currentColor" stroke-width="1.5"/></svg><br>'
        )
    return f"<div>{drawing}<code>{html.escape(facts)}</code></div>"


def in_notebook() -> bool:
    """Return whether a notebook's kernel runs this process."""
    ipython = sys.modules.get("IPython")
    shell = None if ipython is None else ipython.get_ipython()
    return shell is not None and "IPKernelApp" in shell.config


def show(value: object, image: ArrayLike, instead: str) -> None:
    """Show a value in the notebook, or its image in the system's viewer; without a screen, print what to do.

    Args:
        value: What the notebook shows.
        image: As for `png`.
        instead: What to do without a screen.
    """
    if in_notebook():
        sys.modules["IPython"].display.display(value)
        return
    screen = sys.platform in ("win32", "darwin") or any(map(os.environ.get, ("DISPLAY", "WAYLAND_DISPLAY")))
    if screen:
        from PIL import Image, ImageShow  # here, because it takes long to import

        if ImageShow.show(Image.fromarray(to_bytes(image))):
            return
    say(f"show: there is no notebook and no screen; {instead}")


def scenes_shown_by(module: str) -> None:
    """Name the module that draws scenes: it has `scene_html` and `scene_page`, and stands above scenes.

    Args:
        module: Its full name; it is imported when a scene is shown.
    """
    _scenes[:] = [module]


def scene_shower() -> ModuleType:
    """Return the module that draws scenes."""
    return importlib.import_module(_scenes[0])

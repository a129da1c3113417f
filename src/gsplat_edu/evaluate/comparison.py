"""The pictures in renders/test of a run: a photo and its render side by side, photo first, as in the report.

A strip above them names both. A text chunk of the PNG holds their order and the strip's height. Pictures of earlier
versions have neither chunk nor strip, and the render comes first.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image, ImageDraw, ImageFont
from PIL.PngImagePlugin import PngInfo

from gsplat_edu.base.files import written_aside
from gsplat_edu.photos.image_files import opened_image

SEPARATOR_WIDTH = 4
"""Width of the line between two images side by side, px."""

SEPARATOR_GREY = 128

STRIP_HEIGHT = 13
"""Height of the strip with the names, px; it is multiplied by a whole factor that grows with the width."""

WIDTH_PER_SCALE = 600
"""The strip's factor is the width of an image divided by this, px, rounded down, but at least 1."""

PANELS, STRIP = "Panels", "Strip"
"""Keywords of the text chunks: names of the pictures from left to right; height of the strip, px."""

ORDER = "photo,render"

COMPRESSION = 2
"""zlib's level for the pictures: a third of the time of the usual 6, for files that are 14 % larger."""

RgbBytes = UInt8[np.ndarray, "H W 3"]


def save_comparison(path: Path, photo: RgbBytes, render: RgbBytes) -> None:
    """Write a photo and its render as one PNG.

    Args:
        path: Output file; parent folders are created.
        photo: (H, W, 3).
        render: (H, W, 3), of equal size.

    Raises:
        OSError: the file cannot be written. An existing file stays unchanged.
    """
    line = np.full((len(photo), SEPARATOR_WIDTH, 3), SEPARATOR_GREY, dtype=np.uint8)
    row = np.concatenate([photo, line, render], axis=1)
    strip = name_strip(ORDER.split(","), photo.shape[1])
    facts = PngInfo()
    facts.add_text(PANELS, ORDER)
    facts.add_text(STRIP, str(len(strip)))
    with written_aside(path) as aside:
        picture = Image.fromarray(np.concatenate([strip, row]))
        picture.save(aside, format="PNG", pnginfo=facts, compress_level=COMPRESSION)


def name_strip(names: Sequence[str], width: int) -> RgbBytes:
    """Return a white strip with a name above each of several pictures of one width, px."""
    scale = max(1, width // WIDTH_PER_SCALE)
    total = len(names) * width + (len(names) - 1) * SEPARATOR_WIDTH
    strip = Image.new("L", (-(-total // scale), STRIP_HEIGHT), 255)
    draw, font = ImageDraw.Draw(strip), ImageFont.load_default_imagefont()
    for number, name in enumerate(names):
        draw.text((number * (width + SEPARATOR_WIDTH) // scale + 2, 1), name, fill=0, font=font)
    large = np.asarray(strip).repeat(scale, axis=0).repeat(scale, axis=1)[:, :total]
    return np.repeat(large[..., None], 3, axis=2)


def comparison_size(path: Path) -> tuple[int, int]:
    """Return width and height of either picture in a file of `save_comparison`, px, from its header.

    Raises:
        OSError, ValueError: the file cannot be read or is not such a picture.
    """
    with opened_image(path, ("PNG",)) as file:
        return (file.width - SEPARATOR_WIDTH) // 2, file.height - _strip_height(file)


def read_comparison(path: Path) -> dict[str, RgbBytes]:
    """Read a file of `save_comparison` as "photo" and "render": a PNG of ours, no photo.

    Raises:
        OSError, ValueError: the file cannot be read or is not such a picture.
    """
    with opened_image(path, ("PNG",)) as file:
        strip = _strip_height(file)
        both = np.asarray(file.convert("RGB"))[strip:]
    W = (both.shape[1] - SEPARATOR_WIDTH) // 2
    if W < 1 or both.shape[1] != 2 * W + SEPARATOR_WIDTH:
        raise ValueError("is not a photo beside its render")
    halves = both[:, :W], both[:, W + SEPARATOR_WIDTH :]
    return {name: np.ascontiguousarray(half) for name, half in zip(ORDER.split(","), halves, strict=True)}


def _strip_height(file: Image.Image) -> int:
    """Return the height of the strip with the names, px; raise a ValueError for another picture."""
    strip = str(file.info.get(STRIP, ""))
    if file.info.get(PANELS) != ORDER or not strip.isdecimal() or not 0 <= int(strip[:6]) < file.height:
        raise ValueError("is not a photo beside its render")
    return int(strip[:6])

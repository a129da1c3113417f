"""Round photos with 16 bits per value to 8; Pillow would keep only the upper 8 bits of colours."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from gsplat_edu.base.headroom import require_memory
from gsplat_edu.photos.image_files import opened_image

DEEP_BYTES_PER_PIXEL = 24
"""Memory needed for decoding: two images of Pillow, two arrays and the result, and one band. Measured: 19 to 21."""

ROWS = 64
"""Rows that are rounded at once: a band's intermediates are small."""

GRAY_ALPHA = "LA;16B"
"""Pillow's name for the pixels of a PNG with 16 bits of gray and of alpha."""


def is_deep(file: Image.Image) -> bool:
    """Return whether a file stores 16 bits per value, or whole numbers of more.

    Args:
        file: An image that was opened but not decoded.
    """
    return file.mode.startswith("I") or ";16" in _packing(file)


def rounded_image(path: Path, file: Image.Image) -> Image.Image:
    """Decode a photo with 16 bits per value and round it to 8: v / 257, so that 65535 becomes 255.

    Args:
        path: The file, which is read a second time.
        file: The same file, opened but not decoded; it is used up.

    Returns:
        The image with 8 bits, in mode L, LA, RGB, RGBA or CMYK. A colour that the file declares transparent is.

    Raises:
        UNDECODABLE: as for `opened_image`.
        NotEnoughMemoryError: the pixels need more memory than is free.
    """
    needed = DEEP_BYTES_PER_PIXEL * file.width * file.height
    require_memory(
        f"{path}: {file.width}x{file.height} px", needed, "close other programs, or make the photo smaller"
    )
    clear = file.info.get("transparency")
    if file.mode.startswith("I"):
        values = np.clip(np.asarray(file, dtype=np.int64), 0, 65535)
        gray = ((values + 128) // 257).astype(np.uint8)
        return Image.fromarray(gray if clear is None else np.dstack([gray, _opaque(values != clear)]))
    packing = _packing(file)
    if packing == GRAY_ALPHA:
        _repack(file, "RGBA")  # four bytes a pixel, as they are stored
        pairs = np.asarray(file)
        return Image.fromarray(_rounded(pairs[..., ::2], pairs[..., 1::2]))
    weighted = packing.startswith("RGBa")
    packing = packing.replace("RGBa", "RGBA")
    with opened_image(path) as again:
        _repack(file, packing)
        _repack(again, _lower_bytes(packing))
        upper, lower = np.asarray(file), np.asarray(again)
    if weighted:
        return Image.fromarray(_unweighted(upper, lower))
    pixels = _rounded(upper, lower)
    if clear is not None and file.mode == "RGB":
        differs = (upper * np.uint16(256) + lower != np.array(clear, np.uint16)).any(axis=2)
        pixels = np.dstack([pixels, _opaque(differs)])
    return Image.fromarray(pixels, "CMYK") if file.mode == "CMYK" else Image.fromarray(pixels)


def _packing(file: Image.Image) -> str:
    """Return Pillow's name for the arrangement of a file's pixels; empty if it has none."""
    tiles = getattr(file, "tile", None)
    given = tiles[0].args if tiles else ""
    name = given[0] if isinstance(given, tuple) and given else given
    return name if isinstance(name, str) else ""


def _repack(file: Image.Image, packing: str) -> None:
    """Set another arrangement of the same number of bits before decoding."""
    tiles = file.tile  # type: ignore[attr-defined]
    file.tile = [  # type: ignore[attr-defined]
        tile._replace(args=(packing, *tile.args[1:]) if isinstance(tile.args, tuple) else packing)
        for tile in tiles
    ]


def _lower_bytes(packing: str) -> str:
    """Return the packing with the opposite byte order, with which Pillow keeps the lower byte of each value."""
    native = "L" if sys.byteorder == "little" else "B"
    order = native if packing[-1] == "N" else packing[-1]
    return packing[:-1] + ("B" if order == "L" else "L")


def _rounded(
    upper: UInt8[np.ndarray, "H W c"], lower: UInt8[np.ndarray, "H W c"]
) -> UInt8[np.ndarray, "H W c"]:
    """Round v / 257 with v = 256 upper + lower = 257 upper + (lower - upper); no value lies half-way."""
    pixels = np.empty(upper.shape, np.uint8)
    for first in range(0, len(upper), ROWS):
        band = slice(first, first + ROWS)
        rest = lower[band].astype(np.int16) - upper[band]
        pixels[band] = upper[band] + (rest > 128) - (rest < -128)
    return pixels


def _unweighted(
    upper: UInt8[np.ndarray, "H W 4"], lower: UInt8[np.ndarray, "H W 4"]
) -> UInt8[np.ndarray, "H W 4"]:
    """Divide premultiplied colours by alpha, and round; black where alpha is zero."""
    pixels = np.empty(upper.shape, np.uint8)
    for first in range(0, len(upper), ROWS):
        band = slice(first, first + ROWS)
        values = upper[band] * 256.0 + lower[band]
        alpha = values[..., 3:]
        colors = np.clip(values[..., :3] / np.maximum(alpha, 1.0), 0.0, 1.0)
        pixels[band] = np.rint(np.concatenate([255.0 * colors, alpha / 257.0], axis=2)).astype(np.uint8)
    return pixels


def _opaque(differs: np.ndarray) -> UInt8[np.ndarray, "H W"]:
    """Return alpha: transparent for pixels of the transparent colour, else opaque."""
    return np.where(differs, 255, 0).astype(np.uint8)

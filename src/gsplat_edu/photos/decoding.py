"""From an image file to pixels: its header, its orientation, 8-bit sRGB of any depth and profile, and thumbnails."""

from __future__ import annotations

import functools
import math
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Shaped, UInt8
from PIL import ExifTags, Image

from gsplat_edu.base.errors import DatasetError, NotEnoughMemoryError, SplatError
from gsplat_edu.photos.colors import conversion_of, to_srgb
from gsplat_edu.photos.image_files import (
    BYTES_PER_PIXEL,
    HEIF,
    SPELLED,
    UNDECODABLE,
    bytes_per_pixel,
    opened_image,
    quiet_decoders,
    require_room,
)
from gsplat_edu.scene.photo import Photo, shrunk

AT_ONCE = 64_000_000
"""Pixels to decode at once; decoding takes about 10 bytes per pixel, and 25 more if alpha is resampled."""

LOSSY, LOSSY_THRESHOLD = ("JPEG", HEIF), 128
"""Formats in which a mask's zeros are noisy near its edges, and the smallest value that counts in them."""

UPRIGHT = 1
"""EXIF orientation of a photo that is stored upright."""

TURNS = {1: 0, 2: 0, 3: 2, 4: 2, 5: 3, 6: 1, 7: 1, 8: 3}
"""Quarter turns clockwise that bring a photo upright, by EXIF orientation; mirrored photos are mirrored first."""

MIRRORED = (2, 4, 5, 7)
"""EXIF orientations of photos whose stored columns are reversed."""

BACK = {1: 1, 2: 2, 3: 3, 4: 4, 5: 5, 6: 8, 7: 7, 8: 6}
"""EXIF orientation that undoes another one."""

DEEP_BYTES_PER_PIXEL = 24
"""Memory needed for decoding: two images of Pillow, two arrays and the result, and one band. Measured: 19 to 21."""

ROWS = 64
"""Rows that are rounded at once: a band's intermediates are small."""

GRAY_ALPHA = "LA;16B"
"""Pillow's name for the pixels of a PNG with 16 bits of gray and of alpha."""

THUMBNAIL_QUALITY = 85
"""JPEG quality of thumbnails."""

BEHIND = (0.5, 0.5, 0.5)
"""RGB from 0 to 1 behind the transparent pixels of a thumbnail."""


@dataclass(frozen=True)
class ImageHeader:
    """Facts from an image file's header.

    Args:
        size: Width and height as stored, px. A HEIC's are upright, because its container turns it.
        problem: Why the colours are taken as sRGB although the file declares others; empty if they are converted.
        decoding: Bytes per pixel that decoding takes.
        alpha: Whether pixels may be transparent.
    """

    size: tuple[int, int]
    problem: str
    decoding: int = BYTES_PER_PIXEL
    alpha: bool = False


def image_header(path: Path) -> ImageHeader:
    """Read a file's header.

    Raises:
        DatasetError: the file is not an image, or is HEIC and pillow-heif is not installed.
    """
    with _readable(path) as file:
        problem = conversion_of(file.info).problem
        return ImageHeader(stored_size(file), problem, _decoding_bytes(file), file.has_transparency_data)


def image_size(path: Path) -> tuple[int, int]:
    """Read width and height from a file's header, px. EXIF orientation is ignored, as in COLMAP.

    Raises:
        DatasetError: as for `image_header`.
    """
    with _readable(path) as file:
        return stored_size(file)


def upright_image_size(path: Path) -> tuple[int, int]:
    """Read width and height of a photo once it is turned by its EXIF orientation, px.

    Raises:
        DatasetError: as for `image_header`.
    """
    with quiet_decoders(), _readable(path) as file:
        return upright_size(stored_size(file), stored_orientation(file))


def image_orientation(path: Path) -> int:
    """Read the EXIF orientation, 1 to 8; 1 if a file has none. Always 1 for HEIC: see `stored_orientation`.

    Raises:
        DatasetError: as for `image_header`.
    """
    with quiet_decoders(), _readable(path) as file:
        return stored_orientation(file)


def recorded_exposure(path: Path) -> float | None:
    """Read how bright EXIF says a photo is: log2(t ISO / N²) with exposure time t in s and f-number N, stops.

    Returns:
        A number to compare with that of other photos; None unless the file records all three.

    Raises:
        DatasetError: as for `image_header`.
    """
    tags = (ExifTags.Base.ExposureTime, ExifTags.Base.ISOSpeedRatings, ExifTags.Base.FNumber)
    with quiet_decoders(), _readable(path) as file:
        # Pillow decodes a PNG to look for EXIF behind its pixels, where cameras do not write it
        late = file.format == "PNG" and "exif" not in file.info
        details = {} if late else file.getexif().get_ifd(ExifTags.IFD.Exif)
    time, iso, number = (_positive(details.get(tag)) for tag in tags)
    return math.log2(time * iso / number**2) if time and iso and number else None


def _positive(value: object) -> float:
    """Convert an EXIF value, the first if there are several, to a number; 0 if it is none, or not positive."""
    try:
        number = float(value[0] if isinstance(value, tuple) else value)  # type: ignore[arg-type]
    except (TypeError, ValueError, ZeroDivisionError, IndexError):
        return 0.0
    return number if 1e-9 < number < 1e9 else 0.0


class PhotoHeaders:
    """Headers of image files, cached; each file is opened once for its header and once for its orientation.

    Attributes:
        of: `image_header`, cached.
        orientation: `image_orientation`, cached.
    """

    def __init__(self) -> None:
        self.of = functools.cache(image_header)
        self.orientation = functools.cache(image_orientation)

    def size(self, path: Path) -> tuple[int, int]:
        """Return width and height as stored, px; see `image_header`."""
        return self.of(path).size


def stored_size(file: Image.Image) -> tuple[int, int]:
    """Return width and height of an opened image as stored, px; Pillow exchanges those of a TIFF that EXIF turns."""
    W, H = file.size
    return (H, W) if file.format == "TIFF" and TURNS[stored_orientation(file)] % 2 else (W, H)


def stored_orientation(file: Image.Image) -> int:
    """Return the EXIF orientation of an opened image that is not decoded, 1 to 8.

    A HEIC's container has its own rotation, which the decoder applies; ISO 23008-12 says to ignore the rotation in
    EXIF.
    """
    if file.format == HEIF:
        return UPRIGHT
    orientation = file.getexif().get(ExifTags.Base.Orientation, UPRIGHT)
    return orientation if orientation in TURNS else UPRIGHT


def upright_size(size: tuple[int, int], orientation: int) -> tuple[int, int]:
    """Return the size of a photo after it is turned.

    Args:
        size: Width and height as stored, px.
        orientation: EXIF orientation.
    """
    return size[::-1] if TURNS[orientation] % 2 else size


def decode(
    path: Path, orientation: int = UPRIGHT, smaller: int | None = None
) -> tuple[UInt8[np.ndarray, "H W 3"], UInt8[np.ndarray, "H W"] | None]:
    """Decode an image file in one of `gsplat_edu.photos.image_files.FORMATS` to 8-bit sRGB.

    Every reader of photos calls this. 16 bits are rounded to 8, and colours of another profile are converted; all other
    pixels are as the file stores them.

    Args:
        path: The file.
        orientation: EXIF orientation by which the stored pixels are turned. The orientation in the file is ignored.
        smaller: Decode JPEGs at 1/2, 1/4 or 1/8 of their size, if both sides stay this long, px; None for full size.

    Returns:
        RGB and alpha; alpha is None if the photo is opaque.

    Raises:
        DatasetError: the file is truncated, corrupt or not an image.
        NotEnoughMemoryError: the pixels need more memory than is free.
    """
    with _readable(path) as file:
        if smaller is not None and file.format == "JPEG":
            file.draft("RGB", (smaller, smaller))
        require_room(path, file, _decoding_bytes(file))
        if file.mode == "F":
            raise ValueError("its pixels are floats")
        info, already = file.info, _turned_by_pillow(file)
        image = _rounded_image(path, file) if _is_deep(file) else file
        converted = image.convert("RGBA" if image.has_transparency_data else "RGB")
        to_srgb(converted, info)
        pixels = turned(turned(np.array(converted), BACK[already]), orientation)
    if pixels.shape[2] == 3:
        return pixels, None
    rgb, alpha = np.ascontiguousarray(pixels[..., :3]), np.ascontiguousarray(pixels[..., 3])
    return rgb, None if alpha.min() == 255 else alpha


def turned(pixels: Shaped[np.ndarray, "h w *c"], orientation: int) -> Shaped[np.ndarray, "H W *c"]:
    """Turn stored pixels upright.

    Args:
        pixels: The stored pixels, of a photo or a mask.
        orientation: EXIF orientation.
    """
    if orientation == UPRIGHT:
        return pixels
    plain = pixels[:, ::-1] if orientation in MIRRORED else pixels
    return np.ascontiguousarray(np.rot90(plain, -TURNS[orientation]))


def decode_mask(path: Path) -> Bool[np.ndarray, "H W"]:
    """Decode a mask: true for nonzero pixels, or for those of at least `LOSSY_THRESHOLD` in a lossy format.

    Raises:
        DatasetError: the file is truncated, corrupt or not an image.
        NotEnoughMemoryError: the pixels need more memory than is free.
    """
    with _readable(path) as file:
        require_room(path, file)
        already = _turned_by_pillow(file)
        least = LOSSY_THRESHOLD if file.format in LOSSY else 0
        plain = np.asarray(file if file.mode[0] in "IF" else file.convert("L"))
        mask: Bool[np.ndarray, "H W"] = turned(plain >= least if least else plain != 0, BACK[already])
        return mask


def decode_grey(path: Path) -> UInt8[np.ndarray, "H W"]:
    """Decode a working copy, 8-bit RGB and upright, to grey values.

    Raises:
        DatasetError: the file is truncated, corrupt or not an image.
        NotEnoughMemoryError: the pixels need more memory than is free.
    """
    with _readable(path) as file:
        require_room(path, file)
        return np.asarray(file.convert("L"))


def thumbnail_jpeg(photo: Path, side: int) -> bytes:
    """Return a photo as a JPEG, turned upright by its EXIF orientation and never enlarged.

    Args:
        photo: The photo's file.
        side: Longest side, px.

    Raises:
        DatasetError: the photo cannot be decoded.
        NotEnoughMemoryError: it needs more memory than is free.
    """
    pixels, alpha = decode(photo, image_orientation(photo), smaller=side)
    if alpha is not None:
        pixels = Photo(pixels, alpha).over(BEHIND)
    data = BytesIO()
    Image.fromarray(shrunk(pixels, side)).save(data, format="JPEG", quality=THUMBNAIL_QUALITY)
    return data.getvalue()


@contextmanager
def _readable(path: Path) -> Iterator[Image.Image]:
    """Open an image, and say of any error while it is read which file it is and what to do.

    Raises:
        DatasetError: the file is truncated, corrupt or not an image, or is HEIC and pillow-heif is not installed.
        NotEnoughMemoryError: Pillow ran out of memory.
    """
    try:
        with opened_image(path) as file:
            yield file
    except UNDECODABLE as error:
        raise _undecodable(path, error) from None


def _undecodable(path: Path, error: BaseException) -> SplatError:
    reason = getattr(error, "strerror", None) or str(error).split("\n")[0] or type(error).__name__
    if "out of memory" in reason:  # Pillow's decoders say so in an OSError
        return NotEnoughMemoryError(f"{path}: ran out of memory while decoding; close other programs")
    if "cannot identify" in reason:
        reason = f"it is not a {SPELLED} image"
    return DatasetError(
        f"{path}: cannot be decoded ({reason}); replace the file, or take it out of the capture", reason
    )


def _turned_by_pillow(file: Image.Image) -> int:
    """Return the EXIF orientation by which Pillow will turn an image while it decodes it: it does so for TIFF only."""
    return stored_orientation(file) if file.format == "TIFF" else UPRIGHT


def _decoding_bytes(file: Image.Image) -> int:
    """Return the memory that `decode` takes, bytes per pixel."""
    return DEEP_BYTES_PER_PIXEL if _is_deep(file) else bytes_per_pixel(file)


def _is_deep(file: Image.Image) -> bool:
    """Return whether a file stores 16 bits per value, or whole numbers of more.

    Args:
        file: An image that was opened but not decoded.
    """
    return file.mode.startswith("I") or ";16" in _packing(file)


def _rounded_image(path: Path, file: Image.Image) -> Image.Image:
    """Decode a photo with 16 bits per value and round it to 8: v / 257, so that 65535 becomes 255.

    Args:
        path: The file, which is read a second time.
        file: The same file, opened but not decoded; it is used up.

    Returns:
        The image with 8 bits, in mode L, LA, RGB, RGBA or CMYK. A colour that the file declares transparent is.

    Raises:
        UNDECODABLE: as for `opened_image`.
    """
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

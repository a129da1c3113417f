"""The one door to image files: formats that cameras and programs write for photos, within a size and within memory.

Pillow knows some forty formats more. One of them starts Ghostscript on the file, others unpack what no photo holds.
"""

from __future__ import annotations

import struct
import threading
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path

from PIL import Image

from gsplat_edu.headroom import require_memory
from gsplat_edu.reading import open_file

FORMATS = ("JPEG", "PNG", "WEBP", "TIFF", "BMP", "PPM")
"""Formats that are opened, by Pillow's names. JPEG opens MPO too, which some cameras and phones write as .jpg."""

SPELLED = "JPEG, PNG, WebP, TIFF, BMP or PPM"
"""The same for people."""

MAX_PIXELS = 2**30
"""Pixels of a photo that are believed; a header that says more is a corrupt file's or not a photo's."""

BYTES_PER_PIXEL = 10
"""Memory that decoding takes: 4 bytes in Pillow, as many after a conversion, and the array's. Measured: 8 to 11."""

UNDECODABLE = (
    OSError,
    SyntaxError,
    ValueError,
    EOFError,
    KeyError,
    IndexError,
    TypeError,
    OverflowError,
    struct.error,
)
"""What Pillow raises on files that are cut short, corrupt, absurdly large or no images."""


class _PillowsLimit:
    """Lifts Pillow's limit of 89 megapixels while images are open: `MAX_PIXELS` and free memory are the limits here.

    Pillow's limit belongs to the process, and some decoders check it again. It is back once no thread reads.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._readers = 0
        self._limit: int | None = None

    def __enter__(self) -> None:
        with self._lock:
            if self._readers == 0:
                self._limit, Image.MAX_IMAGE_PIXELS = Image.MAX_IMAGE_PIXELS, None
            self._readers += 1

    def __exit__(self, *error: object) -> None:
        with self._lock:
            self._readers -= 1
            if self._readers == 0:
                Image.MAX_IMAGE_PIXELS = self._limit


_no_limit = _PillowsLimit()


@contextmanager
def opened_image(source: Path | bytes, formats: Sequence[str] = FORMATS) -> Iterator[Image.Image]:
    """Open an image and read its header; nothing is decoded yet.

    Args:
        source: The file, or its contents.
        formats: Pillow's names of those that are tried.

    Yields:
        The image. Call `require_room` before its pixels are touched.

    Raises:
        UNDECODABLE: it is no image of these formats, no regular file, damaged, or has more than `MAX_PIXELS`.
    """
    with (
        _no_limit,
        BytesIO(source) if isinstance(source, bytes) else open_file(source) as file,
        Image.open(file, formats=tuple(formats)) as image,
    ):
        if image.width * image.height > MAX_PIXELS:
            raise ValueError(f"{image.width}x{image.height} px are more than a photo has")
        yield image


def require_room(path: Path, image: Image.Image) -> None:
    """Check that there is memory to decode an image, by the size in its header.

    Raises:
        NotEnoughMemoryError: there is not.
    """
    require_memory(
        f"{path}: {image.width}x{image.height} px",
        BYTES_PER_PIXEL * image.width * image.height,
        "close other programs, or make the photo smaller",
    )


def is_image(path: Path) -> bool:
    """Say whether a file is an image of one of `FORMATS`, by its header."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with opened_image(path):
                return True
    except UNDECODABLE:
        return False

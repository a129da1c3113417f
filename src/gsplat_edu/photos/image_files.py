"""The only module that opens image files: formats of cameras and photo software, within limits of size and memory.

Photos and their masks are then decoded by `gsplat_edu.photos.decoding` only. What is no photo, as a depth map, a mesh's
texture, an image of SOG or a picture that this program wrote, is decoded where its numbers mean something.

Pillow supports some forty more formats. One of them starts Ghostscript on the file, and others decode data that no
photo contains.
"""

from __future__ import annotations

import os
import struct
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from typing import BinaryIO

from PIL import Image

from gsplat_edu.base.errors import BackendWarning, DatasetError
from gsplat_edu.base.headroom import require_memory
from gsplat_edu.base.locks import ThreadLock
from gsplat_edu.base.reading import open_file
from gsplat_edu.base.text import install_command

HEIF = "HEIF"
"""Pillow's name for HEIC and HEIF, which pillow-heif decodes (extra `heic`)."""

FORMATS = ("JPEG", "PNG", "WEBP", "TIFF", "BMP", "PPM", HEIF)
"""Accepted formats, by Pillow's names. JPEG includes MPO, which some cameras and phones write as .jpg."""

SPELLED = "JPEG, PNG, WebP, TIFF, BMP, PPM or HEIC"
"""The accepted formats in messages."""

HEIF_BRANDS = (b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"hevm", b"hevs", b"mif1", b"msf1")
"""Brands of a file's ftyp box that make it HEIF (ISO 23008-12), for any file name."""

MAX_PIXELS = 400_000_000
"""Most pixels of a photo: cameras have up to 200 million. A header that claims more belongs to a corrupt file, to one
that was made to fill the memory, or not to a photo."""

MAX_SIDE = 65_535
"""Longest side of a photo, px: JPEG's limit."""

PLAIN_PIXELS = 64_000_000
"""A photo of up to this many pixels may be compressed to any size, such as a blank mask."""

PIXELS_PER_BYTE = 200
"""Most pixels for each byte of a larger photo's file. JPEG's shortest code, six bits for 64 pixels of a blank image,
gives 85; a PNG of one colour has 340 and more."""

BYTES_PER_PIXEL = 10
"""Memory needed for decoding: 4 bytes in Pillow, 4 after a conversion, and the array. Measured: 8 to 11."""

HEIF_BYTES_PER_PIXEL = 16
"""As above for HEIC, whose decoder keeps planes and an interleaved image of its own. Measured: 14.3."""

UNDECODABLE = (
    OSError,
    SyntaxError,
    ValueError,
    EOFError,
    KeyError,
    IndexError,
    TypeError,
    OverflowError,
    RuntimeError,
    struct.error,
)
"""Exceptions of Pillow for files that are truncated, corrupt, absurdly large or not images."""


class _PillowsLimit:
    """Lifts Pillow's limit of 89 megapixels while images are open; `MAX_PIXELS` and the free memory apply instead.

    Pillow's limit is global to the process, and some decoders check it again. It is restored once no thread is reading.
    """

    def __init__(self) -> None:
        self._lock = ThreadLock()
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
def quiet_decoders() -> Iterator[None]:
    """Ignore what decoders warn of, as invalid EXIF, which the user cannot fix.

    All threads share the filters, and threads that end this in another order than they began it leave theirs behind.
    So our own warnings stay on.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        warnings.simplefilter("always", BackendWarning)
        yield


@contextmanager
def opened_image(source: Path | bytes, formats: Sequence[str] = FORMATS) -> Iterator[Image.Image]:
    """Open an image and read its header, without decoding it.

    Args:
        source: The file or its contents.
        formats: Pillow's names of the accepted formats.

    Yields:
        The image. Call `require_room` before accessing its pixels.

    Raises:
        UNDECODABLE: not an image of these formats, not a regular file, damaged, or with a size beyond the limits above.
        DatasetError: the file is HEIC, and pillow-heif is not installed; says how to install it.
    """
    with (
        _no_limit,
        BytesIO(source) if isinstance(source, bytes) else open_file(source) as file,
        _opened(file, source, formats) as image,
    ):
        file.seek(0, os.SEEK_END)
        if (reason := _implausible(*image.size, file.tell())) is not None:
            raise ValueError(reason)
        yield image


def _implausible(W: int, H: int, nbytes: int) -> str | None:
    """Return why a file is not decoded, from its size in px and in bytes; None if both are plausible."""
    if max(W, H) > MAX_SIDE or W * H > MAX_PIXELS:
        limits = f"at most {MAX_SIDE:,} px a side and {MAX_PIXELS // 10**6} megapixels"
        return f"{W}x{H} px is too large for a photo: {limits}"
    if W * H > PLAIN_PIXELS and PIXELS_PER_BYTE * nbytes < W * H:
        return f"{W}x{H} px in {nbytes:,} bytes is too much for a photo; save it as a smaller one"
    return None


def _opened(file: BinaryIO | BytesIO, source: Path | bytes, formats: Sequence[str]) -> Image.Image:
    """Open an image by its contents.

    Raises:
        UNDECODABLE: as for `opened_image`.
        DatasetError: as for `opened_image`.
    """
    start = file.read(12)
    file.seek(0)
    if HEIF not in formats or start[4:8] != b"ftyp" or start[8:] not in HEIF_BRANDS:
        return Image.open(file, formats=[name for name in formats if name != HEIF])
    try:
        from pillow_heif import HeifImageFile  # not registered with Pillow: that would be global
    except ImportError:
        reason = f"HEIC needs pillow-heif: {install_command('heic')}, or export it as JPEG"
        name = "the image" if isinstance(source, bytes) else source
        raise DatasetError(f"{name}: cannot be decoded; {reason}", reason) from None
    image: Image.Image = HeifImageFile(file)  # type: ignore[no-untyped-call]
    return image


def require_room(path: Path, image: Image.Image, each: int | None = None) -> None:
    """Check that enough memory is free to decode an image, given the size in its header.

    Args:
        path: The file.
        image: The image, opened but not decoded.
        each: Bytes per pixel; None for those that Pillow takes.

    Raises:
        NotEnoughMemoryError: too little memory is free.
    """
    require_memory(
        f"{path}: {image.width}x{image.height} px",
        (each or bytes_per_pixel(image)) * image.width * image.height,
        "close other programs, or make the photo smaller",
    )


def bytes_per_pixel(image: Image.Image) -> int:
    """Return the memory that decoding an image takes, bytes per pixel."""
    return HEIF_BYTES_PER_PIXEL if image.format == HEIF else BYTES_PER_PIXEL


def is_image(path: Path) -> bool:
    """Return whether a file is an image in one of `FORMATS`, according to its header. HEIC needs no decoder here."""
    try:
        with quiet_decoders(), opened_image(path):
            return True
    except UNDECODABLE:
        return False
    except DatasetError:
        return True

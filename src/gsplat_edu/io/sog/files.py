"""The files of a SOG, in a zip or in a folder, and the pixels of its images.

Nothing is believed before it is checked: entries of a zip are unpacked within limits, and an image's size is read from
its header before a decoder sees it.
"""

from __future__ import annotations

import io
import struct
import warnings
import zipfile
import zlib
from collections.abc import Iterable, Mapping
from contextlib import ExitStack
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from gsplat_edu.errors import SceneFormatError
from gsplat_edu.files import named_failure, written_aside
from gsplat_edu.image_files import opened_image
from gsplat_edu.io.quantize import check_expansion
from gsplat_edu.ply_table import LFS_POINTER
from gsplat_edu.reading import read_bytes

META_NAME = "meta.json"

META_LIMIT = 1 << 20
"""Bytes of a meta.json: it has 20,000 or so."""

MULTIPLE = 4
"""Width and height of images are multiples of it."""

MOST_SPARE = 4
"""An image may have this many times as many pixels as there are splats ..."""

FREE_PIXELS = 1 << 16
"""... or this many more: 256 x 256, so that small scenes may be in images of any usual size."""

EFFORT = {"quality": 75, "method": 4}
"""How hard to look for small images: less makes them 10 % larger, more takes 50 times as long for 0.1 %."""

_UNZIPPABLE = (
    zipfile.BadZipFile,
    zlib.error,
    struct.error,
    NotImplementedError,
    RuntimeError,
    EOFError,
    OSError,
    ValueError,
    OverflowError,
)

_UNDECODABLE = (
    OSError,
    SyntaxError,
    ValueError,
    EOFError,
    RuntimeError,
    OverflowError,
    struct.error,
)


class Bundle:
    """The files in a .sog.

    Args:
        path: The zip.

    Raises:
        SceneFormatError: it is no zip.
        OSError: it cannot be read.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        data = read_bytes(path)
        _check_pointer(path, data)
        self._size = len(data)
        if not data.startswith(b"PK"):
            raise SceneFormatError(f"{path}: is not a SOG: it is no zip; check its name")
        try:
            with warnings.catch_warnings():  # of fields in the directory that are odd
                warnings.simplefilter("ignore")
                self._zip = zipfile.ZipFile(io.BytesIO(data))
        except _UNZIPPABLE:
            raise SceneFormatError(f"{path}: is a damaged or truncated zip; get the file again") from None

    def read(self, name: str) -> bytes:
        """Unpack a file; of several of one name the last.

        Raises:
            SceneFormatError: it is not there, damaged, or larger than it can be.
        """
        entry = self._zip.NameToInfo.get(name)
        if entry is None:
            raise _missing(self._path, name)
        if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise SceneFormatError(
                f"{self._path}: {name} is neither stored nor deflated; zip it again without compression"
            )
        check_expansion(self._path, entry.file_size, self._size)
        try:
            with self._zip.open(entry) as file:
                # without a number a bomb would go off before it is cut
                return file.read(entry.file_size)
        except _UNZIPPABLE:
            raise SceneFormatError(f"{self._path}: {name} in it is damaged; get the file again") from None

    def stored(self, names: Iterable[str]) -> int:
        """Return the bytes of the zip."""
        return self._size


class Folder:
    """The files beside a meta.json, and itself.

    Args:
        path: The meta.json.
    """

    def __init__(self, path: Path) -> None:
        self._path = path

    def read(self, name: str) -> bytes:
        """Read a file.

        Raises:
            SceneFormatError: it is not there, or a Git LFS pointer.
            OSError: it cannot be read, or there is no meta.json.
        """
        file = self._file(name)
        data = read_bytes(file)
        _check_pointer(file, data)
        return data

    def stored(self, names: Iterable[str]) -> int:
        """Return the bytes of some of the files."""
        return sum(self._file(name).stat().st_size for name in names)

    def _file(self, name: str) -> Path:
        if name == META_NAME:
            return self._path
        file = self._path.with_name(name)
        if not file.is_file():
            raise _missing(self._path, name)
        return file


Files = Bundle | Folder


def _check_pointer(path: Path, data: bytes) -> None:
    if data.startswith(LFS_POINTER):
        raise SceneFormatError(f"{path}: is a Git LFS pointer, not the file; fetch it with: git lfs pull")


def _missing(path: Path, name: str) -> SceneFormatError:
    return SceneFormatError(f"{path}: is not a SOG, or damaged: {name} is missing; get the file again")


def write_bundle(path: Path, contents: Mapping[str, bytes]) -> None:
    """Write files into a zip, stored, with no dates: the same bytes for the same files.

    Raises:
        OSError: it cannot be written. What stood there before is untouched.
    """
    with written_aside(path) as aside, zipfile.ZipFile(aside, "w", zipfile.ZIP_STORED) as bundle:
        for name, data in contents.items():
            entry = zipfile.ZipInfo(name)  # of 1980
            entry.create_system = 3  # on every system
            entry.external_attr = 0o644 << 16
            bundle.writestr(entry, data)


def write_folder(path: Path, contents: Mapping[str, bytes]) -> None:
    """Write files beside a meta.json, and itself: all aside, then renamed, it last.

    Raises:
        OSError: one cannot be written. What stood there before is untouched.
    """
    places = {name: path if name == META_NAME else path.with_name(name) for name in contents}
    with ExitStack() as stack:  # which leaves what was entered first last
        asides = {name: stack.enter_context(written_aside(place)) for name, place in places.items()}
        for name, data in contents.items():
            with named_failure(places[name]):
                asides[name].write_bytes(data)


def encode(values: UInt8[np.ndarray, "N C"], width: int | None = None) -> bytes:
    """Write pixels as a lossless WebP, row by row; what is left of the last row is zero.

    Args:
        values: N pixels of 3 or 4 channels; colours are kept where alpha is 0.
        width: Width, px; about the square root of N where None.
    """
    count, channels = values.shape
    columns = width or max(MULTIPLE, _up_to_multiple(np.sqrt(count)))
    rows = -(-count // columns) if width else max(MULTIPLE, _up_to_multiple(count / columns))
    pixels = np.zeros((rows * columns, channels), dtype=np.uint8)
    pixels[:count] = values
    file = io.BytesIO()
    image = Image.fromarray(pixels.reshape(rows, columns, channels))
    image.save(file, "WEBP", lossless=True, exact=True, **EFFORT)
    return file.getvalue()


def _up_to_multiple(length: float) -> int:
    return MULTIPLE * int(np.ceil(length / MULTIPLE))


def check_size(path: Path, name: str, data: bytes, count: int) -> tuple[int, int]:
    """Check that an image has a pixel for each splat and not many more.

    Args:
        path: Name of the scene, for messages.
        name: Name of the image, for messages.
        data: The image's bytes; nothing is decoded.
        count: Splats.

    Returns:
        Width and height, px.

    Raises:
        SceneFormatError: it has not, or is no WebP.
    """
    width, height = size_of(path, name, data)
    if not count <= width * height <= MOST_SPARE * count + FREE_PIXELS:
        raise SceneFormatError(
            f"{path}: {name} has {width}x{height} pixels for {count:,} splats; it is damaged, get it again"
        )
    return width, height


def size_of(path: Path, name: str, data: bytes) -> tuple[int, int]:
    """Read width and height from a WebP's header, px.

    Raises:
        SceneFormatError: it is no WebP.
    """
    kind, begin = data[12:16], data[20:30]
    if data[:4] == b"RIFF" and data[8:12] == b"WEBP" and len(begin) == 10:
        if kind == b"VP8L" and begin[0] == 0x2F:
            bits = int.from_bytes(begin[1:5], "little")
            return 1 + (bits & 0x3FFF), 1 + (bits >> 14 & 0x3FFF)
        if kind == b"VP8X":
            return 1 + int.from_bytes(begin[4:7], "little"), 1 + int.from_bytes(begin[7:10], "little")
        if kind == b"VP8 " and begin[3:6] == b"\x9d\x01\x2a":
            width, height = struct.unpack("<HH", begin[6:10])
            return width & 0x3FFF, height & 0x3FFF
    raise SceneFormatError(f"{path}: {name} is no WebP image; export the scene again")


def decode(path: Path, name: str, data: bytes) -> UInt8[np.ndarray, "H W 4"]:
    """Decode an image whose size has been checked.

    Raises:
        SceneFormatError: it is damaged.
    """
    try:
        with opened_image(data, formats=["WEBP"]) as image:
            pixels: UInt8[np.ndarray, "H W 4"] = np.asarray(image.convert("RGBA"))
    except _UNDECODABLE:
        raise SceneFormatError(f"{path}: {name} is a damaged WebP image; get the file again") from None
    return pixels

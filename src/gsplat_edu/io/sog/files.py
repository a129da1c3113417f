"""The files of a SOG, in a zip or a folder, and the pixels of its images.

All input is validated first: zip entries are decompressed within limits, and an image's size is read from its header
before it is decoded.
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

from gsplat_edu.base.errors import SceneFormatError
from gsplat_edu.base.files import named_failure, written_aside
from gsplat_edu.base.ply_table import refuse_lfs_pointer
from gsplat_edu.base.reading import read_bytes
from gsplat_edu.io.quantize import check_expansion
from gsplat_edu.photos.image_files import UNDECODABLE, opened_image

META_NAME = "meta.json"

META_LIMIT = 1 << 20
"""Largest meta.json in bytes; a usual one has about 20,000."""

MULTIPLE = 4
"""Width and height of images are multiples of this."""

MOST_SPARE = 4
"""An image may have this many times as many pixels as there are splats ..."""

FREE_PIXELS = 1 << 16
"""... or this many more: 256 x 256, so that small scenes may use images of any usual size."""

EFFORT = {"quality": 75, "method": 4}
"""Compression effort: less gives images 10 % larger, more takes 50 times as long for 0.1 %."""

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


class Bundle:
    """The files of a .sog.

    Args:
        path: The zip.

    Raises:
        SceneFormatError: the file is not a zip.
        OSError: the file cannot be read.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        data = read_bytes(path)
        refuse_lfs_pointer(path, data)
        self._size = len(data)
        if not data.startswith(b"PK"):
            raise SceneFormatError(f"{path}: is not a SOG: it is not a zip; check its name")
        try:
            with warnings.catch_warnings():  # about unusual fields in the directory
                warnings.simplefilter("ignore")
                self._zip = zipfile.ZipFile(io.BytesIO(data))
        except _UNZIPPABLE:
            raise SceneFormatError(f"{path}: is a damaged or truncated zip; get the file again") from None

    def read(self, name: str) -> bytes:
        """Decompress a file; of several with the same name, the last one.

        Raises:
            SceneFormatError: the file is missing, damaged, or implausibly large.
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
                # the limit keeps a zip bomb from being decompressed in full
                return file.read(entry.file_size)
        except _UNZIPPABLE:
            raise SceneFormatError(f"{self._path}: {name} in it is damaged; get the file again") from None

    def stored(self, names: Iterable[str]) -> int:
        """Return the size of the zip in bytes."""
        return self._size


class Folder:
    """The files of a folder that contains a meta.json.

    Args:
        path: The meta.json.
    """

    def __init__(self, path: Path) -> None:
        self._path = path

    def read(self, name: str) -> bytes:
        """Read a file.

        Raises:
            SceneFormatError: the file is missing or a Git LFS pointer.
            OSError: the file cannot be read, or meta.json is missing.
        """
        file = self._file(name)
        data = read_bytes(file)
        refuse_lfs_pointer(file, data)
        return data

    def stored(self, names: Iterable[str]) -> int:
        """Return the total size of some of the files in bytes."""
        return sum(self._file(name).stat().st_size for name in names)

    def _file(self, name: str) -> Path:
        if name == META_NAME:
            return self._path
        file = self._path.with_name(name)
        if not file.is_file():
            raise _missing(self._path, name)
        return file


Files = Bundle | Folder


def _missing(path: Path, name: str) -> SceneFormatError:
    return SceneFormatError(f"{path}: is not a SOG, or damaged: {name} is missing; get the file again")


def write_bundle(path: Path, contents: Mapping[str, bytes]) -> None:
    """Write files into an uncompressed zip without dates: equal files give equal bytes.

    Raises:
        OSError: the file cannot be written. An existing file stays unchanged.
    """
    data = bundled(contents)
    with written_aside(path) as aside:
        aside.write_bytes(data)


def bundled(contents: Mapping[str, bytes]) -> bytes:
    """Return the bytes of that zip."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as bundle:
        for name, data in contents.items():
            entry = zipfile.ZipInfo(name)  # dated 1980
            entry.create_system = 3  # the same on every system
            entry.external_attr = 0o644 << 16
            bundle.writestr(entry, data)
    return file.getvalue()


def write_folder(path: Path, contents: Mapping[str, bytes]) -> None:
    """Write a meta.json and its files: all under temporary names, then renamed, meta.json last.

    Raises:
        OSError: a file cannot be written. Existing files stay unchanged.
    """
    places = {name: path if name == META_NAME else path.with_name(name) for name in contents}
    with ExitStack() as stack:  # exits in reverse order of entering
        asides = {name: stack.enter_context(written_aside(place)) for name, place in places.items()}
        for name, data in contents.items():
            with named_failure(places[name]):
                asides[name].write_bytes(data)


def encode(values: UInt8[np.ndarray, "N C"], width: int | None = None) -> bytes:
    """Encode pixels as a lossless WebP, row by row; the rest of the last row is zero.

    Args:
        values: N pixels of 3 or 4 channels; colours are kept where alpha is 0.
        width: Width, px; None uses about the square root of N.
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
        count: Number of splats.

    Returns:
        Width and height, px.

    Raises:
        SceneFormatError: the size does not fit, or the image is not a WebP.
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
        SceneFormatError: the image is not a WebP.
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
    raise SceneFormatError(f"{path}: {name} is not a WebP image; export the scene again")


def decode(path: Path, name: str, data: bytes) -> UInt8[np.ndarray, "H W 4"]:
    """Decode an image after its size has been checked; it is no photo: its bytes are numbers of splats.

    Raises:
        SceneFormatError: the image is damaged.
    """
    try:
        with opened_image(data, formats=["WEBP"]) as image:
            pixels: UInt8[np.ndarray, "H W 4"] = np.asarray(image.convert("RGBA"))
    except UNDECODABLE:
        raise SceneFormatError(f"{path}: {name} is a damaged WebP image; get the file again") from None
    return pixels

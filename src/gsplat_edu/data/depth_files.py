"""Read a depth map: 16-bit PNG and TIFF, NPY, NPZ, EXR, COLMAP's geometric maps, and Record3D's compressed floats.

Values keep the file's unit. NaN, infinity, zero and negative values mean that a pixel has no depth and become NaN.
"""

from __future__ import annotations

import os
import re
import sys
import threading
import zipfile
import zlib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, Shaped
from PIL import UnidentifiedImageError

from gsplat_edu.base.errors import DatasetError
from gsplat_edu.base.headroom import require_memory
from gsplat_edu.base.reading import TOO_LARGE, open_file, read_bytes
from gsplat_edu.base.text import install_command
from gsplat_edu.base.zip_directory import check_directory
from gsplat_edu.photos.image_files import UNDECODABLE, opened_image, quiet_decoders, require_room

Map = Float32[np.ndarray, "h w"]

GEOMETRIC, PHOTOMETRIC = ".geometric.bin", ".photometric.bin"
"""Suffixes of COLMAP's maps; only the geometric ones agree between photos, so the others are not read."""

ENDINGS = (".png", ".tif", ".tiff", ".npy", ".npz", ".exr", GEOMETRIC, ".depth")
"""Suffixes of depth maps, in any case."""

MAX_PIXELS = 64_000_000
"""Most pixels of a map; a header that claims more belongs to another or a damaged file."""

MAX_SIDE = 32_767
"""Longest side of a map, px."""

LARGEST_HEADER = 10_000
"""Bytes of an NPY's header; a longer one is no array of numbers."""

LARGEST_LZFSE = 16 * 2**20
"""Bytes of a compressed map of Record3D, whose 256x192 floats take less than 200,000."""

HEADER = (
    r"""['"]descr['"]\s*:\s*['"]([<>|=]?[a-zA-Z]\d{1,3})['"]""",
    r"""['"]fortran_order['"]\s*:\s*(True|False)""",
    r"""['"]shape['"]\s*:\s*\(([\d\s,]{1,200})\)""",
)
"""Type, order and shape in an NPY's header."""

PIECE = 1 << 20
"""Bytes that are read at a time."""

MOST_MEMBERS = 1_000
"""Most arrays in an NPZ."""

MOST_EXR = 96_000_000
"""Most numbers of an EXR, all parts and channels together: 4096 x 2304 px with ten channels."""

EXR_BYTES = 8
"""Peak bytes for each number of an EXR while it is decoded."""

RECORD3D = ((256, 192), (192, 256), (640, 480), (480, 640), (320, 240), (240, 320))
"""Sizes of Record3D's maps, width and height, px; the files have no header."""

CHANNELS = ("Z", "depth", "Y", "R", "V")
"""Channels of an EXR that are taken for depth, the first one found."""


def read_depth(path: Path) -> Map:
    """Read a depth map.

    Args:
        path: A file whose suffix is one of `ENDINGS`.

    Returns:
        (h, w) values in the file's unit; NaN where there is no depth.

    Raises:
        DatasetError: the file is damaged, too large, of another kind, or holds no depth at all; a package is missing.
        NotEnoughMemoryError: the map is larger than the free memory.
    """
    reader = next((read for ending, read in READERS.items() if path.name.lower().endswith(ending)), None)
    try:
        if reader is None:
            raise ValueError(f"has none of the suffixes {', '.join(ENDINGS)}")
        with quiet_decoders():
            values = reader(path)
    except (*UNDECODABLE, zipfile.BadZipFile, zlib.error) as error:
        said = "it is no image" if isinstance(error, UnidentifiedImageError) else str(error)
        reason = getattr(error, "strerror", None) or said.replace("\n", " ")[:200]
        raise DatasetError(f"{path}: is no depth map: {reason}; export it again", reason) from None
    with np.errstate(over="ignore", invalid="ignore"):  # what float32 cannot hold is no depth
        found = np.ascontiguousarray(values, np.float32)
    del values
    found = found if found.flags.writeable else found.copy()
    unknown = ~(found > 0)
    unknown |= np.isinf(found)
    found[unknown] = np.nan
    if unknown.all():
        reason = "no pixel has a depth above 0"
        raise DatasetError(f"{path}: {reason}; export it again, or remove the file", reason)
    return found


def _checked_size(w: int, h: int) -> None:
    if not (2 <= w <= MAX_SIDE and 2 <= h <= MAX_SIDE and w * h <= MAX_PIXELS):
        raise ValueError(f"{w}x{h} px is no plausible size")


def _plane(shape: tuple[int, ...]) -> tuple[int, int]:
    """Return height and width of an array with one value a pixel; axes of length 1 do not count."""
    sides = tuple(side for side in shape if side != 1)
    if len(sides) != 2:
        raise ValueError(f"an array of the shape {shape} has not one value for each pixel")
    _checked_size(sides[1], sides[0])
    return sides[0], sides[1]


def _image(path: Path) -> Shaped[np.ndarray, "h w"]:
    """Read a PNG or TIFF with one channel; it is no photo: its values are depths."""
    with opened_image(path, ("PNG", "TIFF")) as file:
        _checked_size(*file.size)
        if file.mode not in ("I;16", "I;16B", "I;16L", "I", "F", "L"):
            raise ValueError(f"it is a picture ({file.mode}), not one channel of 8, 16 or 32 bits")
        require_room(path, file)
        return np.asarray(file)


def _numbers(file: Any, size: int, path: Path) -> Shaped[np.ndarray, "h w"]:  # noqa: ANN401 - also a member of an archive
    """Read an NPY with one number for each pixel. The header is matched, not evaluated.

    Args:
        file: The NPY at its first byte; also a member of an archive, which is unpacked as it is read.
        size: Its bytes.
        path: The file, for messages.
    """
    start = file.read(10)
    if not start.startswith(b"\x93NUMPY") or len(start) < 10:
        raise ValueError("it does not begin as an NPY")
    if start[6:8] not in (b"\1\0", b"\2\0"):
        raise ValueError(f"version {start[6]}.{start[7]} of NPY is unknown")
    length = start[8:10] if start[6] == 1 else start[8:10] + file.read(2)
    header_bytes = int.from_bytes(length, "little")
    if header_bytes > LARGEST_HEADER:
        raise ValueError(f"a header of {header_bytes:,} bytes is no plausible one")
    header = file.read(header_bytes).decode("latin-1")
    found = [re.search(pattern, header) for pattern in HEADER]
    if len(header) < header_bytes or None in found:
        raise ValueError("its header is damaged, or it holds no plain array")
    kind, order, axes = (match[1] for match in found if match is not None)
    dtype = np.dtype(kind)
    if dtype.kind not in "fui" or dtype.itemsize > 8:
        raise ValueError(f"its values are {dtype}, not numbers")
    shape = tuple(int(axis) for axis in axes.replace(",", " ").split())
    h, w = _plane(shape)
    there, wanted = size - len(start) - len(length[2:]) - header_bytes, dtype.itemsize * h * w
    if there < wanted:
        raise ValueError(f"its header names {wanted:,} bytes of numbers, but it has {max(there, 0):,}")
    require_memory(str(path), (dtype.itemsize + 6) * h * w, TOO_LARGE)
    values = np.empty(h * w, dtype)
    _fill(file, values.data.cast("B"))
    if order == "True":
        return values.reshape(w, h).T
    return values.reshape(h, w)


def _fill(file: Any, room: memoryview) -> None:  # noqa: ANN401
    """Read bytes, a piece at a time, because an archive may hold fewer than it claims."""
    done = 0
    while done < len(room):
        piece = file.read(min(PIECE, len(room) - done))
        if not piece:
            raise ValueError(f"it ends after {done:,} of {len(room):,} bytes of numbers")
        room[done : done + len(piece)] = piece
        done += len(piece)


def _npy(path: Path) -> Shaped[np.ndarray, "h w"]:
    with open_file(path) as file:
        return _numbers(file, os.fstat(file.fileno()).st_size, path)


def _npz(path: Path) -> Shaped[np.ndarray, "h w"]:
    """Read the array `depth` of an NPZ, or its only array."""
    with open_file(path) as file:
        check_directory(file, MOST_MEMBERS)
        file.seek(0)
        with zipfile.ZipFile(file) as archive:
            names = archive.namelist()
            name = names[0] if len(names) == 1 else "depth.npy"
            if name not in names:
                raise ValueError(f"it holds {len(names)} arrays, none of which is called depth")
            entry = archive.getinfo(name)
            if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                raise ValueError("it is compressed in a way that NumPy does not write")
            with archive.open(entry) as member:
                return _numbers(member, entry.file_size, path)


def _exr(path: Path) -> Shaped[np.ndarray, "h w"]:
    try:
        import OpenEXR
    except ImportError:
        reason = f"EXR needs OpenEXR: {install_command('depth')}"
        raise DatasetError(f"{path}: cannot be read; {reason}", reason) from None
    with open_file(path):  # only a regular file
        file = OpenEXR.File(str(path), header_only=True)
    _check_parts([part.header for part in file.parts], path)
    with _exr_turn, _Listener(sys.stdout) as said:
        channels = OpenEXR.File(str(path), separate_channels=True).channels()
    if said.found:
        raise ValueError("its pixels are damaged")
    names = {name.rpartition(".")[2]: name for name in channels}
    name = next((names[name] for name in CHANNELS if name in names), None)
    if name is None:
        raise ValueError(
            f"its channels are {', '.join(sorted(channels)) or 'none'}; depth is {' or '.join(CHANNELS)}"
        )
    values: Shaped[np.ndarray, "h w"] = np.asarray(channels[name].pixels)
    return values.reshape(_plane(values.shape))


class _Listener:
    """Stands for sys.stdout while OpenEXR reads, which prints that pixels are damaged and returns what it has.

    Args:
        out: Gets what other threads print meanwhile.
    """

    def __init__(self, out: Any) -> None:  # noqa: ANN401 - sys.stdout, which others replace too
        self._out = out
        self._thread = threading.get_ident()
        self.found = False

    def write(self, text: str) -> int:
        if threading.get_ident() != self._thread:
            return int(self._out.write(text))
        self.found = True
        return len(text)

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401
        return getattr(self._out, name)

    def __enter__(self) -> _Listener:
        sys.stdout = self
        return self

    def __exit__(self, *error: object) -> None:
        sys.stdout = self._out


_exr_turn = threading.Lock()


def _check_parts(headers: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Check the size of all parts and channels of an EXR, because all of them are decoded."""
    total = 0
    for header in headers:
        low, high = header["dataWindow"]
        w, h = (int(high[i]) - int(low[i]) + 1 for i in (0, 1))
        _checked_size(w, h)
        total += w * h * len(header["channels"])
    if total > MOST_EXR:
        raise ValueError(
            f"its {len(headers)} parts have {total:,} numbers in all channels, and at most {MOST_EXR:,} are read;"
            " keep the channel of the depth only"
        )
    require_memory(str(path), EXR_BYTES * total, TOO_LARGE)


def _colmap(path: Path) -> Shaped[np.ndarray, "h w"]:
    """Read WIDTH&HEIGHT&CHANNELS& and as many floats, row by row."""
    with open_file(path) as file:
        found = re.match(rb"(\d{1,6})&(\d{1,6})&(\d{1,3})&", file.read(24))
        if found is None:
            raise ValueError("it does not begin with WIDTH&HEIGHT&CHANNELS&")
        w, h, channels = (int(number) for number in found.groups())
        if channels != 1:
            raise ValueError(f"it has {channels} channels; a map of depth has one")
        _checked_size(w, h)
        require_memory(str(path), 12 * w * h, TOO_LARGE)
        file.seek(found.end())
        data = file.read(4 * w * h + 1)
    if len(data) != 4 * w * h:
        raise ValueError(f"it does not hold the {w}x{h} floats of its header")
    return np.frombuffer(data, "<f4").reshape(h, w)


def _record3d(path: Path) -> Shaped[np.ndarray, "h w"]:
    """Read floats compressed by LZFSE, whose number tells the map's size."""
    try:
        import liblzfse
    except ImportError:
        reason = "maps of Record3D need pyliblzfse: pip install pyliblzfse"
        raise DatasetError(f"{path}: cannot be read; {reason}", reason) from None
    packed = read_bytes(path)
    if len(packed) > LARGEST_LZFSE:
        raise ValueError(f"{len(packed):,} bytes are too many for a map of Record3D")
    try:
        data = liblzfse.decompress(packed)
    except liblzfse.error as error:
        raise ValueError(f"it is not compressed by LZFSE ({error})") from None
    sizes = [(w, h) for w, h in RECORD3D if 4 * w * h == len(data)]
    if not sizes:
        known = ", ".join(f"{w}x{h}" for w, h in RECORD3D[::2])
        raise ValueError(f"its {len(data) // 4:,} floats are no map of {known}")
    w, h = sizes[0]
    return np.frombuffer(data, "<f4").reshape(h, w)


READERS: dict[str, Callable[[Path], Shaped[np.ndarray, "h w"]]] = {
    ".png": _image,
    ".tif": _image,
    ".tiff": _image,
    ".npy": _npy,
    ".npz": _npz,
    ".exr": _exr,
    GEOMETRIC: _colmap,
    ".depth": _record3d,
}
"""The function that reads a file, by its suffix."""

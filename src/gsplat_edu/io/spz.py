"""Niantic's SPZ: splats quantised to bytes and compressed. Versions 1 to 4 are read; version 4 is written.

Version 4 consists of a header of 32 bytes; extension records, which are skipped; a table of contents with two 64-bit
sizes per stream, compressed and uncompressed; then the streams, each compressed with zstd: positions, opacities,
colours, scales, rotations, coefficients. An empty stream is omitted. Versions 1 to 3 consist of a header of 16 bytes
and the same streams in a single gzip; files without the gzip are read as well. `gsplat_edu.io.spz_values` describes the
values.

The writer uses the full precision of the format. Positions get the largest number of fractional bits that holds the
scene, up to 24; other programs always use 12. Coefficients of the higher degrees use all 8 bits; other programs round
them to 5 and 4 by default. On a trained scene that rounding lowers the PSNR against the original from 56 dB to 40 dB,
and the file from 49 to 29 bytes per splat: fidelity is preferred here, and a `Precision` chooses otherwise. Scenes
beyond +-8,388,607 units are rejected. Scales are clamped to e^-10 to e^5.94, the coefficient of degree 0 to +-3.33, the
others to -1 to 0.992. The antialiasing flag is always stored, so an unknown value reads back as false. Degree 4 of the
harmonics is dropped on reading.

Axes are right, up, back; `gsplat_edu.io.axes.half_turned` converts them to ours. A scene whose up direction is another
one is turned, by the rotation of `root_transform`, so that y is up in the file: splats, in double before they are
rounded. An extension may name other axes; of these, ours are supported and the rest are rejected.

An origin, a unit and an up direction other than y, all in the scene's own axes, are stored in an extension of our own,
whose content is the JSON of `gsplat_edu.io.scene.extras`. The up direction says how to turn a file back into the
scene's axes. Other programs skip extensions that they do not know, and show the scene upright and near zero.

Niantic's library rejects scenes without splats; here they can be written and read.

Source: load-spz.cc, the README and extensions/README of Niantic's spz library.
"""

from __future__ import annotations

import gzip
import json
import struct
import zlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import zstandard
from jaxtyping import Float, UInt8

from gsplat_edu.base.errors import ArgumentError, SceneFormatError
from gsplat_edu.base.files import written_aside
from gsplat_edu.base.ply_table import refuse_lfs_pointer
from gsplat_edu.base.reading import parse_json, read_bytes
from gsplat_edu.io import spz_values as values
from gsplat_edu.io.axes import half_turned, root_transform
from gsplat_edu.io.edit import Similarity
from gsplat_edu.io.quantize import SMALL, byte_to_logit, check_expansion, logit_to_byte
from gsplat_edu.io.scene import Scene, extras, read_extras
from gsplat_edu.scene.camera import WORLD_UP
from gsplat_edu.scene.frame import ORIGIN, Vector
from gsplat_edu.scene.gaussians import Gaussians

MAGIC = b"NGSP"
GZIP = b"\x1f\x8b"

HEADER = struct.Struct("<4sIIBBBx")
"""Magic, version, splats, SH degree, fractional bits, flags."""

HEADER_4 = struct.Struct("<4sIIBBBBI12x")
"""The same, then number of streams and offset of the table of contents."""

RECORD = struct.Struct("<II")
"""Kind and length of an extension's content, which follows."""

TABLE_ROW = struct.Struct("<QQ")
"""Compressed and uncompressed size of a stream."""

ANTIALIASED, EXTENDED, LEVELS_OF_DETAIL = 0x01, 0x02, 0x80
"""Flags. The last one belongs to the viewer Spark: the splats form a tree, of which only a part is drawn."""

COORDINATES = 0xADBE0003
"""Extension that specifies the axes."""

FRAME = 0x67730001
"""Our extension, with the scene's up, unit and origin."""

RIGHT_UP_BACK, RIGHT_DOWN_FORWARD = 4, 6
"""Axes by their number in that extension; 0 means unspecified."""

SH_COUNTS = (0, 3, 8, 15, 24)
"""Coefficients per channel above degree 0, by degree."""

LEVEL = 12
"""Compression level of zstd, as in Niantic's library."""


@dataclass(frozen=True)
class Precision:
    """How finely positions and coefficients are stored; coarser values compress better, and any reader reads them.

    Args:
        position_step: Largest step of positions, as a fraction of the median scale of the splats; None for the finest
            that the format has.
        sh_bits: Bits of the coefficients of degree 1, and of the higher degrees; 1 to 8.
    """

    position_step: float | None = None
    sh_bits: tuple[int, int] = (8, 8)


FULL = Precision()
"""The full precision of the format."""


@dataclass(frozen=True)
class _Header:
    version: int
    count: int
    sh_degree: int
    fractional_bits: int
    flags: int

    def widths(self) -> dict[str, int]:
        """Return the bytes per splat of every stream, in order."""
        return {
            "positions": 6 if self.version == 1 else 9,
            "opacities": 1,
            "colours": 3,
            "scales": 3,
            "rotations": 4 if self.version >= 3 else 3,
            "coefficients": 3 * SH_COUNTS[self.sh_degree],
        }

    def size(self) -> int:
        """Return the total size of all streams in bytes."""
        return self.count * sum(self.widths().values())


Streams = dict[str, UInt8[np.ndarray, "N B"]]


def read(path: Path) -> Scene:
    """Read an SPZ file.

    Args:
        path: The file.

    Returns:
        The scene, float32, in this package's axes.

    Raises:
        SceneFormatError: the file is not an SPZ, is damaged, or is of an unsupported kind; the message says which.
        OSError: the file cannot be read.
    """
    stored, extensions = _opened(path, read_bytes(path))
    try:
        frame = read_extras(parse_json(extensions.get(FRAME, b"{}")))
    except ValueError:
        raise _damaged(path, "its extension with the origin cannot be read") from None
    gaussians = half_turned(_turned(stored.gaussians, frame.up, back=True))
    return Scene(gaussians, stored.antialiased, *frame._replace(up=frame.up or WORLD_UP))


def in_own_axes(path: Path, data: bytes) -> Scene:
    """Read an SPZ from bytes without our extension and in its own axes: right, up, back, as glTF has them.

    Args:
        path: The file that holds them, for messages.
        data: The bytes.

    Raises:
        SceneFormatError: as for `read`.
    """
    return _opened(path, data)[0]


def _opened(path: Path, data: bytes) -> tuple[Scene, dict[int, bytes]]:
    """Return the splats in the format's axes, and the content of the extensions by their kind."""
    refuse_lfs_pointer(path, data)
    if data.startswith(GZIP):
        header, body = _unzipped(path, data)
        streams, records = _planes(path, header, body)
    else:
        header = _read_header(path, data)
        if header.version == 4:
            streams, records = _read_streams(path, header, data)
        else:
            streams, records = _planes(path, header, memoryview(data)[HEADER.size :])
    gaussians, extensions = _decoded(header, streams), dict(_extensions(records))
    if _axes(path, extensions) == RIGHT_DOWN_FORWARD:
        gaussians = half_turned(gaussians)
    return Scene(gaussians, bool(header.flags & ANTIALIASED)), extensions


def _turned(gaussians: Gaussians, up: Vector | None, back: bool = False) -> Gaussians:
    """Turn Gaussians in y-up axes so that a scene's up direction is y, or back; in double where they are turned."""
    if up is None or up == WORLD_UP:
        return gaussians
    turn, _ = root_transform(up, ORIGIN)
    dtype, move = gaussians.means.dtype, Similarity(turn.T if back else turn, 1.0, np.zeros(3))
    turned = move.gaussians(gaussians.map(torch.Tensor.double))
    return turned.map(lambda tensor: tensor.to(dtype)) if back else turned


def _read_header(path: Path, data: bytes) -> _Header:
    if not data.startswith(MAGIC[: len(data)]) or not data:
        raise SceneFormatError(
            f"{path}: is not an SPZ file: it begins with neither NGSP nor gzip; check its name"
        )
    if len(data) < HEADER.size:
        raise _damaged(path, "ends within its header")
    _, version, count, degree, bits, flags = HEADER.unpack_from(data)
    if not 1 <= version <= 4:
        raise SceneFormatError(
            f"{path}: has SPZ version {version}, but 1 to 4 are supported; export it as version 4"
        )
    if degree >= len(SH_COUNTS):
        raise _damaged(path, f"its header gives SH degree {degree}, but SPZ has 0 to 4")
    if bits > values.MAX_FRACTIONAL_BITS:
        raise _damaged(path, f"its header gives {bits} fractional bits for positions, but SPZ has 0 to 24")
    if flags & LEVELS_OF_DETAIL:
        raise SceneFormatError(
            f"{path}: holds levels of detail, which are not supported; export the scene without them"
        )
    return _Header(version, count, degree, bits, flags)


def _unzipped(path: Path, data: bytes) -> tuple[_Header, memoryview]:
    """Decompress a file of versions 1 to 3, at most the size in its header plus room for extensions."""
    unzip = zlib.decompressobj(wbits=16 + zlib.MAX_WBITS)
    try:
        header = _read_header(path, unzip.decompress(data, HEADER.size))
        if header.version == 4:
            raise _damaged(path, "is of version 4, but in one gzip as in versions 1 to 3")
        check_expansion(path, header.size(), len(data))
        limit = header.size() + (SMALL if header.flags & EXTENDED else 0)
        body = unzip.decompress(unzip.unconsumed_tail, limit + 1)
    except zlib.error:
        raise _damaged(path, "its gzip cannot be unpacked") from None
    if not unzip.eof and len(body) <= limit:
        raise _damaged(path, f"is truncated: {len(body):,} of {header.size():,} bytes are present")
    if len(body) > limit or unzip.unused_data:
        raise _damaged(path, "holds more than its header declares")
    return header, memoryview(body)


def _planes(path: Path, header: _Header, body: memoryview) -> tuple[Streams, memoryview]:
    """Split the contents of versions 1 to 3 into streams and extension records."""
    if len(body) < header.size():
        raise _damaged(path, f"is truncated: {len(body):,} of {header.size():,} bytes are present")
    if len(body) > header.size() and not header.flags & EXTENDED:
        raise _damaged(path, "holds more than its header declares")
    streams, start = {}, 0
    for name, width in header.widths().items():
        end = start + header.count * width
        streams[name] = np.frombuffer(body[start:end], dtype=np.uint8).reshape(header.count, width)
        start = end
    return streams, body[start:]


def _read_streams(path: Path, header: _Header, data: bytes) -> tuple[Streams, memoryview]:
    """Decompress the streams of version 4; return them and the extension records."""
    if len(data) < HEADER_4.size:
        raise _damaged(path, "ends within its header")
    *_, there, table = HEADER_4.unpack_from(data)
    widths = header.widths()
    named = [name for name, width in widths.items() if header.count * width]
    start = table + there * TABLE_ROW.size
    if there != len(named):
        raise _damaged(path, f"has {there} streams, but its header requires {len(named)}")
    if table < HEADER_4.size or start > len(data):
        raise _damaged(path, "its table of contents extends beyond its end")
    check_expansion(path, header.size(), len(data))
    view = memoryview(data)
    streams = {name: np.empty((header.count, width), np.uint8) for name, width in widths.items()}
    for name, (packed, unpacked) in zip(named, TABLE_ROW.iter_unpack(view[table:start]), strict=True):
        if unpacked != streams[name].size:
            raise _damaged(path, f"the number of its {name} differs from its header")
        if packed > len(data) - start:
            raise _damaged(path, f"is truncated within its {name}")
        stream = _unpacked(path, name, view[start : start + packed], unpacked)
        streams[name] = np.frombuffer(stream, dtype=np.uint8).reshape(streams[name].shape)
        start += packed
    if start != len(data):
        raise _damaged(path, f"{len(data) - start:,} bytes follow its last stream")
    return streams, view[HEADER_4.size : table] if header.flags & EXTENDED else view[:0]


def _unpacked(path: Path, name: str, packed: memoryview, size: int) -> bytes:
    """Decompress a stream of version 4 that must have the given size."""
    try:
        # A zstd frame may declare its content size, which would be allocated: check it first.
        claimed = zstandard.get_frame_parameters(packed).content_size
        if claimed in (size, zstandard.CONTENTSIZE_UNKNOWN):
            stream = zstandard.ZstdDecompressor().decompress(
                packed, max_output_size=size, allow_extra_data=False
            )
            if len(stream) == size:
                return stream
    except zstandard.ZstdError:
        pass
    raise _damaged(path, f"its {name} cannot be unpacked")


def _extensions(records: memoryview) -> Iterator[tuple[int, bytes]]:
    """Yield the kind and the content of each extension record."""
    at = 0
    while at + RECORD.size <= len(records):
        kind, length = RECORD.unpack_from(records, at)
        at += RECORD.size
        yield kind, bytes(records[at : at + length])
        at += length


def _axes(path: Path, extensions: Mapping[int, bytes]) -> int:
    """Return the axes named by the extensions; the format's own axes if they name none."""
    content = extensions.get(COORDINATES, b"")
    if len(content) < 4:
        return RIGHT_UP_BACK
    axes = int.from_bytes(content[:4], "little")
    if axes not in (0, RIGHT_UP_BACK, RIGHT_DOWN_FORWARD):
        raise SceneFormatError(
            f"{path}: its axes (number {axes} in the axes extension) are not supported; export it without"
        )
    return axes


def _decoded(header: _Header, streams: Streams) -> Gaussians:
    if header.version == 1:
        means = values.read_half(streams["positions"])
    else:
        means = values.read_fixed(streams["positions"], header.fractional_bits)
    read_quats = values.read_smallest_three if header.version >= 3 else values.read_first_three
    arrays = {
        "means": means,
        "quats": read_quats(streams["rotations"]),
        "log_scales": values.read_scales(streams["scales"]),
        "sh0": values.read_colors(streams["colours"]),
        "sh_rest": values.read_harmonics(streams["coefficients"]),
        "logit_opacities": byte_to_logit(streams["opacities"][:, 0]),
    }
    return Gaussians(**{name: torch.from_numpy(np.ascontiguousarray(a)) for name, a in arrays.items()})


def write(path: Path, scene: Scene) -> None:
    """Write an SPZ file of version 4 in full precision.

    Args:
        path: Output file; parent folders are created.
        scene: The scene, in this package's axes, with finite parameters (`write_scene` checks this).

    Raises:
        ArgumentError: a mean is beyond the format's range, or a quaternion has zero length.
        OSError: the file cannot be written. An existing file stays unchanged.
    """
    data = packed(scene)
    with written_aside(path) as aside:
        aside.write_bytes(data)


def packed(scene: Scene, precision: Precision = FULL) -> bytes:
    """Return the bytes of an SPZ file of version 4.

    Args:
        scene: The scene, in this package's axes, with finite parameters.
        precision: How finely values are stored.

    Raises:
        ArgumentError: as for `write`.
    """
    degree = scene.gaussians.sh_degree
    upright = _turned(half_turned(scene.gaussians), scene.up)
    bits, streams = _encoded(upright, values.write_smallest_three, precision)
    contents = [stream.tobytes() for stream in streams if stream.size]
    compressed = [zstandard.ZstdCompressor(level=LEVEL).compress(content) for content in contents]
    records = _frame_record(scene)
    flags = (ANTIALIASED if scene.antialiased else 0) | (EXTENDED if records else 0)
    start = HEADER_4.size + len(records)
    header = HEADER_4.pack(MAGIC, 4, len(scene.gaussians), degree, bits, flags, len(compressed), start)
    table = [TABLE_ROW.pack(len(a), len(b)) for a, b in zip(compressed, contents, strict=True)]
    return b"".join([header, records, *table, *compressed])


def _frame_record(scene: Scene) -> bytes:
    """Return the extension with the scene's frame; nothing if the frame is that of the format."""
    found = extras(scene.frame._replace(up=None) if scene.up == WORLD_UP else scene.frame)
    if not found:
        return b""
    content = json.dumps(found, separators=(",", ":"), sort_keys=True).encode("ascii")
    content += b" " * (-len(content) % 8)
    return RECORD.pack(FRAME, len(content)) + content


def packed_version_2(scene: Scene) -> bytes:
    """Return an SPZ file of version 2, in one gzip, which is the version that glTF embeds.

    Its coordinates are those of the glTF: what turns the scene upright, and its origin, belong to the glTF's nodes.

    Args:
        scene: The scene, in this package's axes, with finite parameters.

    Raises:
        ArgumentError: as for `write`.
    """
    bits, streams = _encoded(half_turned(scene.gaussians), values.write_first_three)
    flags = ANTIALIASED if scene.antialiased else 0
    header = HEADER.pack(MAGIC, 2, len(scene.gaussians), scene.gaussians.sh_degree, bits, flags)
    return gzip.compress(b"".join([header, *(stream.tobytes() for stream in streams)]), mtime=0)


def _encoded(
    gaussians: Gaussians,
    write_quats: Callable[[Float[np.ndarray, "N 4"]], UInt8[np.ndarray, "N B"]],
    precision: Precision = FULL,
) -> tuple[int, tuple[UInt8[np.ndarray, "..."], ...]]:
    """Return the fractional bits of positions, and the streams in the format's order, of splats in its axes."""
    arrays = {name: tensor.numpy(force=True) for name, tensor in gaussians.tensors().items()}
    bits = values.fractional_bits(arrays["means"])
    if bits is None:
        far = float(np.abs(arrays["means"]).max())
        raise ArgumentError(
            f"means: one is {far:,.0f} units from the origin along an axis, but SPZ ends at {values.LARGEST_FIXED:,};"
            " scale the scene down or move it"
        )
    if precision.position_step is not None and len(gaussians):
        bits = min(bits, values.bits_for(precision.position_step, arrays["log_scales"]))
    return bits, (
        values.write_fixed(arrays["means"], bits),
        logit_to_byte(np.clip(arrays["logit_opacities"], -100, 100).astype(np.float32)),
        values.write_colors(arrays["sh0"]),
        values.write_scales(arrays["log_scales"]),
        write_quats(arrays["quats"]),
        values.write_harmonics(arrays["sh_rest"], precision.sh_bits),
    )


def _damaged(path: Path, how: str) -> SceneFormatError:
    return SceneFormatError(f"{path}: {how}; the file is damaged, get it again")

"""RAD of Spark, three.js' renderer of splats: chunks of properties, which a viewer loads one by one.

Little-endian. A file is a header ("RAD0", the size of its JSON, the JSON) and chunks ("RADC", the size of their JSON,
the JSON, the size of the payload, the payload) of at most 65,536 splats; JSON and properties are padded with zeros to
multiples of 8. A property lies plane by plane, first x of all splats of the chunk, and is deflated:

    f32, f16       numbers; f32_lebytes, f16_lebytes: first the lowest bytes of all, then the next ones
    r8, s8         min + (max - min) byte / 255, and max byte / 127; r8_delta, s8_delta: differences to the splat before
    ln_f16, ln_0r8 logarithms, the latter min + (max - min) (byte - 1) / 254, and 0 for a scale of 0
    oct88r8        a rotation as two bytes of an octahedral axis and one of an angle from 0 to pi, splat by splat

Colours are 1/2 + C0 sh0, scales linear, opacities 0 to 1, rotations (x, y, z) with w at least 0. Properties sh1, sh2,
sh3 have the coefficients of a degree, each with its three channels; or sh_label names one of the entries of sh1_code to
sh3_code, which the first chunk has. Of a tree of levels of detail, the splats without children are read, which are the
scene's own. Chunks may lie in files beside that of the header.

We write positions as f32_lebytes and all else as halves. What `gsplat_edu.io.scene.extras` knows of the scene's frame
stands in the header's comment. Axes are those of the scene: nothing is flipped.

Source: rad.rs of Spark 2.2 (MIT licence).
"""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from jaxtyping import Float64, UInt8
from msgspec import Meta, Struct

from gsplat_edu.base.constants import C0, SH_MAX_DEGREE
from gsplat_edu.base.errors import ArgumentError, SceneFormatError
from gsplat_edu.base.files import written_aside
from gsplat_edu.base.ply_table import refuse_lfs_pointer
from gsplat_edu.base.reading import parse_json, read_bytes
from gsplat_edu.base.records import Number, record_of
from gsplat_edu.base.text import shortened
from gsplat_edu.io.node_splats import LARGEST_LOG_SCALE, Activated
from gsplat_edu.io.quantize import MIN_SCALE, check_expansion
from gsplat_edu.io.scene import Scene, extras, read_extras
from gsplat_edu.io.sog.meta import NAME

MAGIC, CHUNK_MAGIC = b"RAD0", b"RADC"

IN_CHUNK = 65_536
"""Most splats of a chunk."""

COMMENT = "gsplat_edu "
"""Our comments are this and JSON."""

NUMBERS = {"f32": "<f4", "f16": "<f2", "ln_f16": "<f2", "u16": "<u2", "u32": "<u4"}
"""Types of encodings whose values lie whole."""

BYTE_PLANES = {"f32_lebytes": "<f4", "f16_lebytes": "<f2"}
"""Types of encodings whose bytes lie apart."""

BYTES = ("r8", "r8_delta", "s8", "s8_delta", "ln_0r8")
"""Encodings of one byte a value."""

OCTAHEDRAL = "oct88r8"

LARGEST_HALF = float(np.finfo(np.float16).max)

Count = Annotated[int, Meta(ge=0, le=1 << 31)]
Size = Annotated[int, Meta(ge=0, le=1 << 48)]
Degree = Annotated[int, Meta(ge=0, le=SH_MAX_DEGREE)]


class Range(Struct, frozen=True):
    """Where a chunk lies: after the header, or in a file beside it."""

    offset: Size
    bytes: Size
    filename: str | None = None


class Header(Struct, frozen=True, rename="camel"):
    """The header's JSON."""

    version: Literal[1]
    type: Literal["gsplat"]
    count: Count
    chunks: list[Range]
    max_sh: Degree = 0
    lod_tree: bool = False
    sh_code_count: Count = 0
    comment: str = ""


class Property(Struct, frozen=True):
    """A property of the splats of a chunk."""

    offset: Size
    bytes: Size
    property: str
    encoding: str
    compression: Literal["gz"] | None = None
    min: Number = 0.0
    max: Number = 0.0


class Chunk(Struct, frozen=True):
    """A chunk's JSON."""

    version: Literal[1]
    count: Annotated[int, Meta(ge=1, le=IN_CHUNK)]
    properties: list[Property]


@dataclass(frozen=True)
class Codes:
    """The palette of harmonics, which the first chunk has.

    Args:
        count: Number of entries.
        bands: (count, 3 (2 d + 1)) coefficients of the degree d.
    """

    count: int
    bands: dict[int, Float64[np.ndarray, "count width"]] = field(default_factory=dict)


def write(path: Path, scene: Scene) -> None:
    """Write a RAD file without a tree of levels of detail.

    Args:
        path: Output file; parent folders are created.
        scene: The scene, in this package's axes, with finite parameters (`write_scene` checks this).

    Raises:
        ArgumentError: a quaternion has zero length.
        OSError: the file cannot be written. An existing file stays unchanged.
    """
    values = Activated.of(scene.gaussians)
    starts = range(0, len(values.means), IN_CHUNK)
    chunks = [_chunk(Activated(*(part[i : i + IN_CHUNK] for part in values)), i) for i in starts]
    known = extras(scene.frame)
    if scene.antialiased is not None:
        known["antialiased"] = scene.antialiased
    ends = np.cumsum([0, *map(len, chunks)]).tolist()
    header = {
        "version": 1,
        "type": "gsplat",
        "count": len(values.means),
        "maxSh": scene.gaussians.sh_degree,
        "chunkSize": IN_CHUNK,
        "allChunkBytes": ends[-1],
        "chunks": [{"offset": at, "bytes": len(chunk)} for at, chunk in zip(ends, chunks, strict=False)],
        "comment": COMMENT + json.dumps(known),
    }
    with written_aside(path) as aside:
        aside.write_bytes(b"".join([_with_json(MAGIC, header), *chunks]))


def _chunk(values: Activated, base: int) -> bytes:
    """Return a chunk of splats, of which `base` lie in chunks before it."""
    degree = round(values.sh.shape[1] ** 0.5) - 1
    halves = {
        "alpha": values.opacities[:, None],
        "rgb": C0 * values.sh[:, 0] + 0.5,
        "scales": np.log(np.maximum(values.scales, MIN_SCALE)),
        "orientation": values.quats[:, 1:] * np.where(values.quats[:, :1] < 0, -1, 1),
    }
    for band in range(1, degree + 1):
        halves[f"sh{band}"] = values.sh[:, band**2 : (band + 1) ** 2].reshape(len(values.sh), -1)
    centers = values.means.T.astype("<f4", order="C").view(np.uint8).reshape(-1, 4)
    planes = [("center", "f32_lebytes", centers.T.tobytes())]
    for name, array in halves.items():
        plane = array.T.clip(-LARGEST_HALF, LARGEST_HALF).astype("<f2", order="C")
        planes.append((name, "ln_f16" if name == "scales" else "f16", plane.tobytes()))
    payload = b""
    properties: list[dict[str, int | str]] = []
    for name, encoding, data in planes:
        packed = _deflated(data)
        place: dict[str, int | str] = {"offset": len(payload), "bytes": len(packed)}
        properties.append(place | {"property": name, "encoding": encoding, "compression": "gz"})
        payload += _padded(packed)
    about = {
        "version": 1,
        "base": base,
        "count": len(values.means),
        "payloadBytes": len(payload),
        "maxSh": degree,
        "properties": properties,
    }
    return _with_json(CHUNK_MAGIC, about) + struct.pack("<Q", len(payload)) + payload


def _with_json(magic: bytes, value: object) -> bytes:
    text = json.dumps(value).encode()
    return magic + struct.pack("<I", len(text)) + _padded(text)


def _deflated(data: bytes) -> bytes:
    """Return a deflate stream without the header of zlib or gzip, although the format calls it gz."""
    packer = zlib.compressobj(wbits=-zlib.MAX_WBITS)
    return packer.compress(data) + packer.flush()


def _padded(data: bytes) -> bytes:
    return data + bytes(-len(data) % 8)


def read(path: Path) -> Scene:
    """Read a RAD file, also one of other programs; of a tree of levels of detail, the finest one.

    Args:
        path: The file.

    Returns:
        The scene, float32.

    Raises:
        SceneFormatError: the file is no RAD, is damaged, or lacks a file of chunks beside it.
        OSError: the file cannot be read.
    """
    data = read_bytes(path)
    refuse_lfs_pointer(path, data)
    try:
        header, start = _json_at(data, MAGIC, Header)
        chunks = [_bytes_of(path, memoryview(data)[start:], entry) for entry in header.chunks]
        claimed = 2 * header.count * (11 + 3 * (header.max_sh + 1) ** 2)
        check_expansion(path, claimed, len(data) + sum(map(len, chunks)))
        codes = Codes(header.sh_code_count)
        parts = [_read_chunk(chunk, header, codes) for chunk in chunks]
        if sum(count for count, _ in parts) != header.count:
            raise ArgumentError(f"does not have the {header.count:,} splats of its header")
        known = _known(header.comment)
        frame = read_extras(known)
    except (ArgumentError, ValueError) as error:
        raise SceneFormatError(f"{path}: {error}; export the scene again") from None
    splats = [splats for _, splats in parts] or [_no_splats(header.max_sh)]
    gaussians = Activated(*map(np.concatenate, zip(*splats, strict=True))).gaussians(path)
    antialiased = known.get("antialiased")
    return Scene(gaussians, antialiased if isinstance(antialiased, bool) else None, *frame)


def _json_at(data: bytes | memoryview, magic: bytes, kind: Any) -> tuple[Any, int]:  # noqa: ANN401
    """Return the JSON at the beginning of a header or chunk, as a record of a kind, and where its padding ends."""
    if data[:4] != magic or len(data) < 8:
        raise ArgumentError(f"lacks the letters {magic.decode()}, so it is no RAD or is damaged")
    (size,) = struct.unpack_from("<I", data, 4)
    if size > len(data) - 8:
        raise ArgumentError("ends within its description")
    return record_of("", parse_json(bytes(data[8 : 8 + size])), kind), 8 + size + -size % 8


def _bytes_of(path: Path, here: memoryview, entry: Range) -> memoryview:
    """Return the bytes of a chunk, which lies in this file or in one beside it."""
    if entry.filename is not None:
        if not NAME.fullmatch(entry.filename):
            raise ArgumentError(f"names a file {shortened(entry.filename)} that cannot lie beside it")
        beside = path.parent / entry.filename
        if not beside.is_file():
            raise ArgumentError(f"lacks {entry.filename}, which belongs beside it")
        here = memoryview(read_bytes(beside))
    if entry.offset + entry.bytes > len(here):
        raise ArgumentError("ends within a chunk")
    return here[entry.offset : entry.offset + entry.bytes]


def _known(comment: str) -> Mapping[str, Any]:
    """Return what a comment of ours says of the scene's frame; nothing for other comments."""
    found = parse_json(comment.removeprefix(COMMENT)) if comment.startswith(COMMENT) else {}
    return found if isinstance(found, dict) else {}


def _no_splats(degree: int) -> Activated:
    return Activated(*(np.zeros((0, *shape)) for shape in ((3,), (4,), (3,), (), ((degree + 1) ** 2, 3))))


def _read_chunk(data: memoryview, header: Header, codes: Codes) -> tuple[int, Activated]:
    """Return the number of a chunk's splats, and those of them that have no children."""
    chunk, start = _json_at(data, CHUNK_MAGIC, Chunk)
    payload, count = data[start + 8 :], chunk.count
    found = {each.property: each for each in chunk.properties}

    def values(name: str, width: int, rows: int = count) -> Float64[np.ndarray, "rows width"]:
        if name not in found:
            raise ArgumentError(f"has a chunk without {name}")
        return _decoded(found[name], payload, rows, width)

    bands = [(values("rgb", 3) - 0.5) / C0]
    for degree in range(1, header.max_sh + 1):
        name, width = f"sh{degree}", 3 * (2 * degree + 1)
        if f"{name}_code" in found:
            codes.bands[degree] = values(f"{name}_code", width, codes.count)
        if "sh_label" in found:
            labels = values("sh_label", 1)[:, 0].astype(np.int64)
            if degree not in codes.bands or labels.max() >= codes.count:
                raise ArgumentError("has a label of harmonics that no code has")
            bands.append(codes.bands[degree][labels])
        else:
            bands.append(values(name, width))
    splats = Activated(
        values("center", 3),
        _octahedral(values("orientation", 3))
        if found["orientation"].encoding == OCTAHEDRAL
        else _with_w(values("orientation", 3)),
        values("scales", 3),
        values("alpha", 1)[:, 0],
        np.concatenate(bands, axis=1).reshape(count, -1, 3),
    )
    if not header.lod_tree:
        return count, splats
    finest = values("child_count", 1)[:, 0] == 0
    return count, Activated(*(part[finest] for part in splats))


def _decoded(
    about: Property, payload: memoryview, rows: int, width: int
) -> Float64[np.ndarray, "rows width"]:
    """Return the values of a property; of an octahedral one, its bytes."""
    encoding = about.encoding
    kind = np.dtype(NUMBERS.get(encoding) or BYTE_PLANES.get(encoding) or "u1")
    size = rows * width * kind.itemsize
    data = bytes(payload[about.offset : about.offset + about.bytes])
    if about.compression is not None:
        try:
            data = zlib.decompressobj(wbits=-zlib.MAX_WBITS).decompress(data, size + 1)
        except zlib.error:
            raise ArgumentError(f"has a damaged {about.property}") from None
    if len(data) != size:
        raise ArgumentError(f"has a damaged {about.property}")
    stored = np.frombuffer(data, np.uint8)
    if encoding in BYTE_PLANES:
        stored = np.ascontiguousarray(stored.reshape(kind.itemsize, -1).T).reshape(-1)
    if encoding in (*NUMBERS, *BYTE_PLANES):
        numbers = stored.view(kind).reshape(width, rows).T
        with np.errstate(over="ignore", invalid="ignore"):
            values = (
                np.exp(numbers.astype(np.float64)) if encoding == "ln_f16" else numbers.astype(np.float64)
            )
        if not np.isfinite(values).all():
            raise ArgumentError(f"has {about.property} that is NaN or infinite")
        return values
    if encoding == OCTAHEDRAL:
        return stored.reshape(rows, width).astype(np.float64)
    if encoding not in BYTES:
        raise ArgumentError(f"has {about.property} of the unknown encoding {shortened(encoding)}")
    return _of_bytes(stored.reshape(width, rows), about)


def _of_bytes(planes: UInt8[np.ndarray, "width rows"], about: Property) -> Float64[np.ndarray, "rows width"]:
    """Return values of one byte each."""
    if about.encoding.endswith("_delta"):
        planes = planes.cumsum(axis=1, dtype=np.uint8)
    codes = np.ascontiguousarray(planes.T)
    if about.encoding.startswith("s8"):
        return codes.view(np.int8) / 127.0 * about.max
    span = about.max - about.min
    if about.encoding != "ln_0r8":
        return about.min + codes / 255.0 * span
    logarithms = about.min + (codes - 1.0) * span / 254.0
    if not np.abs(logarithms).max() < LARGEST_LOG_SCALE:
        raise ArgumentError(f"has a damaged {about.property}")
    return np.where(codes == 0, 0.0, np.exp(logarithms))


def _with_w(xyz: Float64[np.ndarray, "N 3"]) -> Float64[np.ndarray, "N 4"]:
    """Return rotations (w, x, y, z) of length 1 whose w is at least 0."""
    w = np.sqrt(np.maximum(1.0 - (xyz**2).sum(axis=1, keepdims=True), 0.0))
    return np.concatenate([w, xyz], axis=1)


def _octahedral(codes: Float64[np.ndarray, "N 3"]) -> Float64[np.ndarray, "N 4"]:
    """Return rotations (w, x, y, z) from two bytes of an axis on an octahedron and one of an angle."""
    plane = codes[:, :2] / 255.0 * 2.0 - 1.0
    z = 1.0 - np.abs(plane).sum(axis=1, keepdims=True)
    folded = plane - np.where(plane >= 0, 1.0, -1.0) * np.maximum(-z, 0.0)
    axis = np.concatenate([folded, z], axis=1)
    half = codes[:, 2:] / 255.0 * (np.pi / 2)
    return np.concatenate(
        [np.cos(half), np.sin(half) * axis / np.linalg.norm(axis, axis=1, keepdims=True)], axis=1
    )

"""SuperSplat's compressed PLY: 16 bytes per splat, and one byte per SH coefficient above degree 0.

Splats are grouped into chunks of 256. Element `chunk` holds the bounds of each chunk's positions, log scales and
colours (older files: no colours) as float32. Element `vertex` encodes each splat relative to these bounds, from the
highest bit down:

    packed_position  x 11, y 10, z 11 bits
    packed_rotation  index of the largest of (w, x, y, z) 2; the other three in order, 10 each, ± sqrt(1/2)
    packed_scale     log scales: 11, 10, 11
    packed_color     red, green, blue 8 each: C0 f_dc + 1/2, from 0 to 1 if the chunk has no colours; opacity 8

The optional element `sh` has bytes f_rest_*, channel by channel: 9, 24 or 45. Byte b decodes to (b + 1/2) / 32 - 4, the
middle of its step, except that 0 decodes to -4 and 255 to 4. No byte decodes to zero: a coefficient of 0 becomes 1/64.

Axes are those of the scene: nothing is flipped. Metadata without a property is stored in comments: see `ply_comments`.

Source: the reader and writer of PlayCanvas' splat-transform (MIT licence); and the reader of the PlayCanvas engine,
which decodes SH bytes as 8 b / 255 - 4, up to half a step (1/64) off.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import torch
from jaxtyping import Float32, Float64, Int64, UInt8, UInt32
from numpy.lib.recfunctions import structured_to_unstructured

from gsplat_edu.base.constants import C0, SH_OFFSET
from gsplat_edu.base.errors import SceneFormatError
from gsplat_edu.base.files import written_aside
from gsplat_edu.base.ply_table import Element, Header, read_elements, read_rows
from gsplat_edu.base.reading import open_file
from gsplat_edu.io.ply_comments import comments, read_comments
from gsplat_edu.io.quantize import byte_to_logit, logit_to_byte, unit_quats
from gsplat_edu.io.scene import Scene, split_origin
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.scene.morton import morton_codes
from gsplat_edu.scene.shells import far_shell

CHUNK = 256
"""Splats per chunk; the last chunk may have fewer."""

POSITION_BOUNDS = ("min_x", "min_y", "min_z", "max_x", "max_y", "max_z")
SCALE_BOUNDS = ("min_scale_x", "min_scale_y", "min_scale_z", "max_scale_x", "max_scale_y", "max_scale_z")
COLOR_BOUNDS = ("min_r", "min_g", "min_b", "max_r", "max_g", "max_b")
PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")

SH_COUNTS = (9, 24, 45)
"""Numbers of `sh` properties: three channels of the coefficients up to degrees 1 to 3."""

MAX_LOG_SCALE = 20.0
"""Log scales are clamped to ± this when written, as in PlayCanvas: 2e-9 to 5e8 world units."""

SETTLED = 0.9
"""Keep a scene's order if at least this fraction of its splats is in the chunk that sorting would assign."""

_STEPS_11_10_11 = np.array((2047.0, 1023.0, 2047.0))
_ROOT_HALF = np.sqrt(0.5)
_OTHERS = np.array(((1, 2, 3), (0, 2, 3), (0, 1, 3), (0, 1, 2)))
"""The other three components, by the index of a quaternion's largest one."""

_SH_VALUES = ((np.arange(256) + 0.5) / 32.0 - 4.0).astype(np.float32)
_SH_VALUES[[0, 255]] = -4.0, 4.0


def read(path: Path) -> Scene:
    """Read a compressed PLY, with chunks of 12 or 18 properties and any SH degree.

    Args:
        path: The file.

    Returns:
        The scene, float32, in file order; opacities are kept away from 0 and 1.

    Raises:
        SceneFormatError: not a compressed PLY, or damaged: truncated, or with NaN or infinite bounds.
        OSError: the file cannot be read.
    """
    with open_file(path) as file:
        header = read_elements(path, file)
        chunk, vertex, sh = _elements(path, header)
        body = file.tell()
        chunks, splats = _rows(path, file, header, chunk, body), _rows(path, file, header, vertex, body)
        sh_rows = None if sh is None else _rows(path, file, header, sh, body)
    words = splats["packed_color"]
    colors = np.stack([words >> 24, words >> 16 & 255, words >> 8 & 255], axis=1) / 255.0
    if COLOR_BOUNDS[0] in chunk.names:
        colors = _between(_bounds(path, chunks, COLOR_BOUNDS), colors)
    positions = _between(_bounds(path, chunks, POSITION_BOUNDS), _unpacked(splats["packed_position"]))
    antialiased, frame, is_placed = read_comments(path, header.comments)
    means, origin = (positions, frame.origin) if is_placed else split_origin(positions)
    log_scales = _between(_bounds(path, chunks, SCALE_BOUNDS), _unpacked(splats["packed_scale"]))
    with np.errstate(over="ignore"):  # damaged colour bounds: `read_scene` reports infinities
        sh0 = ((colors - SH_OFFSET) / C0).astype(np.float32)
    gaussians = Gaussians(
        means=torch.from_numpy(means.astype(np.float32)),
        quats=torch.from_numpy(_unpacked_rotations(splats["packed_rotation"])),
        log_scales=torch.from_numpy(log_scales.astype(np.float32)),
        sh0=torch.from_numpy(sh0[:, None, :]),
        sh_rest=torch.from_numpy(_sh_rest(sh_rows, len(splats))),
        logit_opacities=torch.from_numpy(byte_to_logit((words & 255).astype(np.uint8))),
    )
    return Scene(gaussians, antialiased, *frame._replace(origin=origin))


def write(path: Path, scene: Scene) -> None:
    """Write a compressed PLY with chunks of 18 properties and the scene's SH degree.

    Splats are sorted along a Morton curve through their means, as in PlayCanvas, so that those of a chunk are close
    together. If most are already in the right chunk, as in a scene read from such a file, the order is kept, so that
    values are not rounded twice.

    Args:
        path: Output file; parent folders are created.
        scene: Quaternions are normalised, log scales clamped to ± `MAX_LOG_SCALE`, and SH coefficients above degree 0
            clamped to ±4.

    Raises:
        ArgumentError: a parameter is NaN or infinite in float32, or a quaternion has zero length.
        OSError: the file cannot be written. An existing file stays unchanged.
    """
    data = packed(scene)
    with written_aside(path) as aside:
        aside.write_bytes(data)


def packed(scene: Scene) -> bytes:
    """Return the bytes of a compressed PLY.

    Args:
        scene: As for `write`.

    Raises:
        ArgumentError: as for `write`.
    """
    gaussians = scene.gaussians.map(torch.Tensor.float)
    gaussians.check_finite()
    order = _order(gaussians.means.numpy(force=True))
    tensors = {name: tensor.numpy(force=True)[order] for name, tensor in gaussians.tensors().items()}
    colors = (tensors["sh0"][:, 0].astype(np.float64) * C0 + SH_OFFSET).astype(np.float32)
    log_scales = np.clip(tensors["log_scales"], -MAX_LOG_SCALE, MAX_LOG_SCALE)
    position_bounds, positions = _within_chunks(tensors["means"], _STEPS_11_10_11)
    scale_bounds, scales = _within_chunks(log_scales, _STEPS_11_10_11)
    color_bounds, rgb = _within_chunks(colors, np.full(3, 255.0))
    alpha = logit_to_byte(tensors["logit_opacities"]).astype(np.uint32)
    words = (
        positions @ np.array((1 << 21, 1 << 11, 1), dtype=np.uint32),
        _packed_rotations(unit_quats(tensors["quats"])),
        scales @ np.array((1 << 21, 1 << 11, 1), dtype=np.uint32),
        rgb @ np.array((1 << 24, 1 << 16, 1 << 8), dtype=np.uint32) | alpha,
    )
    bounds = np.concatenate([position_bounds, scale_bounds, color_bounds], axis=1, dtype="<f4")
    sh = _sh_bytes(tensors["sh_rest"])
    head = _header(scene, len(order), len(bounds), sh.shape[1])
    return b"".join([head, bounds.tobytes(), np.stack(words, axis=1).astype("<u4").tobytes(), sh.tobytes()])


def _elements(path: Path, header: Header) -> tuple[Element, Element, Element | None]:
    """Return `chunk`, `vertex` and `sh` after checking their properties."""
    by_name = {element.name: element for element in header.elements}
    there = {name: by_name[name].names if name in by_name else () for name in ("vertex", "chunk")}
    colors = COLOR_BOUNDS if COLOR_BOUNDS[0] in there["chunk"] else ()
    for name, properties in (("vertex", PACKED), ("chunk", (*POSITION_BOUNDS, *SCALE_BOUNDS, *colors))):
        if missing := [other for other in properties if other not in there[name]]:
            raise SceneFormatError(
                f"{path}: is not a compressed splat PLY: {name} lacks {', '.join(missing)}; give another file, or"
                " rename an uncompressed scene to .ply"
            )
    chunk, vertex, sh = by_name["chunk"], by_name["vertex"], by_name.get("sh")
    if header.format == "ascii":
        raise SceneFormatError(f"{path}: is a compressed splat PLY in ASCII; export it as a binary one")
    kinds = dict(vertex.properties)
    if wrong := [name for name in PACKED if kinds[name] != "u4"]:
        raise SceneFormatError(f"{path}: {', '.join(wrong)} is not of type uint; export the scene again")
    if chunk.count != -(-vertex.count // CHUNK):
        raise SceneFormatError(
            f"{path}: has {chunk.count} chunks of {CHUNK} for {vertex.count} splats; the file is damaged, get it again"
        )
    if sh is not None:
        _check_sh(path, sh, vertex.count)
    return chunk, vertex, sh


def _check_sh(path: Path, sh: Element, count: int) -> None:
    found = {name: kind for name, kind in sh.properties if name.startswith("f_rest_")}
    counts = ", ".join(str(number) for number in SH_COUNTS)
    if len(found) not in SH_COUNTS or set(found) != {f"f_rest_{i}" for i in range(len(found))}:
        raise SceneFormatError(
            f"{path}: sh has {len(found)} properties f_rest_*, but SH degrees 1-3 have {counts}, counted from 0"
        )
    if set(found.values()) != {"u1"}:
        raise SceneFormatError(
            f"{path}: sh has properties f_rest_* that are not uchar; export the scene again"
        )
    if sh.count != count:
        raise SceneFormatError(
            f"{path}: has SH coefficients for {sh.count} of {count} splats; the file is damaged, get it again"
        )


def _rows(
    path: Path, file: BinaryIO, header: Header, wanted: Element, body: int
) -> np.ndarray[Any, np.dtype[Any]]:
    file.seek(body)
    return read_rows(path, file, header, wanted)


def _bounds(path: Path, rows: np.ndarray, names: tuple[str, ...]) -> Float64[np.ndarray, "C 6"]:
    """Return the bounds of all chunks: three minima, then three maxima."""
    with np.errstate(invalid="ignore"):  # NaN is reported below
        bounds = structured_to_unstructured(rows[list(names)], dtype=np.float64)
    fine = np.abs(bounds) <= np.finfo(np.float32).max  # false for NaN
    if not fine.all():
        row, column = np.argwhere(~fine)[0]
        raise SceneFormatError(
            f"{path}: chunk {row}: {names[column]} is {bounds[row, column]}; the file is damaged, get it again"
        )
    return bounds


def _between(bounds: Float64[np.ndarray, "C 6"], t: Float64[np.ndarray, "N 3"]) -> Float64[np.ndarray, "N 3"]:
    """Interpolate from each chunk's minimum (t = 0) to its maximum (t = 1), both reached exactly."""
    low, high = np.split(_of_splats(bounds, len(t)), 2, axis=1)
    values: Float64[np.ndarray, "N 3"] = low * (1.0 - t) + high * t
    return values


def _of_splats(of_chunks: Float64[np.ndarray, "C W"], count: int) -> Float64[np.ndarray, "N W"]:
    return np.repeat(of_chunks, CHUNK, axis=0)[:count]


def _within_chunks(
    values: Float32[np.ndarray, "N 3"], steps: Float64[np.ndarray, "3"]
) -> tuple[Float32[np.ndarray, "C 6"], UInt32[np.ndarray, "N 3"]]:
    """Return the bounds of chunks, and the values as the nearest of `steps` steps between them."""
    starts = np.arange(0, len(values), CHUNK)
    low, high = (extreme.reduceat(values, starts, axis=0) for extreme in (np.minimum, np.maximum))
    extents = high.astype(np.float64) - low
    per_extent = steps / np.where(extents > 0.0, extents, 1.0)
    places = (values - _of_splats(low.astype(np.float64), len(values))) * _of_splats(per_extent, len(values))
    return np.concatenate([low, high], axis=1), np.floor(places + 0.5).astype(np.uint32)


def _unpacked(words: UInt32[np.ndarray, " N"]) -> Float64[np.ndarray, "N 3"]:
    places = np.stack([words >> 21, words >> 11 & 1023, words & 2047], axis=1)
    t: Float64[np.ndarray, "N 3"] = places / _STEPS_11_10_11
    return t


def _unpacked_rotations(words: UInt32[np.ndarray, " N"]) -> Float32[np.ndarray, "N 4"]:
    largest = (words >> 30).astype(np.int64)
    codes = np.stack([words >> 20 & 1023, words >> 10 & 1023, words & 1023], axis=1)
    others = (codes / 1023.0 - 0.5) / _ROOT_HALF
    rest = np.maximum(1.0 - np.square(others).sum(axis=1), 0.0)  # negative if no unit quaternion was packed
    quats = np.empty((len(words), 4))
    np.put_along_axis(quats, _OTHERS[largest], others, axis=1)
    np.put_along_axis(quats, largest[:, None], np.sqrt(rest)[:, None], axis=1)
    return quats.astype(np.float32)


def _packed_rotations(units: Float64[np.ndarray, "N 4"]) -> UInt32[np.ndarray, " N"]:
    largest = np.abs(units).argmax(axis=1)
    others = np.take_along_axis(units, _OTHERS[largest], axis=1)
    positive = np.take_along_axis(units, largest[:, None], axis=1) >= 0.0
    codes = np.floor((np.where(positive, others, -others) * _ROOT_HALF + 0.5) * 1023.0 + 0.5)
    shifts = np.array((1 << 20, 1 << 10, 1), dtype=np.uint32)
    words: UInt32[np.ndarray, " N"] = np.clip(codes, 0, 1023).astype(np.uint32) @ shifts
    words |= largest.astype(np.uint32) << 30
    return words


def _sh_rest(rows: np.ndarray | None, count: int) -> Float32[np.ndarray, "N K 3"]:
    if rows is None:
        return np.zeros((count, 0, 3), dtype=np.float32)
    number = sum(name.startswith("f_rest_") for name in rows.dtype.names or ())
    codes = structured_to_unstructured(rows[[f"f_rest_{i}" for i in range(number)]])
    codes = np.ascontiguousarray(np.moveaxis(codes.reshape(count, 3, number // 3), 1, 2))
    sh_rest: Float32[np.ndarray, "N K 3"] = _SH_VALUES[codes]
    return sh_rest


def _sh_bytes(sh_rest: Float32[np.ndarray, "N K 3"]) -> UInt8[np.ndarray, "N P"]:
    steps = np.floor(np.clip(sh_rest, -4.0, 4.0) * 32.0)  # exact in float32: 32 is a power of two
    codes = (np.minimum(steps, 127.0) + 128.0).astype(np.uint8)
    channel_major: UInt8[np.ndarray, "N P"] = np.moveaxis(codes, 2, 1).reshape(len(codes), 3 * codes.shape[1])
    return channel_major


def _header(scene: Scene, splats: int, chunks: int, sh: int) -> bytes:
    lines = ["ply", "format binary_little_endian 1.0", *comments(scene), f"element chunk {chunks}"]
    lines += [f"property float {name}" for name in (*POSITION_BOUNDS, *SCALE_BOUNDS, *COLOR_BOUNDS)]
    lines += [f"element vertex {splats}"] + [f"property uint {name}" for name in PACKED]
    if sh:
        lines += [f"element sh {splats}"] + [f"property uchar f_rest_{i}" for i in range(sh)]
    return "\n".join([*lines, "end_header", ""]).encode("ascii")


def _order(means: Float32[np.ndarray, "N 3"]) -> Int64[np.ndarray, " N"]:
    """Return the order in which to write the splats."""
    order, own = _order_in_groups(means), np.arange(len(means))
    settled = np.count_nonzero(order // CHUNK == own // CHUNK)
    return own if settled >= SETTLED * len(means) else order


def _order_in_groups(means: Float32[np.ndarray, "N 3"]) -> Int64[np.ndarray, " N"]:
    """Return the order along a Morton curve, a far shell last.

    A chunk with near and far splats would be as large as the shell, and quantise near splats as coarsely. Only the
    farthest near splats, which do not fill a chunk, share one with the shell.
    """
    far = far_shell(means)
    if not far.any():
        return _morton_order(means)
    near = np.flatnonzero(~far)
    away = np.square(means[near] - np.median(means[near], axis=0)).sum(axis=1)
    rest = len(near) % CHUNK
    near = near[np.argsort(away, kind="stable")]
    groups = [np.sort(near[: len(near) - rest]), near[len(near) - rest :], np.flatnonzero(far)]
    return np.concatenate([group[_morton_order(means[group])] for group in groups])


def _morton_order(means: Float32[np.ndarray, "N 3"]) -> Int64[np.ndarray, " N"]:
    """Return the order along a Morton curve with 1024 cells per axis; cells larger than a chunk are sorted inside."""
    order = np.arange(len(means))
    if len(means) <= 1:
        return order
    low = means.min(axis=0).astype(np.float64)
    extents = means.max(axis=0) - low
    if not extents.any():
        return order
    cells = np.minimum((means - low) * (1024.0 / np.where(extents > 0.0, extents, np.inf)), 1023.0)
    codes = morton_codes(cells.astype(np.uint16))
    order = np.argsort(codes, kind="stable")
    ends = np.append(np.flatnonzero(np.diff(codes[order])) + 1, len(order))
    starts = np.append(0, ends[:-1])
    for crowded in np.flatnonzero(ends - starts > CHUNK):
        cell = order[starts[crowded] : ends[crowded]]
        cell[:] = cell[_morton_order(means[cell])]
    return order

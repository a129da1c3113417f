"""The container of binary glTF 2.0: a header, a chunk of JSON and a chunk of bytes, in a file of at most 4 GiB.

The nodes of a file form trees; each node moves what it and its children show.

Source: Khronos, "glTF 2.0 Specification", sections 3.5 and 4.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from gsplat_edu.base.errors import ArgumentError, SceneFormatError
from gsplat_edu.base.files import written_aside
from gsplat_edu.base.ply_table import refuse_lfs_pointer
from gsplat_edu.base.reading import parse_json

EXTENSION = "KHR_gaussian_splatting"
"""Name of the extension that makes a primitive's points splats."""

SPZ_EXTENSION = f"{EXTENSION}_compression_spz_2"
"""Name of the extension whose splats are an SPZ of version 2."""

SPZ_DRAFTS = (SPZ_EXTENSION, f"{EXTENSION}_compression_spz")
"""Names that the drafts of this extension have had."""

SPZ_ALONE = "KHR_spz_gaussian_splats_compression"
"""Name of its first draft, which stood at a primitive itself."""

FILE_HEADER = struct.Struct("<4sII")
"""glTF, version 2, length of the file."""

CHUNK_HEADER = struct.Struct("<I4s")
"""Length, kind."""

GENERATOR = "gsplat-edu"
"""Program named in the asset of our files."""

LARGEST_FILE = (1 << 32) - 1
"""Largest file in bytes: its length is stored in 32 bits."""

MOST_JSON = 1 << 24
"""Most bytes of JSON to parse; files of other programs may describe thousands of meshes."""

MOST_NODES = 1 << 18
"""Most nodes of a file."""

REPEATS = 64
"""A file may show its own size at most so many times, by nodes that share a mesh."""

NUMBERS = {5120: "i1", 5121: "u1", 5122: "i2", 5123: "u2", 5125: "u4", 5126: "f4"}
"""NumPy types of accessors' components."""

WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
"""Numbers of each accessor type that is read."""

MISREAD = (KeyError, IndexError, TypeError, ValueError, AttributeError, OverflowError)
"""What it raises to follow JSON that does not describe a file as glTF does."""


def write_container(
    path: Path, document: dict[str, Any], parts: Sequence[bytes | np.ndarray], content: str
) -> None:
    """Write a binary glTF.

    Args:
        path: Output file; parent folders are created.
        document: The JSON.
        parts: The contents of the file's own buffer, one after the other; each a multiple of 4 bytes long.
        content: What the file holds, for the message if there is too much of it.

    Raises:
        ArgumentError: the file would exceed 4 GiB.
        OSError: the file cannot be written. An existing file stays unchanged.
    """
    described = json.dumps(document, separators=(",", ":")).encode("ascii")
    described += b" " * (-len(described) % 4)
    size = sum(len(part) if isinstance(part, bytes) else part.nbytes for part in parts)
    length = FILE_HEADER.size + CHUNK_HEADER.size + len(described) + (CHUNK_HEADER.size + size if size else 0)
    if length > LARGEST_FILE:
        raise ArgumentError(f"{path}: {content} do not fit into glTF's 4 GiB; write a .ply")
    with written_aside(path) as aside, aside.open("wb") as file:
        file.write(FILE_HEADER.pack(b"glTF", 2, length))
        file.write(CHUNK_HEADER.pack(len(described), b"JSON") + described)
        if size:
            file.write(CHUNK_HEADER.pack(size, b"BIN\0"))
        for part in parts:
            file.write(part if isinstance(part, bytes) else part.tobytes())


def root_node(turn: Float64[np.ndarray, "3 3"], shift: Float64[np.ndarray, "3"]) -> dict[str, list[float]]:
    """Return the properties of a node that transforms what it holds: x' = R x + t; nothing for the identity.

    Args:
        turn: (3, 3) the rotation R.
        shift: (3,) the translation t.
    """
    node = {}
    if not np.array_equal(turn, np.eye(3)):
        node["rotation"] = [float(number) for number in Rotation.from_matrix(turn).as_quat()]
    if shift.any():
        node["translation"] = [float(number) for number in shift]
    return node


def refuse(path: Path, fault: str) -> NoReturn:
    """Raise a SceneFormatError that names the file and its fault."""
    raise SceneFormatError(f"{path}: {fault}; export it again")


def container(path: Path, data: bytes) -> tuple[dict[str, Any], memoryview]:
    """Return the JSON and the buffer of a binary glTF.

    Args:
        path: The file, for messages.
        data: Its bytes.

    Raises:
        SceneFormatError: the file is not a binary glTF of version 2, or is damaged.
    """
    refuse_lfs_pointer(path, data)
    if len(data) < FILE_HEADER.size + CHUNK_HEADER.size or not data.startswith(b"glTF"):
        refuse(path, "is not a binary glTF")
    _, version, length = FILE_HEADER.unpack_from(data)
    if version != 2 or length != len(data):
        refuse(path, f"is version {version} of {length:,} bytes, where {len(data):,} of version 2 should be")
    size, kind = CHUNK_HEADER.unpack_from(data, FILE_HEADER.size)
    start = FILE_HEADER.size + CHUNK_HEADER.size
    if kind != b"JSON" or size > min(len(data) - start, MOST_JSON):
        refuse(path, "does not begin with its JSON")
    try:
        document = parse_json(data[start : start + size])
    except ValueError:
        refuse(path, "has JSON that cannot be read")
    if not isinstance(document, dict):
        refuse(path, "has JSON that is not an object")
    start += size
    if start == len(data):
        return document, memoryview(b"")
    if start + CHUNK_HEADER.size > len(data):
        refuse(path, "ends inside its second chunk")
    size, kind = CHUNK_HEADER.unpack_from(data, start)
    start += CHUNK_HEADER.size
    if kind != b"BIN\0" or start + size != len(data):
        refuse(path, "has a second chunk that is not its buffer")
    return document, memoryview(data)[start:]


def node_matrix(node: Mapping[str, Any]) -> Float64[np.ndarray, "4 4"]:
    """Return the transform of a node, from its own coordinates to its parent's.

    Args:
        node: Its JSON: a matrix, column by column, or any of translation, rotation (x, y, z, w) and scale.
    """
    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T
    x, y, z, w = np.array(node.get("rotation", (0.0, 0.0, 0.0, 1.0)), np.float64)
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    matrix = np.eye(4)
    matrix[:3, :3] = rotation * np.array(node.get("scale", (1.0, 1.0, 1.0)), np.float64).reshape(3)
    matrix[:3, 3] = np.array(node.get("translation", (0.0, 0.0, 0.0)), np.float64).reshape(3)
    return matrix


def node_matrices(path: Path, document: Mapping[str, Any]) -> dict[int, Float64[np.ndarray, "4 4"]]:
    """Return the transforms to world coordinates of the nodes of the scene; of all nodes if there is no scene.

    A hostile file's may be NaN or infinite.

    Args:
        path: The file, for messages.
        document: Its JSON.

    Raises:
        SceneFormatError: a node does not exist, or has two parents, or there are more than `MOST_NODES`.
    """
    nodes, scenes = document.get("nodes", []), document.get("scenes", [])
    if len(nodes) > MOST_NODES:
        refuse(path, f"has {len(nodes):,} nodes, and at most {MOST_NODES:,} are read")
    if scenes:
        roots = scenes[document.get("scene", 0)].get("nodes", [])
    else:
        children = {child for node in nodes for child in node.get("children", [])}
        roots = [index for index in range(len(nodes)) if index not in children]
    matrices: dict[int, Float64[np.ndarray, "4 4"]] = {}
    waiting: list[tuple[Any, Float64[np.ndarray, "4 4"]]] = []

    def add(children: list[Any], outer: Float64[np.ndarray, "4 4"]) -> None:
        """Add nodes to those that wait, at most as many as there are; more would have two parents."""
        if len(waiting) + len(children) > len(nodes) - len(matrices):
            refuse(path, "has a node that does not exist, or has two parents")
        waiting.extend((child, outer) for child in reversed(children))

    add(roots, np.eye(4))
    while waiting:
        index, outer = waiting.pop()
        if type(index) is not int or not 0 <= index < len(nodes) or index in matrices:
            refuse(path, f"has a node {str(index)[:20]} that does not exist, or has two parents")
        with np.errstate(all="ignore"):  # the caller looks for NaN and infinity
            matrices[index] = outer @ node_matrix(nodes[index])
        add(nodes[index].get("children", []), matrices[index])
    return matrices


class GlbFile:
    """A binary glTF of any program while it is read; the methods refuse what a file may not say.

    Args:
        path: The file, for messages.
        document: Its JSON.
        body: Its buffer.
    """

    def __init__(self, path: Path, document: dict[str, Any], body: memoryview) -> None:
        self._path, self._document, self._body = path, document, body
        self._room = max(REPEATS * len(body), 1 << 20)

    def _refuse(self, fault: str) -> NoReturn:
        refuse(self._path, fault)

    def _take(self, size: int, what: str) -> None:
        """Count bytes that are read, which nodes may repeat."""
        self._room -= size
        if self._room < 0:
            self._refuse(f"shows its {what} more than {REPEATS} times")

    def _item(self, kind: str, index: Any) -> dict[str, Any]:  # noqa: ANN401 - of a stranger's JSON
        """Return an entry of one of the document's lists."""
        if type(index) is not int or not 0 <= index < len(self._document[kind]):
            self._refuse(f"names {kind}[{str(index)[:20]}], which does not exist")
        item: dict[str, Any] = self._document[kind][index]
        return item

    def _embedded(self, index: Any, what: str) -> bytes:  # noqa: ANN401
        """Return the bytes of a view of the buffer."""
        view = self._item("bufferViews", index)
        start, size = view.get("byteOffset", 0), view["byteLength"]
        if not (type(start) is type(size) is int and 0 <= start <= start + size <= len(self._body)):
            self._refuse(f"has {what} beyond the file's end")
        return bytes(self._body[start : start + size])

    def _stored(self, accessor: Mapping[str, Any], label: str) -> np.ndarray:
        """Return the numbers of an accessor as they are stored, (count, width), not copied."""
        dtype, width = np.dtype("<" + NUMBERS[accessor["componentType"]]), WIDTHS[accessor["type"]]
        view, count = self._item("bufferViews", accessor["bufferView"]), accessor["count"]
        start, row = view.get("byteOffset", 0) + accessor.get("byteOffset", 0), dtype.itemsize * width
        stride = view.get("byteStride", row)
        if view.get("buffer", 0) != 0 or "uri" in self._document["buffers"][0]:
            self._refuse(f"has values in another file in {label}; export it as one .glb")
        if any(type(value) is not int or value < 0 for value in (count, start, stride)) or stride < row:
            self._refuse(f"has a size or an offset that is impossible in {label}")
        if not count:
            return np.empty((0, width), dtype)
        ends = accessor.get("byteOffset", 0) + (count - 1) * stride + row
        if ends > view["byteLength"] or view.get("byteOffset", 0) + ends > len(self._body):
            self._refuse(f"has values beyond the file's end in {label}")
        return np.ndarray((count, width), dtype, self._body, start, (stride, dtype.itemsize))

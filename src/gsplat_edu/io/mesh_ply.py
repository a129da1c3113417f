"""Meshes as PLY: binary little endian, coordinates as double, colours as uchar.

Coordinates are double because a mesh's are float64: what is written is read back to the bit, and a mesh far from its
origin, in the coordinates of a survey, keeps its details. A face takes 13 bytes, a vertex 24, or 27 with colours.
Coordinates are those of the scene: nothing is flipped. Unit and place on earth are comments, as in scene PLYs.

Files of any program are read: binary of either byte order or ASCII, any number types, further properties and elements.
Faces with more than three corners are cut into triangles.

Source: Turk 1994, "The PLY Polygon File Format".
"""

from __future__ import annotations

from array import array
from io import BytesIO
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from jaxtyping import Float32, Float64, Int64

from gsplat_edu.base.files import written_aside
from gsplat_edu.base.headroom import require_memory
from gsplat_edu.base.ply_table import FORMATS, Element, read_elements
from gsplat_edu.base.reading import TOO_LARGE, read_bytes
from gsplat_edu.io.mesh_parts import (
    Polygons,
    StoredMesh,
    check_vertices,
    eight_bits,
    numbers_in,
    refuse,
    triangles_in,
)
from gsplat_edu.io.ply_comments import OURS, read_comments
from gsplat_edu.scene.earth import Earth
from gsplat_edu.scene.mesh import Mesh

COORDINATES = ("x", "y", "z")

CHANNELS = (("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"), ("r", "g", "b"))
"""Names that programs give to colours; the first match wins."""

INDEX_LISTS = ("vertex_indices", "vertex_index")
"""Names of the list of a face's vertices; programs use either."""

TEXT_BYTES = 24
"""Peak memory for a byte of text: a line of one digit is an object, and so is its number."""

LARGEST = {"u1": 255.0, "u2": 65535.0, "f4": 1.0, "f8": 1.0}
"""Value of white by number type. Other types hold no colours."""


def write(path: Path, mesh: Mesh, unit: str | None, earth: Earth | None) -> None:
    """Write a mesh; see `gsplat_edu.io.mesh_files.write_mesh`."""
    fields = [(name, "<f8") for name in COORDINATES]
    header = ["ply", "format binary_little_endian 1.0", "comment made by gsplat-edu"]
    header += [f"comment {OURS} unit {unit}"] * (unit is not None)
    header += [f"comment {OURS} earth {earth}"] * (earth is not None)
    header += [f"element vertex {len(mesh.vertices)}", *(f"property double {name}" for name in COORDINATES)]
    if mesh.colors is not None:
        fields += [(name, "u1") for name in CHANNELS[0]]
        header += [f"property uchar {name}" for name in CHANNELS[0]]
    header += [f"element face {len(mesh.faces)}", "property list uchar int vertex_indices", "end_header", ""]
    vertices = np.empty(len(mesh.vertices), dtype=fields)
    for axis, name in enumerate(COORDINATES):
        vertices[name] = mesh.vertices[:, axis]
    if mesh.colors is not None:
        for name, channel in zip(CHANNELS[0], eight_bits(mesh.colors).T, strict=True):
            vertices[name] = channel
    faces = np.empty(len(mesh.faces), dtype=[("count", "u1"), ("corners", "<i4", (3,))])
    faces["count"], faces["corners"] = 3, mesh.faces
    with written_aside(path) as aside, aside.open("wb") as file:
        file.write("\n".join(header).encode("ascii"))
        file.write(vertices.tobytes())
        file.write(faces.tobytes())


def read(path: Path) -> StoredMesh:
    """Read a mesh; see `gsplat_edu.io.mesh_files.read_mesh`."""
    data = read_bytes(path)
    file = BytesIO(data)
    header = read_elements(path, file)
    frame = read_comments(path, header.comments)[1]
    by_name = {element.name: element for element in header.elements}
    vertex, face = by_name.get("vertex"), by_name.get("face")
    if vertex is None or not set(COORDINATES) <= set(vertex.names):
        refuse(path, "has no vertices with x, y and z")
    if face is None or not face.count:
        strips = " but triangle strips, which are not supported" if "tristrips" in by_name else ""
        refuse(path, f"has no faces{strips}: it is no mesh that can be read")
    lists = [item for item in face.lists if item[0] in INDEX_LISTS]
    if not lists or lists[0][2][0] == "f":
        refuse(path, f"has faces without a list {INDEX_LISTS[0]} of integers")
    if header.format == "ascii":
        body: _Binary | _Text = _Text(path, data, file.tell())
    else:
        body = _Binary(path, data, file.tell(), FORMATS[header.format])
    tables: dict[str, dict[str, Any]] = {}
    for element in header.elements:
        tables[element.name] = body.rows(element)
        if "vertex" in tables and "face" in tables:
            break
    points = _numbers(tables["vertex"], COORDINATES)
    check_vertices(path, points, lambda row: f"vertex {row}")
    sizes, corners = tables["face"][lists[0][0]]
    triangles = triangles_in(path, points, Polygons(sizes, corners, lambda row: f"face {row}"))
    mesh = Mesh(points, corners[triangles], _colors(path, vertex, tables["vertex"]))
    return StoredMesh(mesh, frame.unit, frame.earth)


def _numbers(table: dict[str, Any], names: tuple[str, ...]) -> Float64[np.ndarray, "V C"]:
    with np.errstate(invalid="ignore"):  # signalling NaN; the caller looks for NaN
        return np.stack([np.asarray(table[name], np.float64) for name in names], axis=1)


def _colors(path: Path, vertex: Element, table: dict[str, Any]) -> Float32[np.ndarray, "V 3"] | None:
    """Return the colours, 0 to 1; None if there are none."""
    kinds = dict(vertex.properties)
    for names in CHANNELS:
        if not set(names) <= set(kinds):
            continue
        kind = kinds[names[0]]
        white = LARGEST.get(kind or "")
        if white is None or any(kinds[name] != kind for name in names):
            refuse(path, f"has colours {', '.join(names)} that are not uchar, ushort or float")
        values = _numbers(table, names)
        inside = (values >= 0.0) & (values <= white)
        if not inside.all():
            row, channel = np.argwhere(~inside)[0]
            refuse(path, f"vertex {row}: {names[channel]} is {values[row, channel]}, not 0 to {white:g}")
        return (values / white).astype(np.float32)
    return None


class _Binary:
    """The rows after a binary header.

    Args:
        path: The file, for messages.
        data: All its bytes.
        start: Where the rows begin.
        order: Byte order in NumPy's notation.
    """

    def __init__(self, path: Path, data: bytes, start: int, order: str) -> None:
        self._path, self._data, self._at, self._order = path, data, start, order

    def rows(self, element: Element) -> dict[str, Any]:
        """Return the columns of the next element: an array, or for a list the lengths and all items."""
        if not element.properties:
            return {}
        if not element.lists:
            dtype = element.dtype(self._path, self._order)
            there = (len(self._data) - self._at) // dtype.itemsize
            if there < element.count:
                self._truncated(element, there)
            table = np.frombuffer(self._data, dtype, element.count, self._at)
            self._at += element.count * dtype.itemsize
            return {name: table[name] for name in element.names}
        return self._equal_rows(element) or self._various_rows(element)

    def _truncated(self, element: Element, there: int) -> NoReturn:
        refuse(self._path, f"is truncated: {there} of {element.count} rows of {element.name} are present")

    def _equal_rows(self, element: Element) -> dict[str, Any] | None:
        """Return the columns if all rows have lists of the same lengths as the first row; None otherwise."""
        lists = {name: (size, item) for name, size, item in element.lists}
        fields: list[tuple[Any, ...]] = []
        at = self._at
        for name, kind in element.properties:
            size, item = lists.get(name, (None, kind))
            if size is None:
                fields.append((name, f"{self._order}{item}"))
            else:
                length = np.dtype(self._order + size)
                if length.kind == "f" or at + length.itemsize > len(self._data):
                    return None
                count = int(np.frombuffer(self._data, length, 1, at)[0])
                if count <= 0 or at + length.itemsize + count * np.dtype(item).itemsize > len(self._data):
                    return None  # checked before NumPy is asked for a row of that size
                fields += [(f"#{name}", length), (name, f"{self._order}{item}", (count,))]
            at = self._at + np.dtype(fields).itemsize
        dtype = np.dtype(fields)
        if element.count * dtype.itemsize > len(self._data) - self._at:
            return None
        table = np.frombuffer(self._data, dtype, element.count, self._at)
        if any((table[f"#{name}"] != dtype[name].shape[0]).any() for name in lists):
            return None
        self._at += table.nbytes
        return {
            name: _list(table[f"#{name}"], table[name]) if name in lists else table[name]
            for name in element.names
        }

    def _various_rows(self, element: Element) -> dict[str, Any]:
        """Return the columns row by row; slower, for faces with different numbers of corners."""
        lists = {name: (np.dtype(self._order + s), np.dtype(self._order + i)) for name, s, i in element.lists}
        plain = {name: np.dtype(self._order + kind) for name, kind in element.properties if kind is not None}
        sizes = {name: array("q") for name in lists}
        items = {name: bytearray() for name in lists}
        data, at, end = self._data, self._at, len(self._data)
        for row in range(element.count):
            for name in element.names:
                if name in plain:
                    at += plain[name].itemsize
                    continue
                length, item = lists[name]
                if at + length.itemsize > end:
                    self._truncated(element, row)
                count = float(np.frombuffer(data, length, 1, at)[0])
                at += length.itemsize
                if not (count >= 0 and count == int(count)):
                    refuse(self._path, f"{element.name} {row} has a list of {count:g} numbers")
                if at + count * item.itemsize > end:
                    self._truncated(element, row)
                sizes[name].append(int(count))
                end_of_list = at + int(count) * item.itemsize
                items[name] += data[at:end_of_list]
                at = end_of_list
            if at > end:
                self._truncated(element, row)
        self._at = at
        return {
            name: _list(np.array(sizes[name], np.int64), np.frombuffer(items[name], lists[name][1]))
            for name in lists
        }


def _list(sizes: np.ndarray, items: np.ndarray) -> tuple[Int64[np.ndarray, " P"], Int64[np.ndarray, " C"]]:
    """Return lengths and items of a list as int64; items of other types are never read."""
    if items.dtype.kind == "f":
        return sizes.astype(np.int64), np.empty(0, np.int64)
    return sizes.astype(np.int64), items.ravel().astype(np.int64)


class _Text:
    """The rows after an ASCII header.

    Args:
        path: The file, for messages.
        data: All its bytes.
        start: Where the rows begin.
    """

    def __init__(self, path: Path, data: bytes, start: int) -> None:
        self._path = path
        require_memory(str(path), TEXT_BYTES * len(data), TOO_LARGE)
        first = 1 + data.count(b"\n", 0, start)
        lines = data[start:].decode("latin-1").splitlines()
        self._lines = ((first + index, line) for index, line in enumerate(lines) if line.strip())

    def rows(self, element: Element) -> dict[str, Any]:
        """Return the columns of the next element: an array, or for a list the lengths and all items."""
        if not element.properties:  # its rows are blank lines, which are skipped
            return {}
        lists = {name for name, _, _ in element.lists}
        plain: dict[str, list[float]] = {name: [] for name in element.names if name not in lists}
        sizes: dict[str, list[int]] = {name: [] for name in lists}
        items: dict[str, list[float]] = {name: [] for name in lists}
        for row in range(element.count):
            place, line = next(self._lines, (0, ""))
            if not place:
                refuse(
                    self._path, f"is truncated: {row} of {element.count} rows of {element.name} are present"
                )
            words = line.split()
            at = 0
            for name in element.names:
                take = 1
                if name in lists:
                    take = self._length(words, at, place)
                    sizes[name].append(take)
                    at += 1
                if at + take > len(words):
                    refuse(self._path, f"line {place}: is too short for a {element.name}")
                (items[name] if name in lists else plain[name]).extend(
                    numbers_in(self._path, words[at : at + take], place)
                )
                at += take
            if at < len(words):
                refuse(self._path, f"line {place}: has {len(words)} numbers, but a {element.name} has {at}")
        columns: dict[str, Any] = {name: np.array(values, np.float64) for name, values in plain.items()}
        for name in lists:
            columns[name] = np.array(sizes[name], np.int64), self._indices(items[name])
        return columns

    def _length(self, words: list[str], at: int, place: int) -> int:
        count = numbers_in(self._path, words[at : at + 1], place) or [0.0]
        if not (0 <= count[0] <= len(words) and count[0] == int(count[0])):
            refuse(self._path, f"line {place}: a list cannot have {count[0]:g} numbers here")
        return int(count[0])

    def _indices(self, values: list[float]) -> Int64[np.ndarray, " C"]:
        """Return indices; a number that is none becomes -1, which the caller refuses."""
        found: Float64[np.ndarray, " C"] = np.array(values, np.float64)
        whole = (found >= 0) & (found < 2**53) & (found == np.floor(found))
        return np.where(whole, found, -1.0).astype(np.int64)

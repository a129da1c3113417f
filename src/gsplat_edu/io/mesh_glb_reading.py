"""Read the triangles of a binary glTF of any program; `gsplat_edu.io.mesh_glb` says what is read and what is not."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, Float64, Int64

from gsplat_edu.base.headroom import require_memory
from gsplat_edu.base.reading import TOO_LARGE, read_bytes
from gsplat_edu.io.axes import POSITION_SIGNS, root_transform
from gsplat_edu.io.glb_container import GENERATOR, MISREAD, REPEATS, container, node_matrices, refuse
from gsplat_edu.io.mesh_glb import TRIANGLES, UNLIT
from gsplat_edu.io.mesh_image import decoded
from gsplat_edu.io.mesh_parts import Polygons, StoredMesh, check_vertices, distinct_rows, triangles_in
from gsplat_edu.io.scene import read_extras
from gsplat_edu.scene.frame import ORIGIN, Vector
from gsplat_edu.scene.mesh import Mesh, Texture

MOST_PARTS = 100_000
"""Most primitives at nodes. Each takes time and memory, even one without triangles; nodes may share them."""

ARRAY_BYTES = 3
"""Peak memory for a byte of vertices and corners: the parts, and the arrays that they are joined to."""

NUMBERS = {5120: "i1", 5121: "u1", 5122: "i2", 5123: "u2", 5125: "u4", 5126: "f4"}
"""NumPy types of accessors."""

TYPES = {"POSITION": ("VEC3",), "COLOR_0": ("VEC3", "VEC4"), "TEXCOORD_0": ("VEC2",)}
"""Attributes that are read, and their types."""

ATTRIBUTE_BYTES = 36
"""Most bytes of a vertex's attribute as it is converted."""

WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
"""Numbers of each accessor type that meshes need."""


def srgb(linear: Float[np.ndarray, "*N"]) -> Float64[np.ndarray, "*N"]:
    """Return sRGB values of linear values, both 0 to 1 (IEC 61966-2-1)."""
    values = np.clip(np.asarray(linear, np.float64), 0.0, 1.0)
    return np.where(values <= 0.0031308, values * 12.92, 1.055 * values ** (1 / 2.4) - 0.055)


def read(path: Path) -> StoredMesh:
    """Read a mesh; see `gsplat_edu.io.mesh_files.read_mesh`."""
    data = read_bytes(path)
    document, body = container(path, data)
    needed = document.get("extensionsRequired", [])
    if not isinstance(needed, list) or set(map(str, needed)) - {UNLIT}:
        names = ", ".join(sorted(map(str, needed))) if isinstance(needed, list) else "?"
        refuse(path, f"needs the extension {names[:80]}, which is not supported")
    try:
        parts = list(_File(path, document, body).parts())
        unit, up = _frame(document["asset"])
    except MISREAD:
        refuse(path, "its JSON does not describe meshes as glTF does")
    if not parts:
        refuse(path, "has no mesh of triangles")
    starts = np.cumsum([0, *(len(part.points) for part in parts)])
    points = np.concatenate([part.points for part in parts])
    if up is not None:  # the root turned up to y; the mesh gets its own coordinates back
        points = points @ root_transform(up, ORIGIN)[0]
    points = points * np.array(POSITION_SIGNS) + 0.0
    check_vertices(path, points, lambda row: f"vertex {row}")
    corners = np.concatenate([part.corners + start for part, start in zip(parts, starts[:-1], strict=True)])
    polygons = Polygons(np.full(len(corners) // 3, 3), corners, lambda row: f"triangle {row}")
    faces = corners[triangles_in(path, points, polygons)]
    colors = _all_colors(parts)
    texture = _texture(path, document, body, parts, faces)
    kept, merged = _merged(points)
    colors = None if colors is None else colors[kept]
    return StoredMesh(Mesh(points[kept], merged[faces], colors, texture), unit)


def _frame(asset: dict[str, Any]) -> tuple[str | None, Vector | None]:
    """Return the unit and the scene's up direction: metres and None, except for our files."""
    if asset.get("generator") != GENERATOR:
        return "m", None
    up, unit, _ = read_extras(asset.get("extras"))
    return unit, up


def _merged(points: Float64[np.ndarray, "N 3"]) -> tuple[Int64[np.ndarray, " V"], Int64[np.ndarray, " N"]]:
    """Return the first vertex at each position, in their order, and the number among these of every vertex."""
    first, group = distinct_rows(*points.T)
    order = np.argsort(first)
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    return first[order], rank[group]


class _Part:
    """A primitive at a node.

    Args:
        points: (N, 3) positions in glTF's axes.
        corners: (3 F,) indices of points.
        colors: (N, 3) sRGB, or None.
        uvs: (N, 2) texture coordinates, or None.
        image: Index of the image, or None.
    """

    def __init__(
        self,
        points: Float64[np.ndarray, "N 3"],
        corners: Int64[np.ndarray, " C"],
        colors: Float32[np.ndarray, "N 3"] | None,
        uvs: Float32[np.ndarray, "N 2"] | None,
        image: int | None,
    ) -> None:
        self.points, self.corners, self.colors, self.uvs, self.image = points, corners, colors, uvs, image


def _all_colors(parts: list[_Part]) -> Float32[np.ndarray, "N 3"] | None:
    """Return the colours of all vertices; None unless every part has some."""
    colors = [part.colors for part in parts if part.colors is not None]
    return np.concatenate(colors) if len(colors) == len(parts) else None


def _texture(
    path: Path,
    document: dict[str, Any],
    body: memoryview,
    parts: list[_Part],
    faces: Int64[np.ndarray, "F 3"],
) -> Texture | None:
    """Return the texture if one embedded image covers all parts."""
    uvs = [part.uvs for part in parts if part.uvs is not None]
    images = {part.image for part in parts}
    if len(uvs) < len(parts) or len(images) != 1 or None in images:
        return None
    try:
        image = document["images"][images.pop()]
        if "bufferView" not in image:
            return None
        view = document["bufferViews"][image["bufferView"]]
        start, size = view.get("byteOffset", 0), view["byteLength"]
        if not (type(start) is type(size) is int and 0 <= start <= start + size <= len(body)):
            refuse(path, "has an image that extends beyond the file's end")
    except MISREAD:
        refuse(path, "its JSON does not describe an image as glTF does")
    return Texture(decoded(path, bytes(body[start : start + size])), np.concatenate(uvs)[faces])


class _File:
    """The parts of a file.

    Args:
        path: The file, for messages.
        document: Its JSON.
        body: Its buffer.
    """

    def __init__(self, path: Path, document: dict[str, Any], body: memoryview) -> None:
        self._path, self._document, self._body = path, document, body
        self._room = max(REPEATS * len(body), 1 << 20)
        self._taken = self._parts = 0

    def parts(self) -> Iterator[_Part]:
        """Yield the primitives of the scene's nodes; of all nodes if there is no scene."""
        for index, matrix in node_matrices(self._path, self._document).items():
            node = self._document["nodes"][index]
            if "mesh" in node:
                for primitive in self._item("meshes", node["mesh"])["primitives"]:
                    yield self._part(primitive, matrix)

    def _item(self, kind: str, index: Any) -> dict[str, Any]:  # noqa: ANN401 - of a stranger's JSON
        """Return an entry of one of the document's lists."""
        if type(index) is not int or not 0 <= index < len(self._document[kind]):
            refuse(self._path, f"names {kind}[{str(index)[:20]}], which does not exist")
        item: dict[str, Any] = self._document[kind][index]
        return item

    def _part(self, primitive: dict[str, Any], matrix: Float64[np.ndarray, "4 4"]) -> _Part:
        if primitive.get("mode", TRIANGLES) != TRIANGLES:
            refuse(self._path, f"has a primitive of mode {str(primitive['mode'])[:9]}, not of triangles")
        attributes = primitive["attributes"]
        self._parts += 1
        if self._parts > MOST_PARTS:
            refuse(self._path, f"shows its meshes in more than {MOST_PARTS:,} parts")
        self._reserve(primitive, attributes)
        with np.errstate(invalid="ignore"):  # signalling NaN; the caller looks for NaN
            points = self._array(attributes["POSITION"], *TYPES["POSITION"]).astype(np.float64)
        if "indices" in primitive:
            corners = self._view(primitive["indices"], "SCALAR", whole=True)[:, 0].astype(np.int64)
        else:
            corners = np.arange(len(points))
        corners = corners[: len(corners) // 3 * 3]
        with np.errstate(over="ignore", invalid="ignore"):  # the caller checks the result
            moved = points @ matrix[:3, :3].T + matrix[:3, 3]
            mirrored = bool(np.linalg.det(matrix[:3, :3]) < 0.0)
        if mirrored:
            corners = corners.reshape(-1, 3)[:, ::-1].ravel()
        colors = uvs = None
        if "COLOR_0" in attributes:
            shades = self._array(attributes["COLOR_0"], *TYPES["COLOR_0"])[:, :3]
            colors = srgb(np.nan_to_num(shades)).astype(np.float32)
        if "TEXCOORD_0" in attributes:
            uvs = np.nan_to_num(self._array(attributes["TEXCOORD_0"], *TYPES["TEXCOORD_0"]))
        return _Part(moved, corners, colors, uvs, self._image(primitive))

    def _reserve(self, primitive: dict[str, Any], attributes: dict[str, Any]) -> None:
        """Check, before the arrays of a primitive are made, that they are not too many.

        Raises:
            SceneFormatError: the file shows its own contents too often.
            NotEnoughMemoryError: the arrays do not fit into the free memory.
        """
        counts = {
            name: len(self._view(attributes[name], *TYPES[name])) for name in TYPES if name in attributes
        }
        points = counts["POSITION"]
        corners = (
            len(self._view(primitive["indices"], "SCALAR", whole=True)) if "indices" in primitive else points
        )
        if any(count != points for count in counts.values()):
            refuse(self._path, "has attributes of different numbers of vertices")
        size = ATTRIBUTE_BYTES * len(counts) * points + 8 * corners
        self._room -= 24 * points + 8 * corners
        if self._room < 0:
            refuse(self._path, f"shows its meshes more than {REPEATS} times")
        self._taken += size
        require_memory(str(self._path), ARRAY_BYTES * self._taken, TOO_LARGE)

    def _image(self, primitive: dict[str, Any]) -> int | None:
        """Return the image of a primitive's base colour; None if it has none, or not with the first coordinates."""
        if "material" not in primitive:
            return None
        material = self._item("materials", primitive["material"])
        used = material.get("pbrMetallicRoughness", {}).get("baseColorTexture")
        if used is None or used.get("texCoord", 0) != 0 or "extensions" in used:
            return None
        source = self._item("textures", used["index"]).get("source")
        if source is not None:
            self._item("images", source)
        return source

    def _array(self, index: Any, *types: str) -> np.ndarray:  # noqa: ANN401
        """Return the values of an accessor: (count, width) float32."""
        values = self._view(index, *types)
        if values.dtype.kind == "f":
            return values.astype(np.float32)
        return np.maximum(values / np.float64(np.iinfo(values.dtype).max), -1.0).astype(np.float32)

    def _view(self, index: Any, *types: str, whole: bool = False) -> np.ndarray:  # noqa: ANN401
        """Return the stored values of an accessor: (count, width); floats or normalised integers unless `whole`."""
        accessor = self._item("accessors", index)
        name = f"(accessor {index})"
        number, kind = NUMBERS.get(accessor["componentType"]), accessor["type"]
        if number is None or kind not in types or "sparse" in accessor or "bufferView" not in accessor:
            refuse(self._path, f"has values of a kind that is not supported {name}")
        if (whole and number[0] != "u") or (not whole and number != "f4" and not accessor.get("normalized")):
            refuse(self._path, f"has values of a type that is not supported {name}")
        view = self._item("bufferViews", accessor["bufferView"])
        dtype, width, count = np.dtype("<" + number), WIDTHS[kind], accessor["count"]
        start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
        stride = view.get("byteStride", dtype.itemsize * width)
        if view.get("buffer", 0) != 0 or "uri" in self._document["buffers"][0]:
            refuse(self._path, f"has values in another file {name}; export it as one .glb")
        if any(type(value) is not int or value < 0 for value in (count, start, stride)):
            refuse(self._path, f"has a size or an offset that is no number {name}")
        if not count:
            return np.empty((0, width), np.float32)
        if stride < dtype.itemsize * width or start + (count - 1) * stride + dtype.itemsize * width > len(
            self._body
        ):
            refuse(self._path, f"has values that extend beyond the file's end {name}")
        steps = (stride, dtype.itemsize)
        return np.ndarray((count, width), dtype, self._body, start, steps)

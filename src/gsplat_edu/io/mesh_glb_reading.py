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
from gsplat_edu.io.glb_container import GENERATOR, MISREAD, NUMBERS, GlbFile, container, node_matrices, refuse
from gsplat_edu.io.mesh_glb import TRIANGLES, UNLIT
from gsplat_edu.io.mesh_image import decoded
from gsplat_edu.io.mesh_parts import Polygons, StoredMesh, check_vertices, distinct_rows, triangles_in
from gsplat_edu.io.scene import SceneFrame, read_extras
from gsplat_edu.scene.frame import ORIGIN
from gsplat_edu.scene.mesh import Mesh, Texture

MOST_PARTS = 100_000
"""Most primitives at nodes. Each takes time and memory, even one without triangles; nodes may share them."""

ARRAY_BYTES = 3
"""Peak memory for a byte of vertices and corners: the parts, and the arrays that they are joined to."""

TYPES = {"POSITION": ("VEC3",), "COLOR_0": ("VEC3", "VEC4"), "TEXCOORD_0": ("VEC2",)}
"""Attributes that are read, and their types."""

ATTRIBUTE_BYTES = 36
"""Most bytes of a vertex's attribute as it is converted."""


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
        file = _File(path, document, body)
        parts = list(file.parts())
        frame = _frame(path, document["asset"])
    except MISREAD:
        refuse(path, "its JSON does not describe meshes as glTF does")
    if not parts:
        refuse(path, "has no mesh of triangles")
    starts = np.cumsum([0, *(len(part.points) for part in parts)])
    points = np.concatenate([part.points for part in parts])
    if frame.up is not None:  # the root turned up to y; the mesh gets its own coordinates back
        points = points @ root_transform(frame.up, ORIGIN)[0]
    points = points * np.array(POSITION_SIGNS) + 0.0
    check_vertices(path, points, lambda row: f"vertex {row}")
    corners = np.concatenate([part.corners + start for part, start in zip(parts, starts[:-1], strict=True)])
    polygons = Polygons(np.full(len(corners) // 3, 3), corners, lambda row: f"triangle {row}")
    faces = corners[triangles_in(path, points, polygons)]
    colors = _all_colors(parts)
    texture = file.texture(parts, faces)
    kept, merged = _merged(points)
    colors = None if colors is None else colors[kept]
    return StoredMesh(Mesh(points[kept], merged[faces], colors, texture), frame.unit, frame.earth)


def _frame(path: Path, asset: dict[str, Any]) -> SceneFrame:
    """Return what our files say of the coordinates; of other files, that they are metres."""
    if asset.get("generator") != GENERATOR:
        return SceneFrame(unit="m")
    try:
        return read_extras(asset.get("extras"))
    except ValueError:
        refuse(path, "has an origin or a place on earth that is none")


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


class _File(GlbFile):
    """A file of meshes."""

    _parts = _taken = 0  # parts that were read, and bytes of their arrays

    def parts(self) -> Iterator[_Part]:
        """Yield the primitives of the scene's nodes; of all nodes if there is no scene."""
        for index, matrix in node_matrices(self._path, self._document).items():
            node = self._document["nodes"][index]
            if "mesh" in node:
                for primitive in self._item("meshes", node["mesh"])["primitives"]:
                    yield self._part(primitive, matrix)

    def texture(self, parts: list[_Part], faces: Int64[np.ndarray, "F 3"]) -> Texture | None:
        """Return the texture if one embedded image covers all parts."""
        uvs = [part.uvs for part in parts if part.uvs is not None]
        images = {part.image for part in parts}
        if len(uvs) < len(parts) or len(images) != 1 or None in images:
            return None
        try:
            image = self._document["images"][images.pop()]
            if "bufferView" not in image:
                return None
            data = self._embedded(image["bufferView"], "an image")
        except MISREAD:
            self._refuse("its JSON does not describe an image as glTF does")
        return Texture(decoded(self._path, data), np.concatenate(uvs)[faces])

    def _part(self, primitive: dict[str, Any], matrix: Float64[np.ndarray, "4 4"]) -> _Part:
        if primitive.get("mode", TRIANGLES) != TRIANGLES:
            self._refuse(f"has a primitive of mode {str(primitive['mode'])[:9]}, not of triangles")
        attributes = primitive["attributes"]
        self._parts += 1
        if self._parts > MOST_PARTS:
            self._refuse(f"shows its meshes in more than {MOST_PARTS:,} parts")
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
            self._refuse("has attributes of different numbers of vertices")
        size = ATTRIBUTE_BYTES * len(counts) * points + 8 * corners
        self._take(24 * points + 8 * corners, "meshes")
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
        name = f"accessor {index}"
        number, kind = NUMBERS.get(accessor["componentType"]), accessor["type"]
        if number is None or kind not in types or "sparse" in accessor or "bufferView" not in accessor:
            self._refuse(f"has values of a kind that is not supported in {name}")
        if (whole and number[0] != "u") or (not whole and number != "f4" and not accessor.get("normalized")):
            self._refuse(f"has values of a type that is not supported in {name}")
        return self._stored(accessor, name)

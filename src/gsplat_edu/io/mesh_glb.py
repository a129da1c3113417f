"""Meshes as binary glTF 2.0: positions and normals as float32, with colours per vertex or a texture.

glTF's y points up and its front is +z, so a mesh is converted by a half turn about x, as scenes are
(`gsplat_edu.io.axes`): (x, y, z) becomes (x, -y, -z). glTF's unit is the metre: if the scene's unit is known,
coordinates are converted to metres, and the asset's extras say so, and where on earth these are if that is known.
Positions are float32, which is all that glTF has.

Colours of vertices (COLOR_0) are linear in glTF. They are written in 16 bits: in 8 bits, the darker sRGB values would
become equal. A texture is an embedded PNG or JPEG, which stays sRGB. A viewer would multiply it by the vertices'
colours, so these are left out beside a texture. Materials are unlit where viewers know KHR_materials_unlit, because
photos already contain the light, and are seen from both sides.

A vertex of glTF has one texture coordinate. Vertices at seams are therefore repeated when written. Vertices at the
same position become one when read, in files of any program. `gsplat_edu.io.mesh_glb_reading` reads the triangles of all
meshes of the scene, moved by the transforms of their nodes, and a texture if one embedded image covers all of them. A
file that needs an extension (compressed meshes, for example) is rejected with an error that names it.

Source: Khronos, "glTF 2.0 Specification".
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, Float64, Int64, UInt16

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.io.axes import POSITION_SIGNS
from gsplat_edu.io.glb_container import GENERATOR, root_node, write_container
from gsplat_edu.io.mesh_image import encoded
from gsplat_edu.io.mesh_parts import METRES, Placement, split_at_seams, turned_positions, vertex_normals
from gsplat_edu.scene.earth import Earth
from gsplat_edu.scene.frame import Vector
from gsplat_edu.scene.mesh import Mesh

TRIANGLES, FLOAT, UNSIGNED_SHORT, UNSIGNED_INT = 4, 5126, 5123, 5125
"""Mode of a primitive; component types of accessors."""

ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER = 34962, 34963
"""Targets of buffer views."""

LINEAR, CLAMP_TO_EDGE = 9729, 33071
"""Filter and wrapping of a sampler."""

UNLIT = "KHR_materials_unlit"
"""Extension for materials that show their colour as it is."""

WIDE = np.float64(65535.0)
"""White in 16 bits."""


def linear(srgb: Float[np.ndarray, "*N"]) -> Float64[np.ndarray, "*N"]:
    """Return linear values of sRGB values, both 0 to 1 (IEC 61966-2-1)."""
    values = np.asarray(srgb, np.float64)
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)


def write(path: Path, mesh: Mesh, placement: Placement, jpeg: int | None) -> None:
    """Write a mesh; see `gsplat_edu.io.mesh_files.write_mesh`."""
    origin, faces, uvs = split_at_seams(mesh)
    positions = turned_positions(path, mesh.vertices[origin], placement, "glTF")
    normals = vertex_normals(mesh)[origin] * np.array(POSITION_SIGNS) + 0.0
    file = _Document()
    attributes = {"POSITION": file.attribute(positions, bounds=True)}
    attributes["NORMAL"] = file.attribute(normals.astype("<f4"))
    material: dict[str, Any] = {
        "pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 1.0},
        "doubleSided": True,
    }
    if uvs is not None and mesh.texture is not None:
        attributes["TEXCOORD_0"] = file.attribute(uvs.astype("<f4"))
        material["pbrMetallicRoughness"]["baseColorTexture"] = {"index": 0}
    elif mesh.colors is not None:
        attributes["COLOR_0"] = file.attribute(_wide_colors(mesh.colors))
    if len(attributes) > 2:
        material["extensions"] = {UNLIT: {}}
        file.document["extensionsUsed"] = [UNLIT]
    primitive = {"attributes": attributes, "indices": file.indices(faces), "mode": TRIANGLES, "material": 0}
    if mesh.texture is not None:
        file.image(encoded(mesh.texture.image, jpeg), "image/png" if jpeg is None else "image/jpeg")
    file.document |= {"meshes": [{"primitives": [primitive]}], "materials": [material]}
    file.document["nodes"] = [{"mesh": 0, **root_node(*placement.root)}]
    file.place(placement)
    file.write(path, f"{len(mesh.faces):,} faces")


def write_parts(
    path: str | Path,
    parts: Sequence[tuple[str, Mesh]],
    unit: str | None = None,
    up: Vector | None = None,
    earth: Earth | None = None,
) -> None:
    """Write several meshes as one binary glTF, a node for each; colours and textures are not written.

    The same meshes give the same bytes.

    Args:
        path: Output file; parent folders are created.
        parts: Name and mesh of each node, at least one, each with at least one face.
        unit: Unit of the coordinates, "m", "cm" or "mm", which become metres; None if unknown.
        up: Up direction of the scene, which becomes y; None if unknown.
        earth: Where on earth the coordinates are; None if unknown.

    Raises:
        ArgumentError: there are no parts, one has no faces or a coordinate beyond float32, or the unit is unknown.
        OSError: the file cannot be written. An existing file stays unchanged.
    """
    path = Path(path)
    if unit is not None and unit not in METRES:
        raise ArgumentError(f"unit: is {unit!r}, but must be one of {', '.join(METRES)}")
    if not parts or not all(len(mesh.faces) for _, mesh in parts):
        raise ArgumentError(f"{path}: a part has no faces, or there are no parts; there is nothing to write")
    file = _Document()
    meshes: list[dict[str, Any]] = []
    nodes: list[dict[str, Any]] = []
    placement = Placement.of(np.concatenate([mesh.vertices for _, mesh in parts]), unit, up, earth)
    for name, mesh in parts:
        attributes = {
            "POSITION": file.attribute(turned_positions(path, mesh.vertices, placement, "glTF"), bounds=True)
        }
        primitive = {"attributes": attributes, "indices": file.indices(mesh.faces), "mode": TRIANGLES}
        nodes.append({"name": name, "mesh": len(meshes), **root_node(*placement.root)})
        meshes.append({"name": name, "primitives": [primitive]})
    file.document |= {"meshes": meshes, "nodes": nodes, "scenes": [{"nodes": list(range(len(nodes)))}]}
    file.place(placement)
    file.write(path, f"{len(parts):,} parts")


def _wide_colors(colors: Float32[np.ndarray, "V 3"]) -> UInt16[np.ndarray, "V 4"]:
    """Return linear colours in 16 bits; the opacity fills rows up to a multiple of 4 bytes, which glTF requires."""
    rows = np.full((len(colors), 4), WIDE)
    rows[:, :3] = np.rint(linear(np.clip(colors, 0.0, 1.0)) * WIDE)
    return rows.astype("<u2")


class _Document:
    """The JSON and the buffer of a file, under construction."""

    def __init__(self) -> None:
        self.document: dict[str, Any] = {
            "asset": {"version": "2.0", "generator": GENERATOR},
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "accessors": [],
            "bufferViews": [],
        }
        self._parts: list[bytes] = []
        self._size = 0

    def _view(self, data: bytes, **more: int) -> int:
        """Add bytes to the buffer, and return their view."""
        views = self.document["bufferViews"]
        views.append({"buffer": 0, "byteOffset": self._size, "byteLength": len(data), **more})
        self._parts.append(data + b"\0" * (-len(data) % 4))
        self._size += len(self._parts[-1])
        return len(views) - 1

    def attribute(self, values: np.ndarray, bounds: bool = False) -> int:
        """Add an attribute of vertices, and return its accessor. glTF wants bounds for positions."""
        kind, integers = FLOAT, values.dtype.kind == "u"
        described: dict[str, Any] = {"bufferView": self._view(values.tobytes(), target=ARRAY_BUFFER)}
        if integers:
            kind, described["normalized"] = UNSIGNED_SHORT, True
        described |= {"componentType": kind, "count": len(values), "type": f"VEC{values.shape[1]}"}
        if bounds:
            described |= {"min": values.min(axis=0).tolist(), "max": values.max(axis=0).tolist()}
        self.document["accessors"].append(described)
        return len(self.document["accessors"]) - 1

    def indices(self, faces: Int64[np.ndarray, "F 3"]) -> int:
        """Add the vertices of faces, and return their accessor."""
        wide = faces.max() >= 65535  # glTF reserves the largest index
        view = self._view(faces.astype("<u4" if wide else "<u2").tobytes(), target=ELEMENT_ARRAY_BUFFER)
        kind = UNSIGNED_INT if wide else UNSIGNED_SHORT
        accessor = {"bufferView": view, "componentType": kind, "count": faces.size, "type": "SCALAR"}
        self.document["accessors"].append(accessor)
        return len(self.document["accessors"]) - 1

    def image(self, data: bytes, kind: str) -> None:
        """Add the image of the only texture."""
        self.document["images"] = [{"bufferView": self._view(data), "mimeType": kind}]
        sampler = {"magFilter": LINEAR, "minFilter": LINEAR, "wrapS": CLAMP_TO_EDGE, "wrapT": CLAMP_TO_EDGE}
        self.document["samplers"] = [sampler]
        self.document["textures"] = [{"source": 0, "sampler": 0}]

    def place(self, placement: Placement) -> None:
        """State unit, up and place on earth, by which `mesh_glb_reading` finds the mesh's own coordinates again."""
        if placement.stated:
            self.document["asset"]["extras"] = placement.stated

    def write(self, path: Path, content: str) -> None:
        """Write the file."""
        self.document["buffers"] = [{"byteLength": self._size}]
        write_container(path, self.document, self._parts, content)

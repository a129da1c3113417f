"""The registry of all mesh formats, by file suffix.

PLY and OBJ hold a mesh in the scene's own coordinates. glTF and USD have axes and a unit of their own: see
`gsplat_edu.io.mesh_glb` and `gsplat_edu.io.mesh_usd`.
"""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from pathlib import Path

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.validation import of_type
from gsplat_edu.io.mesh_parts import METRES, Placement, StoredMesh
from gsplat_edu.scene.earth import Earth
from gsplat_edu.scene.frame import Vector
from gsplat_edu.scene.mesh import Mesh


@dataclass(frozen=True)
class MeshFormat:
    """A mesh format.

    Args:
        suffix: Suffix of its files, in lower case.
        reader: Module of `gsplat_edu.io` with `read(path) -> StoredMesh`; empty if the format is only written.
        writer: Module of `gsplat_edu.io` with `write`.
        name: Its common name.
        texture: Whether it can store a texture.
        colors_with_texture: Whether it can store colours of vertices beside a texture.
        jpeg: Whether it can store the texture as JPEG.
    """

    suffix: str
    reader: str
    writer: str
    name: str
    texture: bool = True
    colors_with_texture: bool = True
    jpeg: bool = False

    def read(self, path: Path) -> StoredMesh:
        """Read a file of the format; see `read_mesh`."""
        if not self.reader:
            raise ArgumentError(f"{path}: {self.name} is written, not read; give a .glb, .ply or .obj")
        stored: StoredMesh = importlib.import_module(f"gsplat_edu.io.{self.reader}").read(path)
        return stored


MESH_FORMATS = (
    MeshFormat(
        ".glb",
        "mesh_glb_reading",
        "mesh_glb",
        "binary glTF",
        colors_with_texture=False,
        jpeg=True,
    ),
    MeshFormat(".ply", "mesh_ply", "mesh_ply", "PLY", texture=False),
    MeshFormat(".obj", "mesh_obj", "mesh_obj", "Wavefront OBJ"),
    MeshFormat(".usdz", "", "mesh_usd", "USDZ", colors_with_texture=False, jpeg=True),
)


def mesh_format_of(path: str | Path) -> MeshFormat:
    """Return the mesh format that a file's name indicates.

    Args:
        path: The file's name; it need not exist.

    Raises:
        ArgumentError: the name has no suffix of a mesh format.
    """
    for candidate in MESH_FORMATS:
        if Path(path).suffix.lower() == candidate.suffix:
            return candidate
    known = ", ".join(candidate.suffix for candidate in MESH_FORMATS)
    raise ArgumentError(f"{path}: unknown mesh format; known are {known}")


def mesh_losses(path: str | Path, mesh: Mesh) -> list[str]:
    """List the parts of a mesh that the format of a path cannot store, one sentence each.

    Args:
        path: The file's name.
        mesh: The mesh.

    Raises:
        ArgumentError: the name has no suffix of a mesh format.
    """
    found = mesh_format_of(path)
    said = []
    if mesh.texture is not None and not found.texture:
        said.append(f"{path}: {found.name} cannot store the texture; write a .glb or .obj")
    if mesh.texture is not None and mesh.colors is not None and not found.colors_with_texture:
        said.append(
            f"{path}: {found.name} would multiply the texture by the vertices' colours; they are dropped"
        )
    return said


def read_mesh(path: str | Path, unit: str | None = None) -> Mesh:
    """Read a mesh of any format and any program.

    Polygons are cut into triangles.

    Args:
        path: The file.
        unit: Unit of the wanted coordinates, "m", "cm" or "mm". They are converted if the file states its own; a
            binary glTF of another program is in metres. None leaves them as they are in the file.

    Returns:
        The mesh, in this package's axes if the format prescribes axes (glTF), otherwise in those of the file.

    Raises:
        ArgumentError: the name has no suffix of a mesh format that is read, or the unit is unknown.
        SceneFormatError: the file does not match its suffix, has no faces, or is damaged.
        NotEnoughMemoryError: the file does not fit into memory.
        OSError: the file cannot be read.
    """
    _check_unit(unit)
    path = Path(path)
    stored = mesh_format_of(path).read(path)
    if unit is None or stored.unit in (None, unit):
        return stored.mesh
    mesh, factor = stored.mesh, METRES[stored.unit] / METRES[unit]
    return Mesh(mesh.vertices * factor, mesh.faces, mesh.colors, mesh.texture)


def write_mesh(
    path: str | Path,
    mesh: Mesh,
    unit: str | None = None,
    jpeg: int | None = None,
    up: Vector | None = None,
    earth: Earth | None = None,
) -> None:
    """Write a mesh in the format that the file's name indicates; parent folders are created.

    An OBJ with a texture has two more files beside it, of the same name with .mtl and .png. The same mesh gives the
    same bytes.

    Args:
        path: The file.
        mesh: The mesh, in this package's axes, with at least one face.
        unit: Unit of its coordinates, "m", "cm" or "mm"; None if unknown. glTF and USDZ get metres, others a comment.
        jpeg: Quality of the texture in a binary glTF or USDZ as JPEG, 1 to 95; None writes PNG, which loses nothing.
        up: The scene's up direction, which a glTF or USDZ turns to y; None if unknown. Others keep the coordinates.
        earth: Where on earth its coordinates are, which every format states; None if unknown.

    Raises:
        ArgumentError: the name has no suffix of a mesh format, the mesh has no faces or does not fit into the format,
            the unit is unknown, the quality is out of range, or usd-core is not installed for a USDZ.
        OSError: a file cannot be written. Existing files stay unchanged.
    """
    found = mesh_format_of(path)
    of_type("mesh", mesh, Mesh)
    _check_unit(unit)
    if not len(mesh.faces):
        raise ArgumentError(f"{path}: the mesh has no faces; there is nothing to write")
    if jpeg is not None and not 1 <= jpeg <= 95:
        raise ArgumentError(f"jpeg: is {jpeg}, but must be from 1 to 95")
    module = importlib.import_module(f"gsplat_edu.io.{found.writer}")
    if found.jpeg:
        module.write(Path(path), mesh, Placement.of(mesh.vertices, unit, up, earth), jpeg)
    else:
        module.write(Path(path), mesh, unit, earth)


def _check_unit(unit: str | None) -> None:
    if unit is not None and unit not in METRES:
        raise ArgumentError(f"unit: is {unit!r}, but must be one of {', '.join(METRES)}")

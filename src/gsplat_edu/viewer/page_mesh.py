"""Meshes that a page shows beside its splats, and their binary layout.

One mesh after the other, little-endian, each with these arrays; an entry of the page's facts has their lengths:

    positions   3 float32   per vertex, world units, relative to the page's origin
    colors      4 uint8     per vertex, sRGB and 255; only with colours
    uvs         2 float32   per vertex, (0, 0) is the top left corner of the image; only with a texture
    faces       3 uint32    per face
    image       uint8       the texture as PNG, zeros up to a multiple of 4; only with a texture

A vertex has one texture coordinate; vertices at the seams of a texture are repeated. `viewer/web/mesh.js` reads this.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from gsplat_edu.base.constants import PAGE_FACES
from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.io.edit import Similarity
from gsplat_edu.io.mesh_files import read_mesh
from gsplat_edu.io.mesh_image import encoded
from gsplat_edu.io.mesh_parts import split_at_seams
from gsplat_edu.runs.source import Source
from gsplat_edu.scene.mesh import Mesh


@dataclass(frozen=True, eq=False)
class Meshes:
    """The meshes of a page, in the coordinates of its scene.

    Args:
        surface: Drawn in place of the splats on one side of a line.
        collider: Drawn translucent over the surface and the splats; None for none.
        stays: Some splats were moved without the others; the meshes show them where they were, and the page says so.
    """

    surface: Mesh
    collider: Mesh | None = None
    stays: bool = False

    def moved(self, move: Similarity) -> Meshes:
        """Return the meshes after a transform of the scene."""
        collider = None if self.collider is None else _moved(self.collider, move)
        return Meshes(_moved(self.surface, move), collider, self.stays)


def open_meshes(surface: Path | None, collider: Path | None, source: Source) -> Meshes | None:
    """Read the meshes of a scene.

    Args:
        surface: The file of the surface, in the coordinates of the capture, as `gsplat-edu mesh` writes it.
        collider: The file of the collider in the same coordinates; None for none.
        source: The scene, whose origin is subtracted. Its unit decides that of the coordinates, if a file has one.

    Returns:
        The meshes in the coordinates of the scene; None without a surface.

    Raises:
        ArgumentError: there is a collider only, a file is of no known format, or they have more than `PAGE_FACES`
            faces.
        SceneFormatError: a file is damaged.
        OSError: a file cannot be read.
    """
    if surface is None:
        if collider is not None:
            raise ArgumentError("--collider: is shown with a surface; add --surface FILE")
        return None
    found, faces = [], 0
    for file in (surface,) if collider is None else (surface, collider):
        mesh = read_mesh(file, source.scene.unit)
        faces += len(mesh.faces)
        if faces > PAGE_FACES:
            raise ArgumentError(
                f"{file}: a page holds at most {PAGE_FACES:,} triangles, but this makes {faces:,};"
                " make a smaller one with gsplat-edu mesh --faces"
            )
        found.append(replace(mesh, vertices=mesh.vertices - np.array(source.origin)))
    return Meshes(found[0], found[1] if len(found) > 1 else None)


def packed(meshes: Meshes) -> tuple[list[dict[str, Any]], bytes]:
    """Pack meshes.

    Returns:
        The entry "meshes" of the page's facts, one for the surface and one for the collider; and their bytes. Colours
        are rounded to 8 bits and positions to float32.
    """
    entries, parts = [], []
    for name, mesh in (("surface", meshes.surface), ("collider", meshes.collider)):
        if mesh is None:
            continue
        entry, data = _packed(mesh)
        entries.append({"name": name, **entry} | ({"stays": True} if meshes.stays else {}))
        parts += data
    return entries, b"".join(parts)


def _packed(mesh: Mesh) -> tuple[dict[str, Any], list[bytes]]:
    """Return the facts of one mesh, and its arrays in their order."""
    origin, faces, uvs = split_at_seams(mesh)
    positions = mesh.vertices[origin].astype("<f4")
    if not np.isfinite(positions).all():
        raise ArgumentError("--surface: a coordinate is beyond float32, which a page stores")
    arrays, coloring, image = [positions.tobytes()], "none", b""
    if mesh.texture is not None and uvs is not None:
        coloring, image = "texture", encoded(mesh.texture.image)
        arrays.append(uvs.astype("<f4").tobytes())
    elif mesh.colors is not None:
        rgba = np.full((len(origin), 4), 255, np.uint8)
        rgba[:, :3] = np.rint(255 * np.clip(mesh.colors[origin], 0, 1))
        coloring = "vertices"
        arrays.append(rgba.tobytes())
    arrays += [faces.astype("<u4").tobytes(), image + b"\0" * (-len(image) % 4)]
    facts = {"vertices": len(origin), "faces": len(faces), "coloring": coloring, "image": len(image)}
    return facts, arrays


def _moved(mesh: Mesh, move: Similarity) -> Mesh:
    return replace(mesh, vertices=move.s * mesh.vertices @ move.R.T + move.t)

"""A triangle mesh: vertices and faces, with colours per vertex or a texture."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Float32, Float64, Int64, UInt8

from gsplat_edu.base.errors import ArgumentError


@dataclass(frozen=True, eq=False)
class Texture:
    """An image on a mesh.

    Args:
        image: (h, w, 3) sRGB.
        uvs: (F, 3, 2) place of each corner of each face in the image, 0 to 1; (0, 0) is the top left corner.
    """

    image: UInt8[np.ndarray, "h w 3"]
    uvs: Float32[np.ndarray, "F 3 2"]


@dataclass(frozen=True, eq=False)
class Mesh:
    """A triangle mesh, in the frame of its scene.

    Args:
        vertices: (V, 3) world units.
        faces: (F, 3) indices of vertices, counterclockwise as seen from outside.
        colors: (V, 3) sRGB, 0 to 1; None if there are none.
        texture: The image on it, or None.

    Raises:
        ArgumentError: a face names a vertex that does not exist, a coordinate is NaN or infinite, or there are not as
            many colours as vertices, or uvs as faces.
    """

    vertices: Float64[np.ndarray, "V 3"]
    faces: Int64[np.ndarray, "F 3"]
    colors: Float32[np.ndarray, "C 3"] | None = None
    texture: Texture | None = None

    def __post_init__(self) -> None:
        """Check indices, coordinates and numbers."""
        count = len(self.vertices)
        if not np.isfinite(self.vertices).all():
            raise ArgumentError("vertices: have a coordinate that is NaN or infinite")
        if self.faces.size and not 0 <= self.faces.min() <= self.faces.max() < count:
            raise ArgumentError(
                f"faces: name vertices {self.faces.min()} to {self.faces.max()}, but there are {count}"
            )
        if self.colors is not None and len(self.colors) != count:
            raise ArgumentError(f"colors: are {len(self.colors)}, but there are {count} vertices")
        if self.texture is not None and len(self.texture.uvs) != len(self.faces):
            raise ArgumentError(f"texture: has {len(self.texture.uvs)} uvs for {len(self.faces)} faces")

    def __repr__(self) -> str:
        """Say how many vertices and faces there are, and what they carry."""
        extras = [field.name for field in fields(self)[2:] if getattr(self, field.name) is not None]
        carried = "".join(f", {name}" for name in extras)
        return f"Mesh({len(self.vertices)} vertices, {len(self.faces)} faces{carried})"

    @property
    def corners(self) -> Float64[np.ndarray, "F 3 3"]:
        """(F, 3, 3) the positions of every face's vertices."""
        return np.asarray(self.vertices[self.faces])

    def face_normals(self) -> Float64[np.ndarray, "F 3"]:
        """(F, 3) outward normals, as long as twice the face's area."""
        a, b, c = np.moveaxis(self.corners, 1, 0)
        return np.asarray(np.cross(b - a, c - a))

    def summed_normals(self) -> Float64[np.ndarray, "V 3"]:
        """Return the sum of `face_normals` over the faces of each vertex; zero at unused vertices."""
        sums, normals = np.zeros_like(self.vertices), self.face_normals()
        for corner in range(3):
            for axis in range(3):
                sums[:, axis] += np.bincount(self.faces[:, corner], normals[:, axis], len(sums))
        return sums

    def used(self) -> Mesh:
        """Return the mesh without the vertices that no face names; the order of the others stays."""
        kept = np.zeros(len(self.vertices), dtype=bool)
        kept[self.faces.ravel()] = True
        index = np.cumsum(kept) - 1
        colors = None if self.colors is None else self.colors[kept]
        return Mesh(self.vertices[kept], index[self.faces], colors, self.texture)

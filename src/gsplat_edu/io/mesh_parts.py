"""What mesh formats share: polygons of a file become a mesh or one line says what is wrong, and parts of writers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from jaxtyping import Float32, Float64, Int64

from gsplat_edu.base.errors import ArgumentError, SceneFormatError
from gsplat_edu.base.headroom import require_memory
from gsplat_edu.base.reading import TOO_LARGE
from gsplat_edu.io.axes import POSITION_SIGNS, root_transform
from gsplat_edu.io.scene import SceneFrame, extras
from gsplat_edu.scene.earth import Earth
from gsplat_edu.scene.frame import Vector, as_origin, origin_of
from gsplat_edu.scene.mesh import Mesh
from gsplat_edu.scene.polygons import triangles_of

MOST_CORNERS = 256
"""Most corners of a face. Cutting a larger polygon into triangles takes long."""

LARGEST_COORDINATE = 1e30
"""Larger coordinates are damage, and areas of their triangles would overflow."""

TRIANGLE_BYTES = 200
"""Peak memory for each corner of a polygon while it is cut."""

METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001}
"""Metres in one unit of a scene's coordinates; the keys are `gsplat_edu.scene.frame.UNITS`."""


@dataclass(frozen=True, eq=False)
class StoredMesh:
    """The contents of a mesh file.

    Args:
        mesh: The mesh, in this package's axes.
        unit: Unit of its coordinates, "m", "cm" or "mm"; None if the file does not say.
        earth: Where on earth its coordinates are; None if the file does not say.
    """

    mesh: Mesh
    unit: str | None = None
    earth: Earth | None = None


@dataclass(frozen=True, eq=False)
class Polygons:
    """The faces of a file.

    Args:
        sizes: (P,) number of corners of each.
        corners: (C,) vertices of all faces, one face after the other.
        place: Returns where in the file a face is, for example "face 7".
    """

    sizes: Int64[np.ndarray, " P"]
    corners: Int64[np.ndarray, " C"]
    place: Callable[[int], str]


def refuse(path: Path, fault: str) -> NoReturn:
    """Raise a SceneFormatError that names the file and its fault."""
    raise SceneFormatError(f"{path}: {fault}; export it again")


def check_vertices(path: Path, vertices: Float64[np.ndarray, "V 3"], place: Callable[[int], str]) -> None:
    """Refuse coordinates that are NaN, infinite or absurdly large.

    Args:
        path: The file, for messages.
        vertices: (V, 3) coordinates.
        place: Returns where in the file a vertex is.

    Raises:
        SceneFormatError: there is one; names the first.
    """
    bad = ~(np.abs(vertices) <= LARGEST_COORDINATE).all(axis=1)
    if bad.any():
        row = int(bad.argmax())
        values = ", ".join(f"{value:g}" for value in vertices[row])
        refuse(path, f"{place(row)} is at ({values}), which is no position")


def triangles_in(
    path: Path, vertices: Float64[np.ndarray, "V 3"], polygons: Polygons
) -> Int64[np.ndarray, "F 3"]:
    """Cut the faces of a file into triangles.

    Args:
        path: The file, for messages.
        vertices: (V, 3) finite coordinates.
        polygons: The faces.

    Returns:
        (F, 3) places in `polygons.corners`, face after face.

    Raises:
        SceneFormatError: there are no faces, or one has fewer than 3 or too many corners, or names a vertex that does
            not exist; names the first.
        NotEnoughMemoryError: the triangles would not fit into memory.
    """
    sizes, corners = polygons.sizes, polygons.corners
    if not len(sizes):
        refuse(path, "has no faces: it is a point cloud, not a mesh")
    require_memory(str(path), TRIANGLE_BYTES * len(corners), TOO_LARGE)
    starts = np.cumsum(sizes) - sizes
    odd = (sizes < 3) | (sizes > MOST_CORNERS)
    if odd.any():
        face = int(odd.argmax())
        refuse(path, f"{polygons.place(face)} has {sizes[face]} corners; a face needs 3 to {MOST_CORNERS}")
    wrong = (corners < 0) | (corners >= len(vertices))
    if wrong.any():
        corner = int(wrong.argmax())
        face = int(np.searchsorted(starts, corner, side="right")) - 1
        named = f"names vertex {corners[corner]}, but there are {len(vertices)}, counted from 0"
        refuse(path, f"{polygons.place(face)} {named}")
    parts, owners = [], []
    for size, rule in ((3, _as_it_is), (4, _quads)):
        chosen = np.flatnonzero(sizes == size)
        rings = starts[chosen, None] + np.arange(size)
        cut = rule(vertices, corners, rings)
        parts.append(cut.reshape(-1, 3))
        owners.append(np.repeat(chosen, size - 2))
    for face in np.flatnonzero(sizes > 4).tolist():
        ring = np.arange(starts[face], starts[face] + sizes[face])
        parts.append(ring[triangles_of(vertices[corners[ring]])])
        owners.append(np.full(len(ring) - 2, face))
    order = np.argsort(np.concatenate(owners), kind="stable")
    return np.asarray(np.concatenate(parts)[order], dtype=np.int64)


def _as_it_is(
    vertices: Float64[np.ndarray, "V 3"], corners: Int64[np.ndarray, " C"], rings: Int64[np.ndarray, "P 3"]
) -> Int64[np.ndarray, "P 3"]:
    return rings


def _quads(
    vertices: Float64[np.ndarray, "V 3"], corners: Int64[np.ndarray, " C"], rings: Int64[np.ndarray, "P 4"]
) -> Int64[np.ndarray, "P 2 3"]:
    """Cut quadrilaterals along the diagonal from their first corner, or the other one if the first lies outside."""
    a, b, c, d = np.moveaxis(vertices[corners[rings]], 1, 0)
    whole = np.cross(c - a, d - b)
    first = (np.cross(b - a, c - a) * whole).sum(axis=1) >= 0.0
    first &= (np.cross(c - a, d - a) * whole).sum(axis=1) >= 0.0
    one = rings[:, [[0, 1, 2], [0, 2, 3]]]
    other = rings[:, [[0, 1, 3], [1, 2, 3]]]
    return np.asarray(np.where(first[:, None, None], one, other))


def numbers_in(path: Path, words: Sequence[str], line: int) -> list[float]:
    """Parse numbers of a text file.

    Args:
        path: The file, for messages.
        words: The numbers' texts.
        line: The number of their line.

    Raises:
        SceneFormatError: one is not a number; a decimal comma is named as such.
    """
    try:
        return [float(word) for word in words]
    except ValueError:
        return [_number(path, word, f"line {line}") for word in words]


def _number(path: Path, word: str, place: str) -> float:
    try:
        return float(word)
    except ValueError:
        pass
    if word.count(",") == 1 and word.replace(",", "").lstrip("+-").isdecimal():
        refuse(path, f"{place}: {word[:40]!r} has a decimal comma, where a decimal point should be")
    refuse(path, f"{place}: {word[:40]!r} is not a number")


def eight_bits(colors: Float32[np.ndarray, "V 3"]) -> np.ndarray:
    """Return colours from 0 to 1 as (V, 3) uint8, rounded; values outside are clamped."""
    return np.asarray(np.rint(np.clip(colors, 0.0, 1.0) * np.float32(255.0)), np.uint8)


def distinct_rows(*columns: np.ndarray) -> tuple[Int64[np.ndarray, " M"], Int64[np.ndarray, " N"]]:
    """Find equal rows of a table.

    Args:
        columns: (N,) columns of numbers; rows are ordered by the first, then by the next.

    Returns:
        (M,) the first row of each group of equal ones, in the order of their values, and (N,) the group of each row.
    """
    order = np.lexsort(columns[::-1])
    new = np.ones(len(order), dtype=bool)
    new[1:] = False
    for column in columns:
        ordered = column[order]
        new[1:] |= ordered[1:] != ordered[:-1]
    group = np.empty(len(order), np.int64)
    group[order] = np.cumsum(new) - 1
    return order[new].astype(np.int64), group


def split_at_seams(
    mesh: Mesh,
) -> tuple[Int64[np.ndarray, " N"], Int64[np.ndarray, "F 3"], Float32[np.ndarray, "N 2"] | None]:
    """Repeat vertices until each has one texture coordinate.

    Returns:
        For each resulting vertex, the index of the mesh's vertex that it repeats; the faces among the resulting
        vertices; the texture coordinates, None without a texture.
    """
    if mesh.texture is None:
        return np.arange(len(mesh.vertices)), mesh.faces, None
    corners, uvs = mesh.faces.ravel(), mesh.texture.uvs.reshape(-1, 2)
    first, group = distinct_rows(corners, uvs[:, 0], uvs[:, 1])
    return corners[first], group.reshape(-1, 3), uvs[first]


@dataclass(frozen=True, eq=False)
class Placement:
    """Where a y-up file shows a mesh: in metres if its unit is known, with its up direction as y.

    Args:
        unit: Unit of the mesh's coordinates, "m", "cm" or "mm"; None if unknown, which leaves their size.
        up: Its up direction, in this package's axes; None if unknown, which turns nothing.
        origin: Subtracted from its vertices, in double, so that float32 resolves them.
        earth: Where on earth its coordinates are; None if unknown.
    """

    unit: str | None
    up: Vector | None
    origin: Vector
    earth: Earth | None

    @classmethod
    def of(
        cls,
        vertices: Float64[np.ndarray, "V 3"],
        unit: str | None,
        up: Vector | None,
        earth: Earth | None = None,
    ) -> Placement:
        """Return the placement of vertices; their origin is `gsplat_edu.scene.frame.origin_of`."""
        return cls(unit, up, as_origin("vertices", origin_of(vertices)), earth)

    @property
    def metres(self) -> float:
        """Metres in one unit of the coordinates; 1 if the unit is unknown."""
        return METRES.get(self.unit or "m", 1.0)

    @property
    def root(self) -> tuple[Float64[np.ndarray, "3 3"], Float64[np.ndarray, "3"]]:
        """Rotation and translation of the file's root, in its axes and its unit."""
        turn, shift = root_transform(self.up, self.origin)
        return turn, self.metres * shift

    @property
    def stated(self) -> dict[str, Any]:
        """What the file states as JSON about the coordinates that it has once a known unit is the metre."""
        earth = None if self.earth is None else self.earth.after(np.diag([*3 * [1.0 / self.metres], 1.0]))
        return extras(SceneFrame(self.up, self.unit and "m", earth=earth))


def turned_positions(
    path: Path, vertices: Float64[np.ndarray, "V 3"], placement: Placement, named: str
) -> Float32[np.ndarray, "V 3"]:
    """Return positions in y-up axes, relative to the root of the file.

    Args:
        path: The file to write, for messages.
        vertices: (V, 3) coordinates in this package's axes.
        placement: Where the file shows them.
        named: The format's name, for messages.

    Raises:
        ArgumentError: a coordinate is beyond float32.
    """
    near = vertices - np.array(placement.origin)
    turned = near * np.array(POSITION_SIGNS) * placement.metres + 0.0  # no -0.0
    with np.errstate(over="ignore"):
        positions: Float32[np.ndarray, "V 3"] = turned.astype("<f4")
    if not np.isfinite(positions).all():
        raise ArgumentError(f"{path}: a coordinate is beyond float32, which {named} uses; write a .ply")
    return positions


def vertex_normals(mesh: Mesh) -> Float64[np.ndarray, "V 3"]:
    """Return normals of length 1, averaged over the faces of a vertex by area; of unused vertices, the z axis."""
    sums = mesh.summed_normals()
    lengths = np.linalg.norm(sums, axis=1, keepdims=True)
    usable = lengths[:, 0] > np.finfo(np.float64).tiny
    return np.where(usable[:, None], sums / np.where(usable[:, None], lengths, 1.0), [0.0, 0.0, 1.0])

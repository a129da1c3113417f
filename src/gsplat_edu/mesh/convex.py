"""Cut a mesh into convex parts, which physics engines collide much faster than triangles.

CoACD cuts the mesh by planes until the hull of each piece is close to the piece. It needs the boundary of a solid.
Holes of an object, for example below it, are closed. Any other open mesh, for example a room, is replaced by a thin
closed shell around it, which becomes more parts and takes longer. The parts are the hulls of the pieces. Hulls are
larger than their pieces, so the parts cover a closed mesh up to the vertices that a hull gives up to stay small.

Source: Wei et al., "Approximate Convex Decomposition for 3D Meshes with Collision-Aware Concavity and Tree Search",
SIGGRAPH 2022.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64
from scipy.spatial import ConvexHull, QhullError

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.text import install_command
from gsplat_edu.base.validation import in_range, whole_number
from gsplat_edu.evaluate.surface import triangle_distances
from gsplat_edu.evaluate.topology import topology
from gsplat_edu.mesh.coacd_process import cut
from gsplat_edu.mesh.topology import boundary_loops, edge_ends, separated
from gsplat_edu.scene.mesh import Mesh

SHELL_CELLS = 30
"""Cells along the longest side of the grid in which an open mesh becomes a closed shell."""

LARGEST_CAPS = 0.4
"""Holes are closed if caps are no more than this share of the area (those of half a ball are a third, those of a sheet
half), and the surface then encloses a positive volume."""

SEARCH = {"mcts_nodes": 10, "mcts_iterations": 40, "mcts_max_depth": 2}
"""Effort of the search for each cut; CoACD's defaults took twice as long for as many parts of a torus."""

PROBES = 16_384
"""Points by which volumes are compared."""

SPREAD = 1.0 / 1.2207440846057596 ** np.arange(1, 4)
"""Steps of the points along the sides of their box: no plane holds many of them. The number is the root of
x^4 = x + 1 (Roberts 2018, "The unreasonable effectiveness of quasirandom sequences")."""

PAIRS = 1 << 18
"""Pairs of a point and a face whose solid angles are computed at a time."""

ROWS = 256
"""Points whose distances to all triangles of the parts are computed at a time."""


@dataclass(frozen=True)
class ConvexSettings:
    """How a mesh is cut into convex parts.

    Args:
        concavity: A piece is cut no further if its hull is so close to it, as a share of the mesh's size; 0.01 to 1.
        vertices: Most vertices of a part; physics engines often allow 64 to 256.
        seed: Seed of the search for cuts.

    Raises:
        ArgumentError: a number is out of range.
    """

    concavity: float = 0.05
    vertices: int = 64
    seed: int = 0

    def __post_init__(self) -> None:
        """Check the ranges."""
        in_range("concavity", self.concavity, 0.01, 1.0)
        whole_number("vertices", self.vertices, 8)
        whole_number("seed", self.seed, 0)


def convex_parts(mesh: Mesh, settings: ConvexSettings | None = None) -> list[Mesh]:
    """Return convex parts that together cover a mesh, without colours.

    The same mesh gives the same parts, for any number of threads.

    Args:
        mesh: The mesh, of at least one face. A few thousand faces take seconds; decimate larger meshes first.
        settings: How far it is cut; None for the defaults.

    Raises:
        ArgumentError: CoACD is not installed or fails, or the mesh has no faces, or is so flat that no part has a
            volume.
    """
    settings = ConvexSettings() if settings is None else settings
    if not len(mesh.faces):
        raise ArgumentError("mesh: has no faces to cut into convex parts")
    if find_spec("coacd") is None:
        raise ArgumentError(f"convex parts: need coacd, which is not installed: {install_command('mesh')}")
    solid, closed = _solid(separated(mesh))
    centre = solid.vertices.mean(axis=0)
    scale = float(np.abs(solid.vertices - centre).max()) or 1.0
    pieces = cut(
        Mesh((solid.vertices - centre) / scale, solid.faces),
        {
            "threshold": settings.concavity,
            "preprocess_mode": "off" if closed else "on",
            "preprocess_resolution": SHELL_CELLS,
            "decimate": True,
            "max_ch_vertex": settings.vertices,
            "seed": settings.seed,
            **SEARCH,
        },
    )
    hulls = [_hull(points * scale + centre) for points in pieces]
    parts = [hull for hull in hulls if hull is not None]
    if not parts:
        raise ArgumentError(
            "mesh: is flat, so no convex part of it has a volume; write its triangles instead"
        )
    return parts


def _solid(mesh: Mesh) -> tuple[Mesh, bool]:
    """Close the holes of an object; return the mesh, and whether it is the outer boundary of a solid."""
    start, end = edge_ends(mesh.faces)
    vertices, faces = [mesh.vertices], [mesh.faces]
    for number, loop in enumerate(boundary_loops(mesh), len(mesh.vertices)):
        vertices.append(mesh.vertices[start[loop]].mean(axis=0, keepdims=True))
        faces.append(np.stack([end[loop], start[loop], np.full(len(loop), number)], axis=1))
    capped = Mesh(np.concatenate(vertices), np.concatenate(faces))
    shape = topology(capped)
    outward = shape.closed and shape.volume is not None and shape.volume > 0.0
    if outward and shape.area - topology(mesh).area <= LARGEST_CAPS * shape.area:
        return capped, True
    return mesh, False


def _hull(points: Float64[np.ndarray, "N 3"]) -> Mesh | None:
    """Return the convex hull of points, its faces outward; None if it has no volume."""
    if len(points) < 4:
        return None
    try:
        hull = ConvexHull(points)
    except QhullError:
        return None
    faces = hull.simplices.astype(np.int64)
    corners = points[faces]
    facing = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    inward = (facing * hull.equations[:, :3]).sum(axis=1) < 0.0
    faces[inward] = faces[inward][:, ::-1]
    return Mesh(points, faces).used()


def farthest_outside(points: Float64[np.ndarray, "N 3"], parts: Sequence[Mesh]) -> float:
    """Return how far the points lie outside of all parts at most, world units; 0 if each is inside of one.

    Args:
        points: (N, 3) points.
        parts: Convex parts, at least one, their faces outward.
    """
    left = points[_outside(points, parts)]
    triangles = np.concatenate([part.corners for part in parts])
    farthest = 0.0
    for start in range(0, len(left), ROWS):
        rows = left[start : start + ROWS]
        pairs = np.repeat(rows, len(triangles), axis=0)
        distances = triangle_distances(pairs, np.tile(triangles, (len(rows), 1, 1)))
        farthest = max(farthest, float(distances.reshape(len(rows), -1).min(axis=1).max()))
    return farthest


class ConvexFit(NamedTuple):
    """How convex parts differ from the mesh that they stand for.

    Args:
        outside: Distance by which a vertex of the mesh lies outside of all parts at most, world units.
        filled: Volume inside the parts and outside of the mesh: empty space where things collide. A share of the
            parts' volume, 0 to 1; None if the mesh is open and encloses nothing.
        uncovered: Volume inside the mesh and outside of the parts, as a share of the mesh's; likewise None.
    """

    outside: float
    filled: float | None
    uncovered: float | None


def fit_of(mesh: Mesh, parts: Sequence[Mesh]) -> ConvexFit:
    """Compare convex parts with their mesh, whose holes are closed as `convex_parts` closes them.

    Volumes are counts of `PROBES` points that fill the box around both evenly, the same for every call: their error is
    less than 1 % of the box.

    Args:
        mesh: The mesh.
        parts: Its convex parts, at least one, their faces outward.
    """
    outside = farthest_outside(mesh.vertices, parts)
    solid, closed = _solid(separated(mesh))
    if not closed:
        return ConvexFit(outside, None, None)
    corners = np.concatenate([solid.vertices, *(part.vertices for part in parts)])
    low, high = corners.min(axis=0), corners.max(axis=0)
    points = low + (high - low) * (np.arange(1, PROBES + 1)[:, None] * SPREAD % 1.0)
    covered = ~_outside(points, parts)
    within = _inside(points, solid)
    filled = float((covered & ~within).sum()) / max(int(covered.sum()), 1)
    uncovered = float((within & ~covered).sum()) / max(int(within.sum()), 1)
    return ConvexFit(outside, filled, uncovered)


def _outside(points: Float64[np.ndarray, "N 3"], parts: Sequence[Mesh]) -> Bool[np.ndarray, " N"]:
    """Return which points lie outside of all parts."""
    outside = np.ones(len(points), dtype=bool)
    for part in parts:
        normals, corner = part.face_normals(), part.corners[:, 0]
        rows = np.flatnonzero(outside)
        heights = points[rows] @ normals.T - (normals * corner).sum(axis=1)
        outside[rows] = (heights > 0.0).any(axis=1)
    return outside


def _inside(points: Float64[np.ndarray, "N 3"], solid: Mesh) -> Bool[np.ndarray, " N"]:
    """Return which points a closed mesh encloses, by the solid angle of its faces: 4 pi inside, 0 outside.

    tan(angle / 2) = a · (b x c) / (|a| |b| |c| + (a · b) |c| + (b · c) |a| + (c · a) |b|) with the corners a, b, c seen
    from the point (van Oosterom and Strackee 1983).
    """
    inside = np.zeros(len(points), dtype=bool)
    rows = max(PAIRS // max(len(solid.faces), 1), 1)
    for start in range(0, len(points), rows):
        seen = solid.corners[None] - points[start : start + rows, None, None]
        lengths = np.linalg.norm(seen, axis=-1)
        a, b, c = np.moveaxis(seen, 2, 0)
        p, q, r = np.moveaxis(lengths, 2, 0)
        triple = np.einsum("nfd,nfd->nf", a, np.cross(b, c))
        ab, bc, ca = (np.einsum("nfd,nfd->nf", *pair) for pair in ((a, b), (b, c), (c, a)))
        angles = 2.0 * np.arctan2(triple, p * q * r + ab * r + bc * p + ca * q)
        inside[start : start + rows] = angles.sum(axis=1) > 2.0 * np.pi
    return inside

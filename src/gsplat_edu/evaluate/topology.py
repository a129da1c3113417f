"""The connectivity of a triangle mesh: boundary edges, components, genus, area and volume."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Int64
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from gsplat_edu.scene.mesh import Mesh


@dataclass(frozen=True)
class Topology:
    """The connectivity and size of a mesh.

    Vertices are the same if their index is the same: corners that only share a position are not connected. Faces that
    name a vertex twice have no area and are left out.

    Args:
        vertices: Number of vertices that a face names.
        edges: Number of edges, each counted once.
        faces: Number of faces.
        components: Number of connected parts. Faces that share a vertex are connected.
        boundary_edges: Edges of one face only; 0 for a closed surface.
        boundary_loops: Holes: closed chains of boundary edges. None if three boundary edges meet at a vertex.
        non_manifold_edges: Edges of three faces or more.
        non_manifold_vertices: Vertices whose faces form more than one fan, like the tip that two cones share.
        flipped_edges: Edges whose two faces are oriented oppositely: one of them shows its inside.
        euler: Euler characteristic, vertices - edges + faces; 2 for a closed surface without handles.
        genus: Number of handles of all components together; holes count as filled. None if the mesh is not an
            oriented manifold.
        area: Sum of the faces' areas, square world units.
        volume: Enclosed volume, cubic world units, negative if the faces show their inside. None if the mesh is not a
            closed oriented manifold.
    """

    vertices: int
    edges: int
    faces: int
    components: int
    boundary_edges: int
    boundary_loops: int | None
    non_manifold_edges: int
    non_manifold_vertices: int
    flipped_edges: int
    euler: int
    genus: int | None
    area: float
    volume: float | None

    @property
    def manifold(self) -> bool:
        """Whether the faces around each edge and each vertex form one sheet, consistently oriented."""
        return self.non_manifold_edges + self.non_manifold_vertices + self.flipped_edges == 0

    @property
    def closed(self) -> bool:
        """Whether the mesh is the boundary of a solid: an oriented manifold without boundary, and not empty."""
        return self.faces > 0 and self.manifold and self.boundary_edges == 0


class _HalfEdges(NamedTuple):
    """The directed edges of all faces, sorted so that those of one edge follow one another."""

    start: Int64[np.ndarray, " E"]
    end: Int64[np.ndarray, " E"]
    corner: Int64[np.ndarray, " E"]  # 3 * face + place of the start in the face
    following: Int64[np.ndarray, " E"]  # the same for the end
    edge: Int64[np.ndarray, " E"]  # number of the undirected edge

    @classmethod
    def of(cls, faces: Int64[np.ndarray, "F 3"]) -> _HalfEdges:
        start, end = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
        corner = np.arange(len(start))
        following = np.roll(corner.reshape(-1, 3), -1, axis=1).ravel()
        key = np.minimum(start, end) * (int(faces.max(initial=0)) + 1) + np.maximum(start, end)
        order = np.argsort(key)
        new = np.ones(len(order), dtype=bool)
        new[1:] = np.diff(key[order]) != 0
        return cls(start[order], end[order], corner[order], following[order], np.cumsum(new) - 1)


def topology(mesh: Mesh) -> Topology:
    """Measure the connectivity of a mesh.

    Args:
        mesh: The mesh; it may be empty.
    """
    faces = mesh.faces.astype(np.int64)
    a, b, c = faces.T
    faces = faces[(a != b) & (b != c) & (c != a)]
    named = np.zeros(int(faces.max(initial=-1)) + 1, dtype=bool)
    named[faces.ravel()] = True
    used = np.flatnonzero(named)
    faces = (np.cumsum(named) - 1)[faces]
    half = _HalfEdges.of(faces)
    uses = np.bincount(half.edge, minlength=0)
    first = np.cumsum(uses) - uses
    pairs = first[uses == 2]
    flipped = int((half.start[pairs] == half.start[pairs + 1]).sum())
    lone = first[uses == 1]
    loops = _loops(half.start[lone], half.end[lone], len(used))
    components = _components(half.start, half.end, len(used))
    fans = _fans(half, faces)
    broken = int((uses > 2).sum()), int((fans > 1).sum())
    euler = len(used) - len(uses) + len(faces)
    oriented = not (broken[0] or broken[1] or flipped)
    area = 0.5 * float(np.linalg.norm(mesh.face_normals(), axis=1).sum())
    return Topology(
        vertices=len(used),
        edges=len(uses),
        faces=len(faces),
        components=components,
        boundary_edges=len(lone),
        boundary_loops=loops,
        non_manifold_edges=broken[0],
        non_manifold_vertices=broken[1],
        flipped_edges=flipped,
        euler=euler,
        genus=components - (euler + loops) // 2 if oriented and loops is not None else None,
        area=area,
        volume=_volume(mesh) if oriented and not len(lone) and len(faces) else None,
    )


def _components(start: Int64[np.ndarray, " E"], end: Int64[np.ndarray, " E"], count: int) -> int:
    """Return the number of components of a graph of `count` nodes."""
    if count == 0:
        return 0
    graph = coo_array((np.ones(len(start), np.int8), (start, end)), shape=(count, count))
    return int(connected_components(graph, directed=False)[0])


def _loops(start: Int64[np.ndarray, " E"], end: Int64[np.ndarray, " E"], count: int) -> int | None:
    """Return the number of loops of the boundary edges; None if they meet other than two at a vertex."""
    meeting = np.bincount(np.concatenate([start, end]), minlength=count)
    if np.any((meeting != 0) & (meeting != 2)):
        return None
    return _components(start, end, count) - int((meeting == 0).sum())


def _fans(half: _HalfEdges, faces: Int64[np.ndarray, "F 3"]) -> Int64[np.ndarray, " V"]:
    """Return for each vertex the number of fans of its faces: corners joined by a shared edge are in one fan."""
    if len(faces) == 0:
        return np.zeros(0, np.int64)
    joined = np.flatnonzero(np.diff(half.edge) == 0)
    along = half.start[joined] == half.start[joined + 1]
    here, there = half.corner[joined], half.following[joined]
    links_from = np.concatenate([here, there])
    links_to = np.concatenate(
        [
            np.where(along, half.corner[joined + 1], half.following[joined + 1]),
            np.where(along, half.following[joined + 1], half.corner[joined + 1]),
        ]
    )
    size = faces.size
    graph = coo_array((np.ones(len(links_from), np.int8), (links_from, links_to)), shape=(size, size))
    count, label = connected_components(graph, directed=False)
    vertex_of = np.zeros(count, np.int64)
    vertex_of[label] = faces.ravel()
    return np.bincount(vertex_of).astype(np.int64)


def _volume(mesh: Mesh) -> float:
    """Return the signed volume; the origin is moved to the mesh, so that a distant mesh loses no digits."""
    middle = mesh.vertices[mesh.faces[0, 0]]
    a, b, c = np.moveaxis(mesh.corners - middle, 1, 0)
    return float((a * np.cross(b, c)).sum() / 6.0)

"""Tidy a mesh: drop spoiled faces and small components, fill small holes, reduce the number of faces.

Each step returns a new mesh, the same bytes for the same input.

Holes: a boundary loop is filled if it is short, at most 5 % of the diagonal of the mesh, or if it has at most 12 edges
and is at most 25 % of the diagonal. Everything larger stays open: a room keeps its door. A loop is no hole if the
surface that fills it would face the other way than the faces around it: that is the rim of a patch or of a dish.

Decimation collapses edges by their quadric error (Garland and Heckbert 1997) with fast-simplification, which does not
check that the result is manifold. On noisy marching cubes it left up to 32 edges with more than two faces in 5,000
faces, nearly all by pairs of faces back to back, and now and then a face that is turned over. Both are repaired here.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64, UInt64
from scipy.spatial import cKDTree

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.text import install_command
from gsplat_edu.mesh.smooth import ROUNDS, smoothed
from gsplat_edu.mesh.topology import (
    boundary_loops,
    component_labels,
    edge_ends,
    mean_edge,
    opposite_half_edges,
    separated,
    unit,
    vertex_normals,
)
from gsplat_edu.scene.mesh import Mesh, Texture
from gsplat_edu.scene.polygons import area_vector, has_plain_fan, least_area_triangles

SMALLEST_SHARE = 0.01
"""Components with a smaller share of the whole area are dropped."""

FEW_EDGES, SHORT_LOOP, LONGEST_LOOP = 12, 0.05, 0.25
"""Fill loops up to SHORT_LOOP of the mesh's diagonal, and those of up to FEW_EDGES edges up to LONGEST_LOOP of it."""

MOST_LOOP_EDGES = 256
"""Loops with more edges are left open unless a fan fills them: other fillings take too long."""

FLATTEST = 1e-10
"""A face whose height is less than this share of its longest edge has no area."""

AGGRESSIVENESS = (7.0, 5.0, 4.0)
"""How fast fast-simplification raises its threshold. The next value is tried if a face is turned over."""

NEAREST_FACES = 8
"""A face is turned over if it opposes all of so many faces of the original mesh that are nearest."""

SMOOTHINGS = 20
"""Most rounds of moving the vertices of faces that are turned over."""

_one_at_a_time = threading.Lock()  # fast-simplification keeps its mesh in variables of the module


@dataclass(frozen=True)
class TidySettings:
    """How `tidied` tidies a mesh.

    Args:
        share: Components with a smaller share of the area are dropped; 0 keeps all.
        largest: Keep the largest component only.
        holes: Fill small holes.
        smoothing: Rounds of `gsplat_edu.mesh.smooth.smoothed`; 0 for none.
        faces: Most faces of the result, by decimation; None leaves their number as it is.
    """

    share: float = SMALLEST_SHARE
    largest: bool = False
    holes: bool = True
    smoothing: int = ROUNDS
    faces: int | None = None


def tidied(
    mesh: Mesh,
    settings: TidySettings | None = None,
    progress: Callable[[str, int, int], None] = lambda what, done, total: None,
) -> Mesh:
    """Clean a mesh, drop small components, fill small holes, smooth and decimate it, in this order.

    Args:
        mesh: The mesh, without a texture.
        settings: What to do; None for the defaults.
        progress: Called after each step of "tidying", and before and after "simplifying" if there is something to do.

    Returns:
        A manifold mesh. It has no faces if the input has none.

    Raises:
        ArgumentError: a setting is out of range, the mesh has a texture, or fast-simplification is needed and not
            installed.
    """
    settings = TidySettings() if settings is None else settings
    steps: list[Callable[[Mesh], Mesh]] = [
        without_spoiled_faces,
        separated,
        lambda whole: with_large_components(whole, settings.share, settings.largest),
        lambda whole: with_filled_holes(whole) if settings.holes else whole,
        lambda whole: smoothed(whole, settings.smoothing),
    ]
    for done, step in enumerate(steps):
        progress("tidying", done, len(steps))
        mesh = step(mesh)
    progress("tidying", len(steps), len(steps))
    if settings.faces is not None and len(mesh.faces) > settings.faces:
        progress("simplifying", 0, 1)
        # Repairs after decimation cut specks off.
        mesh = with_large_components(decimated(mesh, settings.faces), settings.share, settings.largest)
        progress("simplifying", 1, 1)
    return mesh


def without_spoiled_faces(mesh: Mesh) -> Mesh:
    """Drop faces without area and duplicates, so that a closed mesh stays closed; drop unused vertices.

    Vertices at the same position become one. A face that then names a vertex twice is dropped. Of faces with the same
    vertices, those that face opposite ways are dropped in pairs, and one of the others is kept. A face whose corners
    lie on a line is merged with its neighbour at its longest edge.

    Args:
        mesh: The mesh.
    """
    faces = _representatives(mesh.vertices)[mesh.faces]
    kept = _distinct_faces(faces)
    cleaned = _with_faces(mesh, faces[kept], kept)
    return _without_needles(cleaned).used()


def _representatives(vertices: Float64[np.ndarray, "V 3"]) -> Int64[np.ndarray, " V"]:
    """Return for each vertex the first one at the same position."""
    along = np.argsort(vertices[:, 0], kind="stable")
    same = vertices[along[1:], 0] == vertices[along[:-1], 0]
    shared = np.zeros(len(vertices), dtype=bool)
    shared[along[1:][same]] = shared[along[:-1][same]] = True
    some = np.flatnonzero(shared)  # only these can be at the same position as another
    representative = np.arange(len(vertices))
    if not len(some):
        return representative
    order = some[np.lexsort(vertices[some].T[::-1])]
    new = np.ones(len(order), dtype=bool)
    new[1:] = (vertices[order][1:] != vertices[order][:-1]).any(axis=1)
    first = np.minimum.reduceat(order, np.flatnonzero(new))
    representative[order] = first[np.cumsum(new) - 1]
    return representative


def _with_faces(mesh: Mesh, faces: Int64[np.ndarray, "F 3"], kept: Int64[np.ndarray, " F"]) -> Mesh:
    """Return the mesh with other faces, which have the texture coordinates of its faces `kept`."""
    texture = mesh.texture
    if texture is not None:
        texture = Texture(texture.image, texture.uvs[kept])
    return Mesh(mesh.vertices, faces, mesh.colors, texture)


def _distinct_faces(faces: Int64[np.ndarray, "F 3"]) -> Int64[np.ndarray, " K"]:
    """Return the faces with three different vertices, without duplicates and without pairs that cancel."""
    a, b, c = faces.T
    usable = np.flatnonzero((a != b) & (b != c) & (c != a))
    alone = np.ones(len(usable), dtype=bool)
    sums = (_scattered(a) + _scattered(b) + _scattered(c))[usable]  # equal for faces with the same vertices
    by_sum = np.argsort(sums)
    twin = np.flatnonzero(sums[by_sum[1:]] == sums[by_sum[:-1]])
    alone[by_sum[twin]] = alone[by_sum[twin + 1]] = False
    return np.sort(np.concatenate([usable[alone], _without_twins(faces, usable[~alone])]))


def _scattered(numbers: Int64[np.ndarray, " N"]) -> UInt64[np.ndarray, " N"]:
    """Return numbers of 64 bits that look random, equal for equal numbers (the mixer of SplitMix64)."""
    mixed = numbers.astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15)
    for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB)):
        mixed = (mixed ^ (mixed >> np.uint64(shift))) * np.uint64(factor)
    return np.asarray(mixed ^ (mixed >> np.uint64(31)))


def _without_twins(
    faces: Int64[np.ndarray, "F 3"], usable: Int64[np.ndarray, " U"]
) -> Int64[np.ndarray, " K"]:
    """Return some of the usable faces, without duplicates and without pairs that cancel."""
    if not len(usable):
        return usable
    corners, ordered = faces[usable], np.sort(faces[usable], axis=1)
    a, b, c = corners.T
    even = ((a < b).astype(int) + (b < c) + (c < a)) == 2  # an even permutation of the ordered vertices
    order = np.lexsort((usable, *ordered.T[::-1]))
    new = np.ones(len(order), dtype=bool)
    new[1:] = (ordered[order][1:] != ordered[order][:-1]).any(axis=1)
    group = np.cumsum(new) - 1
    surplus = np.bincount(group, np.where(even[order], 1, -1))  # of those that face one way
    candidate = (surplus[group] != 0) & (even[order] == (surplus[group] > 0))
    _, first = np.unique(group[candidate], return_index=True)
    return np.asarray(usable[order[candidate][first]])


def _without_needles(mesh: Mesh) -> Mesh:
    """Remove faces whose corners lie on a line, each by a flip of its longest edge.

    The other face at this edge is cut at the needle's third corner, so that no crack opens. A needle at the boundary
    is dropped. With a texture, needles stay: the neighbour's coordinates may lie elsewhere in the image.
    """
    faces = mesh.faces.copy()
    for _ in range(8):  # a flip may make another needle
        lengths = np.linalg.norm(mesh.vertices[np.roll(faces, -1, axis=1)] - mesh.vertices[faces], axis=2)
        areas = np.linalg.norm(Mesh(mesh.vertices, faces).face_normals(), axis=1)
        needles = np.flatnonzero(areas <= FLATTEST * lengths.max(axis=1, initial=0.0) ** 2)
        if not len(needles) or mesh.texture is not None:
            break
        opposite = opposite_half_edges(Mesh(mesh.vertices, faces))
        touched: set[int] = set()
        gone = np.zeros(len(faces), dtype=bool)
        for face in needles.tolist():
            edge = 3 * face + int(lengths[face].argmax())
            other = int(opposite[edge])
            if face in touched or other // 3 in touched:
                continue
            if other < 0:
                gone[face] = True
                continue
            tip, far = (int(faces.flat[_next(_next(place))]) for place in (edge, other))
            start, end = int(faces.flat[edge]), int(faces.flat[other])
            touched |= {face, other // 3}
            faces[face], faces[other // 3] = (tip, start, far), (tip, far, end)
        faces = faces[~gone]
        faces = faces[_distinct_faces(faces)]
    return mesh if mesh.texture is not None else Mesh(mesh.vertices, faces, mesh.colors)


def _next(half_edge: int) -> int:
    return half_edge - half_edge % 3 + (half_edge + 1) % 3


def with_large_components(mesh: Mesh, share: float = SMALLEST_SHARE, largest: bool = False) -> Mesh:
    """Drop small components and the vertices that only they use.

    Args:
        mesh: The mesh.
        share: Components with a smaller share of the whole area are dropped, 0 to 1.
        largest: Keep the largest component only; of equal ones the first.

    Raises:
        ArgumentError: the share is out of range.
    """
    if not 0.0 <= share <= 1.0:
        raise ArgumentError(f"share: is {share}, but must be from 0 to 1")
    if not len(mesh.faces):
        return mesh
    labels = component_labels(mesh)
    areas = np.bincount(labels, np.linalg.norm(mesh.face_normals(), axis=1))
    chosen = areas >= share * areas.sum()
    if largest:
        chosen = np.arange(len(areas)) == areas.argmax()
    kept = np.flatnonzero(chosen[labels])
    return _with_faces(mesh, mesh.faces[kept], kept).used()


def with_filled_holes(
    mesh: Mesh, few_edges: int = FEW_EDGES, short: float = SHORT_LOOP, longest: float = LONGEST_LOOP
) -> Mesh:
    """Fill the small holes of a mesh; see this module's docstring for which ones.

    A loop is filled by a fan about its centre, whose colour is the mean of the loop's, if all triangles of the fan
    face the same way; otherwise by the triangles of least area between the loop's vertices. A loop that neither can
    fill without an edge of more than two faces stays open.

    Args:
        mesh: A manifold mesh without a texture.
        few_edges: Loops of at most so many edges may be up to `longest`.
        short: Other loops are filled up to this length.
        longest: Longest loop of few edges. Both lengths are shares of the diagonal of the mesh's bounding box.

    Raises:
        ArgumentError: the mesh has a texture, which says nothing about the new faces.
    """
    _check_untextured(mesh)
    if not len(mesh.faces):
        return mesh
    diagonal = float(np.linalg.norm(np.ptp(mesh.vertices[mesh.faces.ravel()], axis=0)))
    normals = mesh.face_normals()
    start, _ = edge_ends(mesh.faces)
    loops = boundary_loops(mesh)
    patch = _Patch(mesh, np.concatenate([start[loop] for loop in loops]) if loops else start[:0])
    for loop in loops:
        around = start[loop[::-1]]  # new faces lie on the other side of the loop
        ring = mesh.vertices[around]
        length = float(np.linalg.norm(ring - np.roll(ring, -1, axis=0), axis=1).sum())
        limit = max(short, longest) if len(loop) <= few_edges else short
        if len(loop) < 3 or length > limit * diagonal:
            continue
        if float(area_vector(ring) @ normals[loop // 3].sum(axis=0)) > 0.0:
            patch.fill(around, ring)
    return patch.result()


class _Patch:
    """New vertices and faces of a mesh.

    Args:
        mesh: The mesh.
        rim: The vertices of its boundary, which are those between which edges are added.
    """

    def __init__(self, mesh: Mesh, rim: Int64[np.ndarray, " N"]) -> None:
        self._mesh = mesh
        start, end = edge_ends(mesh.faces)
        on_rim = np.zeros(len(mesh.vertices), dtype=bool)
        on_rim[rim] = True
        between = on_rim[start] & on_rim[end]
        start, end = start[between], end[between]
        low, high = np.minimum(start, end).tolist(), np.maximum(start, end).tolist()
        self._edges = set(zip(low, high, strict=True))
        self._vertices: list[Float64[np.ndarray, "1 3"]] = [mesh.vertices]
        self._colors = [] if mesh.colors is None else [mesh.colors]
        self._faces: list[Int64[np.ndarray, "N 3"]] = [mesh.faces]
        self._count = len(mesh.vertices)

    def fill(self, around: Int64[np.ndarray, " N"], ring: Float64[np.ndarray, "N 3"]) -> None:
        """Fill a loop, given by its vertices in the orientation of the new faces, if that is possible."""
        if len(around) > 3 and has_plain_fan(np.concatenate([ring.mean(axis=0)[None], ring, ring[:1]])):
            self._vertices.append(ring.mean(axis=0)[None])
            if self._mesh.colors is not None:
                self._colors.append(self._mesh.colors[around].mean(axis=0)[None])
            centre = np.full(len(around), self._count)
            self._count += 1
            self._faces.append(np.stack([centre, around, np.roll(around, -1)], axis=1))
            return
        if len(around) > MOST_LOOP_EDGES:
            return

        def allowed(i: int, j: int) -> bool:
            a, b = int(around[i]), int(around[j])
            return (min(a, b), max(a, b)) not in self._edges

        triangles = least_area_triangles(ring, allowed)
        if triangles is None:
            return
        faces = around[triangles]
        self._faces.append(faces)
        for a, b in zip(*(ends.tolist() for ends in edge_ends(faces)), strict=True):
            self._edges.add((min(a, b), max(a, b)))

    def result(self) -> Mesh:
        """Return the mesh with all new vertices and faces after its own."""
        colors = np.concatenate(self._colors) if self._colors else None
        return Mesh(np.concatenate(self._vertices), np.concatenate(self._faces), colors)


def decimated(mesh: Mesh, faces: int) -> Mesh:
    """Reduce the number of faces.

    Colours of the new vertices are means over the original vertices that are nearest to them and face the same way.
    The result is manifold if the mesh is, and closed if the mesh is closed.

    Args:
        mesh: The mesh, without a texture.
        faces: Most faces wanted; the result has about as many. A mesh with no more is returned as it is.

    Raises:
        ArgumentError: fewer than 4 faces are wanted, the mesh has a texture, or fast-simplification is not installed.
    """
    _check_untextured(mesh)
    if faces < 4:
        raise ArgumentError(f"faces: is {faces}, but must be at least 4")
    if len(mesh.faces) <= faces:
        return mesh
    best, fewest = None, 0
    for aggressiveness in AGGRESSIVENESS:
        candidate = separated(without_spoiled_faces(_simplified(mesh, faces, aggressiveness)))
        turned = int(flipped_faces(mesh, candidate).sum())
        if best is None or (turned < fewest and len(candidate.faces) <= faces):
            best, fewest = candidate, turned
        if fewest == 0:
            break
    assert best is not None  # there is at least one aggressiveness
    best = _unfolded(mesh, best)
    colors = None if mesh.colors is None else _carried_colors(mesh, mesh.colors, best)
    return Mesh(best.vertices, best.faces, colors)


def require_simplification() -> None:
    """Check that meshes can be decimated.

    Raises:
        ArgumentError: fast-simplification is not installed.
    """
    if find_spec("fast_simplification") is None:
        how = install_command("mesh")
        raise ArgumentError(f"faces: needs fast-simplification, which is not installed: {how}")


def _simplified(mesh: Mesh, faces: int, aggressiveness: float) -> Mesh:
    """Return the result of fast-simplification, without colours."""
    require_simplification()
    import fast_simplification

    centre = mesh.vertices.mean(axis=0)  # its quadrics lose digits far from the origin
    scale = float(np.abs(mesh.vertices - centre).max()) or 1.0
    with _one_at_a_time:
        points, triangles = fast_simplification.simplify(
            np.ascontiguousarray((mesh.vertices - centre) / scale),
            mesh.faces.astype(np.int64),
            target_count=faces,
            agg=aggressiveness,
        )
    points = np.asarray(points, np.float64) * scale + centre
    triangles = np.asarray(triangles, np.int64)
    spoiled = ~np.isfinite(points).all(axis=1)
    points[spoiled] = centre
    return Mesh(points, triangles[~spoiled[triangles].any(axis=1)])


def flipped_faces(mesh: Mesh, candidate: Mesh) -> Bool[np.ndarray, " F"]:
    """Return for each face of a decimated mesh whether it opposes all original faces near its centre."""
    near = min(NEAREST_FACES, len(mesh.faces))
    _, found = cKDTree(mesh.corners.mean(axis=1)).query(candidate.corners.mean(axis=1), k=near)
    original = unit(mesh.face_normals())[found.reshape(-1, near)]
    return np.asarray((np.einsum("fkd,fd->fk", original, unit(candidate.face_normals())) < 0.0).all(axis=1))


def _unfolded(mesh: Mesh, candidate: Mesh) -> Mesh:
    """Move the vertices of faces that are turned over to the mean of their neighbours until no face is."""
    best, turned = candidate, flipped_faces(mesh, candidate)
    count = int(turned.sum())
    for _ in range(SMOOTHINGS):
        if not turned.any():
            return candidate
        start, end = edge_ends(candidate.faces)
        chosen = np.zeros(len(candidate.vertices), dtype=bool)
        chosen[candidate.faces[turned].ravel()] = True
        degree = np.maximum(np.bincount(start, minlength=len(chosen)), 1)
        means = [np.bincount(start, candidate.vertices[end, axis], len(chosen)) / degree for axis in range(3)]
        moved = np.where(chosen[:, None], np.stack(means, axis=1), candidate.vertices)
        candidate = Mesh(moved, candidate.faces)
        turned = flipped_faces(mesh, candidate)
        if int(turned.sum()) < count:
            best, count = candidate, int(turned.sum())
    return best


def _carried_colors(
    mesh: Mesh, colors: Float32[np.ndarray, "V 3"], smaller: Mesh
) -> Float32[np.ndarray, "U 3"]:
    """Return colours for a decimated mesh.

    Every original vertex gives its colour to the nearest new one. Half the difference of their normals counts as much
    as an edge, so that the sides of a thin wall keep their colours. A new vertex without any takes the nearest colour.
    """
    reach = 0.5 * mean_edge(smaller)
    old = np.concatenate([mesh.vertices, reach * vertex_normals(mesh)], axis=1)
    new = np.concatenate([smaller.vertices, reach * vertex_normals(smaller)], axis=1)
    used = np.unique(mesh.faces)
    _, owner = cKDTree(new).query(old[used])
    counts = np.bincount(owner, minlength=len(new))
    sums = [np.bincount(owner, colors[used, channel], len(new)) for channel in range(3)]
    _, nearest = cKDTree(old[used]).query(new)
    means = np.stack(sums, axis=1) / np.maximum(counts, 1)[:, None]
    return np.where(counts[:, None] > 0, means, colors[used][nearest]).astype(np.float32)


def _check_untextured(mesh: Mesh) -> None:
    if mesh.texture is not None:
        raise ArgumentError("mesh: has a texture, which this would spoil; make the texture afterwards")

"""How the faces of a mesh are connected: opposite half-edges, components, boundary loops, normals of vertices.

Half-edge 3 f + k is the edge of face f from its corner k to its corner k + 1; the same number names corner k.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float64, Int64, Integer
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from gsplat_edu.scene.mesh import Mesh, Texture


def edge_ends(faces: Int64[np.ndarray, "F 3"]) -> tuple[Int64[np.ndarray, " H"], Int64[np.ndarray, " H"]]:
    """Return the start and the end of every half-edge, (3 F,) vertices each."""
    return faces.ravel(), np.roll(faces, -1, axis=1).ravel()


def by_edge(
    low: Int64[np.ndarray, " H"], high: Int64[np.ndarray, " H"]
) -> tuple[Int64[np.ndarray, " H"], Bool[np.ndarray, " H"]]:
    """Sort half-edges by their edges. Those of one edge follow one another, in no particular order.

    Args:
        low: (H,) the lower of the two vertices of each, below 2^31.
        high: (H,) the higher one.

    Returns:
        The order, and which of the sorted half-edges is the first of its edge.
    """
    key = low * (int(high.max(initial=0)) + 1) + high
    order = np.argsort(key)
    key = key[order]
    new = np.ones(len(order), dtype=bool)
    new[1:] = key[1:] != key[:-1]
    return order, new


def following(half_edges: Int64[np.ndarray, " N"]) -> Int64[np.ndarray, " N"]:
    """Return the next half-edge of the same face for each of some half-edges."""
    return np.asarray(half_edges - half_edges % 3 + (half_edges + 1) % 3)


def opposite_half_edges(mesh: Mesh) -> Int64[np.ndarray, " H"]:
    """Return the half-edge on the other side of each; -1 at the boundary.

    Where more than two faces meet at an edge, those that bound the same solid are opposite: solids that touch along an
    edge stay separate. Faces that meet at an edge but are oriented differently have no opposite.

    Args:
        mesh: F faces.

    Returns:
        (3 F,) half-edges; the opposite of the opposite is the half-edge itself.
    """
    start, end = edge_ends(mesh.faces)
    low, high = np.minimum(start, end), np.maximum(start, end)
    order, new = by_edge(low, high)
    first = np.flatnonzero(new)
    sizes = np.diff(np.append(first, len(order)))
    opposite = np.full(len(order), -1, dtype=np.int64)
    one, other = order[first[sizes == 2]], order[first[sizes == 2] + 1]
    usable = start[one] != start[other]
    opposite[one[usable]], opposite[other[usable]] = other[usable], one[usable]
    for group in np.flatnonzero(sizes > 2):
        members = order[first[group] : first[group] + sizes[group]]
        members = members[np.lexsort((members, start[members] > end[members]))]
        for one_edge, other_edge in _pairs(mesh, members):
            opposite[one_edge], opposite[other_edge] = other_edge, one_edge
    return opposite


def _pairs(mesh: Mesh, members: Int64[np.ndarray, " N"]) -> list[tuple[int, int]]:
    """Pair the half-edges of one edge whose faces bound the same solid.

    Seen along the edge from its vertex of lower index, a solid lies at angles above a backward half-edge's face and
    below a forward one's. So a backward face is paired with the forward face that follows it, as brackets are.
    """
    start, end = edge_ends(mesh.faces)
    low, high = sorted((int(start[members[0]]), int(end[members[0]])))
    axis = mesh.vertices[high] - mesh.vertices[low]
    length = float(np.linalg.norm(axis))
    if length == 0.0:
        return []
    axis = axis / length
    apexes = mesh.vertices[end[following(members)]] - mesh.vertices[low]
    side = np.cross(axis, np.eye(3)[int(np.abs(axis).argmin())])
    side /= np.linalg.norm(side)
    angles = np.arctan2(apexes @ np.cross(axis, side), apexes @ side)
    forward = start[members] == low
    around = np.lexsort((members, forward, angles))
    waiting: list[int] = []
    pairs: list[tuple[int, int]] = []
    for place in [*around, *around]:  # twice: a solid may contain the direction of angle pi
        edge = int(members[place])
        if any(edge in pair for pair in pairs):
            continue
        if not forward[place]:
            if edge not in waiting:
                waiting.append(edge)
        elif waiting:
            pairs.append((waiting.pop(), edge))
    return pairs


def component_labels(mesh: Mesh) -> Int64[np.ndarray, " F"]:
    """Return the component of each face, counted from 0. Faces are connected through edges, not through vertices.

    Args:
        mesh: F faces.
    """
    start, end = edge_ends(mesh.faces)
    low, high = np.minimum(start, end), np.maximum(start, end)
    order, new = by_edge(low, high)
    a, b = order[:-1][~new[1:]] // 3, order[1:][~new[1:]] // 3
    return _joined(len(mesh.faces), a, b)


def _joined(count: int, a: Int64[np.ndarray, " N"], b: Int64[np.ndarray, " N"]) -> Int64[np.ndarray, " M"]:
    """Return the component of each of `count` things, of which a[i] is joined with b[i]; in order of appearance."""
    links = coo_array((np.ones(len(a), dtype=np.int8), (a, b)), shape=(count, count))
    _, labels = connected_components(links, directed=False)
    first = _first_places(labels)
    rank = np.empty(len(first), dtype=np.int64)
    rank[np.argsort(first)] = np.arange(len(first))
    return np.asarray(rank[labels])


def _first_places(labels: Integer[np.ndarray, " N"]) -> Int64[np.ndarray, " M"]:
    """Return where each of the labels 0 to M - 1 appears first."""
    first = np.empty(int(labels.max(initial=-1)) + 1, dtype=np.int64)
    first[labels[::-1]] = np.arange(len(labels))[::-1]  # of equal indices, the last assignment holds
    return first


def separated(mesh: Mesh) -> Mesh:
    """Repeat vertices until the mesh is manifold: at most two faces at an edge, one fan of faces at a vertex.

    The surface stays where it is. A closed mesh stays closed, because faces that bound the same solid stay connected.
    Vertices that no face names are dropped. If the faces about an edge with more than two of them are one fan at both
    of its vertices, repeating these would not help: the edge is then halved once for each sheet, by a vertex each.

    Args:
        mesh: F faces, none of which names a vertex twice.
    """
    while True:
        mesh = _repeated(mesh)
        halved = _halved(mesh)
        if halved is mesh:
            return mesh
        mesh = halved


def _repeated(mesh: Mesh) -> Mesh:
    """Repeat vertices until each has one fan of faces."""
    opposite = opposite_half_edges(mesh)
    edges = np.flatnonzero(opposite >= 0)
    labels = _joined(mesh.faces.size, edges, following(opposite[edges]))
    corner = _first_places(labels)
    owner = mesh.faces.ravel()[corner]
    order = np.argsort(owner * len(owner) + np.arange(len(owner)))  # no two are equal
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    origin = owner[order]
    colors = None if mesh.colors is None else mesh.colors[origin]
    return Mesh(mesh.vertices[origin], rank[labels].reshape(-1, 3), colors, mesh.texture)


def _halved(mesh: Mesh) -> Mesh:
    """Halve edges with more than two faces, all but one sheet of each; at most one edge of a face."""
    start, end = edge_ends(mesh.faces)
    low, high = np.minimum(start, end), np.maximum(start, end)
    order, new = by_edge(low, high)
    sizes = np.diff(np.append(np.flatnonzero(new), len(order)))
    crowded = order[np.repeat(sizes > 2, sizes)]
    if not len(crowded):
        return mesh
    crowded = crowded[np.lexsort((crowded, high[crowded], low[crowded]))]
    opposite = opposite_half_edges(mesh)
    seen: set[tuple[int, int]] = set()
    touched: set[int] = set()
    middles: list[tuple[int, int]] = []
    added: list[tuple[int, int, int]] = []  # half-edge, its vertex in the middle
    for edge in crowded.tolist():
        other = int(opposite[edge])
        sheet = [edge] if other < 0 else [edge, other]
        if edge != min(sheet):
            continue
        ends = (int(low[edge]), int(high[edge]))
        if ends not in seen:
            seen.add(ends)  # the first sheet keeps the edge
        elif not touched & {half // 3 for half in sheet}:
            touched |= {half // 3 for half in sheet}
            added += [(half // 3, half % 3, len(mesh.vertices) + len(middles)) for half in sheet]
            middles.append(ends)
    return _with_middles(mesh, middles, added)


def _with_middles(mesh: Mesh, middles: list[tuple[int, int]], added: list[tuple[int, int, int]]) -> Mesh:
    """Add the middles of edges as vertices, and cut faces there.

    Args:
        mesh: The mesh.
        middles: The vertices of each edge.
        added: Face, corner and new vertex: the vertex halves the edge that begins at the corner.
    """
    if not added:
        return mesh
    pairs = np.array(middles)
    vertices = np.concatenate([mesh.vertices, mesh.vertices[pairs].mean(axis=1)])
    colors = None if mesh.colors is None else np.concatenate([mesh.colors, mesh.colors[pairs].mean(axis=1)])
    faces = np.concatenate([mesh.faces, mesh.faces[[face for face, _, _ in added]]])
    uvs = None
    if mesh.texture is not None:
        uvs = np.concatenate([mesh.texture.uvs, mesh.texture.uvs[[face for face, _, _ in added]]])
    for place, (face, corner, vertex) in enumerate(added, len(mesh.faces)):
        after = (corner + 1) % 3
        faces[face, after] = faces[place, corner] = vertex
        if uvs is not None:
            uvs[face, after] = uvs[place, corner] = (uvs[face, corner] + uvs[face, after]) / 2
    texture = None if mesh.texture is None or uvs is None else Texture(mesh.texture.image, uvs)
    return Mesh(vertices, faces, colors, texture)


def boundary_loops(mesh: Mesh) -> list[Int64[np.ndarray, " N"]]:
    """Return the half-edges of every boundary loop, in the order in which they follow one another.

    At a vertex where several loops meet, each follows the faces of one fan. A loop that visits a vertex twice is cut
    there into two.

    Args:
        mesh: F faces.

    Returns:
        (N,) half-edges of each loop, at least 2; the mesh lies on their left. Loops of single edges do not exist.
    """
    opposite = opposite_half_edges(mesh)
    start, _ = edge_ends(mesh.faces)
    boundary = np.flatnonzero(opposite < 0)
    after = following(boundary)
    turning = opposite[after] >= 0
    for _ in range(len(opposite)):  # turn about the vertex, through its fan, to the next boundary edge
        if not turning.any():
            break
        after[turning] = following(opposite[after[turning]])
        turning = opposite[after] >= 0
    successor = dict(zip(boundary.tolist(), after.tolist(), strict=True))
    loops: list[Int64[np.ndarray, " N"]] = []
    left = set(successor)
    for first in boundary.tolist():
        edge = first
        path: list[int] = []
        places: dict[int, int] = {}  # of the start of each edge of the path
        while edge in left:
            left.discard(edge)
            vertex = int(start[edge])
            if vertex in places:
                loops.append(np.array(path[places[vertex] :]))
                for old in path[places[vertex] :]:
                    del places[int(start[old])]
                path = path[: len(path) - len(loops[-1])]
            places[vertex] = len(path)
            path.append(edge)
            edge = successor[edge]
        if path:
            loops.append(np.array(path))
    return loops


def mean_edge(mesh: Mesh) -> float:
    """Return the mean length of the half-edges, world units."""
    ends: Float64[np.ndarray, "F 3 3"] = mesh.corners - np.roll(mesh.corners, -1, axis=1)
    return float(np.linalg.norm(ends, axis=2).mean())


def unit(vectors: Float64[np.ndarray, "N 3"]) -> Float64[np.ndarray, "N 3"]:
    """Return vectors of length 1; zero stays zero."""
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.asarray(vectors / np.where(lengths > 0.0, lengths, 1.0))


def vertex_normals(mesh: Mesh) -> Float64[np.ndarray, "V 3"]:
    """Return normals of vertices, averaged over their faces by area, of length 1; zero at unused vertices."""
    return unit(mesh.summed_normals())

"""A closed mesh of solids, by their distance field: one vertex in each cell that the surface crosses (surface nets).

Only cells near the surface are visited. Vertices are moved onto the surface, so the mesh is off it only between them.
"""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float64, Int8, Int64

from gsplat_edu.base.validation import in_range
from gsplat_edu.scene.mesh import Mesh
from lab.captures.solids import SolidScene

BLOCK = 16
"""Cells along each side of the largest blocks that are skipped if the surface is too far away; a power of 2."""

PROJECTIONS = 4
"""Number of times that a vertex moves by its distance along the gradient."""

SIDE = 1 << 20
"""Largest number of cells along an axis: three indices fit in an int64."""

Cells = Int64[np.ndarray, "n 3"]


def solids_mesh(scene: SolidScene, step: float = 0.015) -> Mesh:
    """Mesh the surface of a scene.

    The mesh is closed. Where the surface nearly touches itself, such as along a concave edge, four faces may share an
    edge. Walls and gaps thinner than two steps may merge or break, and edges are blunt by up to half a step.

    Args:
        scene: The solids.
        step: Side of the cells, world units.

    Returns:
        The mesh, with faces counterclockwise as seen from outside.

    Raises:
        ArgumentError: `step` is not above 0, or so small that there are more than a million cells along a side.
    """
    in_range("step", step, 0.0, open_low=True)
    low = np.min([part.shape.center - part.shape.radius for part in scene.parts], axis=0) - 2.37 * step
    high = np.max([part.shape.center + part.shape.radius for part in scene.parts], axis=0) + 2 * step
    in_range("cells along a side", float((high - low).max() / step), 0.0, SIDE - 2 * BLOCK)
    cells = _cells_near(scene, low, high, step)
    lattice, inverse = np.unique(_code((cells[:, None] + CORNERS).reshape(-1, 3)), return_inverse=True)
    values = scene.distance(low + step * _index(lattice))
    inside = np.asarray(values < 0)
    filled = inside[inverse.reshape(-1, 8)]
    active = filled.any(axis=1) & ~filled.all(axis=1)
    corners = values[inverse.reshape(-1, 8)][active]
    codes = _code(cells[active])
    order = np.argsort(codes)
    vertices = _vertices(scene, low + step * cells[active][order], corners[order], step)
    return Mesh(vertices, _faces(lattice, inside.astype(np.int8), codes[order]))


CORNERS: Cells = np.array([[i >> 2 & 1, i >> 1 & 1, i & 1] for i in range(8)], dtype=np.int64)
"""Offsets of a cell's corners."""

EDGES = [(i, i | bit) for bit in (4, 2, 1) for i in range(8) if not i & bit]
"""Pairs of corners that are the edges of a cell."""


def _code(index: Cells) -> Int64[np.ndarray, " n"]:
    """Return one number for three indices."""
    return np.asarray((index[:, 0] * SIDE + index[:, 1]) * SIDE + index[:, 2])


def _index(code: Int64[np.ndarray, " n"]) -> Cells:
    """Return the three indices of a number."""
    return np.stack([code // SIDE**2, code // SIDE % SIDE, code % SIDE], axis=1)


def _cells_near(
    scene: SolidScene, low: Float64[np.ndarray, "3"], high: Float64[np.ndarray, "3"], step: float
) -> Cells:
    """Return the indices of the cells that the surface may cross: blocks that it may cross are halved repeatedly."""
    blocks = [np.arange(n) for n in np.ceil((high - low) / (step * BLOCK)).astype(int)]
    first = BLOCK * np.stack(np.meshgrid(*blocks, indexing="ij"), axis=-1).reshape(-1, 3).astype(np.int64)
    size = BLOCK
    while True:
        away = np.abs(scene.distance(low + step * (first + size / 2)))
        first = first[away <= step * size * math.sqrt(3) / 2]
        if size == 1:
            return np.asarray(first)
        size //= 2
        first = (first[:, None] + size * CORNERS).reshape(-1, 3)


def _vertices(
    scene: SolidScene, low: Float64[np.ndarray, "n 3"], corners: Float64[np.ndarray, "n 8"], step: float
) -> Float64[np.ndarray, "n 3"]:
    """Return a point of the surface in each cell: the mean of the crossings of its edges, projected.

    A vertex whose projection leaves the cell stays at the mean, so that the mesh does not fold.

    Args:
        scene: The solids.
        low: Lower corners of the cells.
        corners: Distances at the corners.
        step: Side of a cell.
    """
    total, count = np.zeros_like(low), np.zeros(len(low))
    for a, b in EDGES:
        crossed = (corners[:, a] < 0) != (corners[:, b] < 0)
        difference = np.where(crossed, corners[:, a] - corners[:, b], 1.0)
        share = np.where(crossed, corners[:, a] / difference, 0.0)[:, None]
        total += crossed[:, None] * (CORNERS[a] + share * (CORNERS[b] - CORNERS[a]))
        count += crossed
    mean = low + step * total / count[:, None]
    moved = mean.copy()
    for _ in range(PROJECTIONS):
        moved -= scene.distance(moved)[:, None] * scene.normals(moved)
    kept = np.all((moved >= low) & (moved <= low + step), axis=1, keepdims=True)
    return np.asarray(np.where(kept, moved, mean))


def _faces(
    lattice: Int64[np.ndarray, " L"], sides: Int8[np.ndarray, " L"], codes: Int64[np.ndarray, " n"]
) -> Int64[np.ndarray, "F 3"]:
    """Return two triangles for each edge of the lattice that the surface crosses, around it.

    Args:
        lattice: Codes of the lattice's points, sorted.
        sides: 1 for each that is inside, 0 for others.
        codes: Codes of the cells that have a vertex, sorted.
    """
    strides = (SIDE**2, SIDE, 1)
    found = []
    for axis in range(3):
        after = lattice + strides[axis]
        at = np.minimum(np.searchsorted(lattice, after), len(lattice) - 1)
        crossed = np.not_equal(sides, sides[at])
        start = np.flatnonzero((lattice[at] == after) & crossed)
        right, up = strides[(axis + 1) % 3], strides[(axis + 2) % 3]
        ring = [lattice[start] - back for back in (0, right, right + up, up)]
        quad = np.stack([np.searchsorted(codes, cell) for cell in ring], axis=1)
        entering = sides[start] == 0
        quad[entering] = quad[entering, ::-1]
        found += [quad[:, [0, 1, 2]], quad[:, [0, 2, 3]]]
    return np.concatenate(found).astype(np.int64)

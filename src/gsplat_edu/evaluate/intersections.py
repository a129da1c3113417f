"""Which triangles of a mesh pass through another triangle of the same mesh.

Two triangles in general position intersect if and only if an edge of one passes through the inside of the other. The
test is made of signs of volumes of tetrahedra. A sign counts only if the volume is larger than its rounding error, so
triangles that merely touch, share a corner or an edge, or overlap in one plane do not count, and every triangle that
counts does intersect another one.

Pairs to test come from a tree of boxes: the triangles are sorted along a space-filling curve, and two neighbouring
boxes at a time become one of the level above.

Source: Shewchuk, "Adaptive Precision Floating-Point Arithmetic and Fast Robust Geometric Predicates", 1997 (the bound
of the rounding error).
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int64

from gsplat_edu.base.validation import whole_number
from gsplat_edu.scene.mesh import Mesh
from gsplat_edu.scene.morton import order_in_space

HALF_ULP = 2.0**-53
ROUNDING = (7.0 + 56.0 * HALF_ULP) * HALF_ULP
"""Rounding error of a volume, as a share of the sum of the absolute values of its products."""

PAIRS_AT_ONCE = 1 << 17
"""Pairs of boxes or triangles handled at a time; limits memory to about 100 MB."""

TESTED = 200_000
"""Most triangles that are compared with all others; of a larger mesh, so many at even steps."""


class Intersections(NamedTuple):
    """How many triangles of a mesh pass through another one.

    Args:
        found: Number of tested triangles that intersect another triangle of the mesh.
        tested: Number of tested triangles; each is compared with all others.
        faces: Number of triangles of the mesh.
    """

    found: int
    tested: int
    faces: int

    @property
    def share(self) -> float:
        """Share of the tested triangles that intersect another, 0 to 1."""
        return self.found / self.tested if self.tested else 0.0


def self_intersections(mesh: Mesh, most: int = TESTED) -> Intersections:
    """Count the triangles that intersect another triangle of the mesh.

    Args:
        mesh: The mesh; it may be empty.
        most: Most triangles to test; of a larger mesh, every n-th is tested, against all others.

    Raises:
        ArgumentError: `most` is not a positive whole number.
    """
    whole_number("most", most, 1)
    faces = len(mesh.faces)
    step = max(-(-faces // most), 1)
    chosen = np.zeros(faces, dtype=bool)
    chosen[::step] = True
    hit = intersecting_faces(mesh, chosen)
    return Intersections(int(hit.sum()), int(chosen.sum()), faces)


def intersecting_faces(mesh: Mesh, chosen: Bool[np.ndarray, " F"] | None = None) -> Bool[np.ndarray, " F"]:
    """Return which faces intersect another face.

    Args:
        mesh: The mesh.
        chosen: (F,) faces to test, each against all faces; None for all. The result is False at the others.
    """
    faces = len(mesh.faces)
    hit = np.zeros(faces, dtype=bool)
    wanted = np.ones(faces, dtype=bool) if chosen is None else chosen
    if faces < 2:
        return hit
    corners = mesh.corners
    corners = corners - corners.mean(axis=(0, 1))  # small coordinates have small rounding errors
    for pair in _near_pairs(corners, wanted):
        # Of faces with a common edge, none passes through the other.
        common = (mesh.faces[pair[0]][:, :, None] == mesh.faces[pair[1]][:, None, :]).sum(axis=(1, 2))
        first, second = (side[common < 2] for side in pair)
        crossing = _crossing(corners[first], corners[second])
        hit[first[crossing]] = hit[second[crossing]] = True
    return np.asarray(hit & wanted)


def _near_pairs(
    corners: Float64[np.ndarray, "F 3 3"], wanted: Bool[np.ndarray, " F"]
) -> Iterator[tuple[Int64[np.ndarray, " N"], Int64[np.ndarray, " N"]]]:
    """Yield pairs of faces whose boxes overlap and of which one or both are wanted, each pair once."""
    order = order_in_space(corners.mean(axis=1))
    levels = _tree(corners[order], wanted[order])
    waiting = [(len(levels) - 1, np.zeros(1, dtype=np.int64), np.zeros(1, dtype=np.int64))]
    while waiting:
        level, a, b = waiting.pop()
        if level == 0:
            apart = a != b
            yield order[a[apart]], order[b[apart]]
            continue
        low, high, asked = levels[level - 1]
        # The children of both; of a node and itself, one of the two mixed pairs.
        first = np.concatenate([2 * a, 2 * a, 2 * a + 1, 2 * a + 1])
        second = np.concatenate([2 * b, 2 * b + 1, 2 * b, 2 * b + 1])
        kept = (first <= second) & (second < len(low))
        first, second = first[kept], second[kept]
        kept = asked[first] | asked[second]
        for axis in range(3):
            kept &= low[first, axis] <= high[second, axis]
            kept &= low[second, axis] <= high[first, axis]
        first, second = first[kept], second[kept]
        for start in range(0, len(first), PAIRS_AT_ONCE):
            part = slice(start, start + PAIRS_AT_ONCE)
            waiting.append((level - 1, first[part], second[part]))


Level = tuple[Float64[np.ndarray, "N 3"], Float64[np.ndarray, "N 3"], Bool[np.ndarray, " N"]]
"""Lower and upper corners of boxes, and which contain a wanted triangle."""


def _tree(corners: Float64[np.ndarray, "F 3 3"], wanted: Bool[np.ndarray, " F"]) -> list[Level]:
    """Return the boxes of all levels: of the triangles first, of all of them together last."""
    levels = [(corners.min(axis=1), corners.max(axis=1), wanted)]
    while len(levels[-1][0]) > 1:
        low, high, asked = levels[-1]
        starts = np.arange(0, len(low), 2)
        levels.append(
            (
                np.minimum.reduceat(low, starts),
                np.maximum.reduceat(high, starts),
                np.logical_or.reduceat(asked, starts),
            )
        )
    return levels


def _crossing(a: Float64[np.ndarray, "N 3 3"], b: Float64[np.ndarray, "N 3 3"]) -> Bool[np.ndarray, " N"]:
    """Return which triangles pass through one another, pair by pair."""
    sides_a, sides_b = _sides(a, b), _sides(b, a)
    near = np.flatnonzero(_both(sides_a) & _both(sides_b))
    found = np.zeros(len(a), dtype=bool)
    for sides, through, target in ((sides_a[near], b[near], a[near]), (sides_b[near], a[near], b[near])):
        for corner in range(3):
            after = (corner + 1) % 3
            apart = sides[:, corner] * sides[:, after] < 0
            start, end = through[:, corner], through[:, after]
            turns = np.stack(
                [_sign(start, end, target[:, k], target[:, (k + 1) % 3]) for k in range(3)], axis=1
            )
            found[near] |= apart & (np.abs(turns.sum(axis=1)) == 3)
    return found


def _sides(a: Float64[np.ndarray, "N 3 3"], b: Float64[np.ndarray, "N 3 3"]) -> Int64[np.ndarray, "N 3"]:
    """Return on which side of the plane of a each corner of b is: -1, 1, or 0 if rounding hides it."""
    return np.stack([_sign(a[:, 0], a[:, 1], a[:, 2], b[:, k]) for k in range(3)], axis=1)


def _both(sides: Int64[np.ndarray, "N 3"]) -> Bool[np.ndarray, " N"]:
    return np.asarray((sides.min(axis=1) < 0) & (sides.max(axis=1) > 0))


def _sign(
    p: Float64[np.ndarray, "N 3"],
    q: Float64[np.ndarray, "N 3"],
    r: Float64[np.ndarray, "N 3"],
    s: Float64[np.ndarray, "N 3"],
) -> Int64[np.ndarray, " N"]:
    """Return the sign of the volume of the tetrahedra p q r s; 0 if it is within its rounding error."""
    (ax, ay, az), (bx, by, bz), (cx, cy, cz) = (p - s).T, (q - s).T, (r - s).T
    products = (bx * cy, cx * by, cx * ay, ax * cy, ax * by, bx * ay)
    volume = az * (products[0] - products[1])
    volume += bz * (products[2] - products[3])
    volume += cz * (products[4] - products[5])
    bound = np.abs(az) * (np.abs(products[0]) + np.abs(products[1]))
    bound += np.abs(bz) * (np.abs(products[2]) + np.abs(products[3]))
    bound += np.abs(cz) * (np.abs(products[4]) + np.abs(products[5]))
    return np.where(np.abs(volume) > ROUNDING * bound, np.sign(volume), 0.0).astype(np.int64)

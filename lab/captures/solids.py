"""The scene `solids`: a bowl, rods, slots and a torus, with or without a floor, and exact distances to their surface.

The shapes are hard for methods that reconstruct surfaces: a thin wall seen from both sides, rods a few pixels wide,
slots deeper than wide, and a hole. `solids_photos.py` photographs the scene, and `solids_mesh.py` makes a mesh of it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int64

from gsplat_edu.base.validation import whole_number
from lab.captures.solids_shapes import (
    DOWN,
    Block,
    Bowl,
    Points,
    Rod,
    SolidShape,
    Torus,
    Values,
    gradient,
    upright,
)

AT_ONCE = 16_384
"""Points whose distances are computed together, chosen so that they stay in the processor's cache."""

HIDDEN = 1e-9
"""A sample of a shape that is deeper than this in another shape is not on the surface, world units."""


class Part(NamedTuple):
    """A shape of a scene, and the object that it belongs to."""

    name: str
    shape: SolidShape


@dataclass(frozen=True, eq=False)
class SolidScene:
    """A scene of solids; they may overlap.

    Args:
        parts: The shapes, at least one.
    """

    parts: tuple[Part, ...]

    def distance(self, points: Points) -> Values:
        """Return the signed distance of points to the surface, negative inside, world units.

        It is exact outside, and at most the true distance inside, where shapes overlap.
        """
        found = np.full(len(points), np.inf)
        for first in range(0, len(points), AT_ONCE):
            some = slice(first, first + AT_ONCE)
            for part in self.parts:
                np.minimum(found[some], part.shape.distance(points[some]), out=found[some])
        return found

    def nearest(self, points: Points) -> Int64[np.ndarray, " n"]:
        """Return the index of the part with the least signed distance."""
        least, owner = np.full(len(points), np.inf), np.zeros(len(points), np.int64)
        for index, part in enumerate(self.parts):
            away = part.shape.distance(points)
            owner[away < least] = index
            np.minimum(least, away, out=least)
        return owner

    def normals(self, points: Points) -> Points:
        """Return the outward unit normals of the surface at its closest points.

        Args:
            points: (n, 3) on the surface or near it, world units.
        """
        owner, found = self.nearest(points), np.zeros_like(points)
        for index in np.unique(owner):
            mine = owner == index
            found[mine] = gradient(self.parts[index].shape, points[mine])
        return found

    def surface(self, count: int, seed: int = 0) -> tuple[Points, Points]:
        """Sample the surface, uniformly over its area; what is inside another shape is no surface.

        Every part is sampled in proportion to its area by a formula that is exactly uniform, and samples inside another
        part are drawn again. So the samples are independent and exactly uniform.

        Args:
            count: Number of samples, at least 1.
            seed: Seed of the samples.

        Returns:
            points: (count, 3) world units.
            normals: (count, 3) outward unit normals.

        Raises:
            ArgumentError: a number is out of range.
        """
        whole_number("count", count, 1)
        rng = np.random.default_rng(whole_number("seed", seed, 0))
        areas = np.array([part.shape.area for part in self.parts])
        points, normals = np.zeros((count, 3)), np.zeros((count, 3))
        missing = np.arange(count)
        while len(missing):
            owner = rng.choice(len(areas), len(missing), p=areas / areas.sum())
            kept = np.zeros(len(missing), dtype=bool)
            for index, part in enumerate(self.parts):
                mine = np.flatnonzero(owner == index)
                drawn = part.shape.sample(rng, len(mine))
                shown = self._uncovered(index, drawn)
                rows = missing[mine[shown]]
                points[rows], normals[rows] = drawn[shown], gradient(part.shape, drawn[shown])
                kept[mine[shown]] = True
            missing = missing[~kept]
        return points, normals

    def _uncovered(self, index: int, points: Points) -> Bool[np.ndarray, " n"]:
        """Return which points of one part are in no other part."""
        free = np.ones(len(points), dtype=bool)
        for other, part in enumerate(self.parts):
            if other != index:
                free &= part.shape.distance(points) > -HIDDEN
        return free


def solids(floor: bool = True) -> SolidScene:
    """Make the scene: a bowl, an arch of thin rods and a leaning one, a block with slots, and a leaning torus.

    The scene is 3 world units wide; y points down. What stands on the floor is sunk into it by a few hundredths, so
    that no two surfaces coincide.

    Args:
        floor: Add a square slab, whose upper side is y = 0.
    """
    parts = [Part("floor", Block(np.array([0.0, 0.05, 0.0]), np.array([1.5, 0.05, 1.5])))] if floor else []
    parts.append(Part("bowl", Bowl(np.array([-0.62, -0.43, -0.5]), 0.42, 0.02, math.radians(80.0))))
    feet = [np.array([x, 0.03, z]) for x, z in ((0.3, -0.8), (0.95, -0.45))]
    tops = [foot - 0.75 * DOWN for foot in feet]
    rods = [(feet[0], tops[0], 0.03), (feet[1], tops[1], 0.03), (tops[0], tops[1], 0.02)]
    rods.append((np.array([0.25, 0.03, -0.25]), np.array([0.75, -0.62, -0.1]), 0.015))
    parts += [Part("rods", Rod(*rod)) for rod in rods]
    parts += [Part("slots", block) for block in _slots(np.array([0.6, 0.0, 0.6]), 0.5)]
    axis = np.array([0.35, -0.9, 0.25])
    axis /= np.linalg.norm(axis)
    lean = 0.3 * math.hypot(axis[0], axis[2]) + 0.11
    parts.append(Part("torus", Torus(np.array([-0.6, 0.01 - lean, 0.6]), axis, 0.3, 0.11)))
    return SolidScene(tuple(parts))


def _slots(place: Float64[np.ndarray, "3"], turn: float) -> list[Block]:
    """Make four upright plates on a base; the slots between them are 0.16 wide and 0.35 deep.

    Args:
        place: (3,) middle of the block on the floor, world units.
        turn: About the vertical, radians.
    """
    blocks = [Block(place + np.array([0.0, -0.035, 0.0]), np.array([0.42, 0.065, 0.32]), turn)]
    for x in (-0.36, -0.12, 0.12, 0.36):
        aside = upright(turn) @ np.array([x, -0.25, 0.0])
        blocks.append(Block(place + aside, np.array([0.04, 0.2, 0.3]), turn))
    return blocks

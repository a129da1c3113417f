"""Solid shapes with exact signed distances: block, rod, torus and bowl.

Each shape has a distance field, a volume that rays must meet, and samples that are uniform over its area.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float64

Points = Float64[np.ndarray, "n 3"]
Values = Float64[np.ndarray, " n"]

DIFFERENCE = 1e-6
"""Step of the central differences that give normals, world units."""

DOWN = np.array([0.0, 1.0, 0.0])
"""The direction of gravity."""


@runtime_checkable
class SolidShape(Protocol):
    """A solid shape."""

    @property
    def center(self) -> Float64[np.ndarray, "3"]:
        """Centre of the bounding sphere, world units."""

    @property
    def radius(self) -> float:
        """Radius of the bounding sphere, world units."""

    @property
    def area(self) -> float:
        """Area of the surface, square world units."""

    def distance(self, points: Points) -> Values:
        """Return the distance of points to the surface, negative inside, world units. Exact inside and outside."""

    def reach(self, origin: Float64[np.ndarray, "*n 3"], rays: Points) -> tuple[Values, Values]:
        """Return where rays enter and leave a volume around the shape, as multiples of their length.

        Infinity and -infinity if they miss it.
        """

    def sample(self, rng: np.random.Generator, count: int) -> Points:
        """Return points that are uniform over the area."""


@dataclass(frozen=True, eq=False)
class Block:
    """An upright box.

    Args:
        center: (3,) world units.
        half: (3,) half of its sides, world units.
        turn: About the vertical, radians.
    """

    center: Float64[np.ndarray, "3"]
    half: Float64[np.ndarray, "3"]
    turn: float = 0.0

    @property
    def radius(self) -> float:
        """Radius of the bounding sphere, world units."""
        return float(np.linalg.norm(self.half))

    @property
    def area(self) -> float:
        """Area of the surface, square world units."""
        a, b, c = self.half
        return float(8 * (a * b + b * c + c * a))

    def distance(self, points: Points) -> Values:
        """Return the signed distance of points, world units."""
        beyond = np.abs((points - self.center) @ upright(self.turn)) - self.half
        most = np.maximum(np.maximum(beyond[:, 0], beyond[:, 1]), beyond[:, 2])
        return np.asarray(lengths(np.maximum(beyond, 0.0)) + np.minimum(most, 0.0))

    def reach(self, origin: Float64[np.ndarray, "*n 3"], rays: Points) -> tuple[Values, Values]:
        """Return where rays enter and leave the box, as multiples of their length."""
        return slab(upright(self.turn), self.center, self.half, (origin, rays))

    def sample(self, rng: np.random.Generator, count: int) -> Points:
        """Return points that are uniform over the area."""
        a, b, c = self.half
        sides = np.array([b * c, c * a, a * b])
        axis = rng.choice(3, count, p=sides / sides.sum())
        points = rng.uniform(-1.0, 1.0, (count, 3))
        points[np.arange(count), axis] = rng.choice([-1.0, 1.0], count)
        return np.asarray(self.center + (points * self.half) @ upright(self.turn).T)


@dataclass(frozen=True, eq=False)
class Rod:
    """A cylinder with round ends.

    Args:
        start: (3,) centre of one end's hemisphere, world units.
        end: (3,) centre of the other end.
        thickness: Its radius, world units.
    """

    start: Float64[np.ndarray, "3"]
    end: Float64[np.ndarray, "3"]
    thickness: float

    @property
    def center(self) -> Float64[np.ndarray, "3"]:
        """Centre of the bounding sphere, world units."""
        return np.asarray((self.start + self.end) / 2)

    @property
    def length(self) -> float:
        """Length of the cylinder without its ends, world units."""
        return float(np.linalg.norm(self.end - self.start))

    @property
    def radius(self) -> float:
        """Radius of the bounding sphere, world units."""
        return self.length / 2 + self.thickness

    @property
    def area(self) -> float:
        """Area of the surface, square world units."""
        return 2 * math.pi * self.thickness * (self.length + 2 * self.thickness)

    def distance(self, points: Points) -> Values:
        """Return the signed distance of points, world units."""
        axis, away = self.end - self.start, points - self.start
        along = np.clip(away @ axis / self.length**2, 0.0, 1.0)
        rest = away - along[:, None] * axis
        return lengths(rest) - self.thickness

    def reach(self, origin: Float64[np.ndarray, "*n 3"], rays: Points) -> tuple[Values, Values]:
        """Return where rays enter and leave a box around the rod, as multiples of their length."""
        frame = np.stack(_frame(self.end - self.start), axis=1)
        half = np.array([self.thickness, self.thickness, self.radius])
        return slab(frame, self.center, half, (origin, rays))

    def sample(self, rng: np.random.Generator, count: int) -> Points:
        """Return points that are uniform over the area.

        On a cylinder around a sphere, the height of a point is as uniform as on the sphere, so one number chooses the
        height along cylinder and both ends.
        """
        x, y, axis = _frame(self.end - self.start)
        half = self.length / 2
        height = rng.uniform(-half - self.thickness, half + self.thickness, count)
        cap = height - np.clip(height, -half, half)
        out, turn = np.sqrt(self.thickness**2 - cap**2), rng.uniform(0, 2 * math.pi, count)
        around = np.cos(turn)[:, None] * x + np.sin(turn)[:, None] * y
        return np.asarray(self.center + height[:, None] * axis + out[:, None] * around)


@dataclass(frozen=True, eq=False)
class Torus:
    """A ring.

    Args:
        center: (3,) world units.
        axis: (3,) direction through its hole.
        ring: Radius of the circle through the middle of the tube, world units.
        tube: Radius of the tube, world units.
    """

    center: Float64[np.ndarray, "3"]
    axis: Float64[np.ndarray, "3"]
    ring: float
    tube: float

    @property
    def radius(self) -> float:
        """Radius of the bounding sphere, world units."""
        return self.ring + self.tube

    @property
    def area(self) -> float:
        """Area of the surface, square world units."""
        return 4 * math.pi**2 * self.ring * self.tube

    def distance(self, points: Points) -> Values:
        """Return the signed distance of points, world units."""
        height, out = _cylindrical(points - self.center, self.axis)
        return np.asarray(np.hypot(out - self.ring, height) - self.tube)

    def reach(self, origin: Float64[np.ndarray, "*n 3"], rays: Points) -> tuple[Values, Values]:
        """Return where rays enter and leave a box around the torus, as multiples of their length."""
        frame = np.stack(_frame(self.axis), axis=1)
        return slab(frame, self.center, np.array([self.radius, self.radius, self.tube]), (origin, rays))

    def sample(self, rng: np.random.Generator, count: int) -> Points:
        """Return points that are uniform over the area."""
        angle = _tube_angles(rng, count, self.ring, self.tube, (0.0, 2 * math.pi))
        out, height = self.ring + self.tube * np.cos(angle), self.tube * np.sin(angle)
        return np.asarray(self.center + _turned(rng, self.axis, out, height))


@dataclass(frozen=True, eq=False)
class Bowl:
    """Part of a hollow sphere, open upwards, with a round rim.

    Args:
        center: (3,) centre of the sphere, world units.
        sphere: Radius of the middle of the wall, world units.
        wall: Half of the wall's thickness, world units.
        opening: Angle from the lowest point to the rim, radians.
    """

    center: Float64[np.ndarray, "3"]
    sphere: float
    wall: float
    opening: float

    @property
    def radius(self) -> float:
        """Radius of the bounding sphere, world units."""
        return self.sphere + self.wall

    @property
    def _areas(self) -> tuple[float, float, float]:
        """Areas of the outside, the inside and the rim: half a torus around the rim, which leans outwards."""
        cap = 2 * math.pi * (1 - math.cos(self.opening))
        # the rim's centroid is 2 / pi of its radius from the middle of the wall, in the direction of the wall
        out = self.sphere * math.sin(self.opening) + 2 / math.pi * self.wall * math.cos(self.opening)
        rim = 2 * math.pi * out * math.pi * self.wall
        return cap * (self.sphere + self.wall) ** 2, cap * (self.sphere - self.wall) ** 2, rim

    @property
    def area(self) -> float:
        """Area of the surface, square world units."""
        return float(sum(self._areas))

    def distance(self, points: Points) -> Values:
        """Return the signed distance of points, world units."""
        depth, out = _cylindrical(points - self.center, DOWN)
        rim = self.sphere * math.sin(self.opening), self.sphere * math.cos(self.opening)
        # beside the arc, the closest point is on the sphere; beyond it, on the rim
        beside = out * math.cos(self.opening) <= depth * math.sin(self.opening)
        to_sphere = np.abs(np.hypot(out, depth) - self.sphere)
        to_rim = np.hypot(out - rim[0], depth - rim[1])
        return np.asarray(np.where(beside, to_sphere, to_rim)) - self.wall

    def reach(self, origin: Float64[np.ndarray, "*n 3"], rays: Points) -> tuple[Values, Values]:
        """Return where rays enter and leave the bounding sphere, as multiples of their length."""
        return ball(self.center, self.radius, origin, rays)

    def sample(self, rng: np.random.Generator, count: int) -> Points:
        """Return points that are uniform over the area."""
        shares = np.array(self._areas) / self.area
        part = rng.choice(3, count, p=shares)
        lean = np.arccos(rng.uniform(math.cos(self.opening), 1.0, count))
        reach = np.where(part == 0, self.sphere + self.wall, self.sphere - self.wall)
        out, depth = reach * np.sin(lean), reach * np.cos(lean)
        rim = np.flatnonzero(part == 2)
        middle = self.sphere * math.sin(self.opening), self.sphere * math.cos(self.opening)
        # angles of the tube are from outwards to downwards; the wall ends in the direction -opening
        ends = -self.opening - math.pi / 2, -self.opening + math.pi / 2
        angle = _tube_angles(rng, len(rim), middle[0], self.wall, ends)
        out[rim] = middle[0] + self.wall * np.cos(angle)
        depth[rim] = middle[1] + self.wall * np.sin(angle)
        return np.asarray(self.center + _turned(rng, DOWN, out, depth))


def ball(
    center: Float64[np.ndarray, "3"], radius: float, origin: Float64[np.ndarray, "*n 3"], rays: Points
) -> tuple[Values, Values]:
    """Return where rays enter and leave a sphere, as multiples of their length; infinity and -infinity if they miss.

    Args:
        center: (3,) world units.
        radius: World units.
        origin: (3,) start of all rays, or (n, 3) of each.
        rays: (n, 3) directions of any length.
    """
    away = center - origin
    squared, (along, beside) = np.einsum("ij,ij->i", rays, rays), along_and_beside(away, rays, radius)
    root = along**2 - squared * beside
    half, met = np.sqrt(np.maximum(root, 0.0)), root > 0
    return np.where(met, (along - half) / squared, np.inf), np.where(met, (along + half) / squared, -np.inf)


def slab(
    frame: Float64[np.ndarray, "3 3"],
    center: Float64[np.ndarray, "3"],
    half: Float64[np.ndarray, "3"],
    beam: tuple[Float64[np.ndarray, "*n 3"], Points],
) -> tuple[Values, Values]:
    """Return where rays enter and leave a box, as multiples of their length; infinity and -infinity if they miss.

    Args:
        frame: (3, 3) unit vectors along its sides, in columns.
        center: (3,) world units.
        half: (3,) half of its sides, world units.
        beam: (3,) start of all rays or (n, 3) of each, and (n, 3) their directions.
    """
    origin, rays = beam
    start, heading = (origin - center) @ frame, rays @ frame
    heading = np.where(np.abs(heading) < 1e-300, 1e-300, heading)
    one, two = (-half - start) / heading, (half - start) / heading
    (a, b, c), (d, e, f) = np.minimum(one, two).T, np.maximum(one, two).T
    near, far = np.maximum(np.maximum(a, b), c), np.minimum(np.minimum(d, e), f)
    return np.where(near < far, near, np.inf), np.where(near < far, far, -np.inf)


def along_and_beside(
    away: Float64[np.ndarray, "*n 3"], rays: Points, radius: float
) -> tuple[Values, Float64[np.ndarray, "*n"]]:
    """Return the products of rays with the vector to a sphere's centre, and |vector|² - radius².

    Args:
        away: (3,) from the start of all rays to the centre, or (n, 3) from that of each.
        rays: (n, 3) directions.
        radius: World units.
    """
    if away.ndim == 1:
        return rays @ away, np.asarray(away @ away - radius**2)
    return np.einsum("ij,ij->i", rays, away), np.einsum("ij,ij->i", away, away) - radius**2


def lengths(vectors: Points) -> Values:
    """Return the lengths of vectors (n, 3)."""
    return np.asarray(np.sqrt(np.einsum("ij,ij->i", vectors, vectors)))


def gradient(shape: SolidShape, points: Points) -> Points:
    """Return the unit gradients of a distance field by central differences, outward normals on the surface.

    Args:
        shape: The shape.
        points: (n, 3) world units.
    """
    found = np.empty_like(points)
    for axis in range(3):
        step = np.zeros(3)
        step[axis] = DIFFERENCE
        found[:, axis] = shape.distance(points + step) - shape.distance(points - step)
    return np.asarray(found / lengths(found)[:, None])


def upright(turn: float) -> Float64[np.ndarray, "3 3"]:
    """Return the rotation about the vertical by an angle, radians."""
    c, s = math.cos(turn), math.sin(turn)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def _frame(axis: Float64[np.ndarray, "3"]) -> tuple[Float64[np.ndarray, "3"], ...]:
    """Return three orthogonal unit vectors, the last along the axis."""
    along = axis / np.linalg.norm(axis)
    other = np.eye(3)[np.abs(along).argmin()]
    x = np.cross(along, other)
    x /= np.linalg.norm(x)
    return x, np.cross(along, x), along


def _cylindrical(points: Points, axis: Float64[np.ndarray, "3"]) -> tuple[Values, Values]:
    """Return the coordinates of points along an axis through the origin, of unit length, and away from it."""
    height = points @ axis
    rest = points - height[:, None] * axis
    return height, lengths(rest)


def _turned(rng: np.random.Generator, axis: Float64[np.ndarray, "3"], out: Values, height: Values) -> Points:
    """Return points at distances from an axis and heights along it, at random angles around it."""
    x, y, along = _frame(axis)
    turn = rng.uniform(0, 2 * math.pi, len(out))
    around = np.cos(turn)[:, None] * x + np.sin(turn)[:, None] * y
    return np.asarray(out[:, None] * around + height[:, None] * along)


def _tube_angles(
    rng: np.random.Generator, count: int, ring: float, tube: float, ends: tuple[float, float]
) -> Values:
    """Return angles around the tube of a torus, 0 outwards, that make points uniform over the area: by rejection.

    The area at an angle is proportional to the distance from the axis, ring + tube cos(angle).
    """
    angles, missing = np.zeros(count), np.arange(count)
    while len(missing):
        drawn = rng.uniform(*ends, len(missing))
        kept = rng.uniform(0.0, ring + tube, len(missing)) < ring + tube * np.cos(drawn)
        angles[missing[kept]] = drawn[kept]
        missing = missing[~kept]
    return angles

"""How far a mesh is from the true surface: accuracy, completeness, F1, and the agreement of normals.

All distances are measured at points that are uniform over area. An error that is averaged over vertices falls when the
wrong part of a mesh gets fewer vertices; an error averaged over area does not. `gsplat_edu.evaluate.intersections`
counts self-intersections.

Chapter: 15_cloud_to_surface.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy.spatial import cKDTree

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.validation import ArrayLike, float64_array, in_range, whole_number
from gsplat_edu.evaluate.topology import Topology, topology
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.mesh import Mesh

Truth: TypeAlias = Mesh | tuple[ArrayLike, ArrayLike]
"""The true surface: a mesh, or points (n, 3) that are uniform over its area, with unit normals (n, 3)."""

Counts: TypeAlias = Callable[[Float64[np.ndarray, "n 3"]], Bool[np.ndarray, " n"]]
"""Returns which points of the truth count for completeness."""

CANDIDATES = 8
"""Number of nearest samples and middles of faces whose triangles are searched for the closest point of a mesh."""

AT_ONCE = 65_536
"""Points whose distances are computed together; limits memory to about 50 MB."""


@dataclass(frozen=True)
class Comparison:
    """How a surface is compared with the truth.

    Args:
        tau: Distance below which a point counts as correct, world units; F1 depends on it.
        samples: Number of samples of each mesh.
        seed: Seed of the samples.
        bounds: (2, 3) lower and upper corner of a box: samples outside it count on neither side. None for all.

    Raises:
        ArgumentError: a number is out of range or NaN, or the box is empty.
    """

    tau: float
    samples: int = 100_000
    seed: int = 0
    bounds: Float64[np.ndarray, "2 3"] | None = None

    def __post_init__(self) -> None:
        """Check the ranges."""
        in_range("tau", self.tau, 0.0, open_low=True)
        whole_number("samples", self.samples, 1)
        whole_number("seed", self.seed, 0)
        if self.bounds is not None:
            low, high = float64_array("bounds", self.bounds, (2, 3))
            if np.any(low >= high):
                raise ArgumentError("bounds: the upper corner has to be above the lower one on every axis")

    def inside(self, points: Float64[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
        """Return which points are inside the bounds."""
        if self.bounds is None:
            return np.ones(len(points), dtype=bool)
        within: Bool[np.ndarray, " n"] = ((points >= self.bounds[0]) & (points <= self.bounds[1])).all(axis=1)
        return within


@dataclass(frozen=True)
class DistanceScores:
    """Distances between a surface and the truth. None where the surface has no samples.

    Args:
        accuracy: Mean distance from the surface to the truth, world units; extra parts raise it.
        completeness: Mean distance from the truth to the surface, world units; missing parts raise it.
        chamfer: Mean of accuracy and completeness, world units.
        precision: Fraction of the surface closer than `tau` to the truth, 0 to 1.
        recall: Fraction of the truth closer than `tau` to the surface, 0 to 1.
        f1: Harmonic mean of precision and recall, 0 to 1; 0 if both are.
        tau: The threshold, world units.
        counted: Fraction of the truth's samples that count for completeness and recall, 0 to 1.
        spacing: Mean distance from a sample of the truth to the next one, world units. A truth given as points makes
            distances too long by a part of it: choose points so dense that it is small beside `tau`.
    """

    accuracy: float | None
    completeness: float | None
    chamfer: float | None
    precision: float
    recall: float
    f1: float
    tau: float
    counted: float
    spacing: float


@dataclass(frozen=True)
class SurfaceScores:
    """A mesh compared with the truth.

    Args:
        distances: Distances and F1.
        normal_cosine: Mean |cos| of the angle between the normals of closest points, both ways, 0 to 1. None if the
            mesh has no samples.
        normal_degrees: Mean of that angle, degrees, 0 to 90; a flipped normal counts as right.
        shape: Connectivity, area and volume of the mesh.
    """

    distances: DistanceScores
    normal_cosine: float | None
    normal_degrees: float | None
    shape: Topology


def sample_surface(
    mesh: Mesh, count: int, seed: int = 0
) -> tuple[Float64[np.ndarray, "n 3"], Float64[np.ndarray, "n 3"]]:
    """Sample points uniformly over the area of a mesh.

    The area is divided into `count` equal parts along the list of faces, with one sample in each. So the number of
    samples in a face differs by less than two from its fraction of the area times `count`.

    Args:
        mesh: The mesh. Faces without area receive no samples.
        count: Number of samples, at least 1.
        seed: Seed of the samples.

    Returns:
        points: (count, 3) world units; (0, 3) if the mesh has no area.
        normals: (count, 3) outward unit normals of their faces.

    Raises:
        ArgumentError: `count` or `seed` is no whole number in range, or the area is too large for a float.
    """
    sampled = _sample(mesh, whole_number("count", count, 1), whole_number("seed", seed, 0))
    return sampled.points, sampled.normals


def score_surface(
    mesh: Mesh, truth: Truth, comparison: Comparison, counts: Counts | None = None
) -> SurfaceScores:
    """Compare a mesh with the true surface.

    Distances to a mesh are to its triangles; distances to a truth given as points are to the nearest point.

    Args:
        mesh: The mesh; it may be empty.
        truth: The true surface.
        comparison: Threshold, samples and bounds.
        counts: Returns which points of the truth count for completeness, for example those of `visible_points`;
            None counts all.

    Raises:
        ShapeError: points or normals of the truth are not (n, 3).
        ArgumentError: a coordinate is NaN, or no point of the truth is left.
    """
    right = _Surface.of_truth(truth, comparison, counts)
    found = _Surface.of_mesh(mesh, comparison, comparison.seed)
    distances, agreement = _compare(found, right, comparison.tau)
    cosine = degrees = None
    if len(agreement):
        cosine = float(agreement.mean())
        degrees = float(np.degrees(np.arccos(np.minimum(agreement, 1.0))).mean())
    return SurfaceScores(distances, cosine, degrees, topology(mesh))


def score_points(
    points: ArrayLike, truth: Truth, comparison: Comparison, counts: Counts | None = None
) -> DistanceScores:
    """Compare points, such as those of a depth map, with the true surface.

    Args:
        points: (n, 3) world units. The scores weight each equally, so their density matters.
        truth: As for `score_surface`.
        comparison: As for `score_surface`.
        counts: As for `score_surface`.

    Raises:
        ShapeError: as for `score_surface`.
        ArgumentError: as for `score_surface`.
    """
    given = float64_array("points", points, ("n", 3))
    right = _Surface.of_truth(truth, comparison, counts)
    mine = _Samples(given, np.zeros_like(given), None)
    found = _Surface(mine.chosen(comparison.inside(given)), mine)
    return _compare(found, right, comparison.tau)[0]


def visible_points(
    points: ArrayLike,
    cameras: Sequence[Camera],
    depths: Sequence[np.ndarray],
    tolerance: float,
    views: int = 1,
) -> Bool[np.ndarray, " n"]:
    """Return which points the photos see: a virtual scan, which excludes what no method could reconstruct.

    A point is seen if it projects into the photo, and is at most `tolerance` behind the depth there. The inverse depth
    is interpolated between pixels, which is exact on planes. At the rim of a nearer object this is off by up to one
    pixel.

    Args:
        points: (n, 3) world units.
        cameras: The cameras.
        depths: For each camera (H, W), the true depth along the optical axis, world units; 0 or infinite where nothing
            is.
        tolerance: World units; above the error of the depths.
        views: Number of cameras that must see a point.

    Raises:
        ShapeError: `points` is not (n, 3).
        ArgumentError: a map's size differs from its camera's, a depth is NaN or negative, or a number is out of range.
    """
    places = float64_array("points", points, ("n", 3))
    in_range("tolerance", tolerance, 0.0)
    whole_number("views", views, 1)
    if len(depths) != len(cameras):
        raise ArgumentError(f"depths: are {len(depths)}, but there are {len(cameras)} cameras")
    seen = np.zeros(len(places), dtype=np.int64)
    for number, (camera, depth) in enumerate(zip(cameras, depths, strict=True)):
        if depth.shape != (camera.H, camera.W):
            raise ArgumentError(f"depths[{number}]: is {depth.shape}, but the photo {(camera.H, camera.W)}")
        if not np.all(depth >= 0):
            raise ArgumentError(f"depths[{number}]: has an entry that is NaN or negative")
        seen += _seen(places, camera, depth.astype(np.float64), tolerance)
    return np.asarray(seen >= views)


def triangle_distances(
    points: Float64[np.ndarray, "n 3"], triangles: Float64[np.ndarray, "n 3 3"]
) -> Float64[np.ndarray, " n"]:
    """Return the distance of each point to its triangle, world units. A triangle without area is its edges.

    Args:
        points: (n, 3) points.
        triangles: (n, 3, 3) corners of the triangle of each point.
    """
    normal = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    length = np.linalg.norm(normal, axis=1)
    over = length > 0
    nearest = np.full(len(points), np.inf)
    for corner in range(3):
        start = triangles[:, corner]
        edge, away = triangles[:, (corner + 1) % 3] - start, points - start
        squared = (edge * edge).sum(axis=1)
        along = (away * edge).sum(axis=1) / np.where(squared > 0, squared, 1.0)
        rest = away - np.clip(along, 0.0, 1.0)[:, None] * edge
        nearest = np.minimum(nearest, np.linalg.norm(rest, axis=1))
        over &= (np.cross(normal, edge) * away).sum(axis=1) >= 0
    height = np.abs((normal * (points - triangles[:, 0])).sum(axis=1)) / np.where(length > 0, length, 1.0)
    return np.where(over, height, nearest)


class _Samples(NamedTuple):
    """Points of a surface, the normal at each, and the triangle of each if it is a mesh."""

    points: Float64[np.ndarray, "n 3"]
    normals: Float64[np.ndarray, "n 3"]
    triangles: Float64[np.ndarray, "n 3 3"] | None

    def chosen(self, kept: Bool[np.ndarray, " n"]) -> _Samples:
        """Return some of the samples."""
        return _Samples(
            self.points[kept], self.normals[kept], None if self.triangles is None else self.triangles[kept]
        )


class _Surface(NamedTuple):
    """What is needed to measure distances from a surface and to it."""

    asking: _Samples  # whose distances to the other surface are measured
    places: _Samples  # where the other surface's closest points are searched
    share: float = 1.0  # fraction of the samples inside the bounds that ask

    @classmethod
    def of_mesh(cls, mesh: Mesh, comparison: Comparison, seed: int) -> _Surface:
        """Sample a mesh. The middles of its faces are places too, because faces may outnumber the samples."""
        samples = _sample(mesh, comparison.samples, seed)
        assert samples.triangles is not None, "samples of a mesh have triangles"
        doubled = mesh.face_normals()
        size = np.linalg.norm(doubled, axis=1)
        flat = size > 0
        corners = mesh.corners[flat]
        places = _Samples(
            np.concatenate([samples.points, corners.mean(axis=1)]),
            np.concatenate([samples.normals, doubled[flat] / size[flat, None]]),
            np.concatenate([samples.triangles, corners]),
        )
        return cls(samples.chosen(comparison.inside(samples.points)), places)

    @classmethod
    def of_truth(cls, truth: Truth, comparison: Comparison, counts: Counts | None) -> _Surface:
        """Sample the truth, and choose the points that count for completeness."""
        if isinstance(truth, Mesh):
            found = cls.of_mesh(truth, comparison, comparison.seed + 1)
        else:
            sizes: dict[str, int] = {}
            points = float64_array("truth points", truth[0], ("n", 3), sizes)
            given = _Samples(points, float64_array("truth normals", truth[1], ("n", 3), sizes), None)
            found = cls(given.chosen(comparison.inside(points)), given)
        asking = found.asking
        counted = np.ones(len(asking.points), dtype=bool) if counts is None else counts(asking.points)
        if not counted.any():
            raise ArgumentError("truth: has no point that counts; check the bounds, and what the cameras see")
        return cls(asking.chosen(counted), found.places, float(counted.mean()))


def _sample(mesh: Mesh, count: int, seed: int) -> _Samples:
    """Sample a mesh; see `sample_surface`."""
    with np.errstate(over="ignore", invalid="ignore"):
        doubled = mesh.face_normals()
        areas = np.linalg.norm(doubled, axis=1)
        below = np.cumsum(areas)
    if len(below) == 0 or below[-1] == 0:
        return _Samples(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3, 3)))
    if not np.isfinite(below[-1]):
        raise ArgumentError("mesh: its area is too large for a float; scale the scene down")
    rng = np.random.default_rng(seed)
    at = (np.arange(count) + rng.random(count)) / count * below[-1]
    face = np.minimum(np.searchsorted(below, at, side="right"), np.flatnonzero(areas)[-1])
    root, v = np.sqrt(rng.random(count)), rng.random(count)  # the root makes points uniform in the triangle
    weights = np.stack([1 - root, root * (1 - v), root * v], axis=1)
    corners = mesh.corners[face]
    points = (weights[:, :, None] * corners).sum(axis=1)
    return _Samples(points, doubled[face] / areas[face, None], corners)


def _compare(
    found: _Surface, right: _Surface, tau: float
) -> tuple[DistanceScores, Float64[np.ndarray, " both"]]:
    """Return the scores, and |cos| between the normals of closest points, both ways."""
    asked = right.asking
    spacing = 0.0
    if len(asked.points) > 1:
        spacing = float(cKDTree(asked.points).query(asked.points, k=2)[0][:, 1].mean())
    if len(found.asking.points) == 0:
        return DistanceScores(None, None, None, 0.0, 0.0, 0.0, tau, right.share, spacing), np.zeros(0)
    there, at = _nearest(found.asking.points, right.places)
    back, near = _nearest(asked.points, found.places)
    precision, recall = float((there < tau).mean()), float((back < tau).mean())
    f1 = 2 * precision * recall / (precision + recall) if precision + recall else 0.0
    accuracy, completeness = float(there.mean()), float(back.mean())
    agreement = np.concatenate(
        [
            np.abs((found.asking.normals * right.places.normals[at]).sum(axis=1)),
            np.abs((asked.normals * found.places.normals[near]).sum(axis=1)),
        ]
    )
    half = (accuracy + completeness) / 2
    scores = DistanceScores(accuracy, completeness, half, precision, recall, f1, tau, right.share, spacing)
    return scores, agreement


def _nearest(
    points: Float64[np.ndarray, "q 3"], surface: _Samples
) -> tuple[Float64[np.ndarray, " q"], Int64[np.ndarray, " q"]]:
    """Return the distance of each point to a surface, and the place that stands for the closest point.

    On a mesh, the triangles of the nearest places are searched. The result is the exact distance or, if the closest
    triangle has none of these places, slightly too long; it never exceeds the distance to the nearest place.
    """
    tree = cKDTree(surface.points)
    best, index = np.full(len(points), np.inf), np.zeros(len(points), np.int64)
    k = 1 if surface.triangles is None else min(CANDIDATES, len(surface.points))
    for first in range(0, len(points), AT_ONCE):
        part = slice(first, first + AT_ONCE)
        apart, rows = tree.query(points[part], k=[*range(1, k + 1)])
        for column in range(k):
            row = rows[:, column]
            distance = apart[:, column]
            if surface.triangles is not None:
                distance = np.minimum(distance, triangle_distances(points[part], surface.triangles[row]))
            closer = distance < best[part]
            best[part][closer], index[part][closer] = distance[closer], row[closer]
    return best, index


def _seen(
    points: Float64[np.ndarray, "n 3"],
    camera: Camera,
    depth: Float64[np.ndarray, "H W"],
    tolerance: float,
) -> Bool[np.ndarray, " n"]:
    """Return which points a camera sees."""
    x, y, z = camera.world_to_cam(points).T
    ahead = z > 0
    safe = np.where(ahead, z, 1.0)
    u, v = camera.fx * x / safe + camera.cx, camera.fy * y / safe + camera.cy
    ahead &= (np.abs(u - (camera.W - 1) / 2) <= camera.W / 2) & (
        np.abs(v - (camera.H - 1) / 2) <= camera.H / 2
    )
    inverse = np.zeros_like(depth)
    np.divide(1.0, depth, out=inverse, where=depth > 0)
    u, v = (np.clip(np.where(ahead, at, 0), 0, size - 1) for at, size in ((u, camera.W), (v, camera.H)))
    left, top = np.floor(u).astype(np.int64), np.floor(v).astype(np.int64)
    right, below = np.minimum(left + 1, camera.W - 1), np.minimum(top + 1, camera.H - 1)
    a, b = u - left, v - top
    there = (1 - b) * ((1 - a) * inverse[top, left] + a * inverse[top, right]) + b * (
        (1 - a) * inverse[below, left] + a * inverse[below, right]
    )
    return np.asarray(ahead & ((z - tolerance) * there <= 1.0))

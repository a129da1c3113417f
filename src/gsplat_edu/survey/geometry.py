"""Geometry of a capture: how the cameras are arranged, and how much of their views they share."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float64, Int64

from gsplat_edu.paths.following import point_nearest_most_axes
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.rig import scene_extent, settled_eyes

SAMPLES = 300
"""Sample points per camera: enough to know a median of ratios to a tenth of their spread."""

GRID = (20, 15)
"""Columns and rows of the sample rays if there is no cloud: `SAMPLES` in total."""

MOST_POINTS = 20_000
"""Larger clouds are subsampled to this size (every n-th point), so that a thousand cameras take seconds."""

CELLS = 16
"""Cells along the image's longer side for the occlusion test."""

BEHIND = 1.15
"""A point is occluded if its depth exceeds this multiple of the 10th percentile in its cell."""

CANDIDATES = 32
"""Neighbours are chosen among this many cameras, nearest in position and direction."""

NEIGHBOURS = 8
"""Maximum number of neighbours per camera: enough for a median, few enough to be near."""

SHARED = 0.25
"""A neighbour must see at least this weighted share of what the camera sees."""

LEVEL = 4
"""Shares are weighted by this power of the cosine between the optical axes: 0.56 at 30 degrees, 0.06 at 60."""

CLOSE = 0.1
"""A centre nearer than this multiple of the cameras' extent lies among the cameras and is not their subject."""

INWARD, OUTWARD, FORWARD, FREE = "inward", "outward", "forward", "free"

MOST = 0.7
"""An arrangement needs at least this share of the cameras."""

FORWARD_SPREAD = math.radians(20.0)
"""Cameras face one way if their median angle to the mean viewing direction is below this."""


AWAY = math.radians(45.0)
"""A camera faces away if its axis points at least this far from the point or direction that the others look at: more
than half of any usual field of view."""

AWAY_FACTOR = 2.5
"""The angle must also exceed this multiple of the cameras' 75th percentile, since close-ups of details face aside."""

SEES_LITTLE = 0.05
"""A camera faces away if it sees fewer points than this fraction of the median camera's count."""

ALONE = 0.05
"""A camera is isolated if no neighbour sees more than this share of what it sees. The lowest share among 158 cameras of
three captures was 0.7."""


@dataclass(frozen=True, eq=False)
class Geometry:
    """The cameras and points of a capture, with derived quantities computed on first use.

    Args:
        cameras: At least one.
        points: (N, 3) the capture's own points, world units; N is 0 if it has none.
    """

    cameras: Sequence[Camera]
    points: Float64[np.ndarray, "N 3"]

    @cached_property
    def eyes(self) -> Float64[np.ndarray, "C 3"]:
        """(C, 3) camera positions."""
        return np.stack([camera.eye for camera in self.cameras])

    @cached_property
    def axes(self) -> Float64[np.ndarray, "C 3"]:
        """(C, 3) viewing directions, unit length."""
        return np.stack([camera.R[2] for camera in self.cameras])

    @cached_property
    def some_points(self) -> Float64[np.ndarray, "n 3"]:
        """(n, 3) at most 20,000 of the points, evenly spaced in the list."""
        return self.points[:: max(1, -(-len(self.points) // MOST_POINTS))]

    @cached_property
    def centre(self) -> Float64[np.ndarray, "3"] | None:
        """(3,) the point nearest to most optical axes, if it is in front of most cameras; otherwise None.

        See `gsplat_edu.paths.following.point_nearest_most_axes`.
        """
        centre = point_nearest_most_axes(self.cameras)
        return centre if centre is not None and np.mean(self.ahead(centre) > 0) >= MOST else None

    def angles_to(self, point: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, " C"]:
        """Return the angle between each optical axis and the direction to a point, radians."""
        lengths = np.maximum(np.linalg.norm(point - self.eyes, axis=1), 1e-300)
        return np.asarray(np.arccos(np.clip(self.ahead(point) / lengths, -1.0, 1.0)))

    def ahead(self, point: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, " C"]:
        """Return the depth of a point in each camera, world units."""
        return np.asarray(np.sum((point - self.eyes) * self.axes, axis=1))

    @cached_property
    def angles_to_mean(self) -> Float64[np.ndarray, " C"]:
        """(C,) angle between each optical axis and their median direction, radians."""
        mean = np.median(self.axes, axis=0)
        cosines = self.axes @ mean / max(float(np.linalg.norm(mean)), 1e-300)
        return np.asarray(np.arccos(np.clip(cosines, -1.0, 1.0)))

    @cached_property
    def in_sight(self) -> Bool[np.ndarray, "C n"]:
        """(C, n) whether each of `some_points` projects into each camera's image; occlusion is ignored."""
        rows = [inside(camera, self.some_points) for camera in self.cameras]
        return np.stack(rows)

    @cached_property
    def depth(self) -> float:
        """Estimated depth of the subject, from the points, the common centre or the cameras' extent; world units."""
        depths = [
            float(np.median(camera.world_to_cam(self.some_points[seen])[:, 2]))
            for camera, seen in zip(self.cameras, self.in_sight, strict=True)
            if seen.any()
        ]
        if depths:
            return float(np.median(depths))
        extent = scene_extent(self.cameras)
        ahead = 0.0 if self.centre is None else float(np.median(self.ahead(self.centre)))
        return ahead if ahead > CLOSE * extent else extent

    @cached_property
    def spread(self) -> float:
        """Largest distance of a camera from the mean position, divided by the subject's depth; without strays."""
        settled = settled_eyes(self.cameras)
        return float(np.linalg.norm(settled - settled.mean(axis=0), axis=1).max()) / self.depth

    @cached_property
    def arrangement(self) -> str:
        """Arrangement of the cameras: `INWARD`, `OUTWARD`, `FORWARD`, or `FREE` if it is none of these."""
        if np.median(self.angles_to_mean) < FORWARD_SPREAD:
            return FORWARD
        if self.centre is not None and np.mean([_holds(c, self.centre) for c in self.cameras]) >= MOST:
            return INWARD
        outwards = np.sum((self.eyes - settled_eyes(self.cameras).mean(axis=0)) * self.axes, axis=1) > 0
        return OUTWARD if np.mean(outwards) >= MOST else FREE

    @cached_property
    def samples(self) -> tuple[Float64[np.ndarray, "_ 3"], ...]:
        """Sample points of what each camera sees, world units; empty if it sees no point of the cloud."""
        if not len(self.points):
            return tuple(self._on_rays(camera) for camera in self.cameras)
        found = []
        for camera, seen in zip(self.cameras, self.in_sight, strict=True):
            rows = _unhidden(camera, self.some_points[seen])
            found.append(self.some_points[seen][rows[:: max(1, -(-len(rows) // SAMPLES))]])
        return tuple(found)

    def _on_rays(self, camera: Camera) -> Float64[np.ndarray, "n 3"]:
        """Return points on a grid of rays, at the subject's depth."""
        u, v = np.meshgrid(
            (np.arange(GRID[0]) + 0.5) * camera.W / GRID[0] - 0.5,
            (np.arange(GRID[1]) + 0.5) * camera.H / GRID[1] - 0.5,
        )
        rays = np.stack(
            [(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)], axis=-1
        ).reshape(-1, 3)
        return np.asarray(self.depth * rays @ camera.R + camera.eye)

    @cached_property
    def shares(self) -> tuple[dict[int, float], ...]:
        """For each camera, its nearest cameras in order and the share of its view that each of them also sees.

        The distance is |e_i - e_j| / depth + the angle between the optical axes. Shares are multiplied by the fourth
        power of that angle's cosine, since two sides of an object look different.
        """
        return tuple(self._shares(i) for i in range(len(self.cameras)))

    def _shares(self, i: int) -> dict[int, float]:
        cosines = np.clip(self.axes @ self.axes[i], -1.0, 1.0)
        away = np.linalg.norm(self.eyes - self.eyes[i], axis=1) / self.depth + np.arccos(cosines)
        away[i] = np.inf
        near = np.argsort(away, kind="stable")[: min(CANDIDATES, len(away) - 1)]
        if not len(self.samples[i]):
            return {}
        seen = self._seen_by(near, self.samples[i]) * np.maximum(cosines[near], 0.0) ** LEVEL
        return dict(zip(near.tolist(), seen.tolist(), strict=True))

    def _seen_by(
        self, rows: Int64[np.ndarray, " r"], points: Float64[np.ndarray, "n 3"]
    ) -> Float64[np.ndarray, " r"]:
        """Return the share of points inside the image of each given camera; a vectorised `inside`."""
        x, y, z = np.moveaxis(
            (points - self.eyes[rows, None]) @ self._rotations[rows].transpose(0, 2, 1), -1, 0
        )
        fx, fy, cx, cy, W, H = (column[:, None] for column in self._intrinsics[rows].T)
        depth = np.where(z > 0, z, np.nan)
        u, v = fx * x / depth + cx, fy * y / depth + cy
        return np.asarray(np.mean((u > -0.5) & (u < W - 0.5) & (v > -0.5) & (v < H - 0.5), axis=1))

    @cached_property
    def _rotations(self) -> Float64[np.ndarray, "C 3 3"]:
        return np.stack([camera.R for camera in self.cameras])

    @cached_property
    def _intrinsics(self) -> Float64[np.ndarray, "C 6"]:
        return np.array([(c.fx, c.fy, c.cx, c.cy, c.W, c.H) for c in self.cameras], dtype=np.float64)

    @cached_property
    def neighbours(self) -> tuple[Int64[np.ndarray, "..."], ...]:
        """For each camera, at most 8 nearest cameras that share at least a quarter of its view."""
        found = []
        for shares in self.shares:
            good = [j for j, share in shares.items() if share >= SHARED]
            found.append(np.array(good[:NEIGHBOURS], dtype=np.int64))
        return tuple(found)


def facing_away(geometry: Geometry) -> set[int]:
    """Return the cameras that face away from the subject, see few points, or share no view with others."""
    return _aside(geometry) | _few_points(geometry) | _alone(geometry)


def _aside(geometry: Geometry) -> set[int]:
    """Return the cameras whose axis misses the common centre or, in a forward capture, the common direction."""
    if geometry.arrangement == INWARD and geometry.centre is not None:
        angles = geometry.angles_to(geometry.centre)
    elif geometry.arrangement == FORWARD:
        angles = geometry.angles_to_mean
    else:
        return set()
    limit = max(AWAY, AWAY_FACTOR * float(np.quantile(angles, 0.75)))
    return set(np.flatnonzero(angles > limit).tolist())


def _few_points(geometry: Geometry) -> set[int]:
    """Return the cameras that see far fewer points than others."""
    counts = geometry.in_sight.sum(axis=1)
    return set(np.flatnonzero(counts < SEES_LITTLE * np.median(counts)).tolist())


def _alone(geometry: Geometry) -> set[int]:
    """Return the cameras whose subject no other camera sees; none if that is usual in this capture."""
    best = np.array([max(shares.values(), default=0.0) for shares in geometry.shares])
    return set(np.flatnonzero(best < ALONE).tolist()) if np.median(best) > 2 * ALONE else set()


def inside(camera: Camera, points: Float64[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
    """Return which points lie in front of a camera and inside its image.

    Args:
        camera: The camera.
        points: (n, 3) world units.
    """
    u, v, z = camera.project(camera.world_to_cam(points))
    # points behind the camera have NaN for u and v, and comparisons with NaN are false
    return np.asarray(
        (z > 0) & (u > -0.5) & (u < camera.W - 0.5) & (v > -0.5) & (v < camera.H - 0.5), dtype=np.bool_
    )


def _holds(camera: Camera, point: Float64[np.ndarray, "3"]) -> bool:
    return bool(inside(camera, point[None])[0])


def _unhidden(camera: Camera, points: Float64[np.ndarray, "n 3"]) -> Int64[np.ndarray, " m"]:
    """Return the points that are probably visible: those near the front of their image cell."""
    u, v, z = camera.project(camera.world_to_cam(points))
    size = max(camera.W, camera.H) / CELLS
    cell = np.floor((v + 0.5) / size).astype(np.int64) * CELLS + np.floor((u + 0.5) / size).astype(np.int64)
    front = np.full(CELLS * CELLS + CELLS, np.inf)
    order = np.lexsort((z, cell))
    starts = np.flatnonzero(np.r_[True, np.diff(cell[order]) != 0]) if len(order) else order
    counts = np.diff(np.r_[starts, len(order)])
    front[cell[order[starts]]] = z[order[starts + counts // 10]]
    return np.flatnonzero(z <= BEHIND * front[cell])

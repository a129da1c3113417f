"""What cameras see of one another's subject: sample points, shared views, neighbours, how the cameras stand."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float64, Int64

from gsplat_edu.camera import Camera
from gsplat_edu.data.dataset import scene_extent
from gsplat_edu.evaluate.following import point_nearest_most_axes

SAMPLES = 300
"""Points that stand for what a camera sees: the median of as many ratios is known to a tenth of their spread."""

GRID = (20, 15)
"""Columns and rows of the rays that stand for it where there is no cloud: as many."""

MOST_POINTS = 20_000
"""Points of a cloud that are looked at: every n-th of a larger one, so that a thousand cameras take seconds."""

CELLS = 16
"""Cells along an image's longer side in which points are told to be hidden by others."""

BEHIND = 1.15
"""A point farther than this times the nearest tenth of its cell is taken for hidden."""

CANDIDATES = 32
"""Cameras, nearest in place and direction, among which neighbours are looked for."""

NEIGHBOURS = 8
"""Most neighbours an image is compared with: enough for a median, few enough to be near."""

SHARED = 0.25
"""Least share of what a camera sees that a neighbour sees too, from a direction not too different."""

LEVEL = 4
"""Power of the cosine between optical axes that shares are multiplied by: 0.56 at 30 degrees, 0.06 at 60."""

CLOSE = 0.1
"""A centre nearer than this times the extent of the cameras is where they stand, not what they look at."""

INWARD, OUTWARD, FORWARD, FREE = "inward", "outward", "forward", "free"

MOST = 0.7
"""Share of the cameras that makes an arrangement what it is called."""

FORWARD_SPREAD = math.radians(20.0)
"""Largest median angle to the mean viewing direction of cameras that are said to look one way."""


@dataclass(frozen=True, eq=False)
class Geometry:
    """Cameras, and the cloud of their capture.

    Args:
        cameras: At least one.
        points: (N, 3) the capture's own points, world units; none where it has none.
    """

    cameras: Sequence[Camera]
    points: Float64[np.ndarray, "N 3"]

    @cached_property
    def eyes(self) -> Float64[np.ndarray, "C 3"]:
        """(C, 3) where the cameras stand."""
        return np.stack([camera.eye for camera in self.cameras])

    @cached_property
    def axes(self) -> Float64[np.ndarray, "C 3"]:
        """(C, 3) where they look, unit length."""
        return np.stack([camera.R[2] for camera in self.cameras])

    @cached_property
    def some_points(self) -> Float64[np.ndarray, "n 3"]:
        """(n, 3) at most 20,000 of the points, evenly over the list."""
        return self.points[:: max(1, -(-len(self.points) // MOST_POINTS))]

    @cached_property
    def centre(self) -> Float64[np.ndarray, "3"] | None:
        """(3,) the point nearest to the optical axes of most cameras, which most have in front; None if there is none.

        `gsplat_edu.evaluate.following.point_nearest_most_axes` says how it is found.
        """
        centre = point_nearest_most_axes(self.cameras)
        return centre if centre is not None and np.mean(self.ahead(centre) > 0) >= MOST else None

    def angles_to(self, point: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, " C"]:
        """Return the angle between each optical axis and the direction of a point, radians."""
        lengths = np.maximum(np.linalg.norm(point - self.eyes, axis=1), 1e-300)
        return np.asarray(np.arccos(np.clip(self.ahead(point) / lengths, -1.0, 1.0)))

    def ahead(self, point: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, " C"]:
        """Return how far a point lies in front of each camera, world units."""
        return np.asarray(np.sum((point - self.eyes) * self.axes, axis=1))

    @cached_property
    def angles_to_mean(self) -> Float64[np.ndarray, " C"]:
        """(C,) angle between each optical axis and the direction of their median, radians."""
        mean = np.median(self.axes, axis=0)
        cosines = self.axes @ mean / max(float(np.linalg.norm(mean)), 1e-300)
        return np.asarray(np.arccos(np.clip(cosines, -1.0, 1.0)))

    @cached_property
    def in_sight(self) -> Bool[np.ndarray, "C n"]:
        """(C, n) which of `some_points` lies in which camera's picture, hidden or not."""
        rows = [inside(camera, self.some_points) for camera in self.cameras]
        return np.stack(rows)

    @cached_property
    def depth(self) -> float:
        """How far what is looked at lies from the cameras, as far as anything says so; world units."""
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
        """Largest distance of a camera from the mean of all, in depths of what they look at."""
        return float(np.linalg.norm(self.eyes - self.eyes.mean(axis=0), axis=1).max()) / self.depth

    @cached_property
    def arrangement(self) -> str:
        """How the cameras stand: around something, looking out, looking one way, or none of these."""
        if np.median(self.angles_to_mean) < FORWARD_SPREAD:
            return FORWARD
        if self.centre is not None and np.mean([_holds(c, self.centre) for c in self.cameras]) >= MOST:
            return INWARD
        outwards = np.sum((self.eyes - self.eyes.mean(axis=0)) * self.axes, axis=1) > 0
        return OUTWARD if np.mean(outwards) >= MOST else FREE

    @cached_property
    def samples(self) -> tuple[Float64[np.ndarray, "_ 3"], ...]:
        """For each camera points that stand for what it sees, world units; none where it sees no point of the cloud."""
        if not len(self.points):
            return tuple(self._on_rays(camera) for camera in self.cameras)
        found = []
        for camera, seen in zip(self.cameras, self.in_sight, strict=True):
            rows = _unhidden(camera, self.some_points[seen])
            found.append(self.some_points[seen][rows[:: max(1, -(-len(rows) // SAMPLES))]])
        return tuple(found)

    def _on_rays(self, camera: Camera) -> Float64[np.ndarray, "n 3"]:
        """Return points on a grid of rays, at the depth of what is looked at."""
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
        """For each camera the others near it, the nearest first, with the share of what it sees that they see too.

        Near is |e_i - e_j| / depth + angle between the optical axes. A share is multiplied by the fourth power of that
        angle's cosine, for two sides of a thing are not the same.
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
        """Return the share of points in the picture of each of some cameras; `inside`, for all at once."""
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
        """For each camera the nearest that see the same: at most 8, each with a share of a quarter."""
        found = []
        for shares in self.shares:
            good = [j for j, share in shares.items() if share >= SHARED]
            found.append(np.array(good[:NEIGHBOURS], dtype=np.int64))
        return tuple(found)


def inside(camera: Camera, points: Float64[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
    """Say which points lie in front of a camera and inside its picture.

    Args:
        camera: The camera.
        points: (n, 3) world units.
    """
    u, v, z = camera.project(camera.world_to_cam(points))
    # what lies behind has NaN for u and v, which compares as outside
    return np.asarray(
        (z > 0) & (u > -0.5) & (u < camera.W - 0.5) & (v > -0.5) & (v < camera.H - 0.5), dtype=np.bool_
    )


def _holds(camera: Camera, point: Float64[np.ndarray, "3"]) -> bool:
    return bool(inside(camera, point[None])[0])


def _unhidden(camera: Camera, points: Float64[np.ndarray, "n 3"]) -> Int64[np.ndarray, " m"]:
    """Return the points that are probably not behind others: near the front ones of their cell of the image."""
    u, v, z = camera.project(camera.world_to_cam(points))
    size = max(camera.W, camera.H) / CELLS
    cell = np.floor((v + 0.5) / size).astype(np.int64) * CELLS + np.floor((u + 0.5) / size).astype(np.int64)
    front = np.full(CELLS * CELLS + CELLS, np.inf)
    order = np.lexsort((z, cell))
    starts = np.flatnonzero(np.r_[True, np.diff(cell[order]) != 0]) if len(order) else order
    counts = np.diff(np.r_[starts, len(order)])
    front[cell[order[starts]]] = z[order[starts + counts // 10]]
    return np.flatnonzero(z <= BEHIND * front[cell])

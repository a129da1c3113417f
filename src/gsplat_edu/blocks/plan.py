"""Split a capture on the ground: recursive halving into cells, each with a margin, and the plan as a file.

Coordinates are those of the capture minus its origin. On the ground they are (a, b), along two horizontal axes that are
turned so that the cameras fill their rectangle best.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float64

from gsplat_edu.base.errors import CheckpointError
from gsplat_edu.base.reading import parse_json, read_text
from gsplat_edu.base.records import record_of
from gsplat_edu.paths.orbits import common_up
from gsplat_edu.runs.blocks_folder import MOST_BLOCKS, PLAN
from gsplat_edu.runs.folder import write_json
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.rig import settled_eyes

Points = Float64[np.ndarray, "N 3"]
Pair = tuple[float, float]

MARGIN = 0.025
"""Width of the margin around a cell, as a fraction of the cell's side; both blocks learn what it shows. 0.05 costs
0.04 dB (the earlier results that benchmarks/RESULTS.md names)."""

OUTLIERS = 0.01
"""The ground's rectangle leaves out this fraction of the points on each side, but no camera."""

REACH = 0.5
"""Ignore points that lie outside the cameras' rectangle by more than this fraction of its longer side."""

TURNS = 90
"""Number of directions, one degree apart, in which the rectangle of the cameras is measured."""

VIEWS_PER_BLOCK = 200
"""Training views for each block if the number of blocks is chosen automatically."""


@dataclass(frozen=True)
class Ground:
    """A horizontal plane with two axes.

    Args:
        centre: The zero of the axes, relative to the capture's origin.
        axes: Unit vectors of a, of b, and up.
    """

    centre: tuple[float, float, float]
    axes: tuple[tuple[float, float, float], ...]

    def coordinates(self, points: Float[np.ndarray, "N 3"]) -> Points:
        """Return (a, b, height) of points.

        The sums have a fixed order, so that every machine gets the same bits.

        Args:
            points: (N, 3) world units.
        """
        x, y, z = (points[:, i].astype(np.float64) - self.centre[i] for i in range(3))
        return np.stack([u * x + v * y + w * z for u, v, w in self.axes], axis=1)


@dataclass(frozen=True)
class Cell:
    """A rectangle on the ground, half-open: it includes its low edges. Outer cells reach to infinity.

    Args:
        low: Smallest a and b.
        high: Upper bound of a and b.
    """

    low: Pair
    high: Pair

    def holds(self, places: Float64[np.ndarray, "N D"]) -> Bool[np.ndarray, " N"]:
        """Return which places lie in the cell.

        Args:
            places: (N, 2) or more columns, of which the first two are a and b.
        """
        inside = np.ones(len(places), dtype=bool)
        for i in range(2):
            inside &= (places[:, i] >= self.low[i]) & (places[:, i] < self.high[i])
        return inside

    def clipped(self, low: Pair, high: Pair) -> Cell:
        """Return the part of the cell inside a rectangle."""
        a, b = (max(x, y) for x, y in zip(self.low, low, strict=True))
        c, d = (min(x, y) for x, y in zip(self.high, high, strict=True))
        return Cell((a, b), (c, d))

    def enlarged(self, low: Pair, high: Pair) -> Cell:
        """Return the cell with a margin on each side that is a fraction of the side of its part in a rectangle."""
        part = self.clipped(low, high)
        by = [MARGIN * (part.high[i] - part.low[i]) for i in range(2)]
        return Cell((self.low[0] - by[0], self.low[1] - by[1]), (self.high[0] + by[0], self.high[1] + by[1]))

    def json(self) -> dict[str, list[float | None]]:
        """Return the cell for a file; null stands for infinity."""
        return {
            name: [value if math.isfinite(value) else None for value in pair]
            for name, pair in (("low", self.low), ("high", self.high))
        }


@dataclass(frozen=True)
class Block:
    """One part of a capture.

    Args:
        core: The cell whose Gaussians the merged scene keeps.
        train: Names of the training views, sorted.
        test: Names of the held-out views that look at the core, sorted.
        start: SHA-256 of the file with the Gaussians to start from; "" before it is written.
        max_gaussians: Cap on the number of Gaussians; None for that of the recipe.
        iterations: Length of the training; None for that of the recipe.
    """

    core: Cell
    train: tuple[str, ...]
    test: tuple[str, ...]
    start: str = ""
    max_gaussians: int | None = None
    iterations: int | None = None


@dataclass(frozen=True)
class Area:
    """What is split: the ground, its rectangle and the range of heights.

    Args:
        ground: Plane and axes.
        low: Smallest a and b of what counts.
        high: Largest a and b of what counts.
        heights: Lowest and highest place.
    """

    ground: Ground
    low: Pair
    high: Pair
    heights: Pair


@dataclass(frozen=True)
class BlockPlan:
    """A capture's blocks and how they are trained.

    Args:
        capture: Path of the capture.
        origin: What is subtracted from the capture's coordinates.
        area: The ground.
        blocks: The blocks.
        recipe: Sections "train", "data" and so on of each block's run, as in config.json.
        views: SHA-256 of the files that hold the views at the time of the split: cameras.json and, with the digest of
            every photo and mask, photos.json.
    """

    capture: str
    origin: tuple[float, float, float]
    area: Area
    blocks: tuple[Block, ...]
    recipe: dict[str, Any] = dataclasses.field(default_factory=dict)
    views: dict[str, str] = dataclasses.field(default_factory=dict)

    @property
    def cores(self) -> list[Cell]:
        """The cells."""
        return [block.core for block in self.blocks]

    def write(self, folder: Path) -> None:
        """Write plan.json.

        Raises:
            OSError: the file cannot be written. An existing file is unchanged.
        """
        contents = dataclasses.asdict(self)
        contents["blocks"] = [
            dataclasses.asdict(block) | {"core": block.core.json()} for block in self.blocks
        ]
        write_json(folder / PLAN, contents)

    @classmethod
    def read(cls, folder: Path) -> BlockPlan:
        """Read plan.json.

        Raises:
            CheckpointError: the folder has no plan, or a damaged one.
        """
        path = folder / PLAN
        if not path.is_file():
            raise CheckpointError(
                f"{folder}: has no {PLAN}; `train CAPTURE --out {folder} --blocks auto --until split` makes it"
            )
        try:
            found = parse_json(read_text(path))
            for block in found["blocks"]:
                for name, infinity in (("low", -math.inf), ("high", math.inf)):
                    ends = block["core"][name]
                    block["core"][name] = [infinity if value is None else value for value in ends]
            plan: BlockPlan = record_of("", found, cls)
            if not all(isinstance(plan.recipe.get(section), dict) for section in ("train", "data")):
                raise ValueError("recipe: lacks a section")
        except (ValueError, KeyError, TypeError) as error:
            raise CheckpointError(f"{path}: is damaged ({error}); restore it, or split again") from None
        return plan

    def digest(self) -> str:
        """Return a digest of everything except the capture's path, which differs between machines."""
        contents = dataclasses.asdict(dataclasses.replace(self, capture=""))
        return hashlib.sha256(json.dumps(contents, sort_keys=True).encode()).hexdigest()


def automatic_count(views: int) -> int:
    """Return the number of blocks for a number of training views."""
    return min(max(round(views / VIEWS_PER_BLOCK), 1), MOST_BLOCKS)


def measured_area(cameras: Sequence[Camera], points: Points) -> Area:
    """Find the ground of a capture: up from its cameras, axes along the smallest rectangle that holds them.

    Strays (`gsplat_edu.scene.rig.stray_eyes`) do not count.

    Args:
        cameras: At least one.
        points: (N, 3) points of the scene, world units.
    """
    up = common_up(cameras)
    eyes = settled_eyes(cameras)
    centre = eyes.mean(axis=0)
    side = np.cross(up, np.eye(3)[int(np.argmin(np.abs(up)))])
    side /= np.linalg.norm(side)
    other = np.cross(up, side)
    flat = np.stack([(eyes - centre) @ side, (eyes - centre) @ other], axis=1)
    turns = np.radians(np.arange(TURNS))
    sizes = [float(np.prod(np.ptp(flat @ _turned(turn), axis=0))) for turn in turns]
    turn = _turned(turns[int(np.argmin(sizes))])
    a, b = (turn.T @ np.stack([side, other])).tolist()
    ground = Ground(_triple(centre.tolist()), (_triple(a), _triple(b), _triple(up.tolist())))
    seen, there = ground.coordinates(eyes), ground.coordinates(points)
    low, high = seen[:, :2].min(axis=0), seen[:, :2].max(axis=0)
    reach = REACH * max(float((high - low).max()), 1e-9)
    near = ((there[:, :2] >= low - reach) & (there[:, :2] <= high + reach)).all(axis=1)
    kept = there[near] if near.any() else seen
    edges = np.quantile(kept, (OUTLIERS, 1 - OUTLIERS), axis=0)
    low, high = np.minimum(low, edges[0, :2]), np.maximum(high, edges[1, :2])
    return Area(ground, _pair(low), _pair(high), _pair(edges[:, 2]))


def halved(area: Area, cameras: Sequence[Camera], points: Points, count: int) -> list[Cell]:
    """Split the ground into cells, recursively, each time across the longer side.

    Each cut divides the cameras and points in proportion to the cells on both sides. All cameras together weigh as much
    as all points.

    Args:
        area: The ground.
        cameras: At least one.
        points: (N, 3) points of the scene, world units.
        count: Number of cells.

    Returns:
        The cells; the outer ones reach to infinity.
    """
    eyes = area.ground.coordinates(np.stack([camera.eye for camera in cameras]))[:, :2]
    there = area.ground.coordinates(points)[:, :2]
    there = there[Cell(area.low, area.high).holds(there)]
    places = np.concatenate([eyes, there])
    weights = np.concatenate([np.full(len(part), 1 / max(len(part), 1)) for part in (eyes, there)])
    whole = Cell((-math.inf, -math.inf), (math.inf, math.inf))
    return _halved(area, whole, places, weights, count)


def _halved(
    area: Area, cell: Cell, places: np.ndarray, weights: Float64[np.ndarray, " N"], count: int
) -> list[Cell]:
    part = cell.clipped(area.low, area.high)
    if count == 1:
        return [cell]
    axis = int(part.high[1] - part.low[1] > part.high[0] - part.low[0])
    few = count // 2
    cut = _cut(places[:, axis], weights, few / count, (part.low[axis], part.high[axis]))
    lower, upper = list(cell.high), list(cell.low)
    lower[axis] = upper[axis] = cut
    below = places[:, axis] < cut
    first, second = Cell(cell.low, _pair(lower)), Cell(_pair(upper), cell.high)
    return [
        *_halved(area, first, places[below], weights[below], few),
        *_halved(area, second, places[~below], weights[~below], count - few),
    ]


def _cut(places: np.ndarray, weights: Float64[np.ndarray, " N"], share: float, ends: Pair) -> float:
    """Return the place with this share of the weights below it; without weights, divide the length."""
    if len(places) < 2:
        return ends[0] + share * (ends[1] - ends[0])
    order = np.argsort(places, kind="stable")
    ranked, sums = places[order], np.cumsum(weights[order])
    at = min(max(int(np.searchsorted(sums, share * sums[-1])), 1), len(ranked) - 1)
    return float((ranked[at - 1] + ranked[at]) / 2)


def _turned(turn: float) -> Float64[np.ndarray, "2 2"]:
    return np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]])


def _pair(values: Sequence[float] | np.ndarray) -> Pair:
    a, b = (float(value) for value in values)
    return a, b


def _triple(values: Sequence[float]) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    return x, y, z

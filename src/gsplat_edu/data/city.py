"""A seeded procedural city, photographed by a drone and from its streets: a capture as large as a test needs.

Boxes stand on lots between streets. Drone photos look down obliquely from a grid, in four directions; the city grows
with their number, so that each place is seen equally often. The rays are those of `gsplat_edu.data.outdoors`, and
poses and points are exact.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path

import numpy as np
from jaxtyping import Float64, Int64, UInt8
from PIL import Image

from gsplat_edu.base.validation import in_range, whole_number
from gsplat_edu.data.city_paint import (
    PITCH,
    Buildings,
    facade_colors,
    ground_colors,
)
from gsplat_edu.data.outdoors import SUN, SUPERSAMPLING, box_hits, camera_rays, sky_colors
from gsplat_edu.data.writers import write_model
from gsplat_edu.scene.camera import Camera, look_at

Rows = Float64[np.ndarray, "N 3"]

SPACING = 2.5
"""Distance between the drone's photos, world units; about 25 of them show each place."""

ALTITUDE = 8.0
"""Mean height of the drone, above the tallest tower."""

TILT = math.radians(50.0)
"""Angle by which the drone looks down."""

EYE_LEVEL = 0.45
"""Height of cameras in the streets."""

FOCAL = 0.9
"""Focal length of every camera in widths of its photo."""

HAZE = 80.0
"""Distance over which things fade into the haze."""


@dataclass(frozen=True)
class City:
    """A city and its photos, all determined by these numbers.

    Args:
        photos: Number of photos.
        width: Width of the photos, px; the height is three quarters of it.
        street: Fraction of the photos taken in the streets.
        points: Number of points for each photo.
        seed: Seed of the city.

    Raises:
        ArgumentError: a number is out of range.
    """

    photos: int = 1_500
    width: int = 192
    street: float = 0.0
    points: int = 20
    seed: int = 0

    def __post_init__(self) -> None:
        """Check the ranges."""
        whole_number("photos", self.photos, 1)
        whole_number("width", self.width, 16)
        whole_number("points", self.points, 1)
        whole_number("seed", self.seed, 0)
        in_range("street", self.street, 0.0, 1.0)

    @property
    def height(self) -> int:
        """Height of the photos, px."""
        return 3 * self.width // 4

    @property
    def walkers(self) -> int:
        """Number of photos taken in the streets."""
        return round(self.street * self.photos)

    @cached_property
    def side(self) -> float:
        """Side of the square that the photos cover, world units."""
        return SPACING * math.ceil(math.sqrt(max(self.photos - self.walkers, 1)))

    @cached_property
    def buildings(self) -> Buildings:
        """The boxes."""
        return Buildings.drawn(math.ceil(self.side / PITCH / 2) + 1, self.seed)

    @cached_property
    def cameras(self) -> tuple[tuple[str, Camera], ...]:
        """Name and camera of each photo, names sorted."""
        rng = np.random.default_rng([self.seed, 1])
        flown = self.photos - self.walkers
        made = [(f"drone_{i:05d}.png", self._drone(i, rng)) for i in range(flown)]
        made += [(f"street_{i:05d}.png", self._walker(rng)) for i in range(self.walkers)]
        return tuple(made)

    def photograph(self, index: int) -> tuple[UInt8[np.ndarray, "H W 3"], Rows, Rows]:
        """Return a photo, and places and colours of some of its pixels that show no sky.

        Args:
            index: Place in `cameras`.
        """
        camera = self.cameras[index][1]
        color, hits, sky = _traced(camera, self.buildings)
        fine = color.reshape(camera.H, SUPERSAMPLING, camera.W, SUPERSAMPLING, 3)
        near = np.flatnonzero(~sky & (np.abs(hits[:, [0, 2]]).max(axis=1) < self.side / 2 + PITCH))
        rng = np.random.default_rng([self.seed, 2, index])
        chosen = rng.choice(near, min(len(near), self.points), replace=False)
        return np.round(255 * fine.mean(axis=(1, 3))).astype(np.uint8), hits[chosen], color[chosen]

    def _drone(self, index: int, rng: np.random.Generator) -> Camera:
        """Make a camera of the grid. It looks inwards where the city would end before it."""
        across = round(self.side / SPACING)
        row, column = divmod(index, across)
        place = (np.array([column, row]) + 0.5) * SPACING - self.side / 2
        place += rng.uniform(-0.4, 0.4, 2)
        heading = math.pi / 2 * ((column + 2 * row) % 4) + rng.uniform(-0.3, 0.3) + 0.35
        high = ALTITUDE + rng.uniform(-0.6, 0.6)
        ahead = np.array([math.cos(heading), math.sin(heading)]) * high / math.tan(TILT)
        ahead = np.where(np.abs(place + ahead) > self.side / 2, -ahead, ahead)
        eye = np.array([place[0], -high, place[1]])
        return self._camera(eye, np.array([place[0] + ahead[0], 0.0, place[1] + ahead[1]]))

    def _walker(self, rng: np.random.Generator) -> Camera:
        """Make a camera in a street, looking along it or across."""
        streets = math.floor(self.side / PITCH / 2)
        along, street = (
            rng.uniform(-self.side / 2, self.side / 2),
            PITCH * rng.integers(-streets, streets + 1),
        )
        place = np.array([along, street + rng.uniform(-0.3, 0.3)])
        if rng.uniform() < 0.5:
            place = place[::-1].copy()
        turn = rng.uniform(0, 2 * math.pi)
        eye = np.array([place[0], -EYE_LEVEL, place[1]])
        return self._camera(eye, eye + np.array([math.cos(turn), -0.15, math.sin(turn)]))

    def _camera(self, eye: Float64[np.ndarray, "3"], target: Float64[np.ndarray, "3"]) -> Camera:
        W, H, focal = self.width, self.height, FOCAL * self.width
        return Camera(look_at(eye, target), eye, focal, focal, (W - 1) / 2, (H - 1) / 2, H, W)


def write_city(
    folder: Path, city: City, workers: int = 1, progress: Callable[[int], None] = lambda done: None
) -> None:
    """Write the capture of a city in COLMAP's layout.

    Args:
        folder: The capture; created if missing.
        city: The city.
        workers: Number of processes that trace photos. The files do not depend on it.
        progress: Receives the number of photos written.
    """
    images = folder / "images"
    images.mkdir(parents=True, exist_ok=True)
    found: list[np.ndarray] = []
    if workers > 1:
        with ProcessPoolExecutor(workers) as pool:
            for done, rows in enumerate(
                pool.map(partial(_save, city, images), range(city.photos), chunksize=8), 1
            ):
                found.append(rows)
                progress(done)
    else:
        for index in range(city.photos):
            found.append(_save(city, images, index))
            progress(index + 1)
    cloud = np.concatenate(found)
    write_model(folder, city.cameras, cloud[:, :3], cloud[:, 3:])


def _save(city: City, images: Path, index: int) -> np.ndarray:
    """Write one photo; return its points and their colours as rows of six numbers."""
    image, points, colors = city.photograph(index)
    Image.fromarray(image).save(images / city.cameras[index][0])
    return np.concatenate([points, colors], axis=1)


def _traced(camera: Camera, buildings: Buildings) -> tuple[Rows, Rows, np.ndarray]:
    """Return colour and place of what each ray hits, and whether it is the sky."""
    eyes, directions = camera_rays(camera)
    with np.errstate(divide="ignore", invalid="ignore"):
        nearest = np.where(directions[:, 1] > 1e-9, -eyes[:, 1] / directions[:, 1], np.inf)
    owner: Int64[np.ndarray, " N"] = np.full(len(eyes), -1)
    normals = np.zeros_like(directions)
    grid = np.arange(len(eyes)).reshape(camera.H * SUPERSAMPLING, camera.W * SUPERSAMPLING)
    for number, (top, bottom, left, right) in _rectangles(camera, buildings):
        rows = grid[top:bottom, left:right].ravel()
        place, halves, turn = buildings.box(number)
        distance, facing = box_hits(eyes[rows], directions[rows], place, halves, turn)
        hit = np.flatnonzero(distance < nearest[rows])
        nearest[rows[hit]], owner[rows[hit]], normals[rows[hit]] = distance[hit], number, facing[hit]
    sky, on_ground = np.isinf(nearest), np.flatnonzero((owner < 0) & np.isfinite(nearest))
    hits = eyes + np.where(sky, 0.0, nearest)[:, None] * directions
    color = np.empty_like(directions)
    color[sky] = sky_colors(directions[sky])
    color[on_ground] = ground_colors(hits[on_ground], buildings)
    on_box = np.flatnonzero(owner >= 0)
    color[on_box] = facade_colors(hits[on_box], normals[on_box], owner[on_box], buildings, SUN)
    haze = np.where(sky, 0.0, 1 - np.exp(-np.square(np.where(sky, 0.0, nearest) / HAZE)))[:, None]
    return np.clip(color * (1 - haze) + haze * np.array([0.72, 0.76, 0.8]), 0, 1), hits, sky


def _rectangles(camera: Camera, buildings: Buildings) -> list[tuple[int, tuple[int, int, int, int]]]:
    """Return the numbers of the boxes that a camera may see, and the part of the fine grid that each may cover."""
    corners = camera.world_to_cam(buildings.corners().reshape(-1, 3)).reshape(-1, 8, 3)
    ahead = corners[..., 2] > 0.05
    z = np.where(ahead, corners[..., 2], 1.0)
    u = SUPERSAMPLING * (camera.fx * corners[..., 0] / z + camera.cx + 0.5)
    v = SUPERSAMPLING * (camera.fy * corners[..., 1] / z + camera.cy + 0.5)
    W, H = SUPERSAMPLING * camera.W, SUPERSAMPLING * camera.H
    whole = ahead.all(axis=1)  # a box that is partly behind the camera may be anywhere
    left = np.where(whole, np.clip(np.floor(u.min(axis=1)) - 1, 0, W), 0).astype(int)
    right = np.where(whole, np.clip(np.ceil(u.max(axis=1)) + 1, 0, W), W).astype(int)
    top = np.where(whole, np.clip(np.floor(v.min(axis=1)) - 1, 0, H), 0).astype(int)
    bottom = np.where(whole, np.clip(np.ceil(v.max(axis=1)) + 1, 0, H), H).astype(int)
    # no box lies wholly on the far side of one of the planes through the camera and an edge of its photo
    x, y, z = np.moveaxis(corners, -1, 0)
    outside = [
        side * c * focal < -z * half
        for c, focal, half in ((x, camera.fx, camera.W / 2 + 1), (y, camera.fy, camera.H / 2 + 1))
        for side in (-1, 1)
    ]
    seen = ahead.any(axis=1) & ~np.any([plane.all(axis=1) for plane in outside], axis=0)
    shown = np.flatnonzero(seen & (left < right) & (top < bottom))
    return [(int(i), (int(top[i]), int(bottom[i]), int(left[i]), int(right[i]))) for i in shown]

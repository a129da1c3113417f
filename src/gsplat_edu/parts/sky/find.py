"""Find the pixels of a capture's photos that show the sky.

One photo is not enough: a smooth region at its upper edge may be a wall. An object at infinity has the same colour in
one direction of the world, in every photo. A near object has the same colour at one place. Both hypotheses are tested:
the colours are compared across photos by direction, and by the place where each ray meets a sphere around the cameras,
for spheres of several sizes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float64, Int64, UInt8
from scipy.sparse import coo_array
from scipy.spatial import cKDTree

from gsplat_edu.paths.orbits import common_up
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.rig import settled_eyes

Vector = Float64[np.ndarray, "3"]
Pixels = UInt8[np.ndarray, "_ _ 3"]
"""Photos of a capture may differ in size."""

SIDE = 128
"""Longest side of the images that are searched, px."""

SMOOTH = 6.0
"""Largest slope of a channel in the sky, grey levels per px of such an image; soft clouds stay below."""

POINT_RADIUS = 2
"""Radius around the image of a point within which no pixel is sky, px."""

HORIZON = np.sin(np.radians(-2.0))
"""Sine of the lowest elevation of the sky; the up direction is a few degrees wrong."""

BELOW = np.sin(np.radians(-8.0))
"""Sine of the elevation below which smooth pixels at a photo's upper edge are evidence against a sky."""

MOST_BELOW = 0.25
"""Largest fraction of the smooth regions at the upper edges that may lie below `BELOW`."""

LEAST_SHARE = 0.02
"""Least share of the sky among all pixels of the photos."""

LEAST_PHOTOS = 3
"""Least number of photos that show it."""

CELLS = 10_000
"""Cells of a sphere in which colours are compared: 2.3 degrees wide, so that soft clouds vary little within one."""

ROUNDS, LEAST_DIFFERENCE = 4, 0.3
"""Rounds in which the exposure and tint of each photo are fitted; the difference, %, below which weights are equal."""

SPHERES = (2.0, 1.25, 3.5)
"""Radii of the spheres, in sizes of the scene."""

QUANTILE = 0.75
"""Quantile of the differences between photos by which the hypotheses are compared. The median is dominated by the plain
parts of a sky, where noise hides the parallax, and the mean by pixels that are not sky."""

CLEAR = 0.8
"""It is a sky if spread < CLEAR * spread_near. Traced skies have a ratio of 0.27 to 0.36, or 0.75 with noise of 4 grey
levels; smooth regions at the edges of three captures have 1.17 to 2.8, a dome 1.3 to 6.6 (`benchmarks/sky.py`)."""

DARK = 0.04
"""Added to colours, 0 to 1, before the logarithm, which turns exposures into shifts."""

PLAIN, WHITE = 2.0, 225.0
"""A sky of one colour shows no parallax to test. If its colours differ by less than `PLAIN` %, it is accepted if it is
at least as bright as `WHITE`, grey levels."""

MOST_POINTS = 0.9
"""Fraction of the points that count for the size of a scene; the others may be wrong or far."""

SAMPLES, COMPARED = 500, 200
"""Largest number of pixels per photo, and of photos, whose colours are compared."""

ALIGNED = 0.7
"""Smallest length of the mean right axis at which cameras may have been held in portrait."""


@dataclass(frozen=True, eq=False)
class Sky:
    """The sky in a capture's photos.

    Args:
        up: (3,) the world's up direction.
        directions: (M, 3) unit vectors of the pixels that show it, all photos in order.
        colors: (M, 3) their colours, 0 to 1.
        photo: (M,) index of each one's photo.
        share: Their share among all pixels.
        below: Fraction of the smooth regions at the upper edges that lies below `BELOW`.
        spread: Upper quartile of the differences between photos' colours in one direction, %; infinite if nothing can
            be compared, or if the sky is too small or reaches below the horizon.
        spread_near: Smallest such quartile at one place, over the trial spheres; an upper bound if the search stopped
            early.
        pixel: Angle between neighbouring pixels of the searched images, radians.
    """

    up: Vector
    directions: Float64[np.ndarray, "M 3"]
    colors: Float64[np.ndarray, "M 3"]
    photo: Int64[np.ndarray, " M"]
    share: float
    below: float
    spread: float
    spread_near: float
    pixel: float

    @property
    def photos(self) -> int:
        """Number of photos that show it."""
        return len(np.unique(self.photo))

    @property
    def lies_at_infinity(self) -> bool:
        """Whether the photos' colours agree in one direction and differ at one place."""
        return self.spread < CLEAR * self.spread_near

    @property
    def is_certain(self) -> bool:
        """Whether the evidence for a sky is beyond doubt."""
        if self.share < LEAST_SHARE or self.photos < LEAST_PHOTOS or self.below > MOST_BELOW:
            return False
        if self.lies_at_infinity:
            return True
        white = float(255 * np.median(self.colors.min(axis=1))) > WHITE
        return white and max(self.spread, self.spread_near) < PLAIN


def find_sky(
    cameras: Sequence[Camera],
    images: Sequence[Pixels],
    points: Float64[np.ndarray, "N 3"],
    masks: Sequence[Bool[np.ndarray, "_ _"] | None] | None = None,
) -> Sky:
    """Search photos for sky.

    Args:
        cameras: The cameras at the size of the images, at least one.
        images: The photos, at most about `SIDE` px wide and high.
        points: (N, 3) points of the capture; N is 0 if it has none.
        masks: True for the pixels of each photo that count; None if all do.

    Returns:
        The sky with the up direction that explains the photos best; it may have no pixels.
    """
    smooth = [_smooth(camera, image, points) for camera, image in zip(cameras, images, strict=True)]
    if masks is not None:
        smooth = [part if m is None else part & m for part, m in zip(smooth, masks, strict=True)]
    size = scene_size(cameras, points)
    found = [_sky(cameras, images, smooth, up, size) for up in _ups(cameras)]
    return max([sky for sky in found if sky.is_certain] or found[:1], key=lambda sky: sky.share)


def scene_size(cameras: Sequence[Camera], points: Float64[np.ndarray, "N 3"]) -> float:
    """Return the distance from the cameras' centre to the farthest camera or to most points, whichever is larger.

    Strays (`gsplat_edu.scene.rig.stray_eyes`) do not count.

    Args:
        cameras: At least one.
        points: (N, 3) points of the capture; N may be 0.

    Returns:
        World units; 1 if that is 0.
    """
    eyes = settled_eyes(cameras)
    centre = eyes.mean(axis=0)
    size = float(np.linalg.norm(eyes - centre, axis=1).max())
    if len(points):
        size = max(size, float(np.quantile(np.linalg.norm(points - centre, axis=1), MOST_POINTS)))
    return size if size > 0.0 else 1.0


def _ups(cameras: Sequence[Camera]) -> list[Vector]:
    """Return the directions that may be up, the likeliest first: held upright, upside down, or in portrait."""
    up = common_up(cameras)
    side = np.mean([camera.R[0] for camera in cameras], axis=0)
    length = float(np.linalg.norm(side))
    return [up, -up] + ([side / length, -side / length] if length > ALIGNED else [])


def _smooth(camera: Camera, image: Pixels, points: Float64[np.ndarray, "N 3"]) -> Bool[np.ndarray, "_ _"]:
    """Return the pixels without edges and without points near them."""
    soft = cv2.GaussianBlur(image.astype(np.float32), (0, 0), 0.8)
    slopes = [cv2.Sobel(soft, cv2.CV_32F, dx, 1 - dx, ksize=3, scale=1 / 8) for dx in (0, 1)]
    steep = np.hypot(*slopes).reshape(*image.shape[:2], -1).max(axis=-1) > SMOOTH
    taken: UInt8[np.ndarray, "h w"] = np.zeros(image.shape[:2], dtype=np.uint8)
    if len(points):
        u, v, z = camera.project(camera.world_to_cam(points))
        seen = (z > 0) & (u > -0.5) & (u < camera.W - 0.5) & (v > -0.5) & (v < camera.H - 0.5)
        taken[np.rint(v[seen]).astype(int), np.rint(u[seen]).astype(int)] = 1
        taken = np.asarray(cv2.dilate(taken, np.ones((2 * POINT_RADIUS + 1,) * 2, np.uint8)), dtype=np.uint8)
    return np.asarray(~steep & (taken == 0), dtype=np.bool_)


def _directions(camera: Camera) -> Float64[np.ndarray, "h w 3"]:
    """Return the unit direction of every pixel."""
    if not camera.pinhole:
        rays = camera.rays()
        return np.asarray(rays / np.linalg.norm(rays, axis=-1, keepdims=True))
    u, v = np.meshgrid(np.arange(camera.W), np.arange(camera.H))
    across, down = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
    # term by term: the rounding of a product of matrices may depend on the number of threads
    rays = across[..., None] * camera.R[0] + down[..., None] * camera.R[1] + camera.R[2]
    return np.asarray(rays / np.linalg.norm(rays, axis=-1, keepdims=True))


def _sky(
    cameras: Sequence[Camera],
    images: Sequence[Pixels],
    smooth: Sequence[Bool[np.ndarray, "_ _"]],
    up: Vector,
    size: float,
) -> Sky:
    directions, colors, photo = [np.zeros((0, 3))], [np.zeros((0, 3))], [np.zeros(0, dtype=np.int64)]
    low = regions = total = 0
    for index, (camera, image, part) in enumerate(zip(cameras, images, smooth, strict=True)):
        rays = _directions(camera)
        height = (rays * up).sum(axis=-1)
        region = _at_upper_edge(part, height)
        sky = cv2.erode((region & (height > HORIZON)).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
        total, regions = total + region.size, regions + int(region.sum())
        low += int((region & (height < BELOW)).sum())
        directions.append(rays[sky])
        colors.append(image[sky] / 255.0)
        photo.append(np.full(int(sky.sum()), index))
    where, paint, of = (np.concatenate(rows) for rows in (directions, colors, photo))
    share, below = len(where) / max(total, 1), low / max(regions, 1)
    spread = near = math.inf
    if share >= LEAST_SHARE and below <= MOST_BELOW:
        spread, near = _spreads(cameras, where, paint, of, size)
    pixel = float(np.median([1 / max(camera.fx, camera.fy) for camera in cameras]))
    return Sky(up, where, paint, of, share, below, spread, near, pixel)


def _at_upper_edge(
    smooth: Bool[np.ndarray, "h w"], height: Float64[np.ndarray, "h w"]
) -> Bool[np.ndarray, "h w"]:
    """Return the smooth regions that touch the photo's edge above the horizon and above the photo's middle."""
    _, labels = cv2.connectedComponents(smooth.astype(np.uint8), connectivity=4)
    edge = np.zeros(smooth.shape, dtype=bool)
    edge[[0, -1]] = edge[:, [0, -1]] = True
    middle = height[height.shape[0] // 2, height.shape[1] // 2]
    seeds = smooth & edge & (height > max(0.0, middle))
    wanted = np.unique(labels[seeds])
    return np.isin(labels, wanted[wanted > 0])


def _spreads(
    cameras: Sequence[Camera],
    directions: Float64[np.ndarray, "M 3"],
    colors: Float64[np.ndarray, "M 3"],
    photo: Int64[np.ndarray, " M"],
    size: float,
) -> tuple[float, float]:
    """Return how much the photos' colours differ in one direction, and at one place of the best sphere, %."""
    counts = np.bincount(photo, minlength=len(cameras))
    first = np.cumsum(counts) - counts
    rank = np.arange(len(photo)) - first[photo]
    rows = np.flatnonzero(
        (rank % np.maximum(1, counts // SAMPLES)[photo] == 0) & (photo % -(-len(cameras) // COMPARED) == 0)
    )
    if not len(rows):
        return math.inf, math.inf
    eyes = np.stack([camera.eye for camera in cameras])
    centre = settled_eyes(cameras).mean(axis=0)
    cells = cKDTree(fibonacci(CELLS))
    rays, paint, of = directions[rows], 100 * np.log(colors[rows] + DARK), photo[rows]
    at_infinity = _spread(cells.query(rays)[1], paint, of)
    offsets = (eyes - centre)[of]
    along = (offsets * rays).sum(axis=1)
    near = math.inf
    for radius in SPHERES:
        if at_infinity >= CLEAR * near:
            break  # no other sphere can make it a sky
        root = np.sqrt(np.maximum(along**2 - (offsets**2).sum(axis=1) + (radius * size) ** 2, 0))
        hits = offsets + (root - along)[:, None] * rays
        hits /= np.maximum(np.linalg.norm(hits, axis=1, keepdims=True), 1e-300)
        near = min(near, _spread(cells.query(hits)[1], paint, of))
    return at_infinity, near


def _spread(
    cell: Int64[np.ndarray, " M"], colors: Float64[np.ndarray, "M 3"], photo: Int64[np.ndarray, " M"]
) -> float:
    """Return the upper quartile of the differences between photos' mean colours in a cell and the cell's, %.

    Each photo may have its own exposure and tint: shifts s of photos and colours c of cells minimise sum |m - s - c|,
    by weighted least squares. The absolute difference and the quantile are robust against pixels that look like sky but
    are not.
    """
    pairs, pair = np.unique(cell * (photo.max() + 1) + photo, return_inverse=True)
    means = np.stack([np.bincount(pair, c) for c in colors.T], axis=1) / np.bincount(pair)[:, None]
    of = np.unique(pairs % (photo.max() + 1), return_inverse=True)[1]
    group = np.unique(pairs // (photo.max() + 1), return_inverse=True)[1]
    number = np.bincount(group)
    if number.max() < 2:
        return math.inf
    weights = np.ones(len(pairs))
    left = means
    for _ in range(ROUNDS):
        table = coo_array((weights, (of, group))).tocsr()
        share = table / table.sum(axis=0)  # each cell's mean as weights of the photos
        laplacian = np.diag(table.sum(axis=1)) - (share @ table.T).toarray()
        sums = np.stack([np.bincount(of, weights * c) for c in means.T], axis=1)
        inner = np.stack([np.bincount(group, weights * c) for c in means.T], axis=1)
        shifted = means - (np.linalg.pinv(laplacian, hermitian=True) @ (sums - share @ inner))[of]
        middle = np.stack([np.bincount(group, weights * c) for c in shifted.T], axis=1)
        left = shifted - (middle / np.bincount(group, weights)[:, None])[group]
        weights = 1 / np.maximum(np.sqrt(np.square(left).mean(axis=1)), LEAST_DIFFERENCE)
    # without the correction, cells that few photos see would seem to vary less
    factor = np.sqrt(number / np.maximum(number - 1, 1))[group]
    differences = factor * np.sqrt(np.square(left).mean(axis=1))
    return float(np.quantile(differences[number[group] > 1], QUANTILE))


def fibonacci(count: int) -> Float64[np.ndarray, "count 3"]:
    """Return evenly spread unit vectors.

    Args:
        count: Their number.
    """
    index = np.arange(count)
    height = 1 - (2 * index + 1) / max(count, 1)
    turn = np.pi * (3 - np.sqrt(5)) * index
    ring = np.sqrt(1 - height**2)
    return np.asarray(np.stack([ring * np.cos(turn), height, ring * np.sin(turn)], axis=1))

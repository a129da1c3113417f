"""Photos of boxes on the ground under a sky, ray traced with exact cameras: a capture whose background is at infinity.

The same colours can be painted on a dome of finite radius instead, which looks alike in every single photo. Only the
parallax between photos tells the two apart.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, UInt8

from gsplat_edu.scene.camera import Camera, look_at
from gsplat_edu.scene.views import View

Rows = Float64[np.ndarray, "N 3"]

SUPERSAMPLING = 2
"""Rays per pixel along each side."""

AT_ONCE = 4_096
"""Rays traced at a time: their numbers stay in the processor's cache."""

RING, TARGET = 4.0, np.array([0.0, -0.7, 0.0])
"""Mean distance of the cameras from the centre, and the point that they look near; y points down from the ground."""

HEIGHTS = (0.5, 1.1, 1.8)
"""Heights of the cameras above the ground, in turn."""

GOLDEN = math.pi * (3 - math.sqrt(5))

REACH = 30.0
"""Points are given up to this distance from the centre."""

HAZE = 25.0
"""Distance over which the ground fades into the haze above the horizon."""

SUN = np.array([0.5, -0.6, -0.62]) / np.linalg.norm([0.5, -0.6, -0.62])
"""Unit direction towards the sun."""

BOXES = (
    ((0.0, 0.0), (0.6, 1.5, 0.6), 0.3, (0.75, 0.25, 0.2)),
    ((1.3, 0.6), (0.35, 0.8, 0.5), 0.9, (0.2, 0.5, 0.3)),
    ((-1.2, 0.9), (0.5, 0.6, 0.4), 0.1, (0.25, 0.35, 0.7)),
    ((-0.7, -1.3), (0.3, 2.1, 0.3), 0.6, (0.8, 0.7, 0.35)),
    ((1.0, -1.2), (0.45, 0.4, 0.6), 1.2, (0.6, 0.45, 0.55)),
    ((9.0, 5.0), (1.5, 3.5, 1.2), 0.4, (0.55, 0.5, 0.45)),
    ((-8.0, 7.0), (1.8, 2.4, 1.4), 1.0, (0.5, 0.4, 0.35)),
    ((-3.0, -11.0), (2.2, 3.0, 1.5), 0.2, (0.45, 0.5, 0.5)),
)
"""Centre on the ground, half widths and height, turn about the vertical, and colour of every box."""


@dataclass(frozen=True, eq=False)
class Outdoors:
    """A capture of the boxes.

    Args:
        views: Its photos, opaque, names sorted.
        sky: (H, W) for each photo, whether most of a pixel shows the sky.
        points: (N, 3) points on boxes and ground that photos see.
        colors: (N, 3) their colours, 0 to 1.
    """

    views: tuple[View, ...]
    sky: tuple[Bool[np.ndarray, "H W"], ...]
    points: Rows
    colors: Rows


def outdoor_capture(
    width: int,
    height: int,
    count: int,
    *,
    points: int = 5_000,
    dome: float = math.inf,
    clouds: float = 1.0,
    seed: int = 0,
) -> Outdoors:
    """Photograph the boxes from a ring of cameras.

    Args:
        width: Width of the photos, px.
        height: Height of the photos, px.
        count: Number of photos.
        points: Number of points.
        dome: Radius of the sphere that the sky is painted on; infinite for a real sky.
        clouds: Strength of gradient and clouds; 0 makes the sky one bright colour.
        seed: Seed of the choice of points.
    """
    rng = np.random.default_rng(seed)
    views, skies, found = [], [], []
    for index in range(count):
        camera = outdoor_camera(index, count, width, height)
        image, hits, color, sky = _photographed(camera, dome, clouds)
        views.append(View(camera, image, name=f"photo_{index:03d}.png"))
        skies.append(sky.reshape(height, SUPERSAMPLING, width, SUPERSAMPLING).mean(axis=(1, 3)) > 0.5)
        near = np.flatnonzero(~sky & (np.linalg.norm(hits, axis=1) < REACH))
        chosen = rng.choice(near, min(len(near), -(-points // count)), replace=False)
        found.append(np.concatenate([hits[chosen], color[chosen]], axis=1))
    cloud = np.concatenate(found)[:points]
    return Outdoors(tuple(views), tuple(skies), cloud[:, :3], cloud[:, 3:])


def photograph(camera: Camera) -> tuple[UInt8[np.ndarray, "H W 3"], Bool[np.ndarray, "H W"]]:
    """Return the photo of a camera, and whether most of each pixel shows the sky.

    Args:
        camera: Any camera above the ground and outside the boxes.
    """
    image, _, _, sky = _photographed(camera, math.inf, 1.0)
    return image, sky.reshape(camera.H, SUPERSAMPLING, camera.W, SUPERSAMPLING).mean(axis=(1, 3)) > 0.5


def outdoor_camera(index: int, count: int, width: int, height: int) -> Camera:
    """Return a camera of the ring.

    Args:
        index: From 0.
        count: Number of cameras of the ring.
        width: Width of its photo, px.
        height: Height of its photo, px.
    """
    turn = 2 * math.pi * index / count
    radius = RING * (1 + 0.15 * math.sin(GOLDEN * index))
    eye = np.array([radius * math.cos(turn), -HEIGHTS[index % len(HEIGHTS)], radius * math.sin(turn)])
    target = TARGET + 0.6 * np.array([math.sin(5 * turn), -0.6 * math.cos(3 * turn), math.cos(4 * turn)])
    return Camera(
        look_at(eye, target), eye, 0.8 * width, 0.8 * width, (width - 1) / 2, (height - 1) / 2, height, width
    )


def sky_colors(directions: Rows, clouds: float = 1.0) -> Rows:
    """Return the colours of the sky: from haze to blue, brighter around the sun, with soft clouds.

    Args:
        directions: Unit vectors.
        clouds: Strength of gradient and clouds.
    """
    x, y, z = directions.T
    up = np.clip(-y, 0, 1)[:, None]
    plain = np.array([0.86, 0.89, 0.92]) * (1 - np.sqrt(up)) + np.array([0.25, 0.45, 0.8]) * np.sqrt(up)
    glow = np.exp(-(1 - directions @ SUN) / 0.08)[:, None]
    drift = (
        np.sin(5 * x + 2 * np.sin(4 * z)) + np.sin(6 * z + 2 * np.sin(3 * x + 7 * y)) + np.sin(9 * y + 4 * x)
    )
    cover = 1 / (1 + np.exp(-4 * (drift - 0.6)))[:, None]
    mixed = plain + (0.95 - plain) * np.clip(0.8 * cover + 0.7 * glow, 0, 1)
    return np.asarray(0.97 + clouds * (mixed - 0.97))


def _photographed(
    camera: Camera, dome: float, clouds: float
) -> tuple[UInt8[np.ndarray, "H W 3"], Rows, Rows, Bool[np.ndarray, " N"]]:
    """Return a photo, and the place, colour and whether it is the sky of each of its rays."""
    eyes, directions = camera_rays(camera)
    parts = [
        _traced(eyes[start : start + AT_ONCE], directions[start : start + AT_ONCE], dome, clouds)
        for start in range(0, len(eyes), AT_ONCE)
    ]
    color, hits, sky = (np.concatenate(rows) for rows in zip(*parts, strict=True))
    image = color.reshape(camera.H, SUPERSAMPLING, camera.W, SUPERSAMPLING, 3).mean(axis=(1, 3))
    return np.round(255 * image).astype(np.uint8), hits, color, sky


def camera_rays(camera: Camera) -> tuple[Rows, Rows]:
    """Return origin and unit direction of `SUPERSAMPLING` squared rays for each pixel, row by row of the finer grid."""
    inside = (np.arange(SUPERSAMPLING) + 0.5) / SUPERSAMPLING - 0.5
    u = (np.arange(camera.W)[:, None] + inside).ravel()
    v = (np.arange(camera.H)[:, None] + inside).ravel()
    across, down = np.meshgrid((u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy)
    directions = np.stack([across.ravel(), down.ravel(), np.ones(across.size)], axis=1) @ camera.R
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return np.broadcast_to(camera.eye, directions.shape), directions


def _traced(
    eyes: Rows, directions: Rows, dome: float, clouds: float
) -> tuple[Rows, Rows, Bool[np.ndarray, " N"]]:
    """Return the colour and the place that each ray hits, and whether it is the sky."""
    nearest, color = np.full(len(eyes), np.inf), np.zeros(eyes.shape)
    with np.errstate(divide="ignore", invalid="ignore"):
        ground = np.where(directions[:, 1] > 1e-9, -eyes[:, 1] / directions[:, 1], np.inf)
    rows = np.flatnonzero(ground < np.inf)
    nearest[rows] = ground[rows]
    color[rows] = _ground(eyes[rows] + ground[rows, None] * directions[rows], ground[rows])
    for place, halves, turn, paint in BOXES:
        distance, normals = box_hits(eyes, directions, place, halves, turn)
        rows = np.flatnonzero(distance < nearest)
        nearest[rows] = distance[rows]
        hits = eyes[rows] + distance[rows, None] * directions[rows]
        color[rows] = _painted(hits, normals[rows], np.array(paint))
    if math.isinf(dome):
        sky, shown = np.isinf(nearest), directions
    else:
        along = (eyes * directions).sum(axis=1)
        to_dome = -along + np.sqrt(along**2 - (eyes**2).sum(axis=1) + dome**2)
        sky = to_dome < nearest
        nearest = np.minimum(nearest, to_dome)
        shown = (eyes + to_dome[:, None] * directions) / dome
    color[sky] = sky_colors(shown[sky], clouds)
    far = np.where(np.isfinite(nearest), nearest, 0.0)
    return np.clip(color, 0, 1), eyes + far[:, None] * directions, sky


def _ground(hits: Rows, distance: Float64[np.ndarray, " N"]) -> Rows:
    x, z = hits[:, 0], hits[:, 2]
    fine = np.sin(7 * x + 2 * np.sin(5 * z)) * np.sin(6 * z + np.sin(4 * x))
    coarse = np.sin(1.3 * x + 1.1 * np.sin(0.9 * z)) * np.cos(1.1 * z)
    base = (
        np.array([0.42, 0.38, 0.28]) + 0.12 * fine[:, None] + 0.1 * coarse[:, None] * np.array([1, 1.2, 0.5])
    )
    haze = (1 - np.exp(-np.square(distance / HAZE)))[:, None]
    return np.asarray(base * (1 - haze) + haze * np.array([0.55, 0.57, 0.58]))


def _painted(hits: Rows, normals: Rows, paint: Float64[np.ndarray, "3"]) -> Rows:
    light = 0.55 + 0.45 * np.clip(normals @ SUN, 0, 1)[:, None]
    checks = (np.floor(4 * hits + 1e-3).sum(axis=1) % 2)[:, None]
    return np.asarray(light * (paint * (0.6 + 0.4 * checks)))


def box_hits(
    eyes: Rows, directions: Rows, place: tuple[float, float], halves: tuple[float, ...], turn: float
) -> tuple[Float64[np.ndarray, " N"], Rows]:
    """Return the distance at which each ray enters a box, infinity where it misses, and the normal there or zero.

    Args:
        eyes: (N, 3) origins of the rays.
        directions: (N, 3) unit vectors.
        place: Centre of the box on the ground, x and z.
        halves: Half width along x, height, and half width along z.
        turn: Turn of the box about the vertical, radians.
    """
    half = np.array([halves[0], halves[1] / 2, halves[2]])
    c, s = math.cos(turn), math.sin(turn)
    axes = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    origins = (eyes - np.array([place[0], -halves[1] / 2, place[1]])) @ axes.T
    heading = directions @ axes.T
    heading = np.where(np.abs(heading) < 1e-12, 1e-12, heading)
    one, other = (-half - origins) / heading, (half - origins) / heading
    enters, leaves = np.minimum(one, other).T, np.maximum(one, other).T
    # one axis after the other: numpy is slow at the maximum of three
    near = np.maximum(np.maximum(enters[0], enters[1]), enters[2])
    far = np.minimum(np.minimum(leaves[0], leaves[1]), leaves[2])
    hit = (near < far) & (near > 1e-4)
    rows, normals = np.flatnonzero(hit), np.zeros_like(directions)
    first = enters[:, rows].argmax(axis=0)
    normals[rows] = -np.sign(heading[rows, first])[:, None] * axes[first]
    return np.where(hit, near, np.inf), normals

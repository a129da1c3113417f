"""Photos with known cameras of a house in a garden, ray traced.

Walls, roof and tree crowns are solids, not splats, so training on the photos is an independent test. Every surface has
texture for feature matching, the window panes mirror the sky, and sky and hills are infinitely far away.
`garden_paint.py` has the colours.

Chapter: 14_photos_to_scene.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int8, UInt8

from gsplat_edu.scene.camera import Camera, look_at
from lab.captures.fine_rays import fine_rays
from lab.captures.garden_paint import MATERIALS, SUN, Directions, Values, ground_colors, paint, sky_colors

GARDEN_TARGET = np.array([0.0, -0.6, 0.0])
"""Target of the cameras, world units; y points down, the ground is y = 0."""

GARDEN_DISTANCE = 4.6
"""Distance from the target to a camera, world units."""

GARDEN_FOCAL = 1.1
"""Focal length as a fraction of the photo's longer side: 352 px at 320."""

RAYS_PER_SIDE = 2
"""Rays per pixel along each side."""

GROUND, SKY = -1, -2
"""What a ray hits that hits no solid; other numbers are indices in `SOLIDS`."""

LEAST_DISTANCE = 1e-3
"""A ray that starts closer than this to a surface does not hit it, world units."""


class Solid(NamedTuple):
    """The points p with normals @ p <= offsets, or an ellipsoid if there are no normals.

    Args:
        material: Index in `MATERIALS`.
        low: (3,) least coordinates of its bounding box, world units.
        high: (3,) largest coordinates.
        normals: (K, 3) outward unit normals of its faces; (0, 3) for the ellipsoid that fills the bounding box.
        offsets: (K,) distances of the faces from the origin.
    """

    material: int
    low: Float64[np.ndarray, "3"]
    high: Float64[np.ndarray, "3"]
    normals: Float64[np.ndarray, "K 3"]
    offsets: Float64[np.ndarray, " K"]

    def corners(self) -> Float64[np.ndarray, "8 3"]:
        """Return the corners of the bounding box."""
        return np.stack(np.meshgrid(*zip(self.low, self.high, strict=True)), axis=-1).reshape(8, 3)

    def hit(
        self, origins: Float[np.ndarray, "3 #N"], rays: Float[np.ndarray, "3 #N"]
    ) -> Float32[np.ndarray, " N"]:
        """Return the multiple of each direction at which the ray enters, infinity where it misses.

        Args:
            origins: (3, N) outside the solid, or (3, 1) for all rays.
            rays: (3, N) directions of any length, or (3, 1).
        """
        if len(self.normals):
            normals = self.normals.astype(np.float32)
            closing = normals @ rays
            closing = np.where(np.abs(closing) < 1e-9, np.float32(1e-9), closing)
            at = (self.offsets.astype(np.float32)[:, None] - normals @ origins) / closing
            near = np.where(closing < 0, at, -np.inf).max(axis=0)
            found = near < np.where(closing > 0, at, np.inf).min(axis=0)
        else:
            half = ((self.high - self.low) / 2).astype(np.float32)[:, None]
            o = (origins - ((self.low + self.high) / 2).astype(np.float32)[:, None]) / half
            d = rays / half
            a, b = (d * d).sum(axis=0), (o * d).sum(axis=0)
            root = b * b - a * ((o * o).sum(axis=0) - 1)
            near, found = -(b + np.sqrt(np.maximum(root, 0))) / a, root > 0
        return np.where(found & (near > LEAST_DISTANCE), near, np.inf).astype(np.float32)

    def normals_at(self, points: Directions) -> Directions:
        """Return the outward unit normals at points of the surface."""
        if len(self.normals):
            apart = self.normals.astype(np.float32) @ points - self.offsets.astype(np.float32)[:, None]
            return np.asarray(self.normals.astype(np.float32)[apart.argmax(axis=0)].T)
        half = ((self.high - self.low) / 2).astype(np.float32)[:, None]
        out = (points - ((self.low + self.high) / 2).astype(np.float32)[:, None]) / half**2
        return np.asarray(out / np.linalg.norm(out, axis=0))


class GardenPhoto(NamedTuple):
    """A photo, and what each pixel shows."""

    image: UInt8[np.ndarray, "H W 3"]  # RGB
    material: Int8[np.ndarray, "H W"]  # index in MATERIALS, of a ray 1/4 px left of and above the centre
    points: Float32[
        np.ndarray, "H W 3"
    ]  # where that ray ends, world units; NaN in the sky and where there is no ray


def garden_camera(azimuth: float, elevation: float = 0.28, size: tuple[int, int] = (320, 240)) -> Camera:
    """Make a camera facing the house.

    Args:
        azimuth: Around the vertical, radians; 0 faces the door.
        elevation: Above the target, radians.
        size: Width and height of its photo, px.
    """
    W, H = size
    level, up = math.cos(elevation), math.sin(elevation)
    eye = GARDEN_TARGET + GARDEN_DISTANCE * np.array(
        [level * math.sin(azimuth), -up, level * math.cos(azimuth)]
    )
    focal = GARDEN_FOCAL * max(size)
    return Camera(look_at(eye, GARDEN_TARGET), eye, focal, focal, (W - 1) / 2, (H - 1) / 2, H, W)


def photograph_garden(camera: Camera) -> GardenPhoto:
    """Trace a photo of the garden.

    Args:
        camera: A camera above the ground and outside the solids, of any lens and shutter; pixel centres have integer
            coordinates. Pixels without a ray are black.
    """
    s = RAYS_PER_SIDE
    eyes, rays, there = _beam(camera, s)
    with np.errstate(divide="ignore"):
        nearest = np.where(rays[1] > 1e-6, -eyes[1] / rays[1], np.float32(np.inf))
    owner = np.where(np.isfinite(nearest), GROUND, SKY).astype(np.int8)
    windows = [_window(solid, camera, s) for solid in SOLIDS]
    for number, (solid, part) in enumerate(zip(SOLIDS, windows, strict=True)):
        beam = np.ascontiguousarray(rays[(slice(None), *part)])
        start = eyes if camera.pinhole else eyes[(slice(None), *part)]
        at = solid.hit(start.reshape(3, -1), beam.reshape(3, -1)).reshape(beam.shape[1:])
        closer = at < nearest[part]
        nearest[part][closer], owner[part][closer] = at[closer], number

    color, material = np.empty((*owner.shape, 3), np.float32), np.empty(owner.shape, np.int8)
    everywhere = (slice(None), slice(None))
    for number, part in ((SKY, everywhere), (GROUND, everywhere), *enumerate(windows)):
        chosen = owner[part] == number
        distance = nearest[part][chosen]
        heading = rays[(slice(None), *part)][:, chosen]
        start = np.broadcast_to(eyes, rays.shape)[(slice(None), *part)][:, chosen]
        points = start + np.nan_to_num(distance, posinf=0) * heading
        heading /= np.linalg.norm(heading, axis=0)
        color[part][chosen], material[part][chosen] = _seen(number, points, distance, heading)
    color[~there] = 0.0
    image = color.reshape(camera.H, s, camera.W, s, 3).mean(axis=(1, 3))
    with np.errstate(invalid="ignore"):
        ends = np.where(there & (owner != SKY), eyes + nearest * rays, np.nan)[:, ::s, ::s]
    pixels = np.round(255 * np.clip(image, 0, 1)).astype(np.uint8)
    return GardenPhoto(pixels, material[::s, ::s].copy(), np.moveaxis(ends, 0, -1).astype(np.float32))


def _beam(
    camera: Camera, s: int
) -> tuple[Float32[np.ndarray, "3 #h #w"], Float32[np.ndarray, "3 h w"], Bool[np.ndarray, "h w"]]:
    """Return where s × s rays per pixel begin, their directions, and which exist; the others look up."""
    if not camera.pinhole:
        eyes, rays = (np.moveaxis(each, -1, 0) for each in fine_rays(camera, s))
        there = np.isfinite(rays[0])
        up = np.array([0.0, -1.0, 0.0])[:, None, None]
        return eyes.astype(np.float32), np.where(there, rays, up).astype(np.float32), there
    inside = (np.arange(s) + 0.5) / s - 0.5
    u, v = ((np.arange(n)[:, None] + inside).ravel() for n in (camera.W, camera.H))
    x, y = np.meshgrid((u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy)
    rays = np.tensordot(camera.R.T, np.stack([x, y, np.ones_like(x)]), axes=1).astype(np.float32)
    return camera.eye.astype(np.float32)[:, None, None], rays, np.ones(x.shape, bool)


def _seen(
    number: int, points: Directions, distance: Values, heading: Directions
) -> tuple[Float[np.ndarray, "N 3"], Int8[np.ndarray, " N"]]:
    """Return the colours and the materials of points on one solid, on the ground or in the sky."""
    if number >= 0:
        solid = SOLIDS[number]
        colors, shown = paint(solid.material, points, solid.normals_at(points), heading)
        return colors.T, shown
    name = "sky" if number == SKY else "grass"
    colors = sky_colors(heading) if number == SKY else ground_colors(points, distance, _ground_shadow)
    return colors.T, np.full(points.shape[1], MATERIALS.index(name), np.int8)


def _window(solid: Solid, camera: Camera, s: int) -> tuple[slice, slice]:
    """Return the rows and columns of the grid of rays that a solid can cover: all of them for other than a pinhole."""
    if not camera.pinhole:
        return slice(None), slice(None)
    seen = (solid.corners() - camera.eye) @ camera.R.T
    if seen[:, 2].min() < 0.05:
        return slice(None), slice(None)
    slices = []
    for axis, f, c, size in ((1, camera.fy, camera.cy, camera.H), (0, camera.fx, camera.cx, camera.W)):
        at = s * (f * seen[:, axis] / seen[:, 2] + c + 0.5)
        low, high = math.floor(at.min()) - 1, math.ceil(at.max()) + 1
        slices.append(slice(min(max(low, 0), s * size), min(max(high, 0), s * size)))
    return slices[0], slices[1]


def _ground_shadow(points: Directions) -> Float32[np.ndarray, " N"]:
    """Return 1 where a solid hides the sun from a point of the ground, else 0."""
    shadow = np.zeros(points.shape[1], np.float32)
    sun = SUN.astype(np.float32)
    away = SUN / -SUN[1]  # towards the sun, per unit of height
    for solid in SOLIDS:
        corners = solid.corners()
        fallen = corners[:, [0, 2]] + corners[:, [1]] * away[[0, 2]]  # y is minus the height
        low, high = fallen.min(axis=0), fallen.max(axis=0)
        inside = (points[0] > low[0]) & (points[0] < high[0]) & (points[2] > low[1]) & (points[2] < high[1])
        rows = np.flatnonzero(inside & (shadow == 0))
        shadow[rows] = np.isfinite(solid.hit(points[:, rows], sun[:, None]))
    return shadow


def _box(
    material: str, place: tuple[float, float], half: tuple[float, float], up: tuple[float, float]
) -> Solid:
    """Make an upright box from its place (x, z), half widths (x, z) and lower and upper height."""
    low = np.array([place[0] - half[0], -up[1], place[1] - half[1]])
    high = np.array([place[0] + half[0], -up[0], place[1] + half[1]])
    normals = np.concatenate([np.eye(3), -np.eye(3)])
    return Solid(MATERIALS.index(material), low, high, normals, np.concatenate([high, -low]))


def _ball(material: str, center: tuple[float, float, float], half: tuple[float, float, float]) -> Solid:
    """Make an ellipsoid from its centre (x, height, z) and half axes (x, height, z)."""
    middle = np.array([center[0], -center[1], center[2]])
    return Solid(MATERIALS.index(material), middle - half, middle + half, np.zeros((0, 3)), np.zeros(0))


def _house() -> list[Solid]:
    """Make walls with gables, the two halves of the roof, and a chimney."""
    half_x, half_z, eaves, ridge = 1.0, 0.7, 0.85, 1.5
    rise = math.atan2(ridge - eaves, half_z)
    made = []
    walls = _box("brick", (0, 0), (half_x, half_z), (0, ridge))
    slopes = np.array([[0, -math.cos(rise), side * math.sin(rise)] for side in (1, -1)])
    top = np.full(2, ridge * math.cos(rise))
    made.append(
        walls._replace(
            normals=np.concatenate([walls.normals, slopes]), offsets=np.concatenate([walls.offsets, top])
        )
    )
    for side in (1, -1):
        out = np.array([0, -math.cos(rise), side * math.sin(rise)])  # through the slab
        down = np.array([0, math.sin(rise), side * math.cos(rise)])  # along it, from the ridge
        normals = np.stack([out, -out, down, [1, 0, 0], [-1, 0, 0], [0, 0, -side]])
        length = math.hypot(ridge - eaves, half_z) + 0.16
        start = down @ np.array([0, -ridge, 0])
        offsets = np.array([top[0] + 0.07, -top[0], start + length, half_x + 0.14, half_x + 0.14, 0.0])
        reach = half_z + 0.3
        low = np.array([-half_x - 0.14, -ridge - 0.12, min(0, side * reach)])
        high = np.array([half_x + 0.14, -eaves + 0.25, max(0, side * reach)])
        made.append(Solid(MATERIALS.index("roof"), low, high, normals, offsets))
    made.append(_box("chimney", (0.55, -0.22), (0.1, 0.1), (1.1, 1.8)))
    return made


def _trees() -> list[Solid]:
    """Make an apple tree, a maple, a spruce and bushes."""
    made = []
    for (x, z), trunk, crown, material in (
        ((-1.55, 0.95), 0.7, 0.42, "leaves"),
        ((1.5, -1.15), 0.75, 0.44, "maple"),
    ):
        made.append(_box("wood", (x, z), (0.055, 0.055), (0, trunk)))
        for ball in range(11):  # around a middle, in a spiral from below to above
            turn, up = 2.4 * ball, ball / 10
            out, r = crown * (0.62 - 0.55 * up**2), crown * (0.5 - 0.08 * math.sin(5 * ball))
            at = (x + out * math.sin(turn), trunk + crown * (0.3 + 1.1 * up), z + out * math.cos(turn))
            made.append(_ball(material, at, (r, 0.9 * r, r)))
    for level in range(5):
        wide = 0.4 * (1 - 0.18 * level)
        made.append(_ball("spruce", (-1.4, 0.3 + 0.26 * level, -1.2), (wide, 0.26, wide)))
    made.append(_box("wood", (-1.4, -1.2), (0.05, 0.05), (0, 0.4)))
    for x, z, r in (
        (1.35, 0.85, 0.24),
        (1.6, 0.45, 0.2),
        (0.62, 0.92, 0.17),
        (-0.62, 0.92, 0.15),
        (-1.3, -0.3, 0.2),
    ):
        made.append(_ball("leaves", (x, 0.6 * r, z), (r, r, r)))
    return made


def _fence() -> list[Solid]:
    """Make a fence in front of the house, with a gap for the path."""
    made = []
    for side in (1, -1):
        for post in np.linspace(0.45, 2.2, 6):
            made.append(_box("fence", (side * post, 1.9), (0.035, 0.035), (0, 0.42)))
        for height in (0.14, 0.3):
            made.append(_box("fence", (side * 1.325, 1.9), (0.875, 0.015), (height, height + 0.06)))
    return made


SOLIDS = (*_house(), *_trees(), *_fence())
"""What stands in the garden, in no particular order."""

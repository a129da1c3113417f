"""Photos of the scene `solids` with known cameras, by sphere tracing, with the exact depth and normal of each pixel.

A ray advances by the distance to the surface, which it cannot pass, until the distance is negligible. Training on the
photos is an independent test, because they are not rendered from splats.

Chapter: 15_cloud_to_surface.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Float64, Int8, Int64, UInt8

from gsplat_edu.base.validation import one_of, whole_number
from gsplat_edu.scene.camera import Camera, look_at
from gsplat_edu.scene.views import View
from lab.captures.fine_rays import fine_rays
from lab.captures.solids import SolidScene, solids
from lab.captures.solids_shapes import Points, SolidShape, Values, along_and_beside, gradient, lengths

SOLIDS_TARGET = np.array([0.0, -0.25, 0.0])
"""Target of the cameras, world units."""

SOLIDS_DISTANCE = 3.6
"""Distance from the target to a camera, world units."""

SOLIDS_FOCAL = 1.1
"""Focal length as a fraction of the photo's longer side: 352 px at 320."""

RAYS_PER_SIDE = 2
"""Rays per pixel along each side."""

RAYS_AT_ONCE = 4_096
"""Pixels traced together, chosen so that their rays stay in the processor's cache."""

CLOSE = 1e-4
"""Distance below which secant steps replace steps of sphere tracing, world units; far below the thinnest wall."""

EXACT = 1e-10
"""A ray has met the surface at this distance, world units."""

MOST_STEPS = 200
"""A ray that has not met the surface after these steps grazes it and misses."""

START_NOISE = 0.01
"""Standard deviation of the start points around the surface along each axis, world units."""

LIGHT = np.array([0.45, -0.8, -0.4]) / np.linalg.norm([0.45, -0.8, -0.4])
"""Unit direction towards the light."""

BEHIND = np.array([0.36, 0.38, 0.42], np.float32)
"""RGB behind the scene, 0 to 1."""


Eyes = Float64[np.ndarray, "... 3"]
"""Where rays begin: (3,) for all of them, or (n, 3)."""


class Finish(NamedTuple):
    """What the surfaces of the objects look like; the floor is always textured."""

    contrast: float  # of the texture, 1 for full
    gloss: float  # peak of the highlight, 0 to 1


FINISHES = {"textured": Finish(1.0, 0.0), "plain": Finish(0.0, 0.0), "glossy": Finish(0.35, 0.8)}
"""The finishes by name. A glossy object also has a weak texture."""

SHININESS = 30.0
"""Exponent of the highlight: it falls to half its peak at 12 degrees between normal and half vector."""

MEAN_COLORS = {
    "floor": (0.55, 0.52, 0.48),
    "bowl": (0.75, 0.35, 0.25),
    "rods": (0.85, 0.8, 0.45),
    "slots": (0.35, 0.6, 0.4),
    "torus": (0.35, 0.45, 0.75),
}
"""Mean RGB of each object before shading, 0 to 1."""

WAVES = 28
"""Number of plane waves whose sum is the texture."""


class SolidsPhoto(NamedTuple):
    """A photo and what its pixels show."""

    image: UInt8[np.ndarray, "H W 3"]  # RGB
    depth: Float64[
        np.ndarray, "H W"
    ]  # along the optical axis at the pixel's centre, or as the projection has it; world units; 0 for no surface
    normals: Float64[np.ndarray, "H W 3"]  # outward unit normals at the centre, world axes; 0 for no surface
    part: Int8[np.ndarray, "H W"]  # index in `SolidScene.parts` at the centre, -1 for no surface


class SolidsCapture(NamedTuple):
    """Photos of solids, and their true surface."""

    scene: SolidScene
    views: list[View]  # names sorted
    points: Float64[np.ndarray, "N 3"]  # noisy points of the surface that a photo sees, world units
    colors: Float64[np.ndarray, "N 3"]  # their colours without highlights, 0 to 1
    photos: list[SolidsPhoto]  # one per view


def solids_capture(
    finish: str = "textured",
    size: int = 320,
    count: int = 32,
    *,
    floor: bool = True,
    start: int = 4_000,
    seed: int = 0,
) -> SolidsCapture:
    """Photograph the solids from a ring of cameras.

    Args:
        finish: A name in `FINISHES`.
        size: Width of the photos, px; the height is three quarters of it.
        count: Number of photos.
        floor: Whether there is a floor.
        start: Number of start points.
        seed: Seed of the start points.

    Raises:
        ArgumentError: the finish is unknown, or a number is out of range.
    """
    one_of("finish", finish, list(FINISHES))
    W, H = whole_number("size", size, 4), max(1, round(0.75 * size))
    scene = solids(floor)
    cameras = solids_orbit(whole_number("count", count, 1), (W, H))
    photos = [photograph_solids(scene, camera, finish) for camera in cameras]
    views = [View(cameras[i], photo.image, name=f"view_{i:03d}.png") for i, photo in enumerate(photos)]
    rng = np.random.default_rng(whole_number("seed", seed, 0))
    exact, colors = _start(scene, cameras, photos, FINISHES[finish], rng, whole_number("start", start, 1))
    return SolidsCapture(scene, views, exact + START_NOISE * rng.normal(size=exact.shape), colors, photos)


def solids_orbit(count: int, size: tuple[int, int] = (320, 240)) -> list[Camera]:
    """Make cameras on a ring around the scene, whose elevation oscillates between 14 and 46 degrees.

    Args:
        count: Number of cameras.
        size: Width and height of the photos, px.
    """
    W, H = size
    focal, cameras = SOLIDS_FOCAL * max(size), []
    for angle in 2 * math.pi * np.arange(count) / count:
        up = 0.52 + 0.28 * math.sin(3 * angle)
        level = math.cos(up)
        direction = np.array([level * math.sin(angle), -math.sin(up), -level * math.cos(angle)])
        eye = SOLIDS_TARGET + SOLIDS_DISTANCE * direction
        cameras.append(Camera(look_at(eye, SOLIDS_TARGET), eye, focal, focal, (W - 1) / 2, (H - 1) / 2, H, W))
    return cameras


def photograph_solids(scene: SolidScene, camera: Camera, finish: str = "textured") -> SolidsPhoto:
    """Trace a photo.

    Args:
        scene: The solids.
        camera: A camera outside them, of any lens and shutter; pixel centres have integer coordinates. Pixels without
            a ray are black.
        finish: A name in `FINISHES`.

    Raises:
        ArgumentError: the finish is unknown.
    """
    one_of("finish", finish, list(FINISHES))
    beam = None if camera.pinhole else fine_rays(camera, RAYS_PER_SIDE)
    image = np.concatenate([_pixels(scene, camera, beam, band, finish) for band in _bands(camera)])
    return SolidsPhoto(image, *scan_solids(scene, camera))


def scan_solids(
    scene: SolidScene, camera: Camera
) -> tuple[Float64[np.ndarray, "H W"], Float64[np.ndarray, "H W 3"], Int8[np.ndarray, "H W"]]:
    """Return depth, normals and part at the centres of pixels; see `SolidsPhoto`.

    Args:
        scene: The solids.
        camera: A camera outside them.
    """
    beam = None if camera.pinhole else fine_rays(camera, 1)
    bands = [_exact(scene, camera, beam, band) for band in _bands(camera)]
    depth, normals, part = (np.concatenate(values) for values in zip(*bands, strict=True))
    return depth, normals, part


def _bands(camera: Camera) -> list[slice]:
    """Return the rows of pixels that are traced together."""
    rows = max(1, RAYS_AT_ONCE // camera.W)
    return [slice(top, min(top + rows, camera.H)) for top in range(0, camera.H, rows)]


Beam = tuple[Float64[np.ndarray, "fine_H fine_W 3"], Float64[np.ndarray, "fine_H fine_W 3"]] | None
"""Origins and directions of a whole photo's rays; None for a pinhole, which has formulas."""


def _pixels(
    scene: SolidScene, camera: Camera, beam: Beam, band: slice, finish: str
) -> UInt8[np.ndarray, "h W 3"]:
    """Return some rows of a photo."""
    s = RAYS_PER_SIDE
    eyes, rays = _beam(camera, beam, band, s)
    at, owner = _met(scene, eyes, rays, exact=False)
    colors = np.tile(BEHIND, (len(rays), 1))
    colors[np.isnan(rays[:, 0])] = 0.0
    for index, part in enumerate(scene.parts):
        mine = np.flatnonzero(owner == index)
        points = _of(eyes, mine) + at[mine, None] * rays[mine]
        kind = FINISHES["textured"] if part.name == "floor" else FINISHES[finish]
        colors[mine] = _shaded(part.name, part.shape, points, _of(eyes, mine), kind)
    mean = colors.reshape(-1, s, camera.W, s, 3).mean(axis=(1, 3))
    return np.asarray(np.round(255 * np.clip(mean, 0, 1)).astype(np.uint8))


def _exact(
    scene: SolidScene, camera: Camera, beam: Beam, band: slice
) -> tuple[Float64[np.ndarray, "h W"], Float64[np.ndarray, "h W 3"], Int8[np.ndarray, "h W"]]:
    """Return depth, normals and part of some rows of pixels."""
    eyes, rays = _beam(camera, beam, band, 1)
    at, owner = _met(scene, eyes, rays)
    normals = np.zeros((len(rays), 3))
    for index, part in enumerate(scene.parts):
        mine = np.flatnonzero(owner == index)
        normals[mine] = gradient(part.shape, _of(eyes, mine) + at[mine, None] * rays[mine])
    shape = (-1, camera.W)
    depth = np.where(owner < 0, 0.0, at)  # rays have depth 1, so this is depth already
    return depth.reshape(shape), normals.reshape(*shape, 3), owner.reshape(shape)


def _beam(camera: Camera, beam: Beam, band: slice, s: int) -> tuple[Eyes, Points]:
    """Return where the rays of some rows begin, and their directions."""
    if beam is None:
        return camera.eye, _rays(camera, band, s)
    rows = slice(s * band.start, s * band.stop)
    origins, rays = (part[rows].reshape(-1, 3) for part in beam)
    return origins, rays


def _of(eyes: Eyes, rows: Int64[np.ndarray, " m"]) -> Eyes:
    """Return where some rays begin."""
    return eyes if eyes.ndim == 1 else eyes[rows]


def _met(
    scene: SolidScene, eyes: Eyes, rays: Points, exact: bool = True
) -> tuple[Values, Int8[np.ndarray, " n"]]:
    """Trace rays of which some are NaN and miss."""
    there = np.flatnonzero(np.isfinite(rays[:, 0]))
    if len(there) == len(rays):
        return trace(scene, eyes, rays, exact)
    at, owner = np.full(len(rays), np.inf), np.full(len(rays), -1, np.int8)
    at[there], owner[there] = trace(scene, _of(eyes, there), rays[there], exact)
    return at, owner


def trace(
    scene: SolidScene, eye: Eyes, rays: Points, exact: bool = True
) -> tuple[Values, Int8[np.ndarray, " n"]]:
    """Return where each ray first meets the surface, and which part it meets.

    Args:
        scene: The solids.
        eye: (3,) start of the rays, or (n, 3), outside the solids.
        rays: (n, 3) directions of any length.
        exact: Whether the hits are within `EXACT` of the surface; else within `CLOSE`, in less time.

    Returns:
        at: Multiple of the direction; infinity where the ray misses.
        owner: Index of the part, -1 where the ray misses.
    """
    at, owner = np.full(len(rays), np.inf), np.full(len(rays), -1, np.int8)
    squared = np.einsum("ij,ij->i", rays, rays)
    for index, part in enumerate(scene.parts):
        rows = _towards(part.shape, eye, rays, squared)
        near, far = part.shape.reach(_of(eye, rows), rays[rows])
        before = (far > 0) & (near < at[rows])
        rows, near, far = rows[before], np.maximum(near[before], 0.0), far[before]
        found = _first_hit(part.shape, _of(eye, rows), rays[rows], near, far)
        if exact:
            found = _polished(part.shape, _of(eye, rows), rays[rows], found)
        closer = found < at[rows]
        at[rows[closer]], owner[rows[closer]] = found[closer], index
    return at, owner


def _towards(shape: SolidShape, eye: Eyes, rays: Points, squared: Values) -> Int64[np.ndarray, " m"]:
    """Return the rays that meet the bounding sphere of a shape; `squared` are the squares of their lengths."""
    along, beside = along_and_beside(shape.center - eye, rays, shape.radius)
    return np.flatnonzero((beside <= 0) | ((along > 0) & (along * along > beside * squared)))


def _first_hit(shape: SolidShape, eye: Eyes, rays: Points, near: Values, far: Values) -> Values:
    """Return where rays meet one shape between `near` and `far`, infinity where they miss."""
    at = near.copy()
    length = lengths(rays)
    left = np.arange(len(rays))
    for _ in range(MOST_STEPS):
        if not len(left):
            break
        away = shape.distance(_of(eye, left) + at[left, None] * rays[left])
        at[left] += np.where(away > CLOSE, away / length[left], 0.0)
        missed = at[left] > far[left]
        at[left[missed]] = np.inf
        left = left[(away > CLOSE) & ~missed]
    at[left] = np.inf
    return at


def _polished(shape: SolidShape, eye: Eyes, rays: Points, at: Values) -> Values:
    """Return where rays meet the surface exactly, from places at most `CLOSE` before it; infinity if they pass it.

    Each step follows the slope of the distance along the ray. Steps that approach too slowly are those of sphere
    tracing, which are safe.
    """
    length = lengths(rays)
    at = at.copy()
    left = np.flatnonzero(np.isfinite(at))
    for _ in range(MOST_STEPS):
        points = _of(eye, left) + at[left, None] * rays[left]
        away = shape.distance(points)
        wide = np.abs(away) > EXACT
        left, away, points = left[wide], away[wide], points[wide]
        if not len(left):
            break
        ahead = rays[left] / length[left, None]
        slope = (shape.distance(points + 1e-7 * ahead) - away) / 1e-7
        step = np.where(slope < -0.02, -away / np.minimum(slope, -0.02), away)
        at[left] += step / length[left]
        passed = away > 2 * CLOSE
        at[left[passed]] = np.inf
        left = left[~passed]
    at[left] = np.inf
    return at


def _rays(camera: Camera, band: slice, s: int) -> Points:
    """Return the directions through a grid of s × s places in each pixel of some rows, of depth 1, row by row."""
    inside = (np.arange(s) + 0.5) / s - 0.5
    u, v = ((n[:, None] + inside).ravel() for n in (np.arange(camera.W), np.arange(camera.H)[band]))
    x, y = np.meshgrid((u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy)
    return np.asarray(np.stack([x.ravel(), y.ravel(), np.ones(x.size)], axis=1) @ camera.R)


def _shaded(
    name: str, shape: SolidShape, points: Points, eye: Eyes, finish: Finish
) -> Float32[np.ndarray, "n 3"]:
    """Return the RGB of points of one part as seen from a place."""
    normals = gradient(shape, points)
    colors = texture_colors(name, points, finish.contrast)
    colors *= (0.45 + 0.55 * np.maximum(normals @ LIGHT, 0.0)).astype(np.float32)[:, None]
    if finish.gloss:
        towards = eye - points
        towards /= lengths(towards)[:, None]
        half = towards + LIGHT
        half /= lengths(half)[:, None]
        peak = finish.gloss * np.maximum(np.einsum("ij,ij->i", normals, half), 0.0) ** SHININESS
        colors += peak.astype(np.float32)[:, None]
    return colors


def texture_colors(name: str, points: Points, contrast: float) -> Float32[np.ndarray, "n 3"]:
    """Return the RGB of points before shading: a sum of plane waves of all lengths around the object's colour.

    Args:
        name: The object, a name in `MEAN_COLORS`.
        points: (n, 3) world units.
        contrast: 0 for the object's mean colour alone, 1 for full contrast.
    """
    mean = np.array(MEAN_COLORS[name], np.float32)
    if contrast == 0:
        return np.tile(mean, (len(points), 1))
    vectors, phases, mixture = _waves(name)
    waves = np.sin(points.astype(np.float32) @ vectors + phases)
    return np.asarray(mean + np.float32(0.3 * contrast) * np.tanh(waves @ mixture))


@functools.cache
def _waves(
    name: str,
) -> tuple[Float32[np.ndarray, "3 K"], Float32[np.ndarray, " K"], Float32[np.ndarray, "K 3"]]:
    """Return wave vectors, phases and amplitudes per channel of an object's texture."""
    rng = np.random.default_rng(list(MEAN_COLORS).index(name))
    direction = rng.normal(size=(3, WAVES))
    length = 0.05 * (0.8 / 0.05) ** (np.arange(WAVES) / (WAVES - 1))
    vectors = 2 * math.pi * direction / np.linalg.norm(direction, axis=0) / length
    mixture = rng.normal(size=(WAVES, 3)) * (0.24 * (length / 0.2) ** 0.3)[:, None]
    phases = rng.uniform(0, 2 * math.pi, WAVES)
    return vectors.astype(np.float32), phases.astype(np.float32), mixture.astype(np.float32)


def _start(
    scene: SolidScene,
    cameras: Sequence[Camera],
    photos: Sequence[SolidsPhoto],
    finish: Finish,
    rng: np.random.Generator,
    count: int,
) -> tuple[Points, Points]:
    """Return exact points of the surface at random pixels, and their shaded colours without highlights."""
    per_photo = np.bincount(rng.integers(0, len(photos), count), minlength=len(photos))
    points, colors = [], []
    for camera, photo, number in zip(cameras, photos, per_photo, strict=True):
        shown: Int64[np.ndarray, " m"] = np.flatnonzero(photo.part.ravel() >= 0)
        if not len(shown):
            continue
        chosen = rng.choice(shown, number)
        eyes, rays = _beam(camera, None if camera.pinhole else fine_rays(camera, 1), slice(0, camera.H), 1)
        places = _of(eyes, chosen) + photo.depth.ravel()[chosen, None] * rays[chosen]
        shades = np.zeros((number, 3))
        for index, part in enumerate(scene.parts):
            mine = photo.part.ravel()[chosen] == index
            kind = FINISHES["textured"] if part.name == "floor" else finish
            shades[mine] = _shaded(
                part.name, part.shape, places[mine], _of(eyes, chosen[mine]), Finish(kind.contrast, 0.0)
            )
        points.append(places)
        colors.append(np.clip(shades, 0.0, 1.0))
    return np.concatenate(points), np.concatenate(colors)

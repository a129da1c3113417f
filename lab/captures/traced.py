"""An object with textures, hard edges, shadows and highlights, ray-traced with alpha.

Unlike the package's procedural capture, the object is not made of Gaussians, so no recipe can represent it exactly.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from gsplat_edu.scene.camera import Camera, look_at
from gsplat_edu.scene.views import View

Points = Float64[np.ndarray, "3 N"]
"""Points, directions or colours; components are the first axis, because NumPy reduces a short last axis slowly."""

Texture = Callable[[Points], Points]

LIGHT = np.array([[0.5], [-0.75], [-0.433]])
"""Unit direction towards the light; y points down."""

SUPERSAMPLING = 2
"""Rays per pixel along each side."""

RADIUS, TARGET = 4.0, (0.0, 0.0, 0.0)
SHININESS = 30.0
"""Phong's exponent of the highlights."""

HELD_OUT = 8
"""Every view of this number is a test view."""


@dataclass(frozen=True)
class Shape:
    """An ellipsoid or a box.

    Args:
        center: (3,) world units.
        axes: (3, 3) rows are its axes divided by its half lengths: points to coordinates in -1 to 1.
        is_box: Whether it is a box.
        texture: Colours, 0 to 1, of points in world coordinates.
        gloss: Strength of the highlight.
    """

    center: Float64[np.ndarray, " 3"]
    axes: Float64[np.ndarray, "3 3"]
    is_box: bool
    texture: Texture
    gloss: float

    def hit(self, origins: Points, directions: Points) -> Float64[np.ndarray, " N"]:
        """Return the distance at which each ray enters, infinity where it misses."""
        o, d = self.axes @ (origins - self.center[:, None]), self.axes @ directions
        if self.is_box:
            d = np.where(np.abs(d) < 1e-12, 1e-12, d)
            one, other = (-1 - o) / d, (1 - o) / d
            near, far = np.minimum(one, other).max(axis=0), np.maximum(one, other).min(axis=0)
            return np.where((near < far) & (near > 1e-4), near, np.inf)
        a, b, c = (d * d).sum(0), (o * d).sum(0), (o * o).sum(0) - 1
        root = b * b - a * c
        near = (-b - np.sqrt(np.maximum(root, 0))) / a
        return np.where((root > 0) & (near > 1e-4), near, np.inf)

    def normals(self, points: Points) -> Points:
        """Return the outward unit normals at points of its surface."""
        local = self.axes @ (points - self.center[:, None])
        if self.is_box:
            largest = np.abs(local).argmax(axis=0) == np.arange(3)[:, None]
            local = np.where(largest, np.sign(local), 0)
        return _unit(self.axes.T @ local)


@dataclass(frozen=True)
class Scene:
    """Shapes under `LIGHT`.

    Args:
        shapes: What is drawn.
        shininess: Phong's exponent of the highlights.
    """

    shapes: tuple[Shape, ...]
    shininess: float


def traced_capture(size: int, count: int) -> tuple[list[View], list[View]]:
    """Photograph the object from a spiral of views around it.

    Args:
        size: Width and height, px.
        count: Number of views.

    Returns:
        Training views and test views, with alpha.
    """
    scene = Scene(SHAPES, SHININESS)
    views = [photographed(scene, f"view_{i:03d}.png", _camera(i, count, size)) for i in range(count)]
    test = views[::HELD_OUT]
    return [view for view in views if view not in test], test


def _camera(i: int, count: int, size: int) -> Camera:
    """Return a camera of the spiral, which winds from above the object to somewhat below its equator."""
    return camera_at(0.9 - 1.2 * (i + 0.5) / count, i * math.pi * (3 - math.sqrt(5)), size)


def camera_at(height: float, azimuth: float, size: int) -> Camera:
    """Return a camera that looks at the object.

    Args:
        height: Sine of its elevation.
        azimuth: Its angle around the vertical axis, radians.
        size: Width and height of the photo, px.
    """
    ring = math.sqrt(1 - height * height)
    eye = RADIUS * np.array([ring * math.sin(azimuth), -height, ring * math.cos(azimuth)])
    return Camera(
        look_at(eye, TARGET), eye, 1.2 * size, 1.2 * size, (size - 1) / 2, (size - 1) / 2, size, size
    )


def photographed(scene: Scene, name: str, camera: Camera) -> View:
    """Trace a photo with alpha, a row of pixels at a time, whose rays fit in cache."""
    rows = [_row(scene, camera, y) for y in range(camera.H)]
    color, alpha = (np.stack(part) for part in zip(*rows, strict=True))
    return View(camera, _bytes(color), alpha=_bytes(alpha), name=name)


def _row(
    scene: Scene, camera: Camera, y: int
) -> tuple[Float64[np.ndarray, "W 3"], Float64[np.ndarray, " W"]]:
    """Return straight colour and alpha of a row of pixels, as means over the rays of each pixel."""
    inside = (np.arange(SUPERSAMPLING) + 0.5) / SUPERSAMPLING - 0.5
    across = (np.arange(camera.W)[:, None] + inside).ravel()
    x, v = np.meshgrid((across - camera.cx) / camera.fx, (y + inside - camera.cy) / camera.fy)
    directions = _unit(camera.R.T @ np.stack([x.ravel(), v.ravel(), np.ones(x.size)]))
    traced = _traced(scene, np.asarray(camera.eye, float)[:, None], directions)
    means = traced.reshape(4, SUPERSAMPLING, camera.W, SUPERSAMPLING).mean(axis=(1, 3))
    return (means[:3] / np.maximum(means[3], 1e-12)).T, means[3]


def _unit(vectors: Points) -> Points:
    units: Points = vectors / np.sqrt((vectors * vectors).sum(axis=0))
    return units


def _bytes(values: Float64[np.ndarray, "..."]) -> np.ndarray:
    levels: np.ndarray = np.round(255 * np.clip(values, 0, 1)).astype(np.uint8)
    return levels


def _traced(scene: Scene, eye: Float64[np.ndarray, "3 1"], directions: Points) -> Float64[np.ndarray, "4 N"]:
    """Return colour times alpha, and alpha, of each ray."""
    result = np.zeros((4, directions.shape[1]))
    distances = np.stack([shape.hit(eye, directions) for shape in scene.shapes])
    nearest = distances.argmin(axis=0)
    for k, shape in enumerate(scene.shapes):
        rays = np.flatnonzero((nearest == k) & np.isfinite(distances[k]))
        points = eye + distances[k, rays] * directions[:, rays]
        result[:3, rays], result[3, rays] = _shaded(scene, shape, points, directions[:, rays]), 1.0
    return result


def _shaded(scene: Scene, shape: Shape, points: Points, directions: Points) -> Points:
    """Return the colours of points on a shape: ambient and diffuse light, a highlight, hard shadows."""
    normals = shape.normals(points)
    diffuse = (LIGHT * normals).sum(axis=0)
    above = points + 1e-3 * normals
    lit = np.all([np.isinf(other.hit(above, LIGHT)) for other in scene.shapes], axis=0)
    mirrored = 2 * diffuse * normals - LIGHT
    highlight = np.maximum(-(mirrored * directions).sum(axis=0), 0) ** scene.shininess * lit
    colors: Points = shape.texture(points) * (0.3 + 0.7 * np.maximum(diffuse, 0) * lit)
    return np.clip(colors + shape.gloss * highlight, 0, 1, out=colors)


def checks(scale: float, dark: tuple[float, ...], bright: tuple[float, ...]) -> Texture:
    """Return a texture of cubes of two colours, `scale` of them per unit of length."""

    def texture(points: Points) -> Points:
        even = np.floor(scale * points).sum(axis=0) % 2 == 0
        return np.where(even, _column(dark), _column(bright))

    return texture


def _waves(points: Points) -> Points:
    """Return a texture of smooth colours with fine ripples."""
    x, y, z = points
    ripple = 0.15 * np.sin(40 * x + 9 * np.sin(5 * y)) * np.sin(35 * z + 3 * x)
    base = [0.6 + 0.3 * np.sin(3 * x + z), 0.4 + 0.3 * np.cos(4 * y), 0.5 - 0.3 * np.sin(5 * z)]
    colors: Points = np.clip(np.stack(base) + ripple, 0, 1)
    return colors


def _stripes(points: Points) -> Points:
    """Return a texture of stripes that wind around the vertical axis."""
    turn = np.arctan2(points[2], points[0]) / (2 * math.pi)
    bright = np.sin(2 * math.pi * (9 * turn + 6 * points[1])) > 0
    return np.where(bright, _column((0.95, 0.9, 0.8)), _column((0.1, 0.25, 0.5)))


def _column(color: tuple[float, ...]) -> Float64[np.ndarray, "3 1"]:
    return np.array(color)[:, None]


def placed(
    center: tuple[float, ...], halves: tuple[float, ...], turn: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """Return centre and axes of a shape that is rotated about the vertical axis, radians."""
    c, s = math.cos(turn), math.sin(turn)
    return np.array(center), np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]) / np.array(halves)[:, None]


RED, YELLOW, GREEN, LIME = (0.7, 0.1, 0.1), (0.95, 0.8, 0.3), (0.1, 0.4, 0.2), (0.6, 0.9, 0.5)
BLACK, STONE = (0.2, 0.2, 0.22), (0.8, 0.75, 0.7)

SHAPES = (
    Shape(*placed((0, 0.75, 0), (1.1, 0.12, 1.1), 0.3), True, checks(5, BLACK, STONE), 0.1),
    Shape(*placed((0, 0.1, 0), (0.52, 0.52, 0.52)), False, _waves, 0.6),
    Shape(*placed((0.62, 0.33, 0.45), (0.3, 0.3, 0.3)), False, _stripes, 0.2),
    Shape(*placed((-0.55, 0.23, 0.5), (0.2, 0.4, 0.2), 0.7), True, checks(13, RED, YELLOW), 0.0),
    Shape(*placed((-0.4, -0.45, -0.3), (0.45, 0.12, 0.22), 0.5), False, checks(9, GREEN, LIME), 0.4),
    Shape(*placed((0.5, -0.15, -0.55), (0.05, 0.78, 0.05)), True, _stripes, 0.0),
)

"""A capture with known ground truth: an asymmetric, textured scene, photographed with the reference renderer.

The asymmetry reveals flipped axes, transposed matrices and mirrored photos.
"""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float64

from gsplat_edu.base.validation import whole_number
from gsplat_edu.render.numpy_reference import render_gaussians
from gsplat_edu.scene.camera import Camera, look_at
from gsplat_edu.scene.gaussian_math import build_cov3d_batch, quat_to_R_batch
from gsplat_edu.scene.views import View

TARGET = (0.1, -0.05, 0.15)
"""Target of the cameras; not the origin, so that errors in the camera centre become visible."""

RADIUS = 3.2
"""Distance of the cameras, world units."""

START_NOISE = 0.03
"""Standard deviation of the start points around the truth, world units."""


def procedural_capture(
    size: int = 64, count: int = 24, *, height: int | None = None, splats: int = 300, seed: int = 0
) -> tuple[list[View], Float64[np.ndarray, "N 3"], Float64[np.ndarray, "N 3"]]:
    """Photograph the scene with a full ring of cameras, on black.

    Cameras have square pixels and a centred principal point, ((W - 1)/2, (H - 1)/2), which every format can represent;
    photos are uint8.

    Args:
        size: Width of the photos, px.
        count: Number of views, named view_000.png and so on.
        height: Height of the photos, px; None means three quarters of the width.
        splats: Number of Gaussians in the scene.
        seed: Seed of the scene and of the start points.

    Returns:
        views: One per camera, sorted by name.
        points: (N, 3) noisy means of two thirds of the Gaussians, world units.
        colors: (N, 3) their colours, 0 to 1.

    Raises:
        ArgumentError: a number is not a whole number of at least 1.
    """
    W, count = whole_number("size", size, 1), whole_number("count", count, 1)
    H = max(1, round(0.75 * W)) if height is None else whole_number("height", height, 1)
    rng = np.random.default_rng(whole_number("seed", seed, 0))
    means, cov3ds, colors, opacities = egg_splats(rng, whole_number("splats", splats, 3))
    views = []
    for i in range(count):
        camera = ring_camera(i, count, W, H)
        image, _ = render_gaussians(camera, means, cov3ds, colors, opacities)
        pixels = np.round(255.0 * np.clip(image, 0.0, 1.0)).astype(np.uint8)
        views.append(View(camera, pixels, name=f"view_{i:03d}.png"))
    start = rng.permutation(len(means))[: 2 * len(means) // 3]
    points = means[start] + START_NOISE * rng.normal(size=(len(start), 3))
    return views, points, np.clip(colors[start] + 0.05 * rng.normal(size=(len(start), 3)), 0.0, 1.0)


def ring_camera(i: int, count: int, W: int, H: int) -> Camera:
    """Make camera i of the ring; its elevation oscillates twice per turn, below and above the horizon."""
    azimuth = 2.0 * math.pi * i / count
    elevation = -0.15 + 0.4 * math.sin(2.0 * azimuth + 0.7)
    direction = (
        math.cos(elevation) * math.sin(azimuth),
        math.sin(elevation),
        -math.cos(elevation) * math.cos(azimuth),
    )
    eye = np.array(TARGET) + RADIUS * np.array(direction)
    focal = 1.15 * W
    return Camera(look_at(eye, TARGET), eye, focal, focal, (W - 1) / 2, (H - 1) / 2, H, W)


def egg_splats(
    rng: np.random.Generator, count: int
) -> tuple[
    Float64[np.ndarray, "n 3"],
    Float64[np.ndarray, "n 3 3"],
    Float64[np.ndarray, "n 3"],
    Float64[np.ndarray, " n"],
]:
    """Make a bumpy egg with a horn on its right and a bright cap on one side."""
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    x, y, z = direction.T
    radius = 0.75 + 0.12 * np.sin(5.0 * x + 2.0 * z) + 0.08 * np.cos(7.0 * y + 1.0)
    means = direction * np.array([1.0, 0.8, 0.65]) * radius[:, None]
    horn = np.arange(count) % 8 == 0
    along = rng.uniform(0.0, 1.0, np.count_nonzero(horn))
    means[horn] = np.stack([0.6 + 0.6 * along, -0.3 - 0.5 * along**2, 0.2 * along], axis=1)
    scales = rng.uniform(0.05, 0.11, (count, 3)) * np.array([1.0, 1.0, 0.5])
    cov3ds = build_cov3d_batch(scales, quat_to_R_batch(rng.normal(size=(count, 4))))
    colors = 0.5 + 0.45 * np.stack(
        [np.sin(6.0 * means[:, 0] + 1.0), np.sin(7.0 * means[:, 1]), np.cos(5.0 * means[:, 2] - 0.5)], axis=1
    )
    colors[horn] = (0.95, 0.6, 0.1)
    colors[z > 0.85] = (0.9, 0.9, 1.0)
    return means, cov3ds, colors, rng.uniform(0.6, 0.95, count)

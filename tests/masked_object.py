"""A capture of the procedural object in a cluttered room, with masks that keep the object."""

from typing import NamedTuple

import numpy as np

from gsplat_edu.data import procedural
from gsplat_edu.scene.views import View

ROOM = 6.0
"""Radius of the painted sphere that is the room."""


class MaskedObject(NamedTuple):
    """The capture: views with masks, start points on the object and on the room, and their colours."""

    views: list
    points: np.ndarray
    colors: np.ndarray


def room(places):
    """Return the colours of points on the room's wall."""
    x, y, z = places.T
    checks = np.sign(np.sin(5 * x) * np.sin(5 * y) * np.sin(5 * z))
    base = np.stack([np.sin(2 * x + 1), np.sin(3 * y), np.cos(2 * z - 0.5)], axis=1)
    return np.clip(0.5 + 0.25 * base + 0.2 * checks[:, None], 0, 1)


def wall_behind(camera):
    """Return where the rays of a camera's pixels meet the room's wall, (H W, 3)."""
    v, u = np.mgrid[: camera.H, : camera.W]
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], axis=-1)
    rays = rays.reshape(-1, 3) @ camera.R
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    along = rays @ camera.eye
    return camera.eye + (np.sqrt(along**2 + ROOM**2 - camera.eye @ camera.eye) - along)[:, None] * rays


def masked_object(width, count, splats=300, seed=0):
    """Photograph the object in the room; masks keep pixels of which the object covers half or more."""
    rng = np.random.default_rng(seed)
    height = round(0.75 * width)
    means, cov3ds, colors, opacities = procedural.egg_splats(rng, splats)
    views = []
    for i in range(count):
        camera = procedural.ring_camera(i, count, width, height)
        image, transmittance = procedural.render_gaussians(camera, means, cov3ds, colors, opacities)
        behind = room(wall_behind(camera)).reshape(height, width, 3)
        pixels = np.round(255 * np.clip(image + transmittance[..., None] * behind, 0, 1)).astype(np.uint8)
        views.append(View(camera, pixels, mask=transmittance < 0.5, name=f"view_{i:03d}.png"))
    on_object = means[rng.permutation(len(means))[: 2 * len(means) // 3]]
    wall = rng.normal(size=(len(on_object), 3))
    wall *= ROOM / np.linalg.norm(wall, axis=1, keepdims=True)
    between = rng.normal(size=(len(on_object) // 4, 3)) * 1.5  # errors of structure from motion
    points = np.concatenate([on_object + 0.03 * rng.normal(size=on_object.shape), wall, between])
    painted = np.concatenate(
        [np.clip(colors[: len(on_object)], 0, 1), room(wall), np.full(between.shape, 0.5)]
    )
    return MaskedObject(views, points, painted)

"""Where a page begins: its first camera, the point that orbits go around, and what is up."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from gsplat_edu.camera import WORLD_UP, Camera, point_nearest_axes
from gsplat_edu.evaluate.paths import PARALLEL, common_up, orbit_of_scene
from gsplat_edu.io.scene import Scene

SIDE = 800
"""px of the start's image where no camera lends its size; the window's size takes its place."""

ORBIT = 4
"""Cameras of the orbit that its centre is found from."""


@dataclass(frozen=True, eq=False)
class Start:
    """The first view.

    Args:
        camera: The camera.
        pivot: (3,) point that orbits go around.
        up: (3,) direction that is up, of length 1.
    """

    camera: Camera
    pivot: Float64[np.ndarray, "3"]
    up: Float64[np.ndarray, "3"]


def start_of(scene: Scene, cameras: Sequence[Camera]) -> Start:
    """Choose the first view: the first camera, or where an orbit around the scene begins.

    Args:
        scene: The scene; it may be empty.
        cameras: Those of its capture, if any.
    """
    up = np.array(scene.up or WORLD_UP, dtype=np.float64)
    up = common_up(cameras) if scene.up is None and cameras else up / np.linalg.norm(up)
    zero = np.zeros(3)
    if len(scene.gaussians):
        orbit = orbit_of_scene(scene.gaussians, ORBIT, SIDE, up)
    else:
        orbit = [Camera.looking_at((0.0, 0.0, -1.0), zero, SIDE, SIDE, SIDE, SIDE)]
    found = [point_nearest_axes(axes, PARALLEL) for axes in (cameras, orbit) if axes]
    pivot = next((point for point in found if point is not None), zero)
    return Start(cameras[0] if cameras else orbit[0], pivot, up)

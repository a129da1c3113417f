"""The sky that a run starts with."""

from __future__ import annotations

import numpy as np

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.data.dataset import Dataset
from gsplat_edu.parts.sky.find import SIDE, find_sky, scene_size
from gsplat_edu.parts.sky.shell import MOST, sky_splats
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.scene.rig import settled_eyes
from gsplat_edu.train.config import TrainConfig
from gsplat_edu.train.far import Shell

RADIUS = 50.0
"""Radius of the shell, in multiples of the scene's size. A nearer sky shows parallax between photos; a farther one
loses precision in file formats and other viewers. Scores with 30 and 100 are alike (`benchmarks/sky.py`)."""

LEAST_SKY = 0.002
"""Below this fraction of all pixels, --sky shell is refused."""

MOST_OF_CAP = 0.1
"""The sky starts with at most this fraction of the cap on Gaussians."""


def shell_around(dataset: Dataset) -> Shell:
    """Return the shell on which a capture's sky lies.

    Args:
        dataset: The capture.
    """
    cameras = [view.camera for view in dataset.train]
    centre = settled_eyes(cameras).mean(axis=0)
    return Shell(centre, RADIUS * scene_size(cameras, dataset.points))


def start_sky(dataset: Dataset, config: TrainConfig) -> tuple[Gaussians, Shell]:
    """Find the sky in the training photos and place splats there.

    Args:
        dataset: The capture.
        config: SH degree and cap.

    Returns:
        The splats, and the shell that they lie on.

    Raises:
        ArgumentError: no photo shows any sky, or the cap leaves no room for it.
        DatasetError: a photo cannot be read.
    """
    cap = config.max_gaussians
    most = MOST if cap is None else min(MOST, int(MOST_OF_CAP * cap))
    if most < 1:
        raise ArgumentError(
            f"sky: `max_gaussians={cap}` leaves no room for a sky; raise it, or use `sky=none`"
        )
    small = [view.scaled(max(1.0, max(view.camera.W, view.camera.H) / SIDE)) for view in dataset.train]
    cameras, images, masks = [view.camera for view in small], [], []
    for view in small:
        photo = view.read()
        opaque = None if photo.alpha is None else photo.alpha == 255
        both = [part for part in (photo.mask, opaque) if part is not None]
        pixels = photo.image if photo.image.dtype == np.uint8 else np.round(255 * photo.image)
        images.append(pixels.astype(np.uint8))
        masks.append(np.logical_and.reduce(both) if both else None)
    points = dataset.points if dataset.measured else np.zeros((0, 3))
    sky = find_sky(cameras, images, points, masks)
    if sky.share < LEAST_SKY:
        raise ArgumentError(
            "sky: no photo shows a smooth region above the horizon that reaches its edge; use `sky=none`"
        )
    shell = shell_around(dataset)
    return sky_splats(sky, shell, config.sh_degree, most), shell

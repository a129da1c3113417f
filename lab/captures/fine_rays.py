"""Rays of a photo that is traced, several per pixel, for cameras of any lens and shutter."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64

from gsplat_edu.scene.camera import Camera


def fine_rays(
    camera: Camera, s: int
) -> tuple[Float64[np.ndarray, "fine_H fine_W 3"], Float64[np.ndarray, "fine_H fine_W 3"]]:
    """Return origins and directions of a grid of s × s rays in each pixel, as of a photo of s times the size.

    Each row of the finer photo has its own time, within that of the photo's row.

    Args:
        camera: The camera.
        s: Rays per pixel along each side.

    Returns:
        Origins, and directions of depth 1 as of `Camera.rays`: NaN where the lens has no ray. World axes and units.
    """
    fine = camera.scaled(s * camera.W, s * camera.H)
    return fine.origins(), fine.rays()

"""A view: a camera and the photo it took. It is what a trainer is fed; where it came from does not matter."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32

from gsplat_edu.camera import Camera
from gsplat_edu.errors import ArgumentError
from gsplat_edu.validation import ArrayLike, first_index, float64_array


@dataclass(frozen=True, eq=False, init=False)
class View:
    """A camera and its photo.

    Args:
        camera: The camera.
        image: (H, W, 3) the photo, of the camera's size: uint8, or float from 0 to 1; kept as float32.

    Raises:
        ShapeError: the image is not of the camera's size.
        ArgumentError: a pixel is NaN or outside 0 to 1.
    """

    camera: Camera
    image: Float32[np.ndarray, "H W 3"]

    def __init__(self, camera: Camera, image: ArrayLike) -> None:
        values = float64_array("image", image, (camera.H, camera.W, 3))
        if np.asarray(image).dtype == np.uint8:
            values = values / 255.0
        if np.any(outside := (values < 0) | (values > 1)):
            where = first_index(outside)
            raise ArgumentError(f"image{where}: is outside 0 to 1; divide by the largest value or give uint8")
        pixels = values.astype(np.float32)
        pixels.flags.writeable = False
        object.__setattr__(self, "camera", camera)
        object.__setattr__(self, "image", pixels)

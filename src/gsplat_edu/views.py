"""A view: a camera and the photo it took. It is what a trainer is fed; where it came from does not matter."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32

from gsplat_edu.camera import Camera
from gsplat_edu.validation import ArrayLike, float64_array


@dataclass(frozen=True, eq=False, init=False)
class View:
    """A camera and its photo.

    Args:
        camera: The camera.
        image: (H, W, 3) the photo, 0 to 1, of the camera's size; kept as float32.

    Raises:
        ShapeError: the image is not of the camera's size.
        ArgumentError: a pixel is NaN or infinite.
    """

    camera: Camera
    image: Float32[np.ndarray, "H W 3"]

    def __init__(self, camera: Camera, image: ArrayLike) -> None:
        pixels = float64_array("image", image, (camera.H, camera.W, 3)).astype(np.float32)
        pixels.flags.writeable = False
        object.__setattr__(self, "camera", camera)
        object.__setattr__(self, "image", pixels)

"""Small upright copies of photos."""

from __future__ import annotations

import io
from pathlib import Path

import cv2
from PIL import Image

from gsplat_edu.data.images import decode, image_orientation
from gsplat_edu.scene.views import Photo

QUALITY = 85
"""Quality of the JPEG."""

BEHIND = (0.5, 0.5, 0.5)
"""RGB from 0 to 1 behind transparent pixels."""


def thumbnail_jpeg(photo: Path, side: int) -> bytes:
    """Return a photo as a JPEG, turned upright by its EXIF orientation and never enlarged.

    Args:
        photo: The photo's file.
        side: Longest side, px.

    Raises:
        DatasetError: the photo cannot be decoded.
        NotEnoughMemoryError: it needs more memory than is free.
    """
    pixels, alpha = decode(photo, image_orientation(photo), smaller=side)
    if alpha is not None:
        pixels = Photo(pixels, alpha).over(BEHIND)
    factor = side / max(pixels.shape[:2])
    if factor < 1.0:
        size = (max(1, round(factor * pixels.shape[1])), max(1, round(factor * pixels.shape[0])))
        pixels = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)
    data = io.BytesIO()
    Image.fromarray(pixels).save(data, format="JPEG", quality=QUALITY)
    return data.getvalue()

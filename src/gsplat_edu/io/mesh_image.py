"""The image on a mesh: encode it, and decode that of any program."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from gsplat_edu.base.errors import SceneFormatError
from gsplat_edu.photos.image_files import UNDECODABLE, opened_image, require_room

FORMATS = ("PNG", "JPEG")
"""Formats that are read, by Pillow's names: those that glTF allows."""


def encoded(image: UInt8[np.ndarray, "h w 3"], jpeg: int | None = None) -> bytes:
    """Encode an image, the same bytes each time.

    Args:
        image: (h, w, 3) sRGB.
        jpeg: Quality of a JPEG, 1 to 95; None for a PNG, which loses nothing.
    """
    file = BytesIO()
    if jpeg is None:
        Image.fromarray(image).save(file, "PNG")
    else:
        Image.fromarray(image).save(file, "JPEG", quality=jpeg, subsampling=0)
    return file.getvalue()


def decoded(path: Path, data: bytes) -> UInt8[np.ndarray, "h w 3"]:
    """Decode a PNG or JPEG.

    Args:
        path: The file that holds it, for messages.
        data: The image's bytes.

    Returns:
        (h, w, 3) sRGB; transparency is dropped.

    Raises:
        SceneFormatError: it is damaged or of another format.
        NotEnoughMemoryError: it does not fit into memory.
    """
    try:
        with opened_image(data, FORMATS) as image:
            require_room(path, image)
            return np.array(image.convert("RGB"))
    except UNDECODABLE as error:
        reason = " ".join(str(error).split())[:100]
        raise SceneFormatError(
            f"{path}: the image on it cannot be decoded ({reason}); export it again"
        ) from None

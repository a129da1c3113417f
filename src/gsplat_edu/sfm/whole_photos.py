"""Write photos that keep their lens: fisheyes with their circle as mask, and panoramas. No photo is resampled."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from gsplat_edu.base.errors import DatasetError
from gsplat_edu.photos.decoding import UPRIGHT, decode, decode_mask, image_orientation, turned
from gsplat_edu.sfm.circle import Circle
from gsplat_edu.sfm.panoramas import Panorama
from gsplat_edu.sfm.photos import JPEG_ENDINGS

QUALITY = 95
"""JPEG quality of photos that are encoded again."""

KEPT = (*JPEG_ENDINGS, ".png")
"""Endings of photos whose files are copied, if their pixels need no turn."""

DIM = 1.5
"""Width of the rim of a fisheye's circle that the mask leaves out, px: its pixels are partly black."""


@dataclass(frozen=True)
class WholePhotos:
    """What the capture needs of photos that keep their lens.

    Args:
        circles: Circles of fisheyes by the names of the working copies, px of these.
        panoramas: The panoramas, if the photos are their faces.
        folder: Folder of the panoramas.
        masks: Masks of the panoramas by their names.
    """

    circles: Mapping[str, Circle] = field(default_factory=dict)
    panoramas: Sequence[Panorama] = ()
    folder: Path = Path()
    masks: Mapping[str, Path] = field(default_factory=dict)


def write_panorama(whole: WholePhotos, name: str, target: Path, mask: Path) -> None:
    """Write a panorama upright, and its mask if it has one.

    Args:
        whole: The panoramas.
        name: Name of the panorama.
        target: Its file in the capture.
        mask: File of its mask in the capture.

    Raises:
        DatasetError: the panorama or its mask cannot be decoded.
    """
    path = whole.folder / name
    orientation = image_orientation(path)
    shape = copy_or_encode(path, target, orientation, 0)
    if name in whole.masks:
        counts = decode_mask(whole.masks[name])
        if counts.shape != shape:
            counts = turned(counts, orientation)
        if counts.shape != shape:
            raise DatasetError(f"{whole.masks[name]}: its size changed while it was in use")
        write_counting(counts, mask)


def copy_or_encode(path: Path, target: Path, orientation: int, turns: int) -> tuple[int, int]:
    """Copy a photo, or encode it again if it has to be turned or has another format.

    Args:
        path: The photo.
        target: The file to write.
        orientation: EXIF orientation that is applied to the decoded pixels.
        turns: Clockwise quarter turns applied after that.

    Returns:
        Height and width of the new photo.

    Raises:
        DatasetError: the photo cannot be decoded.
    """
    target.parent.mkdir(parents=True, exist_ok=True)
    pixels, alpha = decode(path, orientation)
    pixels = np.rot90(pixels, -turns)
    same = path.suffix.lower() in KEPT and path.suffix.lower() == target.suffix.lower()
    if same and orientation == UPRIGHT and turns % 4 == 0:
        shutil.copyfile(path, target)
    else:
        if alpha is not None:
            pixels = np.concatenate([pixels, np.rot90(alpha, -turns)[..., None]], axis=2)
        save(pixels, target)
    return pixels.shape[0], pixels.shape[1]


def save(pixels: UInt8[np.ndarray, "H W c"], target: Path) -> None:
    """Write RGB or RGBA as JPEG if the file's ending says so and there is no alpha, else as PNG."""
    jpeg = target.suffix.lower() in JPEG_ENDINGS and pixels.shape[2] == 3
    options: dict[str, Any] = {"quality": QUALITY, "subsampling": 0} if jpeg else {"compress_level": 3}
    Image.fromarray(np.ascontiguousarray(pixels)).save(target, format="JPEG" if jpeg else "PNG", **options)


def write_counting(counts: np.ndarray, target: Path) -> None:
    """Write a mask, (H, W) and true where a pixel counts."""
    target.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.where(counts, 255, 0).astype(np.uint8)).save(target)

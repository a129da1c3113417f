"""Masks beside photos: where they lie, and the copies that COLMAP reads."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, UInt8
from PIL import Image

from gsplat_edu.data.capture import is_file
from gsplat_edu.data.images import decode_mask, image_size
from gsplat_edu.errors import DatasetError
from gsplat_edu.files import written_aside

MASK_ENDING = ".mask.png"
"""What names of masks end in that lie beside their photos, in any case."""

OPAQUE = 128
"""Alpha from which a pixel counts when features are looked for."""


def find_masks(files: Sequence[Path]) -> dict[Path, Path]:
    """Find the masks of photos in one folder: zero where a pixel does not count.

    A mask of NAME.jpg is NAME.jpg.mask.png or NAME.mask.png beside it, or NAME.jpg.png or NAME.png in a folder masks/
    inside the photos' folder or next to it. A mask that several photos could mean, which differ only in their endings,
    is no one's.

    Args:
        files: The photos.

    Returns:
        The masks by the photos that have one.
    """
    stems = [path.stem for path in files]
    found = {}
    for path in files:
        names = [path.name, path.stem] if stems.count(path.stem) == 1 else [path.name]
        mask = next((place for place in _places(path, names) if is_file(place)), None)
        if mask is not None:
            found[path] = mask
    return found


def check_masks(masks: Mapping[Path, Path], sizes: Mapping[Path, tuple[int, int]]) -> None:
    """Check that masks are as large as their photos.

    Args:
        masks: As `find_masks` returns them.
        sizes: Widths and heights of the photos, px; photos that are not in it are passed over.

    Raises:
        DatasetError: one is not, or is no image.
    """
    for photo, mask in masks.items():
        if photo in sizes and (size := image_size(mask)) != sizes[photo]:
            (w, h), (W, H) = size, sizes[photo]
            raise DatasetError(f"{mask}: the mask is {w}x{h} but its photo {W}x{H}; make them one size")


def counting(mask: Path | None, alpha: UInt8[np.ndarray, "H W"] | None) -> Bool[np.ndarray, "H W"] | None:
    """Return where features are looked for: where a pixel counts and is not transparent; None for everywhere.

    Args:
        mask: The mask's file.
        alpha: The photo's alpha.

    Raises:
        DatasetError: the mask cannot be decoded.
    """
    counts = None if mask is None else decode_mask(mask)
    if alpha is not None:
        counts = alpha >= OPAQUE if counts is None else counts & (alpha >= OPAQUE)
    return counts


def write_mask(counts: Bool[np.ndarray, "H W"], target: Path, size: tuple[int, int]) -> None:
    """Write a mask for COLMAP.

    Args:
        counts: Where features are looked for.
        target: The file.
        size: Its width and height, px.
    """
    target.parent.mkdir(parents=True, exist_ok=True)
    small = cv2.resize(counts.astype(np.uint8) * 255, size, interpolation=cv2.INTER_NEAREST)
    with written_aside(target) as aside:
        Image.fromarray(small).save(aside, format="PNG")


def _places(photo: Path, names: Sequence[str]) -> Iterator[Path]:
    for name in names:
        yield photo.with_name(name + MASK_ENDING)
    for folder in (photo.parent / "masks", photo.parent.with_name("masks") if photo.parent.name else None):
        for name in names if folder is not None else ():
            assert folder is not None
            yield folder / f"{name}.png"

"""Masks of photos: find them, and write the copies that COLMAP reads."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Bool, UInt8
from PIL import Image

from gsplat_edu.base.errors import DatasetError
from gsplat_edu.base.files import written_aside
from gsplat_edu.data.capture import PHOTO_FOLDERS, entries, is_file, is_folder
from gsplat_edu.data.masks import MASK_ENDINGS, MASKS, MaskFolder, check_none_unused
from gsplat_edu.photos.decoding import UPRIGHT, decode_mask, image_size, turned, upright_size
from gsplat_edu.scene.photo import resized_mask

MASK_ENDING = ".mask.png"
"""Ending of masks stored beside their photos; case does not matter."""

OPAQUE = 128
"""Smallest alpha at which a pixel is used for features."""


def find_masks(files: Sequence[Path]) -> dict[Path, Path]:
    """Find the masks of photos in one folder: zero where a pixel does not count.

    The mask of NAME.jpg is NAME.jpg.mask.png or NAME.mask.png beside it, or NAME.jpg, NAME.png or NAME.jpg.png in a
    folder masks/ inside the photos' folder or next to it; `gsplat_edu.data.masks` has the rules. A mask is ignored if
    it fits several photos that differ only in their endings.

    Args:
        files: The photos.

    Returns:
        The masks, by photo; photos without a mask are missing.

    Raises:
        DatasetError: two masks in one folder fit a photo.
    """
    stems, names = [path.stem for path in files], [path.name for path in files]
    places = [MaskFolder(folder, names) for path in files[:1] for folder in _folders(path)]
    found = {}
    for path in files:
        spelled = [path.name, path.stem] if stems.count(path.stem) == 1 else [path.name]
        beside = (path.with_name(name + MASK_ENDING) for name in spelled)
        mask = next((place for place in beside if is_file(place)), None)
        mask = mask or next((one for place in places if (one := place.find(path.name))), None)
        if mask is not None:
            found[path] = mask
    return found


def unused_folders(files: Sequence[Path], masks: Mapping[Path, Path]) -> list[Path]:
    """List the folders masks/ inside and next to the photos' folder that contain images but no photo's mask.

    Args:
        files: The photos.
        masks: The result of `find_masks`.
    """
    used = {mask.parent for mask in masks.values()}
    folders = {folder for path in files[:1] for folder in _folders(path)}
    return [folder for folder in sorted(folders - used) if is_folder(folder) and _direct_images(folder)]


def check_some_used(files: Sequence[Path]) -> None:
    """Raise an error if masks lie beside the photos, but none is named like a photo.

    Args:
        files: The photos.

    Raises:
        DatasetError: names a folder of such masks; or two masks in one folder fit a photo.
    """
    masks = find_masks(files)
    if not masks:
        unused = unused_folders(files, masks)
        check_none_unused([MaskFolder(folder, []) for folder in unused], files[0].name)


def upright_masks(masks: Mapping[Path, Path], shapes: Mapping[Path, tuple[int, int, int]]) -> set[Path]:
    """Find the photos whose masks are upright rather than oriented like the stored pixels; check all sizes.

    The size of a mask reveals its orientation unless the photo is square, mirrored or upside down. Such masks are taken
    to be oriented like the other masks. If all masks are ambiguous, they are read as stored, which is COLMAP's
    convention.

    Args:
        masks: The result of `find_masks`.
        shapes: Width, height and EXIF orientation of the photos as decoded; photos without an entry are skipped.

    Raises:
        DatasetError: the size of a mask fits neither its photo nor its upright photo, or the mask is not an image.
    """
    stored, upright, either = set[Path](), set[Path](), set[Path]()
    for photo, mask in masks.items():
        if photo not in shapes:
            continue
        W, H, orientation = shapes[photo]
        size, shown = image_size(mask), upright_size((W, H), orientation)
        if size not in ((W, H), shown):
            also = f" ({H}x{W} upright)" if shown != (W, H) else ""
            raise DatasetError(
                f"{mask}: the mask is {size[0]}x{size[1]} but its photo {W}x{H}{also}; make them the same size, or "
                "move the mask away"
            )
        if orientation != UPRIGHT:
            kind = either if shown == (W, H) else stored if size == (W, H) else upright
            kind.add(photo)
    return upright | either if upright and not stored else upright


def counting(mask: Path | None, alpha: UInt8[np.ndarray, "H W"] | None) -> Bool[np.ndarray, "H W"] | None:
    """Return the pixels used for features: those that count and are not transparent; None for all pixels.

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


def turn_mask(mask: Path, orientation: int, target: Path) -> None:
    """Turn a mask to the orientation of the picture in which features are detected, and write it.

    Args:
        mask: The mask's file.
        orientation: EXIF orientation by which to turn it.
        target: The file to write.

    Raises:
        DatasetError: the mask cannot be decoded.
    """
    counts = turned(decode_mask(mask), orientation)
    write_mask(counts, target, (counts.shape[1], counts.shape[0]))


def write_mask(counts: Bool[np.ndarray, "H W"], target: Path, size: tuple[int, int]) -> None:
    """Write a mask.

    Args:
        counts: True for the pixels used for features.
        target: The file.
        size: Its width and height, px.
    """
    target.parent.mkdir(parents=True, exist_ok=True)
    W, H = size
    with written_aside(target) as aside:
        Image.fromarray(resized_mask(counts, H, W).astype(np.uint8) * 255).save(aside, format="PNG")


def _direct_images(folder: Path) -> bool:
    return any(path.suffix.lower() in MASK_ENDINGS for path in entries(folder))


def _folders(photo: Path) -> list[Path]:
    """List the mask folders of a photo: masks/ inside the photo's folder and next to it.

    For photos in images/left these include masks/left, in images/ and next to it.
    """
    here = photo.parent
    beside = [here.with_name(MASKS)] if here.name not in ("", MASKS) else []
    above = [here.parent.with_name(MASKS)] if here.parent.name in PHOTO_FOLDERS else []
    below = [place / here.name for place in (*beside, *above)]
    return [here / MASKS, *beside, *below]

"""Find the masks of photos by their names.

In a folder of masks, the mask of the photo left/A.JPG is left/A.JPG (the photo's own name), left/A.png or
left/A.JPG.png, with any suffix of `MASK_ENDINGS` in any case. Every reader of captures and `gsplat_edu.sfm` use these
rules.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath

from gsplat_edu.base.errors import DatasetError
from gsplat_edu.base.text import legible
from gsplat_edu.data.capture import PHOTO_ENDINGS, PHOTO_FOLDERS, Frame, entries, is_file, is_folder
from gsplat_edu.data.notes import LossyMasks, Note, PhotosWithoutMask, UnclearMasks

MASK_ENDINGS = (*PHOTO_ENDINGS, ".bmp", ".pgm")
"""Suffixes of masks, in any case."""

LOSSY_ENDINGS = (".jpg", ".jpeg", ".heic", ".heif", ".hif")
"""Suffixes of masks whose zeros are not exact; `gsplat_edu.photos.decoding.decode_mask` applies a threshold to them."""

MASKS = "masks"
"""Name of the folders that are searched for masks."""


class MaskFolder:
    """The masks in a folder; each folder below it is listed once, when a photo needs it.

    Args:
        path: The folder.
        names: Names of all photos, relative to it, with slashes. A mask A.png fits neither A.jpg nor A.heic if both
            exist, unless each has a mask of its own name.
    """

    def __init__(self, path: Path, names: Sequence[str]) -> None:
        self.path = path
        self._sharing = dict[str, list[str]]()
        for name in dict.fromkeys(names):
            self._sharing.setdefault(_stem(name), []).append(name)
        self._listed = dict[str, dict[str, list[Path]]]()

    def find(self, name: str) -> Path | None:
        """Return the mask of a photo; None if there is none.

        Args:
            name: The photo's name relative to the folder, with slashes.

        Raises:
            DatasetError: two masks fit.
        """
        plain = PurePosixPath(name)
        if plain.is_absolute() or ".." in plain.parts or not plain.name:
            return None
        by_base = self._in(plain.parent.as_posix())
        fitting = list(by_base.get(_folded(plain.name), ()))
        stem, sharing = by_base.get(plain.stem, []), self._sharing.get(_stem(name), [])
        if len(sharing) <= 1:
            fitting += [mask for mask in stem if mask not in fitting]
        elif all(any(_is_named(mask, other) for mask in stem) for other in sharing):
            fitting += [mask for mask in stem if _is_named(mask, name)]
        if len(fitting) > 1:
            first, second = (mask.name for mask in fitting[:2])
            raise DatasetError(
                f"{fitting[0].parent}: {first} and {second} are both named like masks of the photo {legible(name)}; "
                "remove one of them"
            )
        return fitting[0] if fitting else None

    def images(self) -> list[Path]:
        """List the images directly in the folder, or in the folders directly in it if there are none."""
        own = _images(self.path)
        return own or [mask for place in entries(self.path) if is_folder(place) for mask in _images(place)]

    def _in(self, parent: str) -> dict[str, list[Path]]:
        """Return the masks in a folder by their names without suffix."""
        if parent not in self._listed:
            found = self._listed[parent] = {}
            for mask in _images(self.path / parent):
                found.setdefault(_folded(mask.stem), []).append(mask)
        return self._listed[parent]


def with_masks(folder: Path, frames: Sequence[Frame]) -> tuple[list[Frame], list[Note]]:
    """Give frames their masks from the folder masks/ of a capture, if none of them has a mask yet.

    Args:
        folder: The capture.
        frames: Its frames; a mask is named like the frame's image file.

    Returns:
        The frames, and notes about the masks.

    Raises:
        DatasetError: as for `find_named`.
    """
    if any(frame.mask is not None for frame in frames):
        return list(frames), []
    named = [_relative(folder, frame.image) for frame in frames]
    masks, notes = find_named([folder / MASKS], named)
    return [replace(frame, mask=masks.get(name)) for frame, name in zip(frames, named, strict=True)], notes


def find_named(folders: Sequence[Path], names: Sequence[str]) -> tuple[dict[str, Path], list[Note]]:
    """Find the masks of photos. A mask's bare name fits a photo only if no other photo has it.

    Args:
        folders: Folders of masks; the first with a mask for a photo wins.
        names: Names of the photos in the capture, with slashes.

    Returns:
        The masks by name, and notes about them.

    Raises:
        DatasetError: two masks fit one photo, or the folders hold images and none fits.
    """
    places = [folder for folder in folders if is_folder(folder)]
    if not places:
        return {}, []
    spelled = {name: _spellings(name) for name in names}
    bare = Counter(PurePosixPath(name).name for name in names)
    kinds = [MaskFolder(place, [s for name in names for s in spelled[name]]) for place in places]
    single = [MaskFolder(place, [PurePosixPath(name).name for name in names]) for place in places]
    masks, unclear = dict[str, Path](), list[str]()
    for name in names:
        last = PurePosixPath(name).name
        mask = next((found for kind in kinds for s in spelled[name] if (found := kind.find(s))), None)
        if mask is None and (other := next((found for one in single if (found := one.find(last))), None)):
            if bare[last] > 1:
                unclear.append(legible(name))
            else:
                mask = other
        if mask is not None:
            masks[name] = mask
    if not masks and not unclear:
        check_none_unused(kinds, names[0])
        return {}, []
    return masks, _notes(masks, names, unclear)


def check_none_unused(folders: Sequence[MaskFolder], photo: str) -> None:
    """Raise an error if no mask of some folders is used.

    Args:
        folders: The folders.
        photo: Name of a photo.

    Raises:
        DatasetError: one of them holds images.
    """
    for folder in folders:
        if images := folder.images():
            stem = PurePosixPath(photo).stem
            raise DatasetError(
                f"{folder.path}: none of its {len(images)} images is named like a photo: the first is "
                f"{legible(images[0].name)}, a photo {legible(photo)}; rename the masks ({stem}.png, or as the photo), "
                "or move the folder away"
            )


def _notes(masks: Mapping[str, Path], names: Sequence[str], unclear: Sequence[str]) -> list[Note]:
    notes = list[Note]()
    if unclear:
        notes.append(UnclearMasks(len(unclear), len(names), unclear[0]))
    without = [name for name in names if name not in masks and legible(name) not in unclear]
    if without and masks:
        notes.append(PhotosWithoutMask(len(without), len(names), legible(without[0])))
    if lossy := lossy_masks(masks.values()):
        notes.append(LossyMasks(len(lossy), len(masks), lossy[0].name))
    return notes


def lossy_masks(masks: Iterable[Path]) -> list[Path]:
    """Return the masks whose format is lossy, by their suffixes."""
    return [mask for mask in masks if mask.suffix.lower() in LOSSY_ENDINGS]


def _spellings(name: str) -> list[str]:
    """Return a photo's name in a folder of masks: as it is, and without the photos' folder."""
    first, *rest = PurePosixPath(name).parts or ("",)
    return [name, "/".join(rest)] if rest and first in PHOTO_FOLDERS else [name]


def _relative(folder: Path, image: Path) -> str:
    try:
        return image.relative_to(folder).as_posix()
    except ValueError:
        return image.name


def _images(folder: Path) -> list[Path]:
    if not is_folder(folder):
        return []
    return [path for path in entries(folder) if path.suffix.lower() in MASK_ENDINGS and is_file(path)]


def _folded(name: str) -> str:
    """Return a name with its suffix in lower case, if it is an image's."""
    stem, dot, ending = name.rpartition(".")
    return f"{stem}.{ending.lower()}" if dot and f".{ending}".lower() in MASK_ENDINGS else name


def _stem(name: str) -> str:
    return PurePosixPath(name).with_suffix("").as_posix() if PurePosixPath(name).name else name


def _is_named(mask: Path, photo: str) -> bool:
    return _folded(mask.name) == _folded(PurePosixPath(photo).name)

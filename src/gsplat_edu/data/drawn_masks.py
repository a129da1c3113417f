"""Draw on the masks of a capture's photos, and take what was drawn back.

A drawn shape excludes its pixels. It goes into the mask that the readers of captures find for the photo; a photo
without a mask gets masks/NAME.png. The file drawn_masks.json of the capture keeps the shapes of each photo and the
bytes of its mask before the first of them, so that undoing restores that file exactly.
"""

from __future__ import annotations

import base64
import binascii
import hashlib
import io
import json
import tempfile
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from jaxtyping import Bool
from PIL import Image

from gsplat_edu.base.errors import DatasetError
from gsplat_edu.base.files import unreadable, written_aside
from gsplat_edu.base.links import is_inside
from gsplat_edu.base.reading import parse_json, read_bytes
from gsplat_edu.base.text import legible
from gsplat_edu.data.capture import PHOTO_FOLDERS, capture_folder, is_file
from gsplat_edu.data.changes import changing
from gsplat_edu.data.left_out import photo_named, photo_path
from gsplat_edu.data.mask_shapes import MOST_SHAPES, Shape, checked_shape, covered, shape_document, short_text
from gsplat_edu.data.masks import MASKS
from gsplat_edu.data.orientation import oriented
from gsplat_edu.data.reader import CaptureReader, read_capture
from gsplat_edu.photos.decoding import BACK, decode_mask, image_orientation, image_size, turned, upright_size

DRAWN = "drawn_masks.json"
"""Name of the file that keeps what was drawn."""

_JPEG: dict[str, Any] = {
    "format": "JPEG",
    "quality": 100,
}  # zeros stay far below the threshold of the readers
WRITTEN: dict[str, dict[str, Any]] = {
    ".png": {"format": "PNG"},
    ".bmp": {"format": "BMP"},
    ".pgm": {"format": "PPM"},
    ".tif": {"format": "TIFF"},
    ".tiff": {"format": "TIFF"},
    ".webp": {"format": "WEBP", "lossless": True},
    ".jpg": _JPEG,
    ".jpeg": _JPEG,
}
"""How Pillow writes a mask, by its suffix. Masks in HEIC are not written."""


@dataclass(frozen=True)
class Drawing:
    """What was drawn on a photo's mask.

    Args:
        shapes: The shapes.
        mask: The mask's file, below the capture's folder.
        before: Bytes of that file before the first shape; None if there was none.
        after: SHA-256 of the file with the shapes.
    """

    shapes: tuple[Shape, ...]
    mask: str
    before: bytes | None
    after: str


@dataclass(frozen=True)
class MaskedPhoto:
    """A photo and its mask.

    Args:
        photo: The photo's path below the capture, or its whole path if it lies elsewhere.
        W: Width of the upright photo, px.
        H: Its height, px.
        shapes: The shapes on its mask.
        mask: The mask's file; None if the photo has none.
        has_own: Whether there is a mask without the shapes.
    """

    photo: str
    W: int
    H: int
    shapes: tuple[Shape, ...]
    mask: Path | None
    has_own: bool


def read_drawings(capture: Path) -> dict[str, Drawing]:
    """Return what was drawn on the masks of a capture, by photo.

    Args:
        capture: The capture's folder, or its transforms.json.

    Raises:
        DatasetError: drawn_masks.json is damaged or cannot be read.
    """
    path = capture_folder(capture) / DRAWN
    if not is_file(path):
        return {}
    try:
        contents = parse_json(read_bytes(path))
        return {photo: _drawing(facts) for photo, facts in contents["photos"].items()}
    except OSError as error:
        raise DatasetError(unreadable(path, error)) from None
    except (ValueError, KeyError, TypeError, AttributeError, binascii.Error, DatasetError):
        raise DatasetError(f"{path}: is damaged; delete it, the masks then stay as they are") from None


def masked_photo(capture: Path, photo: str) -> MaskedPhoto:
    """Return what is known of a photo's mask.

    Args:
        capture: The capture's folder, or its transforms.json.
        photo: The photo: its path below the folder, its name, or its file name if only one photo has it.

    Raises:
        DatasetError: the photo is unknown, or the capture cannot be read.
    """
    return _Target(capture, photo).facts()


def draw_mask(
    capture: Path,
    photo: str,
    shapes: Sequence[Shape],
    may_replace: Callable[[tuple[Shape, ...]], bool] = lambda drawn: True,
) -> MaskedPhoto:
    """Exclude the pixels of some shapes by a photo's mask; they replace the shapes that were drawn on it before.

    Changes of the same capture by several threads and processes follow one another, so that none is lost.

    Args:
        capture: The capture's folder, or its transforms.json.
        photo: The photo; see `masked_photo`.
        shapes: The shapes; without any, the mask is as before the first of them.
        may_replace: Given the shapes drawn before, says whether to replace them. Otherwise nothing is changed.

    Raises:
        DatasetError: the photo is unknown, a shape covers none of its pixels, they cover all that counts, the mask
            was changed elsewhere, or lies outside the capture; or as for `gsplat_edu.data.changes.changing`. Nothing
            is changed then.
        OSError: the folder cannot be written to.
    """
    with changing(capture):
        target = _Target(capture, photo)
        if not may_replace(target.facts().shapes):
            return target.facts()
        if shapes:
            target.draw(tuple(shapes))
        else:
            target.undo()
        return _Target(capture, target.photo).facts()


class _Target:
    """The mask of a photo, and what was drawn on it."""

    def __init__(self, capture: Path, photo: str) -> None:
        self.capture, self.folder = capture, capture_folder(capture)
        reader = CaptureReader(capture)
        frames = oriented(reader.capture.frames, reader.headers)
        self.photo = photo_named(capture, frames, photo)
        self.frame = next(frame for frame in frames if photo_path(frame, capture) == self.photo)
        others = {frame.image for frame in frames if frame.mask is not None and frame.mask == self.frame.mask}
        self.sharing = len(others - {self.frame.image})
        self.drawings = read_drawings(capture)
        self.drawing = self.drawings.get(self.photo)
        self.exif = image_orientation(self.frame.image)
        self.size = upright_size(image_size(self.frame.image), self.exif)

    def facts(self) -> MaskedPhoto:
        drawn, mask = self.drawing, self.frame.mask
        own = mask is not None if drawn is None else drawn.before is not None
        return MaskedPhoto(self.photo, *self.size, () if drawn is None else drawn.shapes, mask, own)

    def draw(self, shapes: tuple[Shape, ...]) -> None:
        if len(shapes) > MOST_SHAPES:
            raise DatasetError(f"{legible(self.photo)}: has {len(shapes)} shapes; draw {MOST_SHAPES} at most")
        for shape in shapes:
            if not covered([shape], *self.size).any():
                size = "x".join(map(str, self.size))
                raise DatasetError(
                    f"{legible(self.photo)}: shape {short_text(shape)} covers no pixel of its {size}"
                )
        path, before = self._place()
        hidden = turned(turned(covered(shapes, *self.size), BACK[self.exif]), self.frame.orientation)
        counts = ~hidden if before is None else self._own(path, before) & ~hidden
        if not counts.any():
            raise DatasetError(
                f"{legible(self.photo)}: nothing of it would count; leave the photo out instead"
            )
        data = _encoded(counts, path)
        drawing = Drawing(shapes, path.relative_to(self.folder).as_posix(), before, _digest(data))
        # the record first: it has the bytes that the mask then loses
        _write_drawings(self.folder, {**self.drawings, self.photo: drawing})
        _write_mask(path, data)
        if self.frame.mask is None:
            self._check_found(path, drawing)

    def undo(self) -> None:
        if self.drawing is None:
            return
        path, before = self._place()
        if before is None:
            path.unlink(missing_ok=True)
            for place in path.relative_to(self.folder).parents:
                if place.parts:
                    with suppress(OSError):  # other masks are in it, or another program has just removed it
                        (self.folder / place).rmdir()
        else:
            _write_mask(path, before)
        _write_drawings(self.folder, {name: one for name, one in self.drawings.items() if name != self.photo})

    def _place(self) -> tuple[Path, bytes | None]:
        """Return the mask's file, and its bytes without shapes.

        Raises:
            DatasetError: it lies outside the capture, other photos share it, or another program changed it.
        """
        mask, drawn = self.frame.mask, self.drawing
        path = self._new_name() if mask is None else mask
        inside = is_inside(path.parent, [self.folder]) and not path.is_symlink()
        if not inside or not path.is_relative_to(self.folder):
            raise DatasetError(
                f"{path}: this mask lies outside the capture, and is not changed; copy it to {MASKS}/"
            )
        if mask is not None and self.sharing:
            raise DatasetError(
                f"{path}: is the mask of {self.sharing + 1} photos; give {legible(self.photo)} one of its own"
            )
        current = read_bytes(path) if is_file(path) else None
        if drawn is None:
            return path, current
        if path != self.folder / drawn.mask:
            raise DatasetError(
                f"{self.folder / DRAWN}: says that {legible(self.photo)} has the mask {legible(drawn.mask)}, but its "
                f"mask is {path.relative_to(self.folder).as_posix()}; delete one of them"
            )
        if current is not None and current != drawn.before and _digest(current) != drawn.after:
            raise DatasetError(
                f"{path}: was changed by another program after shapes were drawn on it; delete {DRAWN} to keep it so"
            )
        return path, drawn.before

    def _new_name(self) -> Path:
        """Return the file of a mask for a photo that has none: masks/NAME.png, in the folders of its name."""
        parts = PurePosixPath(self.frame.name).parts
        if PurePosixPath(self.photo).is_absolute() or ".." in parts or "/" in parts[:1] or not parts:
            parts = (self.frame.image.name,)
        elif parts[-1] != self.frame.image.name:  # a name without its suffix
            parts = (*parts[:-1], self.frame.image.name)
        parts = parts[1:] if len(parts) > 1 and parts[0] in PHOTO_FOLDERS else parts
        return self.folder.joinpath(MASKS, *parts[:-1], f"{parts[-1]}.png")

    def _own(self, path: Path, before: bytes) -> Bool[np.ndarray, "H W"]:
        """Return the mask without shapes.

        Raises:
            DatasetError: it cannot be decoded, or does not have the photo's size.
        """
        W, H = upright_size(image_size(self.frame.image), self.frame.orientation)
        if self.drawing is None:
            own = decode_mask(path)
        else:
            with tempfile.TemporaryDirectory() as folder:
                kept = Path(folder) / path.name
                kept.write_bytes(before)
                own = decode_mask(kept)
        if own.shape != (H, W):
            raise DatasetError(f"{path}: the mask is {own.shape[1]}x{own.shape[0]} but its photo {W}x{H}")
        return own

    def _check_found(self, path: Path, drawing: Drawing) -> None:
        """Check that the readers find a new mask; take it back if not."""
        try:
            frames = read_capture(self.capture).frames
            found = any(frame.image == self.frame.image and frame.mask == path for frame in frames)
            reason = (
                "the capture names the masks of its other photos itself, or several photos share this name"
            )
        except DatasetError as error:
            found, reason = False, str(error)
        if not found:
            self.drawing, self.drawings = drawing, {**self.drawings, self.photo: drawing}
            self.undo()
            raise DatasetError(f"{legible(self.photo)}: no mask can be added; {reason}")


def _digest(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def _encoded(counts: Bool[np.ndarray, "H W"], path: Path) -> bytes:
    """Return a mask as a file of the format that the suffix of its path says.

    Raises:
        DatasetError: masks of this format cannot be written.
    """
    suffix, data = path.suffix.lower(), io.BytesIO()
    options = WRITTEN.get(suffix)
    if options is None:
        raise DatasetError(f"{path}: masks of this format cannot be written; make it a PNG")
    Image.fromarray(counts.astype(np.uint8) * 255).save(data, **options)
    return data.getvalue()


def _write_mask(path: Path, data: bytes) -> None:
    with written_aside(path) as aside:
        aside.write_bytes(data)


def _drawing(facts: Any) -> Drawing:  # noqa: ANN401
    """Read one photo's entry of drawn_masks.json."""
    shapes = tuple(checked_shape(shape) for shape in facts["shapes"])
    mask, before, after = facts["mask"], facts["before"], facts["after"]
    if not isinstance(mask, str) or not isinstance(after, str) or not shapes:
        raise ValueError("mask")
    return Drawing(shapes, mask, None if before is None else base64.b64decode(before, validate=True), after)


def _write_drawings(folder: Path, drawings: dict[str, Drawing]) -> None:
    """Write drawn_masks.json; without drawings, it is removed."""
    path = folder / DRAWN
    if not drawings:
        path.unlink(missing_ok=True)
        return
    photos = {
        photo: {
            "shapes": [shape_document(shape) for shape in one.shapes],
            "mask": one.mask,
            "before": None if one.before is None else base64.b64encode(one.before).decode("ascii"),
            "after": one.after,
        }
        for photo, one in sorted(drawings.items())
    }
    with written_aside(path) as aside:
        aside.write_text(json.dumps({"version": 1, "photos": photos}, indent=1) + "\n", encoding="utf-8")

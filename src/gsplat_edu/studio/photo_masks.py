"""Shapes drawn on the masks of a capture's photos."""

from __future__ import annotations

import hashlib
import json
import shlex
from collections.abc import Sequence
from http import HTTPStatus
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gsplat_edu.base.errors import DatasetError
from gsplat_edu.base.text import legible
from gsplat_edu.server.refusal import RefusedError, conflict, not_found
from gsplat_edu.studio.contents import photo_names
from gsplat_edu.studio.state import Studio

if TYPE_CHECKING:
    from gsplat_edu.data.mask_shapes import Shape


def mask_of(studio: Studio, entry: Path, photo: str) -> dict[str, Any]:
    """Return what is known of a photo's mask.

    Args:
        studio: The studio.
        entry: The capture.
        photo: The photo, as `gsplat_edu.studio.pictures.photo_list` names it.

    Returns:
        "W" and "H" of the upright photo, px; "shapes", those drawn on its mask, as `gsplat_edu.data.mask_shapes` has
        them; "own", whether it has a mask without them; "version", a digest of the shapes; and "command", which draws
        the same ones.

    Raises:
        RefusedError: there is no such photo, or the capture gives it no pose.
    """
    return _asked(studio, entry, photo)


def draw_on(studio: Studio, entry: Path, photo: str, shapes: list[Any], version: str) -> dict[str, Any]:
    """Draw shapes on a photo's mask in place of those drawn before; without any, the mask is as it was before them.

    Args:
        studio: The studio.
        entry: The capture.
        photo: The photo, as `gsplat_edu.studio.pictures.photo_list` names it.
        shapes: The shapes, as `gsplat_edu.data.mask_shapes` has them.
        version: The "version" of the mask that the drawing began with.

    Returns:
        As `mask_of`.

    Raises:
        RefusedError: there is no such photo, a job uses the capture, other shapes were saved after the drawing began,
            or the mask cannot be changed; has the line.
    """
    with studio.library.lock:
        if (used := studio.in_use(entry)) is not None:
            raise conflict(f"{legible(entry.name)}: {used}; its masks stay as they are meanwhile")
        found = _asked(studio, entry, photo, shapes=shapes, version=version)
        if found.pop("is_newer", False):
            raise conflict(
                f"{legible(photo)}: other shapes were saved on its mask after this drawing began; load them, then save"
            )
    studio.stream.library_changed()
    return found


def draw(
    capture: str, photo: str, shapes: list[Any] | None = None, version: str | None = None
) -> dict[str, Any]:
    """Draw on a photo's mask, or read it; a task of `gsplat_edu.studio.worker`.

    Args:
        capture: The capture's folder.
        photo: The photo's path below it.
        shapes: The shapes; None to change nothing.
        version: The version of the mask that the drawing began with.

    Returns:
        As `mask_of`; also "is_newer" if the mask has other shapes than this version, and was not changed.

    Raises:
        DatasetError: see `gsplat_edu.data.drawn_masks.draw_mask`.
    """
    from gsplat_edu.data.drawn_masks import draw_mask, masked_photo
    from gsplat_edu.data.mask_shapes import checked_shape, shape_document, shape_text

    folder, is_newer = Path(capture), False
    if shapes is None:
        found = masked_photo(folder, photo)
    else:
        given = tuple(checked_shape(shape) for shape in shapes)
        found = draw_mask(folder, photo, given, lambda drawn: drawn == given or version == _version(drawn))
        is_newer = found.shapes != given
    words = ["gsplat-edu", "mask", capture, photo, *map(shape_text, found.shapes)]
    command = shlex.join(words if found.shapes else [*words, "--undo"])
    drawn = [shape_document(shape) for shape in found.shapes]
    facts = {"W": found.W, "H": found.H, "shapes": drawn, "own": found.has_own, "command": command}
    return facts | {"version": _version(found.shapes)} | ({"is_newer": True} if is_newer else {})


def _version(shapes: Sequence[Shape]) -> str:
    """Return a digest of the shapes on a mask."""
    from gsplat_edu.data.mask_shapes import shape_document

    text = json.dumps([shape_document(shape) for shape in shapes], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def masked(entry: Path) -> set[str]:
    """Return the photos of a capture on whose masks shapes are drawn, as `photo_list` names them.

    Raises:
        RefusedError: the record of the shapes cannot be read.
    """
    from gsplat_edu.data.drawn_masks import read_drawings

    try:
        return {legible(photo) for photo in read_drawings(entry)}
    except DatasetError as error:
        raise RefusedError(str(error), HTTPStatus.UNPROCESSABLE_ENTITY) from None


def _asked(studio: Studio, entry: Path, photo: str, **change: Any) -> dict[str, Any]:  # noqa: ANN401
    known = {legible(name): name for name in photo_names(entry)}
    if photo not in known:
        raise not_found(f"{legible(entry.name)}/{legible(photo)}")
    found: dict[str, Any] = studio.decoder.ask("mask", capture=str(entry), photo=known[photo], **change)
    return found

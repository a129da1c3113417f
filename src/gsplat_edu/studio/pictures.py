"""Photos of an entry and their thumbnails."""

from __future__ import annotations

import hashlib
import os
from http import HTTPStatus
from pathlib import Path
from typing import Any

from gsplat_edu.base.errors import DatasetError
from gsplat_edu.base.files import written_aside
from gsplat_edu.base.text import legible
from gsplat_edu.studio.library import Library, photo_names
from gsplat_edu.studio.names import below, checked_path
from gsplat_edu.studio.refusal import RefusedError, not_found
from gsplat_edu.studio.workers import Worker

SIDES = (128, 256, 512, 1024)
"""Longest sides of thumbnails, px."""

QUALITY = 85


def photo_list(entry: Path) -> list[dict[str, Any]]:
    """Return the photos of an entry: name, bytes, and upright width and height; a problem if it cannot be read."""
    from gsplat_edu.data.images import image_orientation, image_size, upright_size

    found = []
    for name in photo_names(entry):
        path = entry / name
        facts: dict[str, Any] = {"name": legible(name), "bytes": path.stat().st_size, "problem": None}
        try:
            facts["W"], facts["H"] = upright_size(image_size(path), image_orientation(path))
        except DatasetError as error:
            facts |= {"W": None, "H": None, "problem": error.reason}
        found.append(facts)
    return found


def thumbnail(decoder: Worker, library: Library, entry: Path, name: str, side: str) -> Path:
    """Return the file of a photo's thumbnail, an upright JPEG, made if there is none yet.

    Args:
        decoder: The process that decodes photos, one after the other, so that the server's memory never holds one.
        library: Has the cache.
        entry: The photo's entry.
        name: The photo, as a path below the entry.
        side: Its longest side, px, as text.

    Raises:
        RefusedError: there is no such photo, it cannot be decoded, or the side is not one of `SIDES`.
    """
    if side not in map(str, SIDES):
        raise RefusedError(f"side: is {side[:20]!r}, but has to be one of {', '.join(map(str, SIDES))}")
    photo = below(entry, checked_path("photo", name), "photo")
    try:
        facts = photo.stat()
    except OSError:
        raise not_found(f"{entry.name}/{legible(name)}") from None
    target = library.hidden("cache") / "thumbs" / f"{cache_name(photo, facts)}-{side}.jpg"
    if not target.is_file():
        try:
            decoder.ask("thumbnail", photo=str(photo), side=int(side), out=str(target))
        except RefusedError as error:
            if error.status is not HTTPStatus.BAD_REQUEST:
                raise
            raise RefusedError(str(error), HTTPStatus.UNPROCESSABLE_ENTITY) from None
    return target


def cache_name(path: Path, facts: os.stat_result) -> str:
    """Return the name under which a file's derivative is cached; it changes with the file."""
    key = f"{path} {facts.st_size} {facts.st_mtime_ns}"
    digest = hashlib.sha256(key.encode("utf-8", "surrogateescape")).hexdigest()
    return f"{digest[:2]}/{digest[2:]}"


def make_thumbnail(photo: str, side: int, out: str) -> dict[str, Any]:
    """Write a thumbnail; a task of `gsplat_edu.studio.worker`.

    Args:
        photo: The photo's file.
        side: Longest side, px.
        out: File to write; an existing one is kept, because another request may have made it.

    Raises:
        DatasetError: the photo cannot be decoded.
        NotEnoughMemoryError: it needs more memory than is free.
    """
    import cv2
    from PIL import Image

    from gsplat_edu.data.images import decode, image_orientation
    from gsplat_edu.scene.views import Photo

    path, target = Path(photo), Path(out)
    if target.is_file():
        return {}
    pixels, alpha = decode(path, image_orientation(path), smaller=side)
    if alpha is not None:
        pixels = Photo(pixels, alpha).over((0.5, 0.5, 0.5))
    factor = side / max(pixels.shape[:2])
    if factor < 1.0:
        size = (max(1, round(factor * pixels.shape[1])), max(1, round(factor * pixels.shape[0])))
        pixels = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)
    with written_aside(target) as aside:
        Image.fromarray(pixels).save(aside, format="JPEG", quality=QUALITY)
    return {}

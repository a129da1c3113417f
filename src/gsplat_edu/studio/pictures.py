"""Photos of an entry and their thumbnails."""

from __future__ import annotations

import hashlib
import os
import threading
from http import HTTPStatus
from pathlib import Path
from typing import Any

from gsplat_edu.errors import DatasetError, NotEnoughMemoryError
from gsplat_edu.files import written_aside
from gsplat_edu.studio.library import Library, photo_names
from gsplat_edu.studio.names import below, checked_path
from gsplat_edu.studio.refusal import RefusedError, not_found
from gsplat_edu.text import legible

SIDES = (128, 256, 512, 1024)
"""Longest sides of thumbnails, px."""

MOST_PIXELS = 300_000_000
"""Pixels of a photo that is decoded for a thumbnail."""

QUALITY = 85

_decoding = threading.Semaphore(2)
"""Photos that are decoded at once: each takes ten bytes per pixel."""


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


def thumbnail(library: Library, entry: Path, name: str, side: str) -> Path:
    """Return the file of a photo's thumbnail, an upright JPEG, made if there is none yet.

    Args:
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
        with _decoding:
            if not target.is_file():
                _make(photo, int(side), target)
    return target


def cache_name(path: Path, facts: os.stat_result) -> str:
    """Return the name of what is made from a file and cached; it changes with the file."""
    key = f"{path} {facts.st_size} {facts.st_mtime_ns}"
    digest = hashlib.sha256(key.encode("utf-8", "surrogateescape")).hexdigest()
    return f"{digest[:2]}/{digest[2:]}"


def _make(photo: Path, side: int, target: Path) -> None:
    import cv2
    from PIL import Image

    from gsplat_edu.data.images import decode, image_orientation, image_size
    from gsplat_edu.views import Photo

    try:
        W, H = image_size(photo)
        if W * H > MOST_PIXELS:
            raise RefusedError(f"{photo.name}: has {W}x{H} px, too many for a preview")
        pixels, alpha = decode(photo, image_orientation(photo), smaller=side)
    except (DatasetError, NotEnoughMemoryError) as error:
        raise RefusedError(str(error), HTTPStatus.UNPROCESSABLE_ENTITY) from None
    if alpha is not None:
        pixels = Photo(pixels, alpha).over((0.5, 0.5, 0.5))
    factor = side / max(pixels.shape[:2])
    if factor < 1.0:
        size = (max(1, round(factor * pixels.shape[1])), max(1, round(factor * pixels.shape[0])))
        pixels = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)
    with written_aside(target) as aside:
        Image.fromarray(pixels).save(aside, format="JPEG", quality=QUALITY)

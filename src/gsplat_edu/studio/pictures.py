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
from gsplat_edu.server.refusal import RefusedError, not_found
from gsplat_edu.studio.contents import photo_names
from gsplat_edu.studio.library import Library
from gsplat_edu.studio.names import below, listed_path
from gsplat_edu.studio.photo_masks import masked
from gsplat_edu.studio.workers import Worker

SIDES = (128, 256, 512, 1024)
"""Longest sides of thumbnails, px."""


def photo_list(entry: Path) -> list[dict[str, Any]]:
    """Return the photos of an entry: name, bytes, upright width and height, and whether it is left out or drawn on.

    A photo that cannot be read has a problem instead of a size.

    Raises:
        RefusedError: the list of photos to leave out, or the record of shapes, cannot be read.
    """
    from gsplat_edu.photos.decoding import upright_image_size

    found, out, drawn = [], left_out(entry), masked(entry)
    for name in photo_names(entry):
        path = entry / name
        try:
            size = path.stat().st_size
        except FileNotFoundError:  # it has just been removed
            continue
        facts: dict[str, Any] = {"name": legible(name), "bytes": size, "problem": None}
        facts |= {"left_out": facts["name"] in out, "masked": facts["name"] in drawn}
        try:
            facts["W"], facts["H"] = upright_image_size(path)
        except DatasetError as error:
            facts |= {"W": None, "H": None, "problem": error.reason}
        found.append(facts)
    return found


def leave_out(entry: Path, photos: list[str], back: bool) -> list[str]:
    """Put photos of a capture on its list of those to leave out, or take them off; return all that it leaves out.

    Args:
        entry: The capture.
        photos: Paths of photos below it, as `photo_list` names them.
        back: Take them off.

    Raises:
        RefusedError: there is no such photo, none would be left, or the list cannot be read or changed now.
    """
    from gsplat_edu.data.changes import changing
    from gsplat_edu.data.left_out import write_left_out

    known = {legible(name): name for name in photo_names(entry)}
    for photo in photos:
        if photo not in known:
            raise not_found(f"{entry.name}/{legible(photo)}")
    chosen = {known[photo] for photo in photos}
    try:
        with changing(entry):
            kept = [name for name in _listed(entry) if not any(name in _names_of(photo) for photo in chosen)]
            listed = {*kept} if back else {*kept, *chosen}
            out = [name for name in known.values() if not _names_of(name).isdisjoint(listed)]
            if len(out) == len(known):
                raise RefusedError(f"{entry.name}: none of its {len(known)} photos would be left; keep some")
            write_left_out(entry, listed)
    except DatasetError as error:
        raise RefusedError(str(error), HTTPStatus.CONFLICT) from None
    return [legible(name) for name in out]


def left_out(entry: Path) -> set[str]:
    """Return the photos that a capture's list leaves out, as `photo_list` names them.

    Raises:
        RefusedError: the list cannot be read.
    """
    listed = _listed(entry)
    names = photo_names(entry) if listed else []
    return {legible(name) for name in names if not _names_of(name).isdisjoint(listed)}


def _listed(entry: Path) -> tuple[str, ...]:
    from gsplat_edu.data.left_out import read_left_out

    try:
        return read_left_out(entry)
    except DatasetError as error:
        raise RefusedError(str(error), HTTPStatus.UNPROCESSABLE_ENTITY) from None


def _names_of(path: str) -> set[str]:
    """Return the names that a list may have for a photo: its path below the entry, and shorter ones."""
    parts = path.split("/")
    return {"/".join(parts[start:]) for start in range(len(parts))}


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
    photo = below(entry, listed_path("photo", name), "photo")
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
    from gsplat_edu.photos.decoding import thumbnail_jpeg

    target = Path(out)
    if target.is_file():
        return {}
    data = thumbnail_jpeg(Path(photo), side)
    with written_aside(target) as aside:
        aside.write_bytes(data)
    return {}

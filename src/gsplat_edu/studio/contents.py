"""The files that an entry contains; links inside are not followed to folders."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from gsplat_edu.data.capture import PHOTO_ENDINGS
from gsplat_edu.sfm.video import VIDEO_ENDINGS

NOT_PHOTOS = frozenset(("masks", "renders", "sfm", "exports", "checkpoints", "point_cloud", "transients"))
"""Folders whose images are not photos of an entry."""


@dataclass(frozen=True)
class Extent:
    """What a folder holds.

    Args:
        files: Number of files.
        num_bytes: Their size.
        photos: Number of files with a photo's ending.
        videos: Number of files with a video's ending.
    """

    files: int
    num_bytes: int
    photos: int
    videos: int


def extent_of(folder: Path) -> Extent:
    """Count what a folder holds, without following links inside."""
    files = num_bytes = photos = videos = 0
    for _, entry, is_photo in files_within(folder):
        with contextlib.suppress(OSError):  # it has just been removed
            num_bytes += entry.stat().st_size
            files += 1
            ending = os.path.splitext(entry.name)[1].lower()  # noqa: PTH122 - a name, thousands of times
            photos += is_photo and ending in PHOTO_ENDINGS
            videos += ending in VIDEO_ENDINGS
    return Extent(files, num_bytes, photos, videos)


def photo_names(folder: Path) -> list[str]:
    """Return the photos below an entry by their endings, as paths with slashes, sorted."""
    found = []
    for name, entry, is_photo in files_within(folder):
        if is_photo and os.path.splitext(entry.name)[1].lower() in PHOTO_ENDINGS:  # noqa: PTH122
            found.append(name)
    return sorted(found)


def files_within(folder: Path) -> Iterator[tuple[str, os.DirEntry[str], bool]]:
    """Yield the files below a folder: their path with slashes, their entry, and whether photos may lie there."""
    waiting = [(str(folder), "", True)]
    while waiting:
        place, prefix, photos = waiting.pop()
        try:
            with os.scandir(place) as found:
                entries = [entry for entry in found if not entry.name.startswith(".")]
        except OSError:
            continue
        for entry in entries:
            if entry.is_dir(follow_symlinks=False):
                inside = photos and entry.name not in NOT_PHOTOS
                waiting.append((entry.path, f"{prefix}{entry.name}/", inside))
            elif _is_file(entry):
                yield f"{prefix}{entry.name}", entry, photos


def _is_file(entry: os.DirEntry[str]) -> bool:
    """Return whether an entry of a folder is a file; false for a link that cannot be followed."""
    try:
        return entry.is_file()
    except OSError:
        return False


def size_of(folder: Path, without: Path | None = None) -> int:
    """Return the bytes of all files below a folder, hidden ones too; links are not followed.

    Args:
        folder: The folder.
        without: A folder below it that does not count.
    """
    size, waiting = 0, [str(folder)]
    while waiting:
        try:
            with os.scandir(waiting.pop()) as found:
                entries = list(found)
        except OSError:
            continue
        for entry in entries:
            with contextlib.suppress(OSError):  # it has just been removed
                if not entry.is_dir(follow_symlinks=False):
                    size += entry.stat(follow_symlinks=False).st_size if not entry.is_symlink() else 0
                elif without is None or entry.path != str(without):
                    waiting.append(entry.path)
    return size

"""Links inside folders that somebody else may have made; the command line and the studio share these checks."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from pathlib import Path

from gsplat_edu.base.errors import ArgumentError


def resolved(path: Path) -> Path | None:
    """Return a path with all its links followed; None if they lead in a circle, or the name is none.

    Args:
        path: The path; it need not exist.
    """
    try:
        return path.resolve()
    except (OSError, RuntimeError, ValueError):  # a circle is a RuntimeError until Python 3.13
        return None


def is_inside(path: Path, roots: Iterable[Path]) -> bool:
    """Return whether a path, with all its links followed, lies in one of some folders; false for a circle of links.

    Args:
        path: The path; it need not exist.
        roots: The folders.
    """
    real = resolved(path)
    return real is not None and any(real.is_relative_to(root.resolve()) for root in roots)


def links_in(folder: Path) -> Iterator[Path]:
    """Yield the links in a folder, at any depth, without following them."""
    waiting = [str(folder)]
    while waiting:
        try:
            with os.scandir(waiting.pop()) as found:
                entries = list(found)
        except OSError:  # it is no folder, may not be read, or has just been removed
            continue
        for entry in entries:
            if entry.is_symlink():
                yield Path(entry.path)
            elif entry.is_dir(follow_symlinks=False):
                waiting.append(entry.path)


def check_links(name: str, folder: Path, parts: Iterable[str] = (".",)) -> None:
    """Check, before anything in a folder is written or removed, that no link in it leads out of it.

    A run or capture from somebody else may have a folder `checkpoints` that is a link to a folder of the user. The
    folder itself may be reached by links, because the user has named it.

    Args:
        name: The user's name for the folder, for messages.
        folder: The folder; it need not exist.
        parts: Parts of the folder that are written to; by default the whole folder.

    Raises:
        ArgumentError: a link leads out, or in a circle; the message names it.
    """
    for part in parts:
        place = folder / part
        for path in (place, *(() if place.is_symlink() else links_in(place))):
            if not is_inside(path, [folder]):
                raise ArgumentError(
                    f"{name}: {path} is a link that leads out of {folder}; nothing was written: remove the link, or put"
                    " what it leads to in its place"
                )

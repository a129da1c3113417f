"""Give entries other names: one alone, or together with what was made from it and named after it."""

from __future__ import annotations

import contextlib
import json
import time
from collections.abc import Callable, Mapping
from pathlib import Path

from gsplat_edu.base.errors import SplatError
from gsplat_edu.base.files import described, written_aside
from gsplat_edu.base.reading import parse_json, read_bytes
from gsplat_edu.server.refusal import conflict

FORMER = "renamed.json"
"""File in the studio's own folder: the former names of entries."""

MOST = 5000
"""Largest number of former names that are kept."""


def names_along(entry: str, to: str, parents: Mapping[str, str]) -> dict[str, str]:
    """Return the new places of an entry and of all that was made from it, by their present ones.

    Entries are renamed along if their names are the old one, or begin with it and a dash ("toy-run-2").

    Args:
        entry: The entry, "photos/toy".
        to: Its new name.
        parents: What each entry was made from; see `gsplat_edu.studio.origins`.
    """
    old = entry.partition("/")[2]
    found = {entry: f"{entry.partition('/')[0]}/{to}"}
    for other in parents:
        above, seen = other, {other}
        while (above := parents.get(above, "")) and above not in seen:
            seen.add(above)
        kind, _, name = other.partition("/")
        if entry in seen and (name == old or name.startswith(f"{old}-")):
            found[other] = f"{kind}/{to}{name[len(old) :]}"
    return found


def rename_all(places: Mapping[str, str], rename: Callable[[str, str], object]) -> None:
    """Rename several places; if one fails, those before it get their old names back.

    Args:
        places: New places by old ones.
        rename: Renames one.

    Raises:
        RefusedError: one cannot be renamed; has one line.
    """
    done: list[tuple[str, str]] = []
    for old, new in places.items():
        try:
            rename(old, new)
        except (SplatError, OSError) as error:
            reason = described(error) if isinstance(error, OSError) else str(error)
            stuck = []
            for before, after in reversed(done):
                try:
                    rename(after, before)
                except (SplatError, OSError):
                    stuck.append(f"{before} is now {after}")
            rest = "all names are as before" if not stuck else "; ".join(stuck)
            raise conflict(f"{reason}; {rest}") from None
        done.append((old, new))


class FormerNames:
    """Remembers where entries were before they were renamed, because a run's config names its capture by path.

    Args:
        folder: The studio's own folder.
    """

    def __init__(self, folder: Path) -> None:
        self._file = folder / FORMER
        self._names = _read(self._file)

    def note(self, old: str, new: str) -> None:
        """Note that an entry was renamed."""
        now = time.time()
        self._names = [*self._names, (old, new, now)][-MOST:]
        with (
            contextlib.suppress(OSError),
            written_aside(self._file) as aside,
        ):  # else links by path are lost, no more
            aside.write_text(json.dumps({"renamed": self._names}), encoding="utf-8")

    def present(self, entry: str, since: float) -> str:
        """Return the present name of what an entry's name meant at a time.

        Args:
            entry: The name, "captures/toy".
            since: The time, s since 1970.
        """
        for old, new, when in self._names:
            if old == entry and when >= since:
                entry, since = new, when
        return entry


def _read(file: Path) -> list[tuple[str, str, float]]:
    """Read former names; a damaged file has none."""
    try:
        listed = parse_json(read_bytes(file))["renamed"]
        return [
            (old, new, float(when))
            for old, new, when in listed
            if isinstance(old, str) and isinstance(new, str)
        ]
    except (OSError, ValueError, KeyError, TypeError):
        return []

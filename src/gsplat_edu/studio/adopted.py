"""The places outside of a library that its links may lead to, because the user has adopted them on this computer.

The list lies in the user's own folder, not in the library, so that no link in a library that somebody else made is
followed.
"""

from __future__ import annotations

import json
import os
from pathlib import Path

from gsplat_edu.base.files import written_aside
from gsplat_edu.base.reading import parse_json, read_bytes
from gsplat_edu.base.text import legible


def list_file() -> Path:
    """Return the list: JSON that maps a library's folder to the places that it has adopted."""
    folder = os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state"
    return Path(folder) / "gsplat-edu" / "adopted.json"


def adopted(library: Path) -> list[Path]:
    """Return the places that a library has adopted; none if the list is missing or damaged.

    Args:
        library: Its folder, resolved.
    """
    places = _read().get(legible(str(library)), [])
    return [Path(place) for place in places if isinstance(place, str)] if isinstance(places, list) else []


def note_adopted(library: Path, place: Path) -> None:
    """Add a place to the list.

    Args:
        library: The library's folder, resolved.
        place: A folder or file, resolved.

    Raises:
        OSError: the list cannot be written.
    """
    known = _read()
    places = [*map(str, adopted(library)), legible(str(place))]
    known[legible(str(library))] = list(dict.fromkeys(places))
    with written_aside(list_file()) as aside:
        aside.write_text(json.dumps(known, indent=1) + "\n", encoding="utf-8")


def _read() -> dict[str, object]:
    try:
        found = parse_json(read_bytes(list_file()))
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}

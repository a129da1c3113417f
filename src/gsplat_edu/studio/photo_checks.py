"""What the doctor says of photos that are not placed yet, measured a few at a time and kept in the cache."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

from gsplat_edu.base.errors import DatasetError
from gsplat_edu.base.files import written_aside
from gsplat_edu.base.reading import parse_json, read_bytes
from gsplat_edu.base.text import legible
from gsplat_edu.studio.contents import photo_names
from gsplat_edu.studio.pictures import cache_name

AT_ONCE = 1.0
"""Seconds that one request measures photos for; the next one goes on. Thumbnails wait meanwhile."""


def check_photos(entry: str, cache: str) -> dict[str, Any]:
    """Measure photos for a while; a task of `gsplat_edu.studio.worker`.

    Args:
        entry: Folder of the photos.
        cache: Folder of what was measured.

    Returns:
        done and total, numbers of photos; usual, the smallest and largest usual number; and once all are done seconds,
        what placing them takes roughly, and the findings, as the fields of events. Before, both are None.
    """
    from msgspec.structs import asdict

    from gsplat_edu.doctor.diagnosis import event_of
    from gsplat_edu.doctor.files import USUAL
    from gsplat_edu.doctor.unplaced import Measured, examine_unplaced
    from gsplat_edu.sfm.source import expected_seconds

    end = time.monotonic() + AT_ONCE
    names = sorted(photo_names(Path(entry)))
    found, done = list[Measured](), 0
    for name in names:
        path = Path(entry, name)
        target = Path(cache, f"{cache_name(path, path.stat())}.json")
        if not target.is_file():
            if done and time.monotonic() > end:
                continue
            _measure(legible(name), path, target)
        done += 1
        if (kept := parse_json(read_bytes(target))) is not None:
            found.append(Measured(legible(name), tuple(kept["size"]), kept["detail"]))
    facts = {"done": done, "total": len(names), "usual": USUAL}
    if done < len(names):
        return facts | {"findings": None, "seconds": None}
    findings = [asdict(event_of(one)) for one in examine_unplaced(found, len(names))] if names else []
    return facts | {"findings": findings, "seconds": expected_seconds(Path(entry)) if names else None}


def _measure(name: str, path: Path, target: Path) -> None:
    """Write what is measured of a photo; null if it cannot be decoded."""
    from gsplat_edu.doctor.unplaced import measured

    try:
        kept = measured(name, path)._asdict()
    except DatasetError:
        kept = None
    with written_aside(target) as aside:
        aside.write_text(json.dumps(kept), encoding="utf-8")

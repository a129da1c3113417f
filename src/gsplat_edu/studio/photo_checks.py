"""What the doctor says of photos that are not placed yet, measured a few at a time and kept in the cache.

First each photo is measured, then each is compared with those after it.
"""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
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

MOST_COMPARED = 200
"""More photos than this are not compared: 200 take most of a minute of one core, 0.25 s each."""


def check_photos(entry: str, cache: str) -> dict[str, Any]:
    """Measure photos for a while; a task of `gsplat_edu.studio.worker`.

    Args:
        entry: Folder of the photos.
        cache: Folder of what was measured.

    Returns:
        photos, their number; done and total, how many of the measurements; usual, the smallest and largest usual
        number of photos; and once all are done seconds, what placing the photos takes roughly, the findings, as the
        fields of events, and ordered, whether photos were compared and are in the order they were taken. Before,
        these are None.
    """
    from msgspec.structs import asdict

    from gsplat_edu.doctor.diagnosis import event_of
    from gsplat_edu.doctor.files import USUAL
    from gsplat_edu.doctor.unplaced import Measured, examine_unplaced, in_order
    from gsplat_edu.sfm.source import expected_seconds

    end = time.monotonic() + AT_ONCE
    names = sorted(photo_names(Path(entry)))
    found, done, keys = list[Measured](), 0, list[tuple[Path, str]]()
    for name in names:
        path = Path(entry, name)
        key = cache_name(path, path.stat())
        target = Path(cache, f"{key}.json")
        if not target.is_file():
            if done and time.monotonic() > end:
                continue
            _measure(legible(name), path, target)
        done += 1
        if (kept := parse_json(read_bytes(target))) is not None:
            found.append(Measured(legible(name), tuple(kept["size"]), kept["detail"]))
            keys.append((path, key))
    compares = len(names) <= MOST_COMPARED
    facts = {"photos": len(names), "usual": USUAL, "total": len(names) * (2 if compares else 1)}
    later = {"findings": None, "seconds": None, "ordered": None}
    if done < len(names):
        return facts | later | {"done": done}
    shared, compared = _compare(keys, Path(cache), end) if compares else ({}, 0)
    if compares and compared < len(keys):
        return facts | later | {"done": done + compared}
    findings = [asdict(event_of(one)) for one in examine_unplaced(found, len(names), shared)] if names else []
    seconds = expected_seconds(Path(entry)) if names else None
    ordered = bool(shared) and in_order(shared)
    return facts | {"done": facts["total"], "findings": findings, "seconds": seconds, "ordered": ordered}


def _compare(
    photos: Sequence[tuple[Path, str]], cache: Path, end: float
) -> tuple[dict[tuple[int, int], Any], int]:
    """Compare photos with those after them until a time; return what pairs share, and how many photos are done."""
    from gsplat_edu.doctor.unplaced import APART, Look, Shared

    looks = dict[int, Look]()
    shared, done, begun = dict[tuple[int, int], Shared](), 0, False
    for i, (_, key) in enumerate(photos):
        after = range(i + 1, min(i + 1 + APART, len(photos)))
        names = "".join(photos[j][1][-16:] for j in after)
        target = Path(cache, f"{key}-{names}.json")
        if not target.is_file():
            if begun and time.monotonic() > end:
                break
            begun = True
            for j in (i, *after):
                looks[j] = looks.get(j) or Look(photos[j][0])
            with written_aside(target) as aside:
                aside.write_text(
                    json.dumps([looks[i].shared_with(looks[j]) for j in after]), encoding="utf-8"
                )
        looks.pop(i, None)
        shared.update(
            {(i, j): Shared(*both) for j, both in zip(after, parse_json(read_bytes(target)), strict=True)}
        )
        done += 1
    return shared, done


def _measure(name: str, path: Path, target: Path) -> None:
    """Write what is measured of a photo; null if it cannot be decoded."""
    from gsplat_edu.doctor.unplaced import measured

    try:
        kept = measured(name, path)._asdict()
    except DatasetError:
        kept = None
    with written_aside(target) as aside:
        aside.write_text(json.dumps(kept), encoding="utf-8")

"""What an entry was made from, by its own files and by the jobs that made it; its name alone says nothing."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from gsplat_edu.base.errors import DatasetError
from gsplat_edu.base.text import legible
from gsplat_edu.jobs.record import Job, State
from gsplat_edu.server.refusal import RefusedError
from gsplat_edu.sfm.photos import fingerprint, photo_files
from gsplat_edu.sfm.stages import read_stages
from gsplat_edu.studio.commands import photos_source
from gsplat_edu.studio.library import Library, scene_file
from gsplat_edu.studio.renaming import FormerNames

MAKERS = {"captures": "sfm", "runs": "train", "scenes": "clean"}
"""Commands that make entries, by the kind of what they make."""

CLOCK = 2.0
"""Seconds by which the time of a file may lie outside the time of the job that wrote it: clocks of file systems are
coarse."""

_DIGESTS = {"frames": "video", "faces": "panoramas", "photos": "photos"}
"""Options of the stages of a search for poses that are digests of what it was given."""


def makers(jobs: Iterable[Job]) -> dict[str, Job]:
    """Return the latest job that makes each entry, by the entry ("captures/toy").

    Args:
        jobs: All jobs, oldest first.
    """
    return {job.work.outputs[0]: job for job in jobs if job.work.command in MAKERS.values()}


def origins(
    library: Library,
    lists: Mapping[str, Sequence[Mapping[str, Any]]],
    made_by: Mapping[str, Job],
    former: FormerNames | None = None,
) -> dict[str, str]:
    """Return what each entry was made from, for those where it is in the library; values are entries too.

    A capture comes from photos, a run from a capture or from photos, a scene from a run.

    Args:
        library: Where the entries are.
        lists: Summaries of the entries, by kind.
        made_by: See `makers`.
        former: Former names of entries; None if there are none.
    """
    found: dict[str, str | None] = {}
    for facts in lists["captures"]:
        found[facts["entry"]] = _of_capture(library, facts, lists["photos"], made_by)
    for facts in lists["runs"]:
        found[facts["entry"]] = _of_run(library, facts, lists, made_by, former)
    for facts in lists["scenes"]:
        found[facts["entry"]] = _of_scene(library, facts, made_by)
    known = {facts["entry"] for entries in lists.values() for facts in entries}
    return {entry: origin for entry, origin in found.items() if origin is not None and origin in known}


def _of_capture(
    library: Library,
    facts: Mapping[str, Any],
    photos: Sequence[Mapping[str, Any]],
    made_by: Mapping[str, Job],
) -> str | None:
    """Return the photos of a capture that a search for poses made."""
    path = library.root / facts["entry"]
    if not (path / "sfm").is_dir():
        return None
    job = made_by.get(facts["entry"])
    if job is not None and facts["adopted"] is None:
        return job.work.inputs[0]
    return _with_digest(library, path / "sfm" / "stages.json", photos)


def _of_run(
    library: Library,
    facts: Mapping[str, Any],
    lists: Mapping[str, Sequence[Mapping[str, Any]]],
    made_by: Mapping[str, Job],
    former: FormerNames | None,
) -> str | None:
    """Return the capture that a run's config names, or the photos whose poses the run found itself."""
    job = made_by.get(facts["entry"])
    if facts["capture"] is None:  # it has not begun, or is damaged
        return None if job is None or facts["adopted"] else job.work.inputs[0]
    capture = legible(facts["capture"])
    if (moved := renamed_capture(library, library.root / facts["entry"], capture, former)) is not None:
        capture = moved
    for other in lists["captures"]:
        if _holds(other, library, capture):
            return str(other["entry"])
    own = _holds(facts, library, capture)
    if job is not None and facts["adopted"] is None and (own or not Path(capture).exists()):
        return job.work.inputs[0]  # jobs follow an entry to its new name, the config does not
    stages = library.root / facts["entry"] / "capture" / "sfm" / "stages.json"
    return _with_digest(library, stages, lists["photos"]) if own else None


def renamed_capture(library: Library, run: Path, capture: str, former: FormerNames | None) -> str | None:
    """Return where the capture of a run lies now, if it was renamed after the run began; else None.

    Args:
        library: Where the entries are.
        run: The run's folder.
        capture: The capture's path in the run's config.
        former: Former names of entries.
    """
    place = Path(capture)
    if former is None or place.parent != library.root / "captures":
        return None
    if (began := _beginning(run)) is None:
        return None
    old = f"captures/{place.name}"
    now = former.present(old, began)
    return None if now == old else str(library.root / now)


def _beginning(run: Path) -> float | None:
    """Return when a run began, s since 1970; None if it has not begun.

    A run with more iterations than before has a new config.json, but the other files of its beginning stay.
    """
    if not (run / "config.json").is_file():
        return None
    times = []
    for name in ("cameras.json", "photos.json", "config.json"):
        with contextlib.suppress(OSError):  # an older version wrote no photos.json
            times.append((run / name).stat().st_mtime)
    return min(times, default=None)


def _holds(facts: Mapping[str, Any], library: Library, place: str) -> bool:
    """Return whether a path is that of an entry or lies below it, in the library or where it was adopted from."""
    own = (facts["path"], facts["adopted"], legible(str((library.root / facts["entry"]).resolve())))
    return any(at is not None and (place == at or place.startswith(f"{at}/")) for at in own)


def _of_scene(library: Library, facts: Mapping[str, Any], made_by: Mapping[str, Job]) -> str | None:
    """Return the run of which a scene is the cleaned one: the job wrote this very file."""
    job, file = made_by.get(facts["entry"]), scene_file(library.root / facts["entry"])
    if job is None or file is None or job.state is not State.DONE or facts["adopted"] or file.is_symlink():
        return None
    began, ended = job.started or job.created, job.ended or job.created
    try:
        written = file.stat().st_mtime
    except FileNotFoundError:  # it has just been renamed or removed
        return None
    return job.work.inputs[0] if began - CLOCK <= written <= ended + CLOCK else None


def _with_digest(library: Library, stages: Path, photos: Sequence[Mapping[str, Any]]) -> str | None:
    """Return the photos that a search for poses was given, by the digest of them that it keeps."""
    try:
        state = stages.stat()
    except OSError:
        return None
    wanted = _digests_in(stages, state.st_mtime_ns, state.st_size)
    for facts in photos if wanted else ():
        entry = library.root / facts["entry"]
        try:
            library.check_tree(entry)
        except RefusedError:
            continue  # a link leads out of the library
        if _digest_of(entry, facts["modified"], facts["files"], facts["bytes"]) in wanted:
            return str(facts["entry"])
    return None


@functools.lru_cache(maxsize=256)
def _digests_in(stages: Path, modified: int, size: int) -> frozenset[str]:
    """Read the digests in a file of stages once for each of its states."""
    try:
        found = read_stages(stages)
    except (OSError, ValueError):
        return frozenset()
    options = [found[stage]["options"].get(name) for stage, name in _DIGESTS.items() if stage in found]
    return frozenset(digest for digest in options if isinstance(digest, str))


@functools.lru_cache(maxsize=256)
def _digest_of(entry: Path, modified: float, files: int, size: int) -> str | None:
    """Return the digest that a search for poses makes of photos, once for each of their states."""
    try:
        source = photos_source(entry).resolve()
        if source.is_file():
            return fingerprint([source], source.parent)
        photos = photo_files(source)
        return fingerprint(photos, photos[0].parent) if photos else None
    except (DatasetError, OSError):
        return None

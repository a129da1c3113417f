"""What the page offers to do about a finding of the doctor: to train with other options, or a part of the page."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any
from urllib.parse import quote

from gsplat_edu.base.errors import CheckpointError
from gsplat_edu.jobs.events import Found
from gsplat_edu.options.train import OFFERED
from gsplat_edu.runs.folder import RunFolder
from gsplat_edu.server.refusal import RefusedError
from gsplat_edu.studio.origins import renamed_capture
from gsplat_edu.studio.state import Studio
from gsplat_edu.train.config import BY_NAME

LABELS = {name: plain.again for name, plain in OFFERED.items() if plain is not None and plain.again}
"""Words of a button by the option that its training changes."""

WHOLE = frozenset(name for name in LABELS if name in BY_NAME and not BY_NAME[name].names)
"""Options whose values are whole numbers."""

LENGTHS = ("quality", "iterations", "time_limit")
"""Options that say how long to train; a training has one of them."""

TABS = {
    "unfinished": ("Go to the training", ""),
    "floaters": ("Go to Clean", "/share"),
    "faint splats": ("Go to the exports", "/share"),
}
"""Words of a link and the tab of the run's screen, by the finding's name."""


def proposals(studio: Studio, kind: str, entry: Path, found: Found) -> list[dict[str, Any]]:
    """Return what the page offers for a finding: each has a label, and a request for a job or a place of the page.

    Args:
        studio: The studio.
        kind: Of the entry that the doctor examined, captures or runs.
        entry: The entry.
        found: The finding.
    """
    offered: list[dict[str, Any]] = []
    subject, before = _trained(studio, kind, entry) if found.options else (None, {})
    for name, value in found.options if subject is not None else ():
        if name not in LABELS or (name in WHOLE and not value.isdecimal()):
            continue  # proposed by another version
        number = int(value) if name in WHOLE else value
        replaced = LENGTHS if name == "iterations" else (name,)
        options = {known: old for known, old in before.items() if known not in replaced} | {name: number}
        label = LABELS[name].format(value=f"{number:,}" if name in WHOLE else value)
        offered.append(
            {"label": label, "request": {"command": "train", "subject": subject, "options": options}}
        )
    if kind == "runs" and found.name in TABS:
        label, tab = TABS[found.name]
        offered.append({"label": label, "place": f"#/runs/{quote(entry.name)}{tab}"})
    return offered


def train_again(studio: Studio, run: Path) -> dict[str, Any] | None:
    """Return the request that trains a run's capture again with the run's options; None if it is not in the library.

    Args:
        studio: The studio.
        run: The run.
    """
    subject, options = _trained(studio, "runs", run)
    return None if subject is None else {"command": "train", "subject": subject, "options": dict(options)}


def _trained(studio: Studio, kind: str, entry: Path) -> tuple[str | None, Mapping[str, Any]]:
    """Return what to train again and with which options; None and none if the run's capture is not in the library."""
    subject = studio.library.name(entry)
    if kind == "captures":
        return subject, {}
    made = [
        job.work
        for job in studio.queue.jobs()
        if job.work.command == "train" and job.work.outputs == (subject,)
    ]
    if made:
        return made[-1].inputs[0], {
            name: value for name, value in made[-1].options.items() if name != "resume"
        }
    try:
        config = RunFolder(entry).read_config()
        named = str(config["data"]["path"])
        place = Path(renamed_capture(studio.library, entry, named, studio.former) or named)
        capture = studio.library.entry("captures", place.name)
        given = {name: config["train"][name] for name in ("strategy", "iterations")}
    except (CheckpointError, RefusedError, KeyError, TypeError):
        return None, {}
    if capture.resolve() != place.resolve():
        return None, {}  # another capture of that name
    return studio.library.name(capture), given

"""Projects: photos, or what came with poses or as a scene, and everything made from them, with one next step."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gsplat_edu.base.files import newest_first
from gsplat_edu.base.text import legible
from gsplat_edu.jobs.record import ACTIVE, Job, State
from gsplat_edu.studio.commands import COLLIDER, SURFACE
from gsplat_edu.studio.library import EXPORTS, KINDS, Library
from gsplat_edu.studio.origins import makers, origins
from gsplat_edu.studio.renaming import FormerNames

STAGES = ("photos", "poses", "training", "look", "share")
"""Stages of a project, in order."""

PENDING = (*ACTIVE, State.QUEUED, State.HELD)
"""States of a job that will still do something."""

Facts = dict[str, Any]
"""Summary of an entry (`gsplat_edu.studio.listing.summary`), a step of a project, or a project."""


def projects(
    library: Library, lists: Mapping[str, list[Facts]], jobs: Sequence[Job], former: FormerNames | None = None
) -> list[Facts]:
    """Group the entries to projects; the project that was worked on last comes first.

    Args:
        library: Where the entries are.
        lists: Summaries of the entries, by kind. Each gets `made_from`, the entry that it was made from or None, and
            `next`, the next step of it and of what was made from it.
        jobs: All jobs, oldest first.
        former: Former names of entries; None if there are none.

    Returns:
        For each: name, entries ("runs/toy", what is made after what it was made from), stage (one of `STAGES`), steps
        (for each stage its place or None), picture (the entry to show), modified (s) and next. A step has a label
        and a place, a request for a job, or a file of an entry; `then` is the step after it.
    """
    made_by = makers(jobs)
    known = {facts["entry"] for entries in lists.values() for facts in entries}
    coming = [
        _coming(entry, job)
        for entry, job in made_by.items()
        if job.work.command == "train" and job.state in PENDING and entry not in known
    ]
    entries = {facts["entry"]: facts for kind in KINDS for facts in (*lists[kind], *_of(coming, kind))}
    parents = origins(library, lists, made_by, former)
    parents |= {one["entry"]: one["made_from"] for one in coming if one["made_from"] in known}
    children: dict[str, list[str]] = {}
    for entry, parent in parents.items():
        children.setdefault(parent, []).append(entry)
    state = _State(library, made_by, jobs, parents)
    found = []
    for entry, facts in entries.items():
        group = [entries[name] for name in _below(entry, children)]
        stage, step = state.next_of(group)
        facts |= {"made_from": parents.get(entry), "next": step}
        if entry not in parents:
            found.append(
                {
                    "name": facts["name"],
                    "entries": [one["entry"] for one in group],
                    "stage": stage,
                    "steps": state.steps(group),
                    "picture": _picture(group),
                    "modified": max(one["modified"] for one in group),
                    "next": step,
                }
            )
    return sorted(found, key=lambda project: -project["modified"])


def _coming(entry: str, job: Job) -> Facts:
    """Return what is known of a run whose folder is not there yet."""
    facts = {"kind": "runs", "name": entry.partition("/")[2], "entry": entry, "modified": job.created}
    return facts | {"made_from": job.work.inputs[0], "finished": False, "psnr": None, "edited": False}


def _of(group: Iterable[Facts], kind: str) -> list[Facts]:
    return [facts for facts in group if facts["kind"] == kind]


def _below(entry: str, children: Mapping[str, list[str]]) -> list[str]:
    """Return an entry and all that was made from it."""
    return [entry, *(name for child in children.get(entry, ()) for name in _below(child, children))]


def _newest(group: Iterable[Facts]) -> Facts | None:
    return max(group, key=lambda facts: facts["modified"], default=None)


def _picture(group: Sequence[Facts]) -> str | None:
    """Return the entry with the best scene, else one with photos."""
    scored = [run for run in _of(group, "runs") if run["psnr"] is not None]
    if scored:
        return str(max(scored, key=lambda run: run["psnr"])["entry"])
    shown = [scene for scene in _of(group, "scenes") if scene["file"]]
    shown += [facts for facts in group if facts.get("photos")]
    return shown[0]["entry"] if shown else None


def _is_posed(capture: Facts) -> bool:
    return capture["layout"] is not None and not capture["unfinished"]


def newest_export(entry: Path) -> str | None:
    """Return the name of the newest page, scene file or video among the exports of an entry; None if there is none."""
    folder = entry / EXPORTS
    if folder.is_symlink() or not folder.is_dir():
        return None
    try:
        files = [path for path in folder.iterdir() if path.name[0] != "." and path.is_file()]
    except FileNotFoundError:  # the entry has just been renamed or removed
        return None
    files = [path for path in files if not path.is_symlink() and not path.name.endswith((SURFACE, COLLIDER))]
    newest = newest_first(files)
    return legible(newest[0].name) if newest else None


@dataclass(frozen=True)
class _State:
    """What next steps depend on beside the entries.

    Args:
        library: Where the entries are.
        made_by: The latest job that makes each entry.
        jobs: All jobs, oldest first.
        parents: The entry that each entry was made from.
    """

    library: Library
    made_by: Mapping[str, Job]
    jobs: Sequence[Job]
    parents: Mapping[str, str]

    def next_of(self, group: Sequence[Facts]) -> tuple[str, Facts]:
        """Return the stage of entries that belong together, and their next step."""
        for run in _of(group, "runs"):
            if self._is_pending(self.made_by.get(run["entry"])):
                return "training", {"label": "Watch the training", "place": run["entry"]}
        if (result := self._result(group)) is not None:
            return self._after_training(result)
        if (capture := _newest(filter(_is_posed, _of(group, "captures")))) is not None:
            work = {"command": "train", "subject": capture["entry"], "options": {"quality": "standard"}}
            start = {"label": "Start training", "request": work}
            return "training", {"label": "Look at the cameras", "place": capture["entry"], "then": start}
        return self._before_poses(group)

    def steps(self, group: Sequence[Facts]) -> list[Facts]:
        """Return the place of each stage, None for those where there is nothing to see yet."""
        photos = _newest(_of(group, "photos")) or _newest(_of(group, "captures"))
        result = self._result(group)
        done = None if result is None or self._is_stopped(result) else result["entry"]
        posed = _newest(filter(_is_posed, _of(group, "captures")))
        run = _newest(_of(group, "runs"))
        places = [None if one is None else one["entry"] for one in (photos, posed, run)]
        places += [done, None if done is None else f"{done}/share"]
        return [{"stage": stage, "place": place} for stage, place in zip(STAGES, places, strict=True)]

    def _result(self, group: Sequence[Facts]) -> Facts | None:
        """Return the newest scene, or run whose training does not go on."""
        found = (*_of(group, "runs"), *_of(group, "scenes"))
        return _newest(one for one in found if not self._is_pending(self.made_by.get(one["entry"])))

    def _is_stopped(self, result: Facts) -> bool:
        job = self.made_by.get(result["entry"])
        return result["kind"] == "runs" and not result["finished"] and job is not None and job.resumable

    def _is_pending(self, job: Job | None) -> bool:
        return job is not None and job.work.command == "train" and job.state in PENDING

    def _after_training(self, result: Facts) -> tuple[str, Facts]:
        """Return stage and next step of a scene, or of a run that has ended."""
        entry = result["entry"]
        if self._is_stopped(result):
            return "training", {"label": "Resume the training", "place": entry}
        share = f"{entry}/share"
        if any(job.state in PENDING and self._is_export(job, entry) for job in self.jobs):
            return "share", {"label": "Watch the export", "place": share}
        if (file := newest_export(self.library.root / entry)) is not None:
            then = {"label": f"Save {file}", "entry": entry, "file": file}
            return "share", {"label": "Share it", "place": share, "then": then}
        work = {"command": "convert", "subject": entry, "format": "html"}
        make = {"label": "Make the file", "request": work | ({"edits": True} if result["edited"] else {})}
        onward = {"label": "Share it", "place": share, "then": make}
        return "look", {"label": "Look at the result", "place": entry, "then": onward}

    def _is_export(self, job: Job, entry: str) -> bool:
        return job.work.command in ("convert", "render") and job.work.inputs[0] == entry

    def _before_poses(self, group: Sequence[Facts]) -> tuple[str, Facts]:
        """Return stage and next step of photos, or of a capture that has no poses."""
        photos = _newest(_of(group, "photos"))
        if photos is None:
            own = group[0]["entry"]  # without its photos, nothing can be done with it
            parent = self.parents.get(own)
            label = "Look at the photos" if parent is None else "Go back to the photos"
            return "poses", {"label": label, "place": parent or own}
        entry = photos["entry"]
        if not photos["photos"] and not photos["videos"]:
            return "photos", {"label": "Add photos", "place": entry}
        searches = [job for job in self.jobs if job.work.command == "sfm" and job.work.inputs[0] == entry]
        if searches and searches[-1].state in PENDING:
            return "poses", {"label": "Watch the photos being placed", "place": entry}
        if searches and searches[-1].resumable:
            return "poses", {"label": "Try again to place the photos", "place": entry}
        return "poses", {"label": "Place the photos", "request": {"command": "sfm", "subject": entry}}

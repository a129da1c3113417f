"""Summaries of entries for the page's list."""

from __future__ import annotations

import bisect
import functools
import math
import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from gsplat_edu.base.errors import CheckpointError
from gsplat_edu.base.files import described
from gsplat_edu.base.reading import open_file, parse_json, read_text
from gsplat_edu.base.text import legible
from gsplat_edu.data.left_out import without_pose
from gsplat_edu.data.reader import layout_of
from gsplat_edu.evaluate.verdict import verdict
from gsplat_edu.runs.folder import RunFolder
from gsplat_edu.server.refusal import RefusedError
from gsplat_edu.studio.contents import extent_of
from gsplat_edu.studio.library import KINDS, Library, scene_file


def summaries(library: Library, trouble: list[str] | None = None) -> dict[str, list[dict[str, Any]]]:
    """Return the facts of all entries, by kind; those that have just been renamed or removed are left out.

    Args:
        library: The library.
        trouble: Gets a line for each entry that cannot be read. It is left out, too.
    """
    found: dict[str, list[dict[str, Any]]] = {kind: [] for kind in KINDS}
    for kind, facts in found.items():
        for path in library.entries(kind):
            try:
                facts.append(summary(library, kind, path))
            except FileNotFoundError:
                continue
            except OSError as error:
                if trouble is not None:
                    trouble.append(legible(described(error)))
    return found


def summary(library: Library, kind: str, path: Path) -> dict[str, Any]:
    """Return an entry's facts.

    Args:
        library: Its library.
        kind: Its kind.
        path: Its folder.

    Raises:
        FileNotFoundError: it has just been renamed or removed.
        OSError: it cannot be read.
    """
    size = extent_of(path)
    facts: dict[str, Any] = {
        "kind": kind,
        "name": legible(path.name),
        "entry": f"{kind}/{legible(path.name)}",
        "path": legible(str(path)),
        "adopted": legible(str(path.readlink())) if path.is_symlink() else None,
        "modified": path.stat().st_mtime,
        "files": size.files,
        "bytes": size.num_bytes,
    }
    if kind in ("photos", "captures"):
        facts |= {"photos": size.photos, "videos": size.videos}
    if kind == "captures":
        (path / "transforms.json").is_file()  # raises the reason if the system refuses to look at it
        facts["layout"] = layout_of(path)
        facts["search"] = search_facts(path)
        facts["unfinished"] = is_unfinished(path)
    if kind == "runs":
        facts |= run_facts(library, path)
    if kind == "scenes":
        file = scene_file(path)
        facts |= {"file": None if file is None else legible(file.name), "scene_bytes": scene_bytes(file)}
    if kind in ("runs", "scenes"):
        facts["edited"] = (path / "edits.json").is_file()
    return facts


def search_facts(path: Path) -> dict[str, Any] | None:
    """Return what a finished search for poses found; None if the capture does not come from one.

    Returns:
        photos, the number that it was given; posed, those with a pose, both null for panoramas; unplaced, the names of
        those without one; beside, for each of these the placed photos before and after it, by name, or null; and error,
        the mean reprojection error, px.
    """
    file = path / "sfm" / "stages.json"
    try:
        facts = file.stat()
    except OSError:
        return None
    return _search_facts(file, facts.st_mtime_ns, facts.st_size)


@functools.lru_cache(maxsize=256)
def _search_facts(file: Path, modified: int, size: int) -> dict[str, Any] | None:
    """Read a file of stages once for each of its states; it lists every photo."""
    try:
        stages = parse_json(read_text(file))["stages"]
        error = float(stages["capture"]["facts"]["error"])
        names = sorted(map(str, stages["photos"]["facts"]["names"]))
        posed = len(stages["mapping again" if "mapping again" in stages else "mapping"]["facts"]["names"])
    except (OSError, ValueError, KeyError, TypeError):
        return None
    if not math.isfinite(error):
        return None
    faces = "faces" in stages
    counts = {"photos": None if faces else len(names), "posed": None if faces else posed}
    unplaced = without_pose(file.parent.parent)
    placed = sorted(set(names) - set(unplaced))
    beside = [_neighbours(name, placed) for name in unplaced]
    return counts | {"unplaced": [*map(legible, unplaced)], "beside": beside, "error": error}


def _neighbours(name: str, placed: Sequence[str]) -> list[str | None]:
    """Return the names before and after one in a sorted list; None beyond its ends."""
    at = bisect.bisect(placed, name)
    around = (placed[at - 1] if at else None, placed[at] if at < len(placed) else None)
    return [None if each is None else legible(each) for each in around]


def is_unfinished(path: Path) -> bool:
    """Return whether a capture holds only what a search for poses needs to be resumed, and no poses."""
    return layout_of(path) is None and (path / "sfm").is_dir()


def scene_bytes(file: Path | None) -> int:
    """Return the size of a scene: its file, or the folder of an unpacked SOG."""
    if file is None:
        return 0
    if file.suffix == ".json":
        return extent_of(file.parent).num_bytes
    try:
        return file.stat().st_size
    except FileNotFoundError:  # it has just been renamed or removed
        return 0


def run_facts(library: Library, path: Path) -> dict[str, Any]:
    """Return a run's progress and scores; `problem` is one line if a file is damaged, or a link leads elsewhere."""
    folder = RunFolder(path)
    facts: dict[str, Any] = {
        "planned": None,
        "iterations": None,
        "finished": False,
        "psnr": None,
        "verdict": None,
        "ssim": None,
        "num_gaussians": None,
        "seconds": None,
        "capture": None,
        "problem": None,
    }
    if not any(not child.name.startswith(".") for child in path.iterdir()):
        return facts  # a training that has not begun
    try:
        library.check_tree(path)
        config, metrics = folder.read_config(), folder.read_metrics()
    except (CheckpointError, RefusedError, OSError) as error:
        return {**facts, "problem": str(error)}
    train, data = config.get("train"), config.get("data")
    planned = train.get("iterations") if isinstance(train, dict) else None
    test = metrics.get("test") or {}
    done = metrics.get("iterations")
    last = last_logged(folder.log_file) if done is None else {}
    return facts | {
        "planned": planned,
        "iterations": last.get("iteration") if done is None else done,
        "finished": done is not None and (planned is None or done >= planned),
        "psnr": test.get("psnr"),
        "verdict": None if done is None else _verdict_facts(metrics, config),
        "ssim": test.get("ssim"),
        "num_gaussians": metrics.get("num_gaussians") or last.get("num_gaussians"),
        "seconds": metrics.get("seconds") or last.get("seconds"),
        "capture": data.get("path") if isinstance(data, dict) else None,
    }


def _verdict_facts(metrics: dict[str, Any], config: dict[str, Any]) -> dict[str, str]:
    """Return the grade of a run, the sentence about it, and the figures for those who ask."""
    found = verdict(metrics, config)
    return {"grade": found.grade, "sentence": legible(str(found)), "details": legible(found.details)}


def last_logged(path: Path) -> dict[str, Any]:
    """Return the figures from the last complete line of a run's log that contains them."""
    try:
        with open_file(path) as file:
            file.seek(max(os.fstat(file.fileno()).st_size - 2048, 0))
            tail = file.read().decode("utf-8", errors="replace")
    except OSError:
        return {}
    found: dict[str, Any] = {}
    for line in tail.splitlines()[::-1]:
        if '"ms"' not in line:
            continue
        for name in ("iteration", "num_gaussians", "seconds"):
            if match := re.search(rf'"{name}": ([0-9]{{1,15}}(?:\.[0-9]*)?)[,}}]', line):
                found[name] = float(match[1]) if name == "seconds" else int(float(match[1]))
        return found
    return found

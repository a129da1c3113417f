"""Shared by `convert` and `train`: write scenes in other formats and report the quality of the files."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from rich.progress import Progress, TaskID

from gsplat_edu.base.locks import locked_file
from gsplat_edu.evaluate.metrics import ImageScore
from gsplat_edu.jobs import emitter
from gsplat_edu.jobs.events import Metric
from gsplat_edu.runs.source import Source
from gsplat_edu.viewer import export

PATIENCE = 600.0
"""Longest time that the export of a trained scene waits for another command that writes the same file, s: it takes a
minute, and the training has taken longer."""


def check_and_say(
    path: Path, source: Source, backend: str, bar: Progress, say: Callable[[str], None]
) -> export.Exported:
    """Compare a written file with its source and report the result in one line."""
    task = bar.add_task(f"checking {path}", total=len(source.probes(export.VIEWS, export.SIDE)))
    found = export.check(path, source, backend, functools.partial(_advance, bar, task))
    bar.remove_task(task)
    emitter.emit(Metric("psnr", found.psnr, "dB", str(path)))
    emitter.emit(Metric("bytes", found.num_bytes, "", str(path)))
    say(found.line())
    return found


def export_all(
    paths: Sequence[Path], bar: Progress, backend: str, say: Callable[[str], None], source: Source
) -> list[dict[str, Any]]:
    """Write a scene to every path, check each file, and return the entries for metrics.json.

    Each file is written and checked once no other command writes it. Point clouds are not checked and have no entry.
    """
    written = []
    for path in paths:
        for note in export.losses(path, source):
            say(note)
        with locked_file("--export", path, "gsplat-edu train", say, PATIENCE):
            export.write(path, source)
            emitter.report_output(path)
            if export.is_points(path):
                say(f"wrote {path}: {export.POINTS}")
                continue
            written.append(check_and_say(path, source, backend, bar, say).document())
    return written


def _advance(bar: Progress, task: TaskID, score: ImageScore) -> None:
    bar.advance(task)

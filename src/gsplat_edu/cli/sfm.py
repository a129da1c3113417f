"""`gsplat-edu sfm`: turn photos or a video without poses into a capture."""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TaskID, TextColumn, TimeElapsedColumn

from gsplat_edu.base.locks import locked
from gsplat_edu.base.text import Told
from gsplat_edu.cli.findings import say_findings
from gsplat_edu.cli.options.sfm import options_from
from gsplat_edu.cli.terminal import Bar, Terminal, TimeLeft
from gsplat_edu.data.reader import CaptureReader
from gsplat_edu.jobs import emitter
from gsplat_edu.sfm.reconstruct import reconstruct

UNSTEADY = "mapping"
"""The stage without a forecast: each photo takes longer than the last, and it may start over."""


def run(arguments: argparse.Namespace) -> None:
    """Find the poses with progress output."""
    options = options_from(arguments)
    console = Terminal()

    def say(sentence: str) -> None:
        console.print(sentence, soft_wrap=True)

    with locked("OUT", options.out, "gsplat-edu sfm", say), stage_bars(console) as progress:
        try:
            reconstruct(options, say, progress)
        except KeyboardInterrupt:
            raise KeyboardInterrupt(
                Told(
                    "interrupted; the same command resumes after the last completed stage",
                    "stopped; it can be continued after the last completed step",
                )
            ) from None
    emitter.report_output(options.out)
    say_findings(CaptureReader(options.out), say)
    say(Told(f"wrote {options.out}; next: gsplat-edu train {shlex.quote(str(options.out))} --out RUN", ""))


@contextmanager
def stage_bars(console: Console) -> Iterator[Callable[[str, int, int], None]]:
    """Show a progress bar per stage; without a terminal, lines about long stages.

    Args:
        console: Console to draw on.

    Yields:
        The progress callback for `reconstruct`.
    """
    columns = (
        TextColumn("{task.description}"),
        BarColumn(bar_width=24),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeLeft(compact=True),
    )
    with Bar(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        tasks: dict[str, TaskID] = {}

        def show(stage: str, done: int, total: int) -> None:
            if stage not in tasks:
                for task in tasks.values():
                    bar.update(task, visible=False)
                tasks[stage] = bar.add_task(stage, total=total, steady=stage != UNSTEADY)
            bar.update(tasks[stage], completed=done, total=total)

        yield show

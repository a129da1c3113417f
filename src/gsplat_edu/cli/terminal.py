"""The console for all regular output. It escapes control characters, since messages may quote names from files."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    Task,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Column
from rich.text import Text

from gsplat_edu.base.text import plain_of, printable
from gsplat_edu.jobs import emitter
from gsplat_edu.jobs.events import Message

LINE_SECONDS = 30.0
"""Least seconds between two lines about one task, if there is no terminal for a progress bar."""

LINE_SHARE = 0.05
"""Least fraction of a task's time between two lines, so that a long task does not fill a log."""

UNSTEADY = "mapping"
"""The stage of `sfm` without a forecast: each photo takes longer than the last, and it may start over."""

SPEED_SECONDS = 300.0
"""Seconds over which a task's speed is averaged: some tasks take a minute per step."""


class Terminal(Console):
    """Standard output. Text is printed literally: no markup, no emoji codes, control characters escaped."""

    def __init__(self) -> None:
        super().__init__(highlight=False, markup=False, emoji=False)

    def print(self, *objects: Any, **options: Any) -> None:  # noqa: ANN401
        """Print like rich, each text on one line; a job also reports them, in the words of a page."""
        for text in objects:
            if isinstance(text, str) and (plain := plain_of(text)):
                emitter.emit(Message(printable(plain)))
        super().print(*(printable(o) if isinstance(o, str) else o for o in objects), **options)

    def say(self, *sentences: str) -> None:
        """Print sentences, each on a line of its own however wide the terminal is."""
        self.print(*sentences, sep="\n", soft_wrap=True)

    def shows(self, characters: str) -> bool:
        """Return whether the terminal's encoding has all of these characters."""
        try:
            characters.encode(self.encoding)
        except (UnicodeError, LookupError):
            return False
        return True


class Bar(Progress):
    """Progress bars that a job also reports as events. Without a terminal, lines show the progress of long tasks.

    Args:
        columns: As for rich.
        options: As for rich.
    """

    def __init__(self, *columns: ProgressColumn | str, **options: Any) -> None:  # noqa: ANN401
        self._told: dict[TaskID, float] = {}
        """Seconds of each task at its last line."""
        super().__init__(*columns, speed_estimate_period=SPEED_SECONDS, **options)

    def update(self, task_id: TaskID, **changes: Any) -> None:  # noqa: ANN401
        """Update a task like rich."""
        super().update(task_id, **changes)
        self._report(task_id)

    def advance(self, task_id: TaskID, advance: float = 1) -> None:
        """Advance a task like rich."""
        super().advance(task_id, advance)
        self._report(task_id)

    def due(self, task_id: TaskID) -> bool:
        """Return whether a task's last line was long ago: `LINE_SECONDS`, or `LINE_SHARE` of the task's time.

        Args:
            task_id: The task. A field "lines" that is false keeps this class from printing lines for it.
        """
        elapsed = self._tasks[task_id].elapsed or 0.0
        return elapsed - self._told.get(task_id, 0.0) >= max(LINE_SECONDS, LINE_SHARE * elapsed)

    def times(self, task_id: TaskID) -> str:
        """Return the time that a task has run, and its time left.

        The time left is missing if no column of the bars forecasts it, or if the task's field "steady" is false.
        """
        task = self._tasks[task_id]
        self._told[task_id] = task.elapsed or 0.0
        said = f"{clock(task.elapsed or 0.0)} elapsed"
        if task.fields.get("steady", True) and any(isinstance(c, TimeRemainingColumn) for c in self.columns):
            remaining = task.time_remaining
            said += "" if remaining is None else f", {clock(remaining)} left"
        return said

    def _report(self, task_id: TaskID) -> None:
        task = self._tasks[task_id]
        if not task.visible:
            return
        emitter.progress(printable(task.description), task.completed, task.total, lambda: _left(task))
        if not self.console.is_terminal and task.fields.get("lines", True) and self.due(task_id):
            total = "" if task.total is None else f" of {task.total:,.0f}"
            line = f"{task.description}: {task.completed:,.0f}{total}, {self.times(task_id)}"
            # not Terminal.print: a job reports this as progress already
            Console.print(self.console, printable(line), markup=False, emoji=False, soft_wrap=True)


def _left(task: Task) -> float | None:
    """Return a task's time left; None at its end, since the time of what follows is unknown."""
    return None if task.finished else task.time_remaining


class TimeLeft(TimeRemainingColumn):
    """The time left; empty for tasks whose field "steady" is false, because their speed changes too much."""

    def render(self, task: Task) -> Text:
        """Return the time left, or nothing."""
        return super().render(task) if task.fields.get("steady", True) else Text()


def clock(seconds: float) -> str:
    """Return a time as minutes and seconds, or hours, minutes and seconds: "3:05", "1:03:05"."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"


class Field(TextColumn):
    """A progress bar column whose text may quote names from files. If the line is too long, this column is cut first.

    Args:
        text: As for rich's `TextColumn`: "{task.description}", for example.
    """

    def __init__(self, text: str) -> None:
        super().__init__(text, markup=False, table_column=Column())  # rich's own column does not shrink

    def render(self, task: Task) -> Text:
        """Return a task's text, escaped."""
        return Text(printable(self.text_format.format(task=task)), no_wrap=True, overflow="ellipsis")


@contextmanager
def stage_bars(console: Console) -> Iterator[Callable[[str, int, int], None]]:
    """Show a progress bar of the stage that runs; without a terminal, lines about long stages.

    Args:
        console: Console to draw on.

    Yields:
        The progress callback: name of the stage, steps done, all steps. A stage that comes again starts anew.
    """
    columns = (
        TextColumn("{task.description}"),
        BarColumn(bar_width=24),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeLeft(compact=True),
    )
    with Bar(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        current: tuple[str, TaskID] | None = None

        def show(stage: str, done: int, total: int) -> None:
            nonlocal current
            if current is None or current[0] != stage:
                if current is not None:
                    bar.update(current[1], visible=False)
                current = stage, bar.add_task(stage, total=total, steady=stage != UNSTEADY)
            bar.update(current[1], completed=done, total=total)

        yield show

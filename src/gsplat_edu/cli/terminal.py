"""The console for all regular output. It escapes control characters, since messages may quote names from files."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, NamedTuple

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

SPEED_SECONDS = 300.0
"""Seconds over which a task's speed is averaged: some tasks take a minute per step."""


class Growth(NamedTuple):
    """Forecast of a stage whose steps take longer and longer: the time of n steps grows with n^power.

    Args:
        power: The exponent.
        share: Fraction of the stage's time that all steps take; the rest follows the last step.
        least: Fraction of the steps from which on the forecast is shown.
    """

    power: float
    share: float
    least: float

    def left(self, task: Task) -> float | None:
        """Return the time left, s; None if it is unknown.

        Args:
            task: The task; its field "reached" is the time after which its latest step was done, s.
        """
        done = task.completed / task.total if task.total else 0.0
        if done < self.least:
            return None
        left = task.fields["reached"] / (self.share * done**self.power) - (task.elapsed or 0.0)
        return left if left > 0 else None


GROWS: Mapping[str, Growth] = {"mapping": Growth(power=1.2, share=0.66, least=0.2)}
"""Stages whose steps take longer and longer. In `sfm`, each photo that gets a pose is adjusted with those before it;
after the last one, all are adjusted again, and the lens is chosen. Of the processor time for snowmiku97 (32 s), 9 % had
passed at 18 of 97 photos, 28 % at 42, and 68 % at all; of that for fox (35 s), 65 % at all."""


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

    def elapsed(self, task_id: TaskID) -> float:
        """Return the time that a task has run, s."""
        return self._tasks[task_id].elapsed or 0.0

    def due(self, task_id: TaskID) -> bool:
        """Return whether a task's last line was long ago: `LINE_SECONDS`, or `LINE_SHARE` of the task's time.

        Args:
            task_id: The task. A field "lines" that is false keeps this class from printing lines for it.
        """
        elapsed = self.elapsed(task_id)
        return elapsed - self._told.get(task_id, 0.0) >= max(LINE_SECONDS, LINE_SHARE * elapsed)

    def times(self, task_id: TaskID) -> str:
        """Return the time that a task has run, and its time left.

        The time left is missing if no column of the bars forecasts it.
        """
        task = self._tasks[task_id]
        self._told[task_id] = self.elapsed(task_id)
        said = f"{clock(self.elapsed(task_id))} elapsed"
        if any(isinstance(column, TimeRemainingColumn) for column in self.columns):
            remaining = time_left(task)
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
    return None if task.finished and "growth" not in task.fields else time_left(task)


def time_left(task: Task) -> float | None:
    """Return the time left of a task, s, by its speed, or by the `Growth` in its field "growth"; None if unknown."""
    growth: Growth | None = task.fields.get("growth")
    return task.time_remaining if growth is None else growth.left(task)


class TimeLeft(TimeRemainingColumn):
    """The time left, also of tasks with a field "growth"."""

    def render(self, task: Task) -> Text:
        """Return the time left, or nothing."""
        if "growth" not in task.fields:
            return super().render(task)
        left = time_left(task)
        return Text("" if left is None else clock(left), style="progress.remaining")


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
        before = 0

        def show(stage: str, done: int, total: int) -> None:
            nonlocal current, before
            starts_over = stage in GROWS and done < before
            if current is None or current[0] != stage or starts_over:
                if current is not None:
                    bar.update(current[1], visible=False)
                fields: dict[str, Any] = {"growth": GROWS[stage], "reached": 0.0} if stage in GROWS else {}
                current, before = (stage, bar.add_task(stage, total=total, **fields)), 0
            changes = {"reached": bar.elapsed(current[1])} if stage in GROWS and done > before else {}
            before = done
            bar.update(current[1], completed=done, total=total, **changes)

        yield show

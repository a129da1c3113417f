"""The console for all regular output. It escapes control characters, since messages may quote names from files."""

from __future__ import annotations

from typing import Any

from rich.console import Console
from rich.progress import Progress, Task, TaskID, TextColumn
from rich.text import Text

from gsplat_edu.jobs import emitter
from gsplat_edu.jobs.events import Message
from gsplat_edu.text import printable


class Terminal(Console):
    """Standard output. Text is printed literally: no markup, no emoji codes, control characters escaped."""

    def __init__(self) -> None:
        super().__init__(highlight=False, markup=False, emoji=False)

    def print(self, *objects: Any, **options: Any) -> None:  # noqa: ANN401
        """Print like rich, each text on one line; a job also reports them (`gsplat_edu.jobs`)."""
        for text in objects:
            if isinstance(text, str):
                emitter.emit(Message(printable(text)))
        super().print(*(printable(o) if isinstance(o, str) else o for o in objects), **options)

    def shows(self, characters: str) -> bool:
        """Return whether the terminal's encoding has all of these characters."""
        try:
            characters.encode(self.encoding)
        except (UnicodeError, LookupError):
            return False
        return True


class Bar(Progress):
    """Progress bars that a job also reports as events."""

    def update(self, task_id: TaskID, **changes: Any) -> None:  # noqa: ANN401
        """Update a task like rich."""
        super().update(task_id, **changes)
        self._report(task_id)

    def advance(self, task_id: TaskID, advance: float = 1) -> None:
        """Advance a task like rich."""
        super().advance(task_id, advance)
        self._report(task_id)

    def _report(self, task_id: TaskID) -> None:
        task = self._tasks[task_id]
        if task.visible:
            emitter.progress(
                printable(task.description), task.completed, task.total, lambda: task.time_remaining
            )


class Field(TextColumn):
    """A progress bar column whose text may quote names from files.

    Args:
        text: As for rich's `TextColumn`: "{task.description}", for example.
    """

    def __init__(self, text: str) -> None:
        super().__init__(text, markup=False)

    def render(self, task: Task) -> Text:
        """Return a task's text, escaped."""
        return Text(printable(self.text_format.format(task=task)))

"""The console for all regular output. It escapes control characters, since messages may quote names from files."""

from __future__ import annotations

from typing import Any

from rich.console import Console
from rich.progress import Task, TextColumn
from rich.text import Text

from gsplat_edu.text import printable


class Terminal(Console):
    """Standard output. Text is printed literally: no markup, no emoji codes, control characters escaped."""

    def __init__(self) -> None:
        super().__init__(highlight=False, markup=False, emoji=False)

    def print(self, *objects: Any, **options: Any) -> None:  # noqa: ANN401
        """Print like rich, each text on one line."""
        super().print(*(printable(o) if isinstance(o, str) else o for o in objects), **options)

    def shows(self, characters: str) -> bool:
        """Return whether the terminal's encoding has all of these characters."""
        try:
            characters.encode(self.encoding)
        except (UnicodeError, LookupError):
            return False
        return True


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

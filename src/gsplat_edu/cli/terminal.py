"""The one way to the terminal: sentences may quote names from files, so what could command a terminal is escaped."""

from __future__ import annotations

from typing import Any

from rich.console import Console
from rich.progress import Task, TextColumn
from rich.text import Text

from gsplat_edu.text import printable


class Terminal(Console):
    """Standard output. Text is printed as it is: no markup, no emoji codes, and control characters are escaped."""

    def __init__(self) -> None:
        super().__init__(highlight=False, markup=False, emoji=False)

    def print(self, *objects: Any, **options: Any) -> None:  # noqa: ANN401
        """Print as rich does, each piece of text on its one line."""
        super().print(*(printable(o) if isinstance(o, str) else o for o in objects), **options)

    def shows(self, characters: str) -> bool:
        """Say whether the terminal's encoding has all of these characters."""
        try:
            characters.encode(self.encoding)
        except (UnicodeError, LookupError):
            return False
        return True


class Field(TextColumn):
    """A column of a progress bar whose text may quote names.

    Args:
        text: As for rich's `TextColumn`: "{task.description}", for example.
    """

    def __init__(self, text: str) -> None:
        super().__init__(text, markup=False)

    def render(self, task: Task) -> Text:
        """Return the text of a task, escaped."""
        return Text(printable(self.text_format.format(task=task)))

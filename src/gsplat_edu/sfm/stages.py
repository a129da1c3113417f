"""Which stages are finished: what lets an interrupted run go on."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from gsplat_edu.errors import DatasetError
from gsplat_edu.files import written_aside
from gsplat_edu.reading import parse_json, read_text


class Stages:
    """The stages of a run, in a file that is whole at any time.

    A stage has options: whatever its outcome depends on, beside the stages before it. When they differ from
    those before, it and all that follow are forgotten.

    Args:
        path: stages.json; it need not be there.
        say: Told why stages are done again.

    Raises:
        DatasetError: the file is damaged.
    """

    def __init__(self, path: Path, say: Callable[[str], None]) -> None:
        self.path, self._say = path, say
        self._stages: dict[str, dict[str, Any]] = {}
        if path.is_file():
            try:
                self._stages = parse_json(read_text(path))["stages"]
                if not all({"options", "facts"} <= stage.keys() for stage in self._stages.values()):
                    raise ValueError
            except (ValueError, KeyError, TypeError, AttributeError):
                raise DatasetError(
                    f"{path}: is damaged; remove {path.parent}, and the same command begins anew"
                ) from None

    @property
    def any_finished(self) -> bool:
        """Whether there is something to resume."""
        return any(stage["facts"] is not None for stage in self._stages.values())

    def finished(self, name: str, options: dict[str, Any]) -> dict[str, Any] | None:
        """Return what a finished stage left to say; None where it is not finished, or was with other options.

        Args:
            name: The stage.
            options: What they are now, as JSON has them.
        """
        known = self._stages.get(name)
        if known is None:
            return None
        if known["options"] == options:
            facts: dict[str, Any] | None = known["facts"]
            return facts
        changed = [key for key in options if known["options"].get(key) != options[key]]
        self._say(f"{name}: {', '.join(changed) or 'options'} differ from those before; again from here")
        self.forget(name)
        return None

    def begun(self, name: str, options: dict[str, Any]) -> bool:
        """Note that a stage begins.

        Returns:
            Whether it goes on with what an interrupted one with the same options left.
        """
        goes_on = name in self._stages
        self._stages[name] = {"options": options, "facts": None}
        self._write()
        return goes_on

    def end(self, name: str, facts: dict[str, Any]) -> None:
        """Note that a stage is finished, and what it found out."""
        self._stages[name]["facts"] = facts
        self._write()

    def forget(self, name: str) -> None:
        """Forget a stage and those that were begun after it."""
        if name in self._stages:
            kept = list(self._stages)[: list(self._stages).index(name)]
            self._stages = {stage: self._stages[stage] for stage in kept}
            self._write()

    def _write(self) -> None:
        with written_aside(self.path) as aside:
            aside.write_text(json.dumps({"stages": self._stages}, indent=1) + "\n", encoding="utf-8")

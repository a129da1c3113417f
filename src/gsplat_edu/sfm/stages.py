"""Records completed stages, so that an interrupted run can resume."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from gsplat_edu.errors import DatasetError
from gsplat_edu.files import written_aside
from gsplat_edu.reading import parse_json, read_text


class Stages:
    """The stages of a run, stored in a file that is always complete.

    A stage has options: everything that determines its result, apart from earlier stages. If they change, the stage and
        all later ones are discarded.

    Args:
        path: stages.json; it need not exist.
        say: Called with the reason when stages are repeated.

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
                    f"{path}: is damaged; remove {path.parent} and run the same command again"
                ) from None

    @property
    def any_finished(self) -> bool:
        """Whether there is a stage to resume from."""
        return any(stage["facts"] is not None for stage in self._stages.values())

    def finished(self, name: str, options: dict[str, Any]) -> dict[str, Any] | None:
        """Return the facts recorded by a completed stage; None if it is incomplete or had other options.

        Args:
            name: The stage.
            options: The current options, as JSON values.
        """
        known = self._stages.get(name)
        if known is None:
            return None
        if known["options"] == options:
            facts: dict[str, Any] | None = known["facts"]
            return facts
        changed = [key for key in options if known["options"].get(key) != options[key]]
        self._say(
            f"{name}: {', '.join(changed) or 'options'} changed; repeating this stage and the later ones"
        )
        self.forget(name)
        return None

    def begin(self, name: str, options: dict[str, Any]) -> bool:
        """Record the start of a stage.

        Returns:
            Whether it resumes an interrupted stage with the same options.
        """
        resumes = name in self._stages
        self._stages[name] = {"options": options, "facts": None}
        self._write()
        return resumes

    def end(self, name: str, facts: dict[str, Any]) -> None:
        """Record the completion of a stage and its facts."""
        self._stages[name]["facts"] = facts
        self._write()

    def forget(self, name: str) -> None:
        """Discard a stage and those started after it."""
        if name in self._stages:
            kept = list(self._stages)[: list(self._stages).index(name)]
            self._stages = {stage: self._stages[stage] for stage in kept}
            self._write()

    def _write(self) -> None:
        with written_aside(self.path) as aside:
            aside.write_text(json.dumps({"stages": self._stages}, indent=1) + "\n", encoding="utf-8")

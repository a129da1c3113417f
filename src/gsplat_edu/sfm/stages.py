"""Records completed stages, so that an interrupted run can resume."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from gsplat_edu.base.errors import DatasetError
from gsplat_edu.base.files import written_aside
from gsplat_edu.base.reading import parse_json, read_text
from gsplat_edu.base.records import LARGEST_NUMBER
from gsplat_edu.base.text import names_a_file


def _text(value: object) -> bool:
    return isinstance(value, str) and names_a_file(value)


def _whole(value: object) -> bool:
    return type(value) is int and 0 <= value < 2**31


def _number(value: object) -> bool:
    return type(value) in (int, float) and abs(value) < LARGEST_NUMBER  # type: ignore[arg-type]


def _texts(value: object) -> bool:
    return isinstance(value, list) and all(map(_text, value))


def _model(value: object) -> bool:
    return isinstance(value, str) and _MODEL.fullmatch(value) is not None


def _panoramas(value: object) -> bool:
    """Accept objects with a name, the names of faces, and a place; a name of a face is a file beside the others."""
    return isinstance(value, list) and all(
        isinstance(one, dict)
        and _text(one.get("name"))
        and _texts(one.get("faces"))
        and one["faces"]
        and all(_PLAIN.fullmatch(face) for face in one["faces"])
        and (one.get("place") is None or _place(one["place"]))
        for one in value
    )


def _place(value: object) -> bool:
    return isinstance(value, list) and len(value) == 3 and all(map(_number, value))


_MODEL = re.compile(r"models/\d{1,4}/\d{1,4}")
"""Folder of a model, relative to the work folder."""

_PLAIN = re.compile(r"(?!\.)[^/\\\0]{1,255}")
"""Name of a file without a folder."""

Check = Callable[[object], bool]

FACTS: Mapping[str, Mapping[str, Check]] = {
    "frames": {},
    "faces": {"panoramas": _panoramas},
    "photos": {"names": _texts},
    "features": {"few": _texts},
    "more features": {},
    "matches": {"connected": _whole},
    "mapping": {"folder": _model, "names": _texts, "doubtful": _texts, "unclear": _texts},
    "capture": {},
}
"""The facts that a resumed run uses, by stage. Each also has "summary", for the user."""


def are_facts(name: str, facts: object) -> bool:
    """Return whether these are facts of a stage; the file may come from somebody else."""
    checks = {"summary": _text, **FACTS[name]}
    return isinstance(facts, dict) and all(check(facts.get(field)) for field, check in checks.items())


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
                if not all(
                    {"options", "facts"} <= stage.keys() and isinstance(stage["options"], dict)
                    for stage in self._stages.values()
                ):
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

        Raises:
            DatasetError: the facts are damaged.
        """
        known = self._stages.get(name)
        if known is None:
            return None
        if known["options"] == options:
            facts = known["facts"]
            if facts is not None and not are_facts(name, facts):
                raise DatasetError(
                    f"{self.path}: stages.{name}.facts: is damaged; remove {self.path.parent} and run the same command"
                    " again"
                )
            return facts  # type: ignore[no-any-return]
        changed = [key for key in known["options"] | options if known["options"].get(key) != options.get(key)]
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

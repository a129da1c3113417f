"""Records completed stages, so that an interrupted run can resume."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any

from msgspec import Meta

from gsplat_edu.base.errors import ArgumentError, DatasetError
from gsplat_edu.base.files import written_aside
from gsplat_edu.base.reading import parse_json, read_text
from gsplat_edu.base.records import Number, Record, Text, record_of

Model = Annotated[str, Meta(pattern=r"^models/\d{1,4}/\d{1,4}\Z(?#the folder of a model)")]
FileName = Annotated[
    str, Meta(pattern=r"^(?!\.)[^/\\\x00\ud800-\udc7f\udd00-\udfff]{1,255}\Z(?#a file name)")
]
Count = Annotated[int, Meta(ge=0, le=2**31 - 1)]


class Facts(Record, frozen=True, forbid_unknown_fields=False):
    """The facts of a stage that a resumed run uses; `summary` is for the user."""

    summary: Text


class _Panorama(Record, frozen=True, forbid_unknown_fields=False):
    name: Text
    faces: Annotated[tuple[FileName, ...], Meta(min_length=1)]
    place: tuple[Number, Number, Number] | None = None


class _Faces(Facts, frozen=True):
    panoramas: tuple[_Panorama, ...]


class _Photos(Facts, frozen=True):
    names: tuple[Text, ...]


class _Features(Facts, frozen=True):
    few: tuple[Text, ...]


class _Matches(Facts, frozen=True):
    connected: Count
    matched: Count = 0
    kind: Text = ""


class _Mapping(Facts, frozen=True):
    folder: Model
    names: tuple[Text, ...]
    doubtful: tuple[Text, ...]
    unclear: tuple[Text, ...]
    held: bool = False


FACTS: Mapping[str, type[Facts]] = {
    "frames": Facts,
    "faces": _Faces,
    "photos": _Photos,
    "features": _Features,
    "more features": Facts,
    "matches": _Matches,
    "mapping": _Mapping,
    "more matches": _Matches,
    "mapping again": _Mapping,
    "capture": Facts,
}


class _Stage(Record, frozen=True, forbid_unknown_fields=False):
    options: dict[str, Any]
    facts: Any


class _File(Record, frozen=True, forbid_unknown_fields=False):
    stages: dict[str, Any]


def read_stages(path: Path) -> dict[str, dict[str, Any]]:
    """Return the stages in a file, each with "options" and "facts".

    Raises:
        ArgumentError: the file does not have them; the message names the field.
        OSError: the file cannot be read.
        ValueError: the file is not JSON.
    """
    file: _File = record_of("", parse_json(read_text(path)), _File)
    for name, stage in file.stages.items():
        record_of(f"stages.{name}", stage, _Stage)
    return file.stages


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
                self._stages = read_stages(path)
            except ValueError as error:
                reason = error if isinstance(error, ArgumentError) else "is not JSON"
                raise DatasetError(
                    f"{path}: {reason}; remove {path.parent} and run the same command again"
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
            if facts is not None:
                try:
                    record_of(f"stages.{name}.facts", facts, FACTS[name])
                except ArgumentError as error:
                    raise DatasetError(
                        f"{self.path}: {error}; remove {self.path.parent} and run the same command again"
                    ) from None
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

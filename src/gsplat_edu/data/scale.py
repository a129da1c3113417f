"""The scale of a capture's coordinates and their place on earth, if known: scale.json beside images/ and sparse/."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import msgspec

from gsplat_edu.base.errors import DatasetError
from gsplat_edu.base.files import unreadable, written_aside
from gsplat_edu.base.reading import parse_json, read_text
from gsplat_edu.base.records import record_of
from gsplat_edu.scene.earth import Earth

SCALE_FILE = "scale.json"
"""Name of the file in a capture's folder."""


class _Stored(msgspec.Struct):
    """A scale as files store it; the place on earth is the text of `Earth`."""

    unit: str
    source: str
    detail: str = ""
    level: bool = False
    earth: str | None = None


@dataclass(frozen=True)
class Scale:
    """What one unit of the coordinates is, and how it is known.

    Args:
        unit: "m", "cm" or "mm"; one unit of the coordinates is one of these.
        source: "GPS" or "a given distance".
        detail: Accuracy of the scale, in words.
        level: Whether up is (0, -1, 0) by GPS; otherwise it is the mean up direction of the photos.
        earth: Where on earth the coordinates are; None if unknown.
    """

    unit: str
    source: str
    detail: str = ""
    level: bool = False
    earth: Earth | None = None

    def __str__(self) -> str:
        """Return the sentence for the user."""
        return f"1 unit = 1 {self.unit}, from {self.source}" + f" ({self.detail})" * bool(self.detail)

    def json(self) -> dict[str, Any]:
        """Return the fields as JSON values, the place on earth as text."""
        return asdict(self) | {"earth": None if self.earth is None else str(self.earth)}

    @classmethod
    def parsed(cls, where: str, value: object) -> Scale | None:
        """Return the scale that `json` described; None for None.

        Args:
            where: Its place in the file; empty for the whole file.
            value: The JSON.

        Raises:
            ArgumentError: a field has another type, or the place on earth is malformed.
        """
        stored: _Stored | None = record_of(where, value, _Stored | None)
        if stored is None:
            return None
        return cls(stored.unit, stored.source, stored.detail, stored.level, Earth.parsed(stored.earth))


def read_scale(folder: Path) -> Scale | None:
    """Read the scale of a capture; None if it is unknown.

    Args:
        folder: The capture.

    Raises:
        DatasetError: the file is damaged.
    """
    path = folder / SCALE_FILE
    if not path.is_file():
        return None
    try:
        return Scale.parsed("", parse_json(read_text(path)))
    except OSError as error:
        raise DatasetError(unreadable(path, error)) from None
    except ValueError as error:
        raise DatasetError(f"{path}: is damaged ({error}); remove it, or make the capture again") from None


def write_scale(folder: Path, scale: Scale) -> None:
    """Write the scale of a capture.

    Args:
        folder: The capture.
        scale: Its scale.

    Raises:
        OSError: the file cannot be written.
    """
    with written_aside(folder / SCALE_FILE) as aside:
        aside.write_text(json.dumps(scale.json(), indent=1) + "\n", encoding="utf-8")

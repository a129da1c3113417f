"""Choose the settings of `gsplat-edu train` that are auto: the parts of a training choose theirs by its capture."""

from __future__ import annotations

from collections.abc import Sequence

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.text import option_flag
from gsplat_edu.survey.capture import Undecided
from gsplat_edu.survey.finding import Remedy
from gsplat_edu.train.part import parts


def remedies_for(capture: Undecided, names: Sequence[str]) -> dict[str, Remedy]:
    """Choose settings for a capture. Its photos are read once, and only if a choice needs them.

    Args:
        capture: The capture.
        names: Names of the settings.

    Raises:
        DatasetError: there is no capture, or its poses cannot be read. Unreadable photos raise no error.
        ArgumentError: no part chooses a setting.
    """
    return {name: _remedy(capture, name) for name in names}


def _remedy(capture: Undecided, name: str) -> Remedy:
    for part in parts().values():
        remedy: Remedy | None = part.choose(name, capture)
        if remedy is not None:
            return remedy
    raise ArgumentError(f"{option_flag(name)}: is auto, but nothing chooses it; give a value")

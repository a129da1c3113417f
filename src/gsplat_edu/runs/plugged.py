"""What plug-ins say of a run that used them: sections of the report and findings of the doctor."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from gsplat_edu.train.config import BY_NAME, TrainConfig
from gsplat_edu.train.part import PLUGGED_PARTS, Part


def plugin_sections(
    config: Mapping[str, Any], log: Sequence[Mapping[str, Any]]
) -> list[tuple[str, Sequence[str]]]:
    """Return heading and sentences of each section that a plug-in adds to the report of a run.

    Args:
        config: The run's config.json.
        log: The entries of its log.
    """
    said = ((name, part.section(settings, log)) for name, part, settings in _used(config))
    return [(name, sentences) for name, sentences in said if sentences]


def plugin_findings(config: Mapping[str, Any], run: Path) -> list[tuple[str, str]]:
    """Return what plug-ins find in a run: sentences, each with what to do about it.

    Args:
        config: The run's config.json.
        run: Its folder.
    """
    return [said for _, part, settings in _used(config) for said in part.findings(settings, run)]


def _used(config: Mapping[str, Any]) -> Iterator[tuple[str, Part, Any]]:
    """Yield the installed parts that a run used, by name, with their settings in the run."""
    used, stored = config.get("plugins", {}), config.get("train", {})
    own = {name: stored[name] for name in stored if name in BY_NAME and BY_NAME[name].part in used}
    settings = TrainConfig().changed(**own).plugged
    for name, part in PLUGGED_PARTS.items():
        if name in used:
            yield name, part, settings[name]

"""What the parts of a training say of a run: sections of the report and findings of the doctor."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

from gsplat_edu.base.errors import ArgumentError, CheckpointError
from gsplat_edu.train.config import BY_NAME, TrainConfig
from gsplat_edu.train.part import PLUGGED_PARTS, Part, parts

if TYPE_CHECKING:  # they import torch
    from gsplat_edu.evaluate.report_parts import Section
    from gsplat_edu.parts.run_values import Reported
    from gsplat_edu.survey.finding import Examined
    from gsplat_edu.survey.trained import Trained


def sections(run: Reported) -> list[Section]:
    """Return the sections that parts add to the report of a run.

    Raises:
        CheckpointError: config.json has a setting that is out of range.
        DatasetError: a photo cannot be read.
    """
    found = (part.section(settings, run) for part, settings in _used(run.config))
    return [section for section in found if section is not None]


def scored(config: Mapping[str, Any]) -> dict[str, Any]:
    """Return what parts add to the scores in metrics.json.

    Args:
        config: The run's config.json.

    Raises:
        CheckpointError: config.json has a setting that is out of range.
    """
    return {key: value for part, settings in _used(config) for key, value in part.scored(settings).items()}


def judgements(config: Mapping[str, Any], run: Trained) -> list[Examined]:
    """Return what the parts of a run's training find in it.

    Args:
        config: The run's config.json.
        run: The run.

    Raises:
        CheckpointError: config.json has a setting that is out of range.
        DatasetError: a photo cannot be read.
    """
    found = (part.judge(settings, run) for part, settings in _used(config))
    return [one for one in found if one is not None]


def recorded(asked: Mapping[str, str]) -> dict[str, Any]:
    """Return what the section data of config.json says of what the user asked of parts.

    Args:
        asked: As in `gsplat_edu.runs.options.RunOptions`.
    """
    said = (part.recorded(asked.get(name)).items() for name, part in parts().items())
    return {key: value for items in said for key, value in items if value is not None}


def stored_config(config: Mapping[str, Any]) -> TrainConfig:
    """Return the configuration in a run's config.json, without settings of plug-ins that are not installed.

    Raises:
        CheckpointError: a setting is out of range.
    """
    plugins, stored = config.get("plugins", {}), config.get("train", {})
    try:
        own = {
            name: stored[name]
            for name in stored
            if name in BY_NAME and BY_NAME[name].plugin in (None, *plugins)
        }
        return TrainConfig.of_record(own)
    except (ArgumentError, TypeError) as error:
        raise CheckpointError(f"config.json: train: {error}; fix the file") from None


def _used(config: Mapping[str, Any]) -> Iterator[tuple[Part, Any]]:
    """Yield our parts, and those plug-ins that a run used and that are installed, with their settings in the run."""
    settings = stored_config(config)
    for name, part in parts().items():
        if name not in PLUGGED_PARTS or name in config.get("plugins", {}):
            yield part, settings.settings_of(name)

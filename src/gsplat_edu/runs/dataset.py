"""Reload the dataset of a run as its config.json describes it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from gsplat_edu.base.errors import ArgumentError, CheckpointError
from gsplat_edu.base.reading import stored_path
from gsplat_edu.data.dataset import Dataset, DataSettings
from gsplat_edu.data.reader import CaptureReader
from gsplat_edu.runs.options import RunOptions
from gsplat_edu.runs.parts import stored_config
from gsplat_edu.train.config import TrainConfig
from gsplat_edu.train.part import parts


def as_trained(settings: DataSettings, config: TrainConfig) -> DataSettings:
    """Return the settings with which a training reads photos: what its parts make of those given."""
    for name, part in parts().items():
        settings = part.reads(config.settings_of(name), settings)
    return settings


def data_settings(config: dict[str, Any]) -> DataSettings:
    """Build the data settings of a run from its config; keys missing in the section "data" get their defaults.

    Raises:
        CheckpointError: the section is missing, or a value of it or of the section "train" is out of range.
    """
    section = config.get("data")
    if not isinstance(section, dict):
        raise CheckpointError("config.json: the section data is missing; restore it or train again")
    try:
        return as_trained(DataSettings.of_record(section), stored_config(config))
    except (ArgumentError, TypeError) as error:
        raise CheckpointError(f"config.json: data: {error}; fix the file") from None


def run_dataset(config: dict[str, Any], path: Path | None = None) -> Dataset:
    """Load the views that a run was trained on. Start points from a separate file are not reloaded.

    Args:
        config: The run's config.json.
        path: As for `run_reader`.

    Raises:
        CheckpointError: as for `run_reader`.
        DatasetError: the dataset cannot be read.
    """
    return Dataset.of(run_reader(config, path), data_settings(config))


def run_reader(config: dict[str, Any], path: Path | None = None) -> CaptureReader:
    """Return the reader of a run's capture.

    Args:
        config: The run's config.json.
        path: Current path of the dataset; the one in config.json if None.

    Raises:
        CheckpointError: config.json does not name the dataset by a path of this computer, or its settings are damaged.
    """
    reading = data_settings(config).reading
    if path is None:
        named = config["data"].get("path")
        path = stored_path(named)
        if path is None:
            raise CheckpointError(
                "config.json: data: path: is not a path of this computer; give the dataset's folder with --dataset PATH"
            )
        if not path.exists():
            raise CheckpointError(
                f"{named}: the run's dataset no longer exists; give its folder with --dataset PATH"
            )
    return CaptureReader(path, reading)


def reader_for(options: RunOptions, given: CaptureReader | None) -> CaptureReader:
    """Return the reader that a caller was given, under the reading of a run, or make one if there is none.

    Args:
        options: The run.
        given: The reader of its capture, or None.

    Raises:
        ArgumentError: the reader is that of another capture.
    """
    path, reading = options.data, options.data_settings.reading
    if given is None:
        return CaptureReader(path, reading)
    if given.path != path:
        raise ArgumentError(f"reader: reads {given.path}, but the run's capture is {path}; make one for that")
    return given.under(reading)

"""Reload the dataset of a run as its config.json describes it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from gsplat_edu.data.dataset import Dataset, DataSettings, load_dataset
from gsplat_edu.errors import ArgumentError, CheckpointError


def data_settings(config: dict[str, Any]) -> DataSettings:
    """Build the data settings of a run from the section "data" of its config; missing keys get their defaults.

    Raises:
        CheckpointError: the section is missing, or a value is out of range.
    """
    section = config.get("data")
    if not isinstance(section, dict):
        raise CheckpointError("config.json: the section data is missing; restore it or train again")
    keys = ("resolution", "test_every", "background", "image_memory")
    values = {key: section[key] for key in keys if key in section}
    if isinstance(values.get("background"), list):
        values["background"] = tuple(values["background"])
    try:
        return DataSettings(**values)
    except (ArgumentError, TypeError) as error:
        raise CheckpointError(f"config.json: data: {error}; fix the file") from None


def run_dataset(config: dict[str, Any], path: Path | None = None) -> Dataset:
    """Load the views that a run was trained on. Start points from a separate file are not reloaded.

    Args:
        config: The run's config.json.
        path: Current path of the dataset; the one in config.json if None.

    Raises:
        CheckpointError: config.json does not name the dataset, or its settings are damaged.
        DatasetError: the dataset cannot be read.
    """
    settings = data_settings(config)
    place = config["data"].get("path")
    if path is None and not isinstance(place, str):
        raise CheckpointError(
            "config.json: data: path is missing; give the dataset's folder with --dataset PATH"
        )
    if path is None and not Path(place).exists():
        raise CheckpointError(
            f"{place}: the run's dataset no longer exists; give its folder with --dataset PATH"
        )
    return load_dataset(path or Path(place), settings)

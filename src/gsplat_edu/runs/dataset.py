"""The dataset of a run, read again as its config.json says."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from gsplat_edu.data.dataset import Dataset, DataSettings, load_dataset
from gsplat_edu.errors import ArgumentError, CheckpointError


def data_settings(config: dict[str, Any]) -> DataSettings:
    """Build the data settings of a run from the section "data" of its config; defaults for what it leaves out.

    Raises:
        CheckpointError: the section is not there, or a value is out of its range.
    """
    section = config.get("data")
    if not isinstance(section, dict):
        raise CheckpointError("config.json: lacks the section data; write it again or train again")
    keys = ("resolution", "test_every", "background", "image_memory")
    values = {key: section[key] for key in keys if key in section}
    if isinstance(values.get("background"), list):
        values["background"] = tuple(values["background"])
    try:
        return DataSettings(**values)
    except (ArgumentError, TypeError) as error:
        raise CheckpointError(f"config.json: data: {error}; mend the file") from None


def run_dataset(config: dict[str, Any], path: Path | None = None) -> Dataset:
    """Load the dataset that a run was trained on, for its views: start points given apart are not read again.

    Args:
        config: The run's config.json.
        path: Where the dataset is now; where config.json says so if None.

    Raises:
        CheckpointError: config.json does not say which dataset it was, or its settings are damaged.
        DatasetError: the dataset cannot be read.
    """
    settings = data_settings(config)
    place = config["data"].get("path")
    if path is None and not isinstance(place, str):
        raise CheckpointError(
            "config.json: data: names no path; give the dataset's folder with --dataset PATH"
        )
    if path is None and not Path(place).exists():
        raise CheckpointError(
            f"{place}: the run's dataset is no longer there; name its folder with --dataset PATH"
        )
    return load_dataset(path or Path(place), settings)

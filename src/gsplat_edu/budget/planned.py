"""The values that a plan chose: as options that reproduce a training, and as a resumed run takes them up."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection

from gsplat_edu.base.errors import ArgumentError, CheckpointError
from gsplat_edu.runs.options import RunOptions
from gsplat_edu.train.config import BY_NAME, MILESTONES, ONLY_FOR, recipe

PLANNED = ("iterations", "tempo", *MILESTONES, "densify_every", "max_gaussians", "resolution", "image_memory")
"""Settings that a plan may choose; `given` lists those that the user set."""


def flags(options: RunOptions, given: Collection[str] = (), *, photos: bool = False) -> str:
    """Return the values that a plan chose as command-line options that reproduce the training.

    Args:
        options: The run.
        given: Names of options that the user gave, which are left out.
        photos: Include the memory for photos, which does not affect the result.
    """
    config, settings = options.config, options.data_settings
    words = []
    if "resolution" not in given and settings.resolution is not None:
        words.append(f"--resolution {settings.resolution:g}")
    if photos and "image_memory" not in given:
        words.append(f"--image-memory {-(-settings.image_memory // 2**20)}MiB")
    if "max_gaussians" not in given and config.max_gaussians is not None:
        words.append(f"--max-gaussians {config.max_gaussians}")
    if "iterations" not in given:
        words.append(f"--iterations {config.iterations}")
        chosen, scaled = (
            config.flat(),
            recipe(config.iterations, strategy=config.strategy, tempo=config.tempo).flat(),
        )
        idle = {name for key, names in ONLY_FOR.items() if key != config.strategy for name in names}
        words += [
            BY_NAME[name].with_value(chosen[name])
            for name in MILESTONES
            if name not in {*given, *idle} and chosen[name] != scaled[name]
        ]
        words += [BY_NAME["tempo"].with_value(config.tempo)] if config.tempo else []
    return " ".join(words)


def taken_up(options: RunOptions, given: Collection[str]) -> RunOptions:
    """Return the options of a run to resume; config.json supplies the planned values that the user did not give.

    Args:
        options: Options from the command line.
        given: Names of `PLANNED` that the user gave.

    Raises:
        CheckpointError: config.json is damaged.
    """
    stored = options.folder.read_config()
    sections = [stored.get(name) for name in ("train", "data")]
    if not all(isinstance(section, dict) for section in sections):
        raise CheckpointError(f"{options.folder.config}: lacks the section train or data; restore the file")
    train, data = (
        {name: section[name] for name in PLANNED if name in section and name not in given}  # type: ignore[index,operator]
        for section in sections
    )
    try:
        return dataclasses.replace(
            options,
            config=options.config.changed(**train),
            data_settings=dataclasses.replace(options.data_settings, **data),
        )
    except ArgumentError as error:
        raise CheckpointError(f"{options.folder.config}: {error}; correct the file") from None

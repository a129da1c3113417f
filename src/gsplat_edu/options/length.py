"""The strategy and the length that the options of `gsplat-edu train` ask for."""

from __future__ import annotations

import argparse

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.validation import one_of
from gsplat_edu.runs.folder import RunFolder
from gsplat_edu.train.capacity import PLANNED_VIEWS
from gsplat_edu.train.config import DEFAULT_STRATEGY, RECIPE_ITERATIONS
from gsplat_edu.train.length import DEFAULT_QUALITY, QUALITIES, planned_iterations


def strategy_of(arguments: argparse.Namespace) -> str:
    """Return the strategy: that given, that of the run to resume, or the default."""
    if arguments.strategy is not None:
        return str(arguments.strategy)
    folder = RunFolder(arguments.out)
    stored = folder.read_config().get("train") if arguments.resume and folder.exists() else None
    found = stored.get("strategy") if isinstance(stored, dict) else None
    return DEFAULT_STRATEGY if found is None else str(found)


def quality_of(arguments: argparse.Namespace) -> str | None:
    """Return the quality that decides on the iterations; None if they are given, follow from a limit, or are stored."""
    if arguments.quality is not None:
        return str(arguments.quality)
    stored = arguments.resume and RunFolder(arguments.out).exists()
    open_ = arguments.iterations is None and arguments.time_limit is None and not stored
    return DEFAULT_QUALITY if open_ and strategy_of(arguments) == "fast" else None


def length_of(arguments: argparse.Namespace, strategy: str) -> int:
    """Return the iterations: those given, or those of the quality or the recipe, as whole batches."""
    fast, quality = strategy == "fast", arguments.quality
    if quality is not None:
        one_of("--quality", quality, tuple(QUALITIES))
        if not fast:
            raise ArgumentError(
                "--quality: is the length of --strategy fast; leave it out or choose that strategy"
            )
        if arguments.iterations is not None or arguments.time_limit is not None:
            raise ArgumentError(
                "--quality: --iterations or --time-limit already says how long; leave one of them out"
            )
    if arguments.iterations is not None:
        return int(arguments.iterations)
    # Of a usual capture: `gsplat_edu.budget.plan.plan` replaces it once the capture is read.
    length = planned_iterations(quality or DEFAULT_QUALITY, PLANNED_VIEWS) if fast else RECIPE_ITERATIONS
    return length + -length % max(arguments.batch or 1, 1)  # whole batches

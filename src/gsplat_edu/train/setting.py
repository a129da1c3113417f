"""A setting of a training as the command line, config.json and the documents see it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

Check = Callable[[str, Any], object]
"""Raises an `ArgumentError` that names the setting if a value is out of range."""

TRANSIENTS = ("none", "mask")
"""What to do about things that move."""

OUTSIDE_MASKS = ("ignore", "empty")
"""What the scene shows where the capture's masks exclude pixels: anything, or nothing."""


@dataclass(frozen=True)
class Setting:
    """A setting, as used by the command line, config.json and docs/RECIPE.md.

    Args:
        name: Flat name: the field's name, with the prefix "mcmc_" for `McmcConfig` and "fast_" for `FastConfig`.
        field: The field's name in its class.
        strategy: The only strategy that uses it; None for the settings of `TrainConfig` itself.
        default: Its default for 30,000 iterations.
        help: Its meaning.
        source: Source of the default; "" if it is ours.
        milestone: Whether `recipe` scales it with the length of the run.
        check: Raises if a value is out of range.
    """

    name: str
    field: str
    strategy: str | None
    default: Any
    help: str
    source: str
    milestone: bool
    check: Check

    @property
    def meaning(self) -> str:
        """The help text for --help and tables: it starts in lower case, after the strategy that uses the setting."""
        only = f"{self.strategy}: " if self.strategy else ""
        return f"{only}{self.help[0].lower()}{self.help[1:].rstrip('.')}"

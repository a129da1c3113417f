"""A setting of a training as the command line, config.json and the documents see it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from gsplat_edu.base.text import option_flag

Check = Callable[[str, Any], object]
"""Raises an `ArgumentError` that names the setting if a value is out of range."""

TRANSIENTS = ("none", "mask")
"""What to do about things that move."""

OUTSIDE_MASKS = ("ignore", "empty")
"""What the scene shows where the capture's masks exclude pixels: anything, or nothing."""

ALPHA_BACKGROUNDS = ("random", "fixed")
"""Behind photos with alpha: a new colour for every iteration, or the background."""

REGIONS = ("capture", "none")
"""Which pixels of the photos count: those that may show the box that the capture names, if it names one, or all."""

DEPTH_KINDS = ("auto", "z", "ray", "inverse")
"""What the values of the user's depth maps are."""

WITH_OPTION = frozenset(
    {
        *("iterations", "batch", "seed", "sh_degree", "strategy", "max_gaussians", "antialiased"),
        *("appearance", "sky", "refine", "transients", "outside_masks", "background", "random_background"),
        "surface",
    }
)
"""Settings that `gsplat-edu train` has an option for; the others are given by `--set NAME=VALUE`."""

FOR_SURFACE = ("surface_start", "surface_every", "normal_weight", "patch_weight", "flat_weight")
"""Settings that only a training with `surface` uses."""

FOR_DEPTH = ("depth_kind", "depth_unit", "depth_weight", "points_weight", "depth_every")
"""Settings that only a training with the user's depth uses."""

COURSE_ONLY = frozenset({"over_cap", "view_order"})
"""Settings that only the course's trainings change (`gsplat_edu.train.course`); `gsplat-edu train` has none of them."""


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

    @property
    def settable(self) -> bool:
        """Whether `--set NAME=VALUE` gives it."""
        return self.name not in WITH_OPTION | COURSE_ONLY


def option_of(name: str) -> str:
    """Return how the command line names a setting: "--batch", or "--set sh_every" where it has no option."""
    return option_flag(name) if name in WITH_OPTION else f"--set {name}"


def option_with(name: str, value: object) -> str:
    """Return the words of the command line that give a setting: "--batch 4", or "--set sh_every=300"."""
    return f"{option_of(name)}{' ' if name in WITH_OPTION else '='}{value}"

"""A setting of a training as the command line, config.json and the documents see it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from gsplat_edu.base.text import option_flag
from gsplat_edu.train.checks import OneOf

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

OWN_STRATEGIES = ("adc", "mcmc", "fast")
"""Strategies with settings of their own."""

LENGTH, PHOTOS, PURPOSE = "Length and size", "What the photos are like", "What the scene is for"
"""Headings above the questions of a page."""

ASKED, BY_DEFAULT = "asked", "by default"
"""When a training decides on a setting from its capture: if the option is `auto`, or also if it is not given and the
strategy is fast."""


@dataclass(frozen=True)
class Plain:
    """How a page asks for the value of an option.

    Args:
        label: What is asked for, in a few words.
        words: Its values and what they mean; the value "" leaves the choice to the program. Empty: any text or number.
        group: Heading above the question.
        example: A value, for an option without `words`.
        again: Words of a button that trains with another value, in which {value} stands for it; "" if there is none.
    """

    label: str
    words: Mapping[str, str] = field(default_factory=dict)
    group: str = "Further settings"
    example: str = ""
    again: str = ""


@dataclass(frozen=True)
class Option:
    """A setting's own option of `gsplat-edu train`; settings without one are given by `--set NAME=VALUE`.

    Args:
        auto: `ASKED` or `BY_DEFAULT` if the capture can decide; "" if not.
        plain: How pages ask for it; None if they do not. Those of the group `PHOTOS` are listed with the options of
            the photos, others with those of the recipe.
        common: Whether `--help` shows it, and not only `--help-all`.
        instead_in_blocks: What to do instead where a training in blocks cannot have it; "" if it can.
    """

    auto: str = ""
    plain: Plain | None = None
    common: bool = False
    instead_in_blocks: str = ""


@dataclass(frozen=True)
class Question(Option):
    """An option of `gsplat-edu train` that asks a part for something besides its settings: a path, or a switch.

    Args:
        name: The option's name, for example "depth".
        help: Its meaning.
        metavar: What --help calls the path; "" for a switch.
        check: Raises an `ArgumentError` for a path that cannot be used; reads no photo.
        about_capture: Its meaning for `gsplat-edu doctor CAPTURE`; "" if that does not have it.
    """

    name: str = field(kw_only=True)
    help: str = field(kw_only=True)
    metavar: str = ""
    check: Callable[[Path], object] = Path
    about_capture: str = ""


@dataclass(frozen=True)
class Setting:
    """A setting, as used by the command line, config.json and docs/RECIPE.md.

    Args:
        name: Flat name: the field's name, with the prefix "mcmc_" for `McmcConfig` and "fast_" for `FastConfig`.
        attribute: Its name in its class.
        strategy: The only strategy that uses it; None for settings of every strategy.
        part: The plug-in part whose setting it is; None for the package's own.
        default: Its default for 30,000 iterations.
        help: Its meaning.
        source: Source of the default; "" if it is ours.
        milestone: Whether `recipe` scales it with the length of the run.
        check: Raises if a value is out of range.
        option: The setting's own option; None if it has none.
        only: What uses the setting: the name of an option for a training with that option, "start" for one that starts
            from points, "course" for a training of the course (`gsplat_edu.train.course`), which the command line does
            not have; "" for any training.
        in_trials: Whether the short trainings that choose another setting have its value too: it changes the image.
    """

    name: str
    attribute: str
    strategy: str | None
    part: str | None
    default: Any
    help: str
    source: str
    milestone: bool
    check: Check
    option: Option | None
    only: str
    in_trials: bool

    @property
    def meaning(self) -> str:
        """The help text for --help and tables: it starts in lower case, after the strategy that uses the setting."""
        only = f"{self.strategy}: " if self.strategy else ""
        return f"{only}{self.help[0].lower()}{self.help[1:].rstrip('.')}"

    @property
    def plugin(self) -> str | None:
        """The plug-in whose setting it is; None for the package's own."""
        return self.part or (self.strategy if self.strategy not in (None, *OWN_STRATEGIES) else None)

    @property
    def names(self) -> tuple[str, ...]:
        """Its values, if they are names."""
        return self.check.names if isinstance(self.check, OneOf) else ()

    @property
    def is_single(self) -> bool:
        """Whether its value is one number, name or switch."""
        return not isinstance(self.default, tuple)

    @property
    def settable(self) -> bool:
        """Whether `--set NAME=VALUE` gives it."""
        return self.option is None and self.only != "course"

    @property
    def written(self) -> str:
        """How the command line names it: "--batch", or "--set sh_every" where it has no option."""
        return f"--set {self.name}" if self.option is None else option_flag(self.name)

    def with_value(self, value: object) -> str:
        """Return the words of the command line that give it a value: "--batch 4", or "--set sh_every=300"."""
        return f"{self.written}{'=' if self.option is None else ' '}{value}"

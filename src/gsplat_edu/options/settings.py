"""`--set NAME=VALUE`: the settings of a training that have no option of their own."""

from __future__ import annotations

import argparse
import difflib
import shutil
import textwrap
from collections.abc import Iterable, Sequence
from typing import Any

from gsplat_edu.base.constants import AUTO
from gsplat_edu.base.text import option_flag
from gsplat_edu.options.values import number_text, whole_number_text
from gsplat_edu.train.config import BY_NAME, FOR_FAST, SETTABLE, WITH_OPTION
from gsplat_edu.train.setting import BY_DEFAULT, Setting

WIDEST_HELP = 100
"""Columns of the list in --help-all on a wide terminal."""


def add_setting(group: argparse._ActionsContainer, name: str, default: str | None = None) -> None:
    """Add the option of a setting.

    Args:
        group: Receives it.
        name: The setting's name.
        default: What is used without the option, in words; None for the setting's default.
    """
    setting = BY_NAME[name]
    option = WITH_OPTION[name]
    if default is None:
        default = f"{AUTO} for the strategy fast, {setting.default} for the others"
        default = default if option.auto == BY_DEFAULT else str(setting.default)
    auto = f'; "{AUTO}": the capture decides' if option.auto else ""
    text = f"{setting.meaning}{auto}".replace("%", "%%")
    flag = option_flag(name)
    if isinstance(setting.default, bool):
        group.add_argument(flag, action="store_true", help=text)
    elif isinstance(setting.default, tuple):
        group.add_argument(
            flag, type=number_text, nargs=3, metavar=("R", "G", "B"), help=f"{text} (default: {default})"
        )
    else:
        kind: Any = str if setting.names else whole_number_text
        kind = number_text if isinstance(setting.default, float) else kind
        metavar = "NAME" if setting.names else "N"
        group.add_argument(flag, type=kind, metavar=metavar, help=f"{text} (default: {default})")


def add_settings(group: argparse._ActionsContainer) -> None:
    """Add the option --set; the namespace gets a dict `settings` of the values given, by name."""
    group.add_argument(
        "--set",
        dest="settings",
        type=given_setting,
        action=_Settings,
        nargs="+",
        default={},
        metavar="NAME=VALUE",
        help=f"change other settings, for example sh_every=300; there are {len(SETTABLE)}, which --help-all and"
        " docs/RECIPE.md list",
    )


class _Settings(argparse.Action):
    """Collects the settings of all --set; the last value of a name counts."""

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: Any,  # noqa: ANN401
        option_string: str | None = None,
    ) -> None:
        """Add the values to those given before."""
        setattr(namespace, self.dest, {**getattr(namespace, self.dest), **dict(values)})


def given_setting(text: str) -> tuple[str, Any]:
    """Parse NAME=VALUE.

    Args:
        text: For example "sh_every=300"; the name may have dashes.

    Returns:
        The setting's name and its value, whose range `TrainConfig` checks.

    Raises:
        argparse.ArgumentTypeError: it is not NAME=VALUE, the name is no setting, or has an option, or the value is of
            another type.
    """
    name, equals, value = text.partition("=")
    name = name.replace("-", "_")
    if not equals:
        raise argparse.ArgumentTypeError(f"{text!r} is not NAME=VALUE, for example sh_every=300")
    if name in WITH_OPTION:
        raise argparse.ArgumentTypeError(f"{name} has an option: give {BY_NAME[name].written}")
    if name in BY_NAME and BY_NAME[name].only == "course":
        raise argparse.ArgumentTypeError(f"only the course's trainings change {name}; leave it out")
    if name not in SETTABLE:
        alike = difflib.get_close_matches(name, SETTABLE, n=3)
        meant = f"did you mean {' or '.join(alike)}?" if alike else "--help-all lists the settings"
        raise argparse.ArgumentTypeError(f"{name!r} is not a setting; {meant}")
    return name, _parsed(SETTABLE[name], value)


def _parsed(setting: Setting, value: str) -> Any:  # noqa: ANN401
    """Convert text to the type of a setting's default."""
    if isinstance(setting.default, str):
        return value
    if setting.name == "jacobian_limit" and value == "none":
        return None
    kind, what = (int, "a whole number") if isinstance(setting.default, int) else (float, "a number")
    try:
        return kind(value)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{setting.name}: {value!r} is not {what}") from None


def given(arguments: argparse.Namespace, names: Iterable[str]) -> list[str]:
    """Return those of the names that the user gave, by an option or by --set."""
    return [
        name for name in names if name in arguments.settings or getattr(arguments, name, None) is not None
    ]


def appendix() -> str:
    """Return what --help-all prints below the options: the settings, their defaults, and what they do."""
    width = min(shutil.get_terminal_size().columns - 2, WIDEST_HELP)
    heading = "settings of --set, with their values for 30,000 iterations; those with * scale with the run's length:"
    parts = [textwrap.fill(heading, width)]
    for setting in SETTABLE.values():
        text = textwrap.fill(_meaning(setting), width, initial_indent=" " * 8, subsequent_indent=" " * 8)
        parts.append(f"  {setting.name}={_default(setting)}\n{text}")
    return "\n" + "\n".join(parts) + "\n"


def _default(setting: Setting) -> str:
    """Return a setting's default; for the strategy fast, the default of `gsplat-edu train`, where that differs."""
    value = FOR_FAST.get(setting.name, setting.default)
    return f"{value:g}" if isinstance(value, float) else str(value)


def _meaning(setting: Setting) -> str:
    others = f" (other strategies: {setting.default:g})" if setting.name in FOR_FAST else ""
    return f"{setting.meaning}{others}{' *' if setting.milestone else ''}"


def explain_unknown(flag: str, known: Sequence[str]) -> str | None:
    """Say what to write instead of an unknown option that is, or resembles, a setting; None if it does not.

    Args:
        flag: The unknown option, for example "--sh-every".
        known: The options of the command.
    """
    spelled = {option_flag(name): name for name in SETTABLE}
    alike = difflib.get_close_matches(flag, [*known, *spelled], n=1)
    if not alike or alike[0] not in spelled:
        return None
    return f"did you mean --set {spelled[alike[0]]}=VALUE?"

"""What a request may give a command, and how a page asks for it: both follow from the command's own options.

A module of options lists in OFFERED what requests may give. Types, bounds, choices and checks are those of the command
line, because a request becomes words that the command's parser reads.
"""

from __future__ import annotations

import argparse
import functools
import importlib
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NoReturn

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.plugins import plugins
from gsplat_edu.base.text import option_flag, shortened
from gsplat_edu.options.parser import OneLineParser
from gsplat_edu.options.values import NumberOr, number_text, whole_number_text
from gsplat_edu.train.setting import Plain

LONGEST_TEXT = 200
"""Characters of an option's text."""


def module_of(command: str) -> Any:  # noqa: ANN401 - a module
    """Return the module that declares a command's options; that of a plug-in also runs it."""
    if command in (added := plugins("commands")):
        return added[command]
    return importlib.import_module(f"gsplat_edu.options.{command.replace('-', '_')}")


class _RaisingParser(OneLineParser):
    """A parser that raises an `ArgumentError` for a mistake."""

    def error(self, message: str) -> NoReturn:
        """Raise the error."""
        raise ArgumentError(message)


@functools.cache
def _parser_of(command: str) -> _RaisingParser:
    parser = _RaisingParser(prog=command, add_help=False)
    module_of(command).add_arguments(parser)
    return parser


def offered(command: str) -> dict[str, argparse.Action]:
    """Return the options that requests may give a command, by name: "max_memory" for --max-memory."""
    names = getattr(module_of(command), "OFFERED", ())
    actions = {
        flag.removeprefix("--").replace("-", "_"): action
        for action in _parser_of(command)._actions
        for flag in action.option_strings
    }
    return {name: action for name, action in actions.items() if name in names}


def _plain(command: str, name: str) -> Plain | None:
    """Return how a page asks for an offered option."""
    names = module_of(command).OFFERED
    return names[name] if isinstance(names, dict) else None


def words_of(command: str, given: Mapping[str, Any]) -> list[str]:
    """Turn options of a request into words of the command line; `check_words` checks their values.

    Args:
        command: The command.
        given: Values by name: true or false for a switch, a number, a text, or for `set` an object of settings.

    Raises:
        ArgumentError: an option is not offered, or a value is of another kind.
    """
    known = offered(command)
    words: list[str] = []
    for name, value in given.items():
        if name not in known:
            raise ArgumentError(f"{shortened(str(name))}: is not one of {', '.join(known) or 'none'}")
        action = known[name]
        if action.nargs == 0:
            if not isinstance(value, bool):
                raise ArgumentError(f"{name}: is {str(value)[:40]}, but has to be true or false")
            words += [option_flag(name)] if value else []
        elif isinstance(action.default, dict):
            if not isinstance(value, dict):
                raise ArgumentError(f'{name}: has to be an object, for example {{"sh_every": 300}}')
            for key, one in value.items():
                _check_printable(name, str(key))
                words += [option_flag(name), f"{key}={_text_of(f'{name}.{key}', one, None)}"]
        else:
            if action.type is Path and value not in (paths := _paths(command, name)):
                raise ArgumentError(
                    f"{name}: is {str(value)[:40]!r}, but has to be one of {', '.join(paths)}"
                )
            words += [option_flag(name), _text_of(name, value, action)]
    return words


def check_words(command: str, words: Sequence[str], *, check: bool) -> None:
    """Check a command line as the command itself does.

    Args:
        command: The command.
        words: All words after its name.
        check: Also check what depends on files.

    Raises:
        ArgumentError: it would be refused.
        SplatError: a file would be refused.
    """
    parsed = _parser_of(command).parse_args(list(words))
    module = module_of(command)
    if check and hasattr(module, "check"):
        module.check(parsed)


def _text_of(name: str, value: Any, action: argparse.Action | None) -> str:  # noqa: ANN401
    kind = None if action is None else action.type
    if type(value) in (int, float) and math.isfinite(value):
        if kind is whole_number_text and type(value) is not int:
            raise ArgumentError(f"{name}: is {value:g}, but has to be a whole number")
        return f"{value:g}" if type(value) is float and value == float(f"{value:g}") else repr(value)
    if kind in (whole_number_text, number_text):
        raise ArgumentError(f"{name}: is {str(value)[:40]!r}, but has to be a number")
    if not isinstance(value, str):
        raise ArgumentError(f"{name}: has to be a number or a short text")
    _check_printable(name, value)
    return value


def _check_printable(name: str, text: str) -> None:
    if not text or len(text) > LONGEST_TEXT or not text.isprintable() or text[0] == "-":
        raise ArgumentError(f"{name}: has to be a short text that does not begin with a dash")


def _paths(command: str, name: str) -> tuple[str, ...]:
    """Return the words that a request may give instead of a path: those that a page offers."""
    plain = _plain(command, name)
    return () if plain is None else tuple(word for word in plain.words if word)


def questions(command: str) -> list[dict[str, Any]]:
    """Return what a page asks for a command: groups of questions, in the order of the options.

    Each group has `title` and `questions`; a question `name`, `label`, `words` (pairs of value and meaning; none for a
    number or a text), `kind` ("switch", "number", "text", or "either") and `example`.
    """
    groups: dict[str, list[dict[str, Any]]] = {}
    for name, action in offered(command).items():
        if (plain := _plain(command, name)) is None:
            continue
        groups.setdefault(plain.group, []).append(
            {
                "name": name,
                "label": plain.label,
                "words": list(plain.words.items()),
                "kind": _kind(action),
                "example": plain.example,
            }
        )
    return [{"title": title, "questions": asked} for title, asked in groups.items()]


def _kind(action: argparse.Action) -> str:
    if action.nargs == 0:
        return "switch"
    if action.type in (whole_number_text, number_text):
        return "number"
    return "either" if isinstance(action.type, NumberOr) else "text"

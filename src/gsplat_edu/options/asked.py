"""Options of `gsplat-edu train` that ask something of a part of the training besides its settings."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

from gsplat_edu.base.text import option_flag
from gsplat_edu.train.part import questions
from gsplat_edu.train.setting import Question

OFFERED_ASKED = {question.name: question.plain for question in questions().values()}
"""How pages ask for them, as `gsplat_edu.options.train.OFFERED` has it."""

COMMON_ASKED = tuple(question.name for question in questions().values() if question.common)
"""Those that `--help` shows."""


def add_of_photos(group: argparse._ActionsContainer) -> None:
    """Add the options that say what else there is besides the photos: those that are paths."""
    for question in questions().values():
        if question.metavar:
            _add(group, question, question.help)


def add_of_results(group: argparse._ActionsContainer) -> None:
    """Add the options that change the trained scene: the switches."""
    for question in questions().values():
        if not question.metavar:
            _add(group, question, question.help)


def add_about_capture(group: argparse._ActionsContainer) -> None:
    """Add those that are also asked about a capture that is not trained."""
    for question in questions().values():
        if question.about_capture:
            _add(group, question, question.about_capture)


def _add(group: argparse._ActionsContainer, question: Question, text: str) -> None:
    flag = option_flag(question.name)
    if question.metavar:
        group.add_argument(flag, type=Path, metavar=question.metavar, help=text)
    else:
        group.add_argument(flag, action="store_true", help=text)


def check_asked(arguments: argparse.Namespace) -> None:
    """Check the options without reading a photo.

    Raises:
        ArgumentError: a folder does not exist.
    """
    for _, question, value in _given(arguments):
        if question.metavar:
            question.check(value)


def asked_of(arguments: argparse.Namespace) -> dict[str, str]:
    """Return what the user asked of parts, as `gsplat_edu.runs.options.RunOptions` takes it.

    Args:
        arguments: Those of a command that has some of the options.
    """
    return {part: str(value) if question.metavar else "" for part, question, value in _given(arguments)}


def words_asked(arguments: argparse.Namespace) -> tuple[str, ...]:
    """Return the words of the command line that ask the same."""
    return tuple(
        word
        for _, question, value in _given(arguments)
        for word in (option_flag(question.name), *((str(value),) if question.metavar else ()))
    )


def _given(arguments: argparse.Namespace) -> Iterator[tuple[str, Question, Path]]:
    """Yield part, option and value of each option that is given."""
    for part, question in questions().items():
        if value := getattr(arguments, question.name, None):
            yield part, question, value

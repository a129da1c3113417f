"""What an assignment is made of: functions to write, and cases that tell right answers from typical wrong ones."""

from __future__ import annotations

import copy
import dataclasses
import traceback
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np

from gsplat_edu.base.text import first_line

Answer: TypeAlias = Any
"""A number, an array, or a tuple of arrays."""

Function = Callable[..., Answer]

TOLERANCE = 1e-9
"""Relative difference up to which numbers are equal: far more than float64 loses in some hundred roundings."""

RIGHT = "right"

MISSING = "is missing: write a function of this name"


@dataclasses.dataclass(frozen=True)
class Part:
    """A function to write.

    Args:
        name: Its name.
        points: For a right answer; a wrong one has none.
        cases: Draws the arguments of several calls.
        answer: The function that is asked for.
        mistakes: Functions of typical wrong answers, by a sentence that says what is wrong with them.
    """

    name: str
    points: int
    cases: Callable[[np.random.Generator], Sequence[tuple[Any, ...]]]
    answer: Function
    mistakes: Mapping[str, Function]


@dataclasses.dataclass(frozen=True)
class Grade:
    """What a part was given.

    Args:
        part: The part's name.
        points: Points given.
        of: Points of a right answer.
        reason: "right", or what is wrong.
    """

    part: str
    points: int
    of: int
    reason: str


def graded(part: Part, function: Function | None, seed: int, number: int) -> Grade:
    """Judge a function.

    Args:
        part: The part that asks for it.
        function: The answer; None if there is none.
        seed: Chooses the cases.
        number: Of the part in its assignment: each has cases of its own.
    """
    reason = MISSING if function is None else _reason(part, function, np.random.default_rng([seed, number]))
    return Grade(part.name, part.points if reason == RIGHT else 0, part.points, reason)


def _reason(part: Part, function: Function, draws: np.random.Generator) -> str:
    """Return "right", or one sentence on what is wrong."""
    cases = list(part.cases(draws))
    answers = []
    for arguments in cases:
        given = copy.deepcopy(arguments)
        try:
            answers.append(_plain(function(*given)))
        except (Exception, SystemExit) as error:  # an answer may raise anything
            frame = traceback.extract_tb(error.__traceback__)[-1]
            return f"line {frame.lineno} raises {first_line(error)}"
        if not all(_equal(before, after) for before, after in zip(arguments, given, strict=True)):
            return "changes its arguments; make new arrays"
    wanted = [_plain(part.answer(*arguments)) for arguments in cases]
    if all(map(_equal, answers, wanted)):
        return RIGHT
    for sentence, mistaken in part.mistakes.items():
        if all(map(_equal, answers, (_plain(mistaken(*arguments)) for arguments in cases))):
            return sentence
    number = next(
        i for i, (answer, right) in enumerate(zip(answers, wanted, strict=True)) if not _equal(answer, right)
    )
    return f"case {number + 1} of {len(cases)}: {_difference(answers[number], wanted[number])}"


def _plain(answer: Any) -> Any:  # noqa: ANN401
    """Return an answer as an array, or a tuple of arrays; as it is if it has no numbers."""
    if isinstance(answer, tuple):
        return tuple(_plain(one) for one in answer)
    try:
        array = np.asarray(answer)
    except ValueError:  # rows of unequal lengths
        return answer
    return array if array.dtype.kind in "biuf" else answer


def _equal(one: Any, other: Any) -> bool:  # noqa: ANN401
    if isinstance(one, tuple) or isinstance(other, tuple):
        same = isinstance(one, tuple) and isinstance(other, tuple) and len(one) == len(other)
        return same and all(map(_equal, one, other))
    one, other = _plain(one), _plain(other)
    if not isinstance(one, np.ndarray) or not isinstance(other, np.ndarray) or one.shape != other.shape:
        return False
    # what is 0 in exact arithmetic is compared with the largest number beside it
    room = TOLERANCE * np.abs(other).max(initial=0.0) if np.isfinite(other).all() else 0.0
    return bool(np.allclose(one, other, rtol=TOLERANCE, atol=room))


def _difference(answer: Any, wanted: Any) -> str:  # noqa: ANN401
    """Say how two unequal answers differ."""
    if isinstance(wanted, tuple):
        if not isinstance(answer, tuple) or len(answer) != len(wanted):
            return f"return {len(wanted)} things, separated by commas"
        number = next(i for i, pair in enumerate(zip(answer, wanted, strict=True)) if not _equal(*pair))
        return (
            f"the {('first', 'second', 'third')[number]} thing: {_difference(answer[number], wanted[number])}"
        )
    if not isinstance(answer, np.ndarray):
        return f"returns {type(answer).__name__}, not numbers"
    if answer.shape != wanted.shape:
        return f"returns the shape {answer.shape} instead of {wanted.shape}"
    place = np.unravel_index(np.abs(answer.astype(float) - wanted).argmax(), wanted.shape)
    where = f" at {tuple(int(i) for i in place)}" if wanted.shape else ""
    return f"returns {answer[place]:.6g} instead of {wanted[place]:.6g}{where}"

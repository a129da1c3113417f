"""Check the fields of JSON documents that users write: each failure is one line that names the field."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from typing import Any

from gsplat_edu.base.errors import ArgumentError


def as_json(value: object) -> str:
    """Return a value as JSON, at most 40 characters of it."""
    text = json.dumps(value)
    return text if len(text) <= 40 else text[:37] + "..."


def check_keys(
    where: str, found: dict[str, Any], needed: Sequence[str], optional: Sequence[str] = ()
) -> None:
    """Reject a missing key, and one that would be ignored, such as a misspelt one.

    Args:
        where: What precedes the message, for example "keyframes[3]: ".
        found: The object.
        needed: Keys that it has to have.
        optional: Keys that it may have.

    Raises:
        ArgumentError: a key is missing or unknown.
    """
    if missing := [key for key in needed if key not in found]:
        raise ArgumentError(f"{where}lacks {missing[0]!r}")
    if unknown := [key for key in found if key not in (*needed, *optional)]:
        raise ArgumentError(
            f"{where}has an unknown key {as_json(unknown[0])}; known are {', '.join((*needed, *optional))}"
        )


def checked_number(where: str, value: object) -> float:
    """Return a finite number.

    Raises:
        ArgumentError: the value is not one.
    """
    if type(value) not in (int, float):
        raise ArgumentError(f"{where}: is {as_json(value)}, but has to be a number")
    try:
        found = float(value)  # type: ignore[arg-type]
    except OverflowError:
        found = math.inf
    if not math.isfinite(found):
        raise ArgumentError(f"{where}: is {as_json(value)}, but has to be finite")
    return found


def checked_numbers(where: str, value: object, count: int) -> list[float]:
    """Return a list of `count` finite numbers.

    Raises:
        ArgumentError: the value is not such a list.
    """
    if not isinstance(value, list) or len(value) != count:
        raise ArgumentError(f"{where}: is {as_json(value)}, but has to be {count} numbers")
    return [checked_number(f"{where}[{index}]", entry) for index, entry in enumerate(value)]


def number_within(where: str, value: object, low: float, high: float) -> float:
    """Return a number from `low` to `high`.

    Raises:
        ArgumentError: the value is not one.
    """
    found = checked_number(where, value)
    if not low <= found <= high:
        raise ArgumentError(f"{where}: is {as_json(value)}, but has to be from {low:g} to {high:g}")
    return found


def numbers_within(where: str, value: object, count: int, most: float) -> tuple[float, ...]:
    """Return `count` numbers from -most to most.

    Raises:
        ArgumentError: the value is not a list of them.
    """
    found = checked_numbers(where, value, count)
    return tuple(number_within(f"{where}[{index}]", entry, -most, most) for index, entry in enumerate(found))


def checked_whole(where: str, value: object, low: int, high: int) -> int:
    """Return a whole number from `low` to `high`.

    Raises:
        ArgumentError: the value is not one.
    """
    if type(value) is not int or not low <= value <= high:
        raise ArgumentError(
            f"{where}: is {as_json(value)}, but has to be a whole number from {low:,} to {high:,}"
        )
    return value


def checked_choice(where: str, value: object, known: Sequence[str]) -> str:
    """Return a word that is one of the known ones.

    Raises:
        ArgumentError: it is not; the message lists them.
    """
    if not isinstance(value, str) or value not in known:
        raise ArgumentError(f"{where}: is {as_json(value)}, but has to be one of {', '.join(known)}")
    return value


def checked_text(where: str, value: object, longest: int, shortest: int = 0) -> str:
    """Return a text without control characters.

    Raises:
        ArgumentError: the value is not one, or its length is not from `shortest` to `longest` characters.
    """
    if not isinstance(value, str) or not shortest <= len(value) <= longest:
        raise ArgumentError(
            f"{where}: is {as_json(value)}, but has to be text of {shortest} to {longest} characters"
        )
    if any(ord(letter) < ord(" ") or letter == "\x7f" for letter in value):
        raise ArgumentError(f"{where}: is {as_json(value)}, but must not hold control characters")
    return value


def checked_list(where: str, value: object, most: int) -> list[Any]:
    """Return a list of at most `most` entries.

    Raises:
        ArgumentError: the value is not one.
    """
    if not isinstance(value, list):
        raise ArgumentError(f"{where}: is {as_json(value)}, but has to be a list")
    if len(value) > most:
        raise ArgumentError(f"{where}: has {len(value):,} entries, but at most {most:,} are allowed")
    return value


def checked_object(where: str, value: object) -> dict[str, Any]:
    """Return an object.

    Raises:
        ArgumentError: the value is not one.
    """
    if not isinstance(value, dict):
        raise ArgumentError(f"{where}: is {as_json(value)}, but has to be an object")
    return value

"""Records: JSON of a known shape, declared as `msgspec.Struct`, refused in one line that names the field.

`record_of` converts parsed JSON to a declared type. Its types and bounds are the record's reference; a relation between
fields is checked in `__post_init__`, which raises an ArgumentError, as "corners: u0 must not exceed u1".
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from typing import Annotated, Any, TypeVar

import msgspec
from msgspec import Meta

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.text import shortened

LARGEST_NUMBER = 1e300
"""No number in a record is as large; a whole number may have more digits than a float can hold."""

Number = Annotated[float, Meta(ge=-LARGEST_NUMBER, le=LARGEST_NUMBER)]
"""A finite number."""

ONE_LINE = r"^[^\x00-\x1f\x7f]*\Z"
"""Pattern of a text without control characters."""

LINES = r"^(?:[^\x00-\x1f\x7f]|\n)*\Z"
"""Pattern of a text whose only control characters are line breaks."""

Absent = msgspec.UnsetType
ABSENT = msgspec.UNSET
"""Value of a field that a record lacks, where null is refused."""


Value = TypeVar("Value")


class Record(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Base of records; an unknown field, such as a misspelt one, is refused."""


def record_of(where: str, value: object, kind: Any) -> Any:  # noqa: ANN401
    """Convert parsed JSON to a type.

    Args:
        where: Its place in the file, as "keyframes[3]"; empty for the whole file.
        value: The parsed JSON.
        kind: A type that msgspec knows, such as a `Record` or a tuple or union of some.

    Raises:
        ArgumentError: the value is not of this type; the message names the field.
    """
    try:
        return msgspec.convert(value, kind)
    except UnicodeEncodeError:
        raise ArgumentError(f"{where or 'a field'}: has a name that is not Unicode text") from None
    except msgspec.ValidationError as error:
        problem, _, place = str(error).partition(" - at `")
        ours = isinstance(error.__cause__, ArgumentError)
    path = "" if place.startswith("key`") else place.rstrip("`").removeprefix("$")
    reason = problem if ours else _reason(problem, value, path, kind)
    at = (where + path).removeprefix(".").removesuffix("[...]")
    names_a_field = re.match(r"[\w\[\].]+: ", reason)
    between = "" if not at or reason[0] == "[" else "." if names_a_field else ": "
    raise ArgumentError(f"{at}{between}{reason}")


def present(value: Value | Absent) -> Value | None:
    """Return the value of a field that may be absent; None if it is."""
    return None if isinstance(value, Absent) else value


def as_json(value: object) -> str:
    """Return a value as JSON, at most 40 characters of it."""
    return shortened(json.dumps(value), 40)


_AT = {">=": "at least", "<=": "at most", ">": "above", "<": "below", "": ""}

_NAMES = {
    "int": "a whole number",
    "float": "a number",
    "str": "text",
    "bool": "true or false",
    "array": "a list",
    "object": "an object",
    "null": "null",
}


def _kinds(text: str) -> list[str]:
    """Return the names in "int | float | null"; a whole number is a number."""
    kinds = text.split(" | ")
    return [kind for kind in kinds if kind != "int" or "float" not in kinds]


_SENTENCES: tuple[tuple[str, Callable[[re.Match[str]], str]], ...] = (
    (r"Object missing required field `(.*)`", lambda found: f"lacks {found[1]!r}"),
    (r"Object contains unknown field `(.*)`", lambda found: f"has an unknown key {as_json(found[1])}"),
    (
        r"Expected `(int|float)` ([<>]=?) (.*)",
        lambda found: f"has to be {_NAMES[found[1]]}, {_AT[found[2]]} {found[3]}",
    ),
    (
        r"Expected `(str|array)` of length ([<>]=|) ?(\d+).*",
        lambda found: (
            f"has to have {_AT[found[2]]} {int(found[3]):,} ".replace("  ", " ")
            + ("characters" if found[1] == "str" else "entries")
        ),
    ),
    (
        r"Expected `(.*?)`(?:, got .*)?",
        lambda found: "has to be " + " or ".join(_NAMES[name] for name in _kinds(found[1])),
    ),
    (r"Number out of range", lambda found: "has to be a smaller number"),
)
"""Messages of msgspec, and how this program says them."""


def _reason(problem: str, value: object, path: str, kind: object) -> str:
    """Return what is wrong, in the words of this program."""
    if problem.startswith("Invalid"):
        wanted = "has to be one of " + ", ".join(map(str, _choices(kind, re.split(r"\W", path)[-1])))
    elif "matching regex" in problem:
        wanted = (
            "must not hold control characters"
            if repr(ONE_LINE) in problem or repr(LINES) in problem
            else "has to be written otherwise"
        )
    else:
        found = ((re.fullmatch(pattern, problem), say) for pattern, say in _SENTENCES)
        wanted = next((say(match) for match, say in found if match), problem)
        if problem.startswith("Object"):
            return wanted
    whose = "each of its values " if path.endswith("[...]") else ""
    return f"is {as_json(_at(value, path))}, but {whose}{wanted}"


def _at(value: Any, path: str) -> object:  # noqa: ANN401
    """Return the value at a path as msgspec writes it; that of "[...]", an object's, is unknown."""
    for name, index in re.findall(r"\.(\w+)|\[(\d+|\.\.\.)\]", path):
        value = value if index == "..." else value[name or int(index)]
    return value


def _choices(kind: object, field: str) -> list[object]:
    """Return the words that fields of a name may have anywhere in a type."""
    _, parts = msgspec.json.schema_components([kind])
    entries = [part["properties"][field] for part in parts.values() if field in part.get("properties", {})]
    entries = [parts.get(entry.get("$ref", "").rpartition("/")[2], entry) for entry in entries]
    return list(dict.fromkeys(word for entry in entries for word in entry.get("enum", ())))

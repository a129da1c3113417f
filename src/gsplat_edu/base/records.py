"""Records: JSON of a known shape, declared as `msgspec.Struct`, refused in one line that names the field.

`record_of` converts parsed JSON to a declared type. Its types and bounds are the record's reference; a relation between
fields is checked in `__post_init__`, which raises an ArgumentError, as "corners: u0 must not exceed u1".
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Sequence
from typing import Annotated, Any, TypeVar

import msgspec
from msgspec import Meta, inspect

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.text import shortened

LARGEST_NUMBER = 1e300
"""No number in a record is as large; a whole number may have more digits than a float can hold."""

Number = Annotated[float, Meta(ge=-LARGEST_NUMBER, le=LARGEST_NUMBER)]
"""A finite number."""

# a text that can be the name or path of a file (`gsplat_edu.base.text.names_a_file`)
Text = Annotated[str, Meta(pattern=r"^[^\x00\ud800-\udc7f\udd00-\udfff]*\Z(?#the name or path of a file)")]

ONE_LINE = r"^[^\x00-\x1f\x7f]*\Z(?#free of control characters)"
"""Pattern of a text without control characters; the comment at its end says in messages what a text has to be."""

LINES = r"^(?:[^\x00-\x1f\x7f]|\n)*\Z(?#free of control characters)"
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
        of_a_record = error.__cause__ is not None  # raised by its __post_init__
    path = place.rstrip("`").rpartition("$")[2].partition("[...]")[0]  # "[...]" is any value of an object
    reason = problem if of_a_record else _reason(value, path, inspect.type_info(kind))
    at = (where + path).removeprefix(".")
    names_a_field = re.match(r"[\w\[\].]+: ", reason)
    between = "" if not at or reason[0] == "[" else "." if names_a_field else ": "
    raise ArgumentError(f"{at}{between}{reason}")


def present(value: Value | Absent) -> Value | None:
    """Return the value of a field that may be absent; None if it is."""
    return None if isinstance(value, Absent) else value


def without_nan(value: Any) -> Any:  # noqa: ANN401
    """Replace NaN and infinities by None, recursively: JSON cannot represent them."""
    if isinstance(value, dict):
        return {key: without_nan(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [without_nan(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def as_json(value: object) -> str:
    """Return a value as JSON, at most 40 characters of it."""
    return shortened(json.dumps(value), 40)


_LIST = ("a list", list, tuple)
_OBJECT = ("an object", dict)
_JSON: dict[Any, tuple[Any, ...]] = {
    inspect.IntType: ("a whole number", int),
    inspect.FloatType: ("a number", int, float),
    inspect.StrType: ("text", str),
    inspect.BoolType: ("true or false", bool),
    inspect.NoneType: ("null", type(None)),
    **dict.fromkeys((inspect.ListType, inspect.VarTupleType, inspect.TupleType), _LIST),
    **dict.fromkeys((inspect.StructType, inspect.DataclassType, inspect.DictType), _OBJECT),
}
"""What values of a type are called, and their types in Python."""


def _reason(value: Any, path: str, kind: Any) -> str:  # noqa: ANN401
    """Return what is wrong with the value at a path, or with an entry of it."""
    for name, index in re.findall(r"\.(\w+)|\[(\d+)\]", path):
        outer = _matching(kind, value)
        if index:
            kind = outer.item_types[int(index)] if isinstance(outer, inspect.TupleType) else outer.item_type
        elif name == getattr(outer, "tag_field", None):
            kind = inspect.LiteralType(tuple(each.tag for each in _members(kind) if hasattr(each, "tag")))
        else:
            kind = next(field.type for field in outer.fields if field.encode_name == name)
        value = value[name or int(index)]
    match = _matching(kind, value)
    if isinstance(match, inspect.StructType | inspect.DataclassType):
        return _wrong_key(value, match)
    return f"is {as_json(value)}, but {_bounds(value, match) if match else f'has to be {_names(kind)}'}"


def _members(kind: Any) -> tuple[Any, ...]:  # noqa: ANN401
    """Return the types of a union, or the type itself."""
    return kind.types if isinstance(kind, inspect.UnionType) else (kind,)


def _matching(kind: Any, value: Any) -> Any:  # noqa: ANN401
    """Return the type of a union that a value is meant to have, by its kind and its tag; None if there is none."""
    matching = [each for each in _members(kind) if type(value) in _JSON.get(type(each), ())]
    tagged = (each for each in matching if hasattr(each, "tag") and value.get(each.tag_field) == each.tag)
    return next(tagged, matching[0] if matching else None)


def _names(kind: Any) -> str:  # noqa: ANN401
    """Return what values of a type are called, as "a number or null"."""
    names = [
        f"one of {', '.join(map(str, _choices(each)))}" if _choices(each) else _JSON[type(each)][0]
        for each in _members(kind)
    ]
    return " or ".join(
        name for name in dict.fromkeys(names) if name != "a whole number" or "a number" not in names
    )


def _choices(kind: Any) -> Sequence[Any]:  # noqa: ANN401
    """Return the values of a type that has only some; empty for other types."""
    if isinstance(kind, inspect.EnumType):
        return [each.value for each in kind.cls]
    return kind.values if isinstance(kind, inspect.LiteralType) else ()


def _wrong_key(value: dict[str, Any], record: Any) -> str:  # noqa: ANN401
    """Return which key of an object is unknown or missing."""
    tag = getattr(record, "tag_field", None)
    required = ({tag: True} if tag else {}) | {field.encode_name: field.required for field in record.fields}
    unknown = [key for key in value if key not in required]
    if unknown and getattr(record, "forbid_unknown_fields", False) and (tag is None or tag in value):
        return f"has an unknown key {as_json(unknown[0])}; known are {', '.join(required)}"
    return f"lacks {next(key for key in required if required[key] and key not in value)!r}"


def _bounds(value: Any, kind: Any) -> str:  # noqa: ANN401
    """Return the bounds of a type, one of which a value breaks, or an entry of it."""
    if isinstance(kind, inspect.DictType):
        return f"each of its values has to be {_names(kind.value_type)}"
    if isinstance(kind, inspect.IntType | inspect.FloatType):
        return f"has to be {_names(kind)}, {_ends(kind.ge, kind.le) or 'a smaller one'}"
    if isinstance(kind, inspect.TupleType):
        return f"has to have {len(kind.item_types)} entries"
    if isinstance(kind, inspect.StrType) and kind.pattern and not re.search(kind.pattern, value):
        return f"has to be {kind.pattern.rpartition('(?#')[2].removesuffix(')')}"
    what = "characters" if isinstance(kind, inspect.StrType) else "entries"
    return f"has to have {_ends(kind.min_length, kind.max_length)} {what}"


def _ends(low: float | None, high: float | None) -> str:
    ends = (("", low),) if low == high else (("at least ", low), ("at most ", high))
    return " and ".join(f"{word}{end:,.12g}" for word, end in ends if end is not None)

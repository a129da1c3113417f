"""Validate public arguments; each error is one line that names the argument.

Public functions accept anything that NumPy can read as an array, so their parameters are annotated `ArrayLike` and
checked here. Return values and internal arguments carry their shapes in their annotations.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from jaxtyping import Float64

from gsplat_edu.base.errors import ArgumentError, ShapeError

if TYPE_CHECKING:
    from numpy.typing import ArrayLike as _NumPyArrayLike

    ArrayLike: TypeAlias = _NumPyArrayLike
else:
    # NumPy's alias requires methods that tuples have only in its stub file, so it cannot be checked at run
    # time; float64_array does that.
    ArrayLike = Any

LARGEST_WHOLE = 2**63 - 1
"""Largest whole number that a setting may have, the largest int64: larger ones overflow NumPy, torch and, beyond 1,024
bits, a float. Records from disk may hold any number of digits."""

Shape = Sequence[int | str]
"""An expected shape. A number requires that size; a letter allows any size, but the same one at each occurrence; "..."
in first place allows any number of leading axes."""


def float64_array(
    name: str, value: ArrayLike, shape: Shape, sizes: dict[str, int] | None = None
) -> Float64[np.ndarray, "..."]:
    """Convert an argument to a finite float64 array of the given shape.

    Args:
        name: The caller's name for the argument.
        value: The argument.
        shape: Expected shape; letters already in `sizes` must match.
        sizes: Sizes of the letters so far; new ones are added.

    Returns:
        The argument as float64; not copied if it already was.

    Raises:
        ShapeError: the shape differs.
        ArgumentError: not numeric, or some entry is NaN or infinite.
    """
    try:
        given = np.asarray(value)
        if np.iscomplexobj(given):
            raise ArgumentError(f"{name}: is complex, but has to be real")
        array = given.astype(np.float64, copy=False)
    except ArgumentError:
        raise
    except (
        TypeError,
        ValueError,
        OverflowError,
        RuntimeError,
    ) as error:  # RuntimeError: a tensor that requires grad
        raise ArgumentError(f"{name}: cannot be read as an array of numbers ({error})") from None
    check_shape(name, array.shape, shape, {} if sizes is None else sizes)
    finite = np.isfinite(array)
    if not finite.all():
        where = first_index(np.asarray(~finite))
        raise ArgumentError(f"{name}{where}: is {array[~finite][0]}, but every entry has to be finite")
    return array


def check_shape(name: str, actual: Sequence[int], expected: Shape, sizes: dict[str, int]) -> None:
    """Compare a shape with the expected one, and record the sizes of its letters.

    Raises:
        ShapeError: names the argument, the expected and the actual shape.
    """
    leading = len(expected) > 0 and expected[0] == "..."
    tail = list(expected[1:] if leading else expected)
    fits = len(actual) >= len(tail) if leading else len(actual) == len(tail)
    found = dict(sizes)
    if fits:
        for size, want in zip(actual[len(actual) - len(tail) :], tail, strict=True):
            fits = fits and size == (want if isinstance(want, int) else found.setdefault(want, size))
    if not fits:
        raise ShapeError(f"{name}: expected shape {_spelled(expected, sizes)}, got {tuple(actual)}")
    sizes.update(found)


def first_index(mask: np.ndarray[Any, np.dtype[np.bool_]]) -> str:
    """Return the index of a mask's first true entry in Python's notation: "[3, 1]"; "" for a scalar."""
    index = np.argwhere(mask)[0]
    return f"[{', '.join(str(i) for i in index)}]" if len(index) else ""


def in_range(name: str, value: float, low: float, high: float = np.inf, *, open_low: bool = False) -> float:
    """Check low <= value <= high (low < value if `open_low`).

    Raises:
        ArgumentError: out of range, or NaN.
    """
    number = float(float64_array(name, value, ()))
    if not (low < number if open_low else low <= number) or number > high:
        bound = f"{'above' if open_low else 'at least'} {low:g}" + (
            f" and at most {high:g}" if high < np.inf else ""
        )
        raise ArgumentError(f"{name}: is {number:g}, but has to be {bound}")
    return number


def whole_number(name: str, value: object, low: int, high: int = LARGEST_WHOLE) -> int:
    """Check that a value is a whole number between `low` and `high`.

    Returns:
        The number as an int.

    Raises:
        ArgumentError: it is not. Booleans and floats such as 3.0 are rejected.
    """
    try:
        number = None if isinstance(value, bool) else operator.index(value)  # type: ignore[arg-type]
    except TypeError:
        number = None
    if number is None or not low <= number <= high:
        open_above = high == LARGEST_WHOLE and (number is None or number < low)
        bounds = f"of at least {low}" if open_above else f"from {low} to {high}"
        raise ArgumentError(f"{name}: is {quoted(value)}, but has to be a whole number {bounds}")
    return number


def flag(name: str, value: object) -> bool:
    """Check that a value is a boolean, Python's or NumPy's; 0 and 1 are taken as well.

    Raises:
        ArgumentError: it is not.
    """
    if not isinstance(value, bool | np.bool_ | int | np.integer) or value not in (0, 1):
        raise ArgumentError(f"{name}: is {quoted(value)}, but has to be True or False")
    return bool(value)


def of_type(name: str, value: object, kind: type) -> None:
    """Check that a value is an instance of a class.

    Raises:
        ArgumentError: it is not.
    """
    if not isinstance(value, kind):
        raise ArgumentError(f"{name}: is {quoted(value)}, but has to be of type {kind.__name__}")


def offers(name: str, value: object, protocol: type) -> None:
    """Check that a value has every method and attribute of a protocol.

    Args:
        name: The caller's name for the value.
        value: The value.
        protocol: A class derived from `typing.Protocol`.

    Raises:
        ArgumentError: it lacks some; the message names them.
    """
    wanted = {n for n in vars(protocol) if not n.startswith("_")} | set(
        getattr(protocol, "__annotations__", {})
    )
    if lacking := sorted(member for member in wanted if not hasattr(value, member)):
        raise ArgumentError(f"{name}: {quoted(value)} lacks {', '.join(lacking)}; see {protocol.__name__}")


def quoted(value: object) -> str:
    """Return a scalar or a short word as Python writes it, of other values the type: a message is one line."""
    if isinstance(value, int) and value.bit_length() > 128:
        return f"a number of {value.bit_length() // math.log2(10) + 1:.0f} digits"  # Python refuses to print 4,301
    text = repr(value) if isinstance(value, bool | int | float | str | bytes | None) else ""
    return text if 0 < len(text) <= 40 else f"of type {type(value).__name__}"


def one_of(name: str, value: object, choices: Sequence[str]) -> None:
    """Check that a word is one of the allowed choices.

    Raises:
        ArgumentError: it is not; the message lists the choices.
    """
    if not isinstance(value, str) or value not in choices:
        raise ArgumentError(f"{name}: is {quoted(value)}, but has to be one of {', '.join(choices)}")


def _spelled(shape: Shape, sizes: Mapping[str, int]) -> str:
    words = [f"{s}={sizes[s]}" if isinstance(s, str) and s in sizes else str(s) for s in shape]
    return f"({', '.join(words)}{',' if len(words) == 1 else ''})"

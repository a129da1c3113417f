"""Checks of public arguments: each failure is one line that names the argument.

Public functions take whatever NumPy can read as an array, so their parameters are annotated `ArrayLike` and
checked here; what they return, and what they pass on inside, carries its shape in the annotation.
"""

from __future__ import annotations

import operator
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from jaxtyping import Float64

from gsplat_edu.errors import ArgumentError, ShapeError

if TYPE_CHECKING:
    from numpy.typing import ArrayLike as _NumPyArrayLike

    ArrayLike: TypeAlias = _NumPyArrayLike
else:
    # NumPy's alias asks for methods that a tuple has in its stub file alone, so it cannot be checked at run
    # time; float64_array does that.
    ArrayLike = Any

Shape = Sequence[int | str]
"""An expected shape: a number is that size; a letter is any size, the same wherever the letter stands;
"..." in the first place is any number of leading axes."""


def float64_array(
    name: str, value: ArrayLike, shape: Shape, sizes: dict[str, int] | None = None
) -> Float64[np.ndarray, "..."]:
    """Read an argument as a finite float64 array of the given shape.

    Args:
        name: What the caller calls the argument.
        value: The argument.
        shape: Expected shape; letters already in `sizes` must have that size.
        sizes: Sizes of the letters met so far; new ones are added.

    Returns:
        The argument as float64; not a copy when it already was one.

    Raises:
        ShapeError: the shape differs.
        ArgumentError: not numbers, or NaN or infinite somewhere.
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
        where = first_index(~finite)
        raise ArgumentError(f"{name}{where}: is {array[~finite][0]}, but every entry has to be finite")
    return array


def check_shape(name: str, actual: Sequence[int], expected: Shape, sizes: dict[str, int]) -> None:
    """Compare a shape with the expected one and remember the sizes its letters stand for.

    Raises:
        ShapeError: naming the argument, the expected and the actual shape.
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
    """Name the first true entry of a mask the way Python indexes it: "[3, 1]"; "" for a scalar."""
    index = np.argwhere(mask)[0]
    return f"[{', '.join(str(i) for i in index)}]" if len(index) else ""


def in_range(name: str, value: float, low: float, high: float = np.inf, *, open_low: bool = False) -> float:
    """Check low <= value <= high (low < value where `open_low`).

    Raises:
        ArgumentError: outside, or NaN.
    """
    number = float(float64_array(name, value, ()))
    if not (low < number if open_low else low <= number) or number > high:
        bound = f"{'above' if open_low else 'at least'} {low:g}" + (
            f" and at most {high:g}" if high < np.inf else ""
        )
        raise ArgumentError(f"{name}: is {number:g}, but has to be {bound}")
    return number


def whole_number(name: str, value: object, low: int, high: int | None = None) -> int:
    """Check that a value is a whole number between `low` and `high`.

    Returns:
        The number as an int.

    Raises:
        ArgumentError: it is not. True is not a number, and 3.0 is not a whole one.
    """
    try:
        number = None if isinstance(value, bool) else operator.index(value)  # type: ignore[arg-type]
    except TypeError:
        number = None
    if number is None or number < low or (high is not None and number > high):
        bounds = f"of at least {low}" if high is None else f"from {low} to {high}"
        raise ArgumentError(f"{name}: is {value!r}, but has to be a whole number {bounds}")
    return number


def one_of(name: str, value: str, choices: Sequence[str]) -> None:
    """Check that a word is one of those allowed.

    Raises:
        ArgumentError: it is not; the message lists the choices.
    """
    if value not in choices:
        raise ArgumentError(f"{name}: is {value!r}, but has to be one of {', '.join(choices)}")


def _spelled(shape: Shape, sizes: Mapping[str, int]) -> str:
    words = [f"{s}={sizes[s]}" if isinstance(s, str) and s in sizes else str(s) for s in shape]
    return f"({', '.join(words)}{',' if len(words) == 1 else ''})"

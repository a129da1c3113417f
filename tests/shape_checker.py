"""The type checker of the shape-checking hook: beartype, which accepts an int where a float is annotated. Only the
first calls of a function in each test are checked, because a training calls some functions a hundred thousand times,
and checking all calls doubles the time of the suite. conftest.py imports the hook from here.
"""

import functools
import inspect
import sys
from collections.abc import Callable
from typing import Any

import pytest
from beartype import BeartypeConf, beartype

CHECKS = 4
"""Number of checks of a function in each test. Arguments and result are separate checks, so these are 2 calls."""

_beartyped = beartype(conf=BeartypeConf(is_pep484_tower=True))
_counts: dict[tuple[str, str], int] = {}
_unchecked: list[Callable[..., Any]] = []


def checked(stub: Callable[..., Any]) -> Callable[..., Any]:
    """Check a function's arguments or its result. jaxtyping calls this for both, with a stub of the same signature.

    beartype writes the check at the first call, because most processes call only some of the functions they import.
    """
    check: Callable[..., Any] | None = None
    name = (stub.__module__, stub.__qualname__)

    @functools.wraps(stub)
    def counting(*arguments: Any, **keywords: Any) -> Any:
        nonlocal check
        check = check or _beartyped(stub)
        _counts[name] = count = _counts.get(name, 0) + 1
        if count == CHECKS and (function := _find(*name)) is not None:
            function.__no_type_check__ = True  # jaxtyping then calls the function without checks
            _unchecked.append(function)
        return check(*arguments, **keywords)

    return counting


def _find(module: str, qualname: str) -> Any:
    """Return a function or a method of a module by name; None for others, such as local functions."""
    found: Any = sys.modules.get(module)
    for part in qualname.split("."):
        found = inspect.getattr_static(found, part, None)
    if isinstance(found, property):
        found = found.fget
    if isinstance(found, (classmethod, staticmethod)):
        found = found.__func__
    return found if inspect.isfunction(found) and hasattr(found, "__wrapped__") else None


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup() -> None:
    """Check every function again from the next test on."""
    _counts.clear()
    while _unchecked:  # two threads may have counted the same call, and listed a function twice
        vars(_unchecked.pop()).pop("__no_type_check__", None)

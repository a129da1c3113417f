"""Plug-ins: what other packages add, through entry points of the groups gsplat_edu.parts, .strategies and so on.

docs/PLUGINS.md shows a package with one of each.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.text import bounded, printable


def plugins(group: str) -> Mapping[str, Any]:
    """Return the plug-ins of a group by name, in the order of their names.

    Args:
        group: "parts", "strategies", "readers", "formats" or "commands".

    Raises:
        ArgumentError: one cannot be loaded, or two have one name; the message names the package.
    """
    return {name: _loaded(point) for name, point in _points(group).items()}


def package_of(group: str, name: str) -> str:
    """Return name and version of the package that a plug-in comes from."""
    return _package(_points(group)[name])


@functools.cache
def _points(group: str) -> dict[str, EntryPoint]:
    found: dict[str, EntryPoint] = {}
    for point in sorted(entry_points(group=f"gsplat_edu.{group}"), key=lambda point: point.name):
        if point.name in found and point.value != found[point.name].value:
            raise ArgumentError(
                f"plug-in {point.name}: is in {_package(found[point.name])} and in {_package(point)}; remove one"
            )
        found[point.name] = point
    return found


@functools.cache
def _loaded(point: EntryPoint) -> Any:  # noqa: ANN401
    try:
        return point.load()
    except Exception as error:  # whatever another package raises
        said = bounded(printable(f"{type(error).__name__}: {error}"))
        raise ArgumentError(
            f"plug-in {point.name} of {_package(point)} cannot be loaded ({said}); update or remove the package"
        ) from error


def _package(point: EntryPoint) -> str:
    return "an unknown package" if point.dist is None else f"{point.dist.name} {point.dist.version}"

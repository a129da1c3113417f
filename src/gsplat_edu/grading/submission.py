"""A file with the answers of an assignment, which is Python and is executed."""

from __future__ import annotations

import ast
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib.machinery import SourceFileLoader
from pathlib import Path
from types import ModuleType
from typing import Any

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.reading import read_text
from gsplat_edu.base.text import first_line
from gsplat_edu.grading import capture, density, derivatives, geometry, layers, tiles
from gsplat_edu.grading.assignment import Grade, Part, graded

ASSIGNMENTS: Mapping[str, Sequence[Part]] = {
    "projection": geometry.PARTS,
    "compositing": layers.PARTS,
    "gradients": derivatives.PARTS,
    "tiles": tiles.PARTS,
    "density": density.PARTS,
}
"""The parts of each assignment whose answers are functions."""

CAPTURE = "capture"
"""The assignment whose answer is a run."""

ALLOWED = ("numpy", "__future__", *sorted(sys.stdlib_module_names))
"""What an answer may import: not a renderer that has the functions already."""


def grades(path: Path, seed: int = 0) -> tuple[str, list[Grade]]:
    """Execute a file and judge each of its answers.

    Args:
        path: The file. It begins with `ASSIGNMENT = "projection"`, or another name of `ASSIGNMENTS` or "capture".
        seed: Chooses the cases.

    Returns:
        The assignment's name, and the grade of each part.

    Raises:
        ArgumentError: the file cannot be read or executed, names no assignment, or imports what it may not.
    """
    module = _executed(path)
    name = getattr(module, "ASSIGNMENT", None)
    names = [*ASSIGNMENTS, CAPTURE]
    if name not in names:
        raise ArgumentError(
            f'{path}: has to set ASSIGNMENT to one of {", ".join(names)}, such as ASSIGNMENT = "tiles"'
        )
    if name == CAPTURE:
        return name, capture.grades(path.parent, getattr(module, "RUN", None))
    functions: dict[str, Any] = {key: value for key, value in vars(module).items() if callable(value)}
    parts = ASSIGNMENTS[name]
    return name, [graded(part, functions.get(part.name), seed, i) for i, part in enumerate(parts)]


def _executed(path: Path) -> ModuleType:
    try:
        text = read_text(path)
    except (OSError, UnicodeDecodeError) as error:
        raise ArgumentError(
            f"{path}: cannot be read ({first_line(error)}); give the Python file with your answers"
        ) from None
    try:
        tree = ast.parse(text, str(path))
    except (SyntaxError, ValueError) as error:
        line = f", line {error.lineno}" if isinstance(error, SyntaxError) else ""
        raise ArgumentError(f"{path}{line}: is not Python ({first_line(error)})") from None
    for node in ast.walk(tree):
        if not isinstance(node, ast.Import | ast.ImportFrom):
            continue
        names = [alias.name for alias in node.names]
        for module in [node.module or ""] if isinstance(node, ast.ImportFrom) else names:
            if module.partition(".")[0] not in ALLOWED:
                raise ArgumentError(
                    f"{path}, line {node.lineno}: may import NumPy and Python's own modules only, not {module or '.'}"
                )
    loader = SourceFileLoader("submission", str(path))
    made = ModuleType(loader.name)
    try:
        with _without_bytecode():
            loader.exec_module(made)
    except (Exception, SystemExit) as error:  # the file may raise anything
        raise ArgumentError(f"{path}: raises an error when it is executed, {first_line(error)}") from None
    return made


@contextmanager
def _without_bytecode() -> Iterator[None]:
    """Write no `__pycache__` beside the file."""
    before, sys.dont_write_bytecode = sys.dont_write_bytecode, True
    try:
        yield
    finally:
        sys.dont_write_bytecode = before

"""Values of options as text, and options that several commands have."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from gsplat_edu.base.constants import AUTO, LOOPBACK
from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.quantities import bytes_of, seconds_of
from gsplat_edu.render.settings import BACKENDS

Quantity = TypeVar("Quantity", int, float)


def add_backend(parser: argparse._ActionsContainer) -> None:
    """Add the option --backend."""
    names = ", ".join((AUTO, *BACKENDS))
    parser.add_argument(
        "--backend",
        default=AUTO,
        metavar="NAME",
        help=f"what renders: {names}; auto takes cuda if a GPU passes a comparison with cpu, else cpu; for a"
        " training also webgpu on a GPU that passes and is forecast to be faster than cpu"
        " (default: %(default)s)",
    )


def add_address(parser: argparse.ArgumentParser, port: int) -> None:
    """Add the options of a server's address.

    Args:
        parser: Receives --host and --port.
        port: The default port.
    """
    parser.add_argument(
        "--host",
        default=LOOPBACK,
        metavar="ADDRESS",
        help=f"address to listen on (default: {LOOPBACK}, reachable from this computer only)",
    )
    parser.add_argument(
        "--port",
        type=whole_number_text,
        default=port,
        metavar="N",
        help=f"port to listen on; 0 for any free one (default: {port})",
    )


def add_meshes(parser: argparse.ArgumentParser) -> None:
    """Add --surface and --collider, the meshes of a page."""
    parser.add_argument(
        "--surface",
        type=Path,
        metavar="FILE",
        help="mesh of the scene, from gsplat-edu mesh, that the page shows beside the splats",
    )
    parser.add_argument(
        "--collider",
        type=Path,
        metavar="FILE",
        help="mesh from gsplat-edu mesh --collider that the page lays over --surface and the splats",
    )


def whole_number_text(text: str) -> int:
    """Parse a whole number."""
    try:
        return int(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number") from None


def numbers_text(count: int) -> Callable[[str], tuple[float, ...]]:
    """Return a parser of `count` finite numbers separated by commas."""

    def read(text: str) -> tuple[float, ...]:
        try:
            numbers = tuple(float(part) for part in text.split(","))
        except ValueError:
            numbers = ()
        if len(numbers) != count or not all(map(math.isfinite, numbers)):
            raise argparse.ArgumentTypeError(f"{text!r} is not {count} numbers separated by commas")
        return numbers

    return read


def number_text(text: str) -> float:
    """Parse a finite number."""
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise argparse.ArgumentTypeError(f"{text!r} is not a number")
    return number


@dataclass(frozen=True)
class NumberOr:
    """Parses a finite number, or one word, which stays text.

    Args:
        word: The word.
        whole: Whether the number has to be whole.
    """

    word: str
    whole: bool = False

    def __call__(self, text: str) -> float | int | str:
        """Parse a text."""
        if text == self.word:
            return text
        return whole_number_text(text) if self.whole else number_text(text)


def seconds_text(text: str) -> float:
    """Parse a duration; see `gsplat_edu.base.quantities.seconds_of`."""
    return _quantity(seconds_of, text)


def bytes_text(text: str) -> int:
    """Parse a size; see `gsplat_edu.base.quantities.bytes_of`."""
    return _quantity(bytes_of, text)


def _quantity(read: Callable[[str], Quantity], text: str) -> Quantity:
    try:
        return read(text)
    except ArgumentError as error:
        raise argparse.ArgumentTypeError(str(error)) from None

"""Command lines whose mistakes cost one line, not a page."""

from __future__ import annotations

import argparse
import sys
import traceback
from collections.abc import Callable
from typing import Any, NoReturn

from gsplat_edu.errors import SplatError

EXIT_BAD_INPUT = 2
EXIT_INTERRUPTED = 130


class OneLineParser(argparse.ArgumentParser):
    """A parser that answers a mistake with one line: what is wrong and where help is.

    Options are not abbreviated: what a script relies on keeps its meaning when options are added.
    """

    def __init__(self, **options: Any) -> None:  # noqa: ANN401
        super().__init__(allow_abbrev=False, **options)

    def error(self, message: str) -> NoReturn:
        """Print the line and exit with 2."""
        self.exit(EXIT_BAD_INPUT, f"{self.prog}: {message}; see {self.prog} --help\n")


def whole_number_text(text: str) -> int:
    """Read a whole number from the command line."""
    try:
        return int(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number") from None


def run_command(program: str, command: Callable[[], None], debug: bool) -> int:
    """Run a command and turn what can go wrong into one line on stderr.

    Args:
        program: Name in front of the line.
        command: What to run.
        debug: Print the traceback too.

    Returns:
        Exit code: 0; 2 for bad input or a file that cannot be written; 130 when interrupted.
    """
    try:
        command()
    except KeyboardInterrupt:
        print(f"{program}: interrupted", file=sys.stderr)
        return EXIT_INTERRUPTED
    except (SplatError, OSError) as error:
        if debug:
            traceback.print_exc()
        print(f"{program}: {error}", file=sys.stderr)
        return EXIT_BAD_INPUT
    return 0

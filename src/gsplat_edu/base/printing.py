"""Terminal output without rich, for errors raised before rich is imported and for scripts."""

from __future__ import annotations

import sys

from gsplat_edu.base.text import bounded, printable


def say(sentence: str) -> None:
    """Print a line to standard output from a script."""
    print(printable(sentence), flush=True)


def complain(sentence: str) -> None:
    """Print a line to standard error; values in it may be of any length, and are shortened."""
    print(bounded(printable(sentence)), file=sys.stderr)


def escape_unencodable_characters() -> None:
    """Escape characters that the locale cannot encode, on standard output and error, to avoid UnicodeEncodeError."""
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")

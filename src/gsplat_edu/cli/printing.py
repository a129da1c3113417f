"""Lines on a terminal, without rich: errors come before it is imported, and scripts do without it."""

from __future__ import annotations

import sys

from gsplat_edu.text import printable


def say(sentence: str) -> None:
    """Print a line to standard output from a script."""
    print(printable(sentence), flush=True)


def complain(sentence: str) -> None:
    """Print a line to standard error."""
    print(printable(sentence), file=sys.stderr)


def spell_what_cannot_be_encoded() -> None:
    """Let standard output and error spell characters that the locale lacks, instead of raising UnicodeEncodeError."""
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")

"""Text for people: short numbers, and names from files on a terminal, in a file, and as a file name.

A name on Linux is bytes, and the text of a JSON file may hold halves of a surrogate pair. Python keeps a byte that it
could not decode as a lone surrogate (PEP 383). No encoding takes these, so a report could fail on its title.
"""

from __future__ import annotations

import os
import re
from pathlib import Path

_SURROGATES = re.compile("[\ud800-\udfff]")

_CONTROLS = re.compile("[\x00-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ufeff]")
"""Characters that move the cursor, change colours, break a line or reverse the direction of text."""

MOST_SPELLED = 1e12
"""From this on `short_number` uses an exponent."""

RAW_BYTES = 0xDC80, 0xDCFF
"""Lone surrogates that stand for the bytes 0x80 to 0xFF."""


def short_number(value: float, digits: int) -> str:
    """Write a number with a few significant digits; a large one with all digits of its whole part, not 1e+03.

    Args:
        value: The number.
        digits: Significant digits.
    """
    text = f"{value:.{digits}g}"
    return f"{value:,.0f}" if "e+" in text and abs(value) < MOST_SPELLED else text


def legible(text: str) -> str:
    """Return text without lone surrogates, which every UTF-8 encoder takes.

    Args:
        text: Any text. Raw bytes in it that are valid UTF-8 together, as in names read under LC_ALL=C, are decoded;
            other raw bytes and lone surrogates become backslash escapes.
    """
    if not _SURROGATES.search(text):
        return text
    low, high = RAW_BYTES
    halves = _SURROGATES.sub(lambda m: m[0] if low <= ord(m[0]) <= high else f"\\u{ord(m[0]):04x}", text)
    return halves.encode("utf-8", "surrogateescape").decode("utf-8", "backslashreplace")


def printable(text: str) -> str:
    """Return one line that is safe to print: control characters become backslash escapes.

    Without this a file name could clear the screen, hide a warning or write its own line.
    """
    return _CONTROLS.sub(_escaped, legible(text))


def _escaped(match: re.Match[str]) -> str:
    code = ord(match[0])
    return {"\n": "\\n", "\r": "\\r", "\t": "\\t"}.get(
        match[0], f"\\x{code:02x}" if code < 0x100 else f"\\u{code:04x}"
    )


def write_text(path: Path, text: str) -> None:
    """Write a text file as UTF-8; `legible` spells what has no UTF-8.

    Raises:
        OSError: the file cannot be written.
    """
    path.write_text(legible(text), encoding="utf-8")


def as_file_name(name: str) -> str:
    """Return a path from a file's text as the system's functions take it, whatever the locale.

    File names are bytes, in UTF-8 on every system in use. Under LC_ALL=C Python would refuse to encode "ü".
    """
    try:
        return os.fsdecode(name.encode("utf-8", "surrogateescape"))
    except UnicodeError:  # half of a pair: no file has this name
        return name

"""Text for people: numbers and durations, and names from files in safe forms for terminals, files and file names.

File names on Linux are bytes, and JSON text may contain unpaired surrogates. Python represents a byte that it cannot
decode as a lone surrogate (PEP 383). No encoding accepts these, so a report could fail because of its title.
"""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from pathlib import Path

_SURROGATES = re.compile("[\ud800-\udfff]")

_CONTROLS = re.compile("[\x00-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ufeff]")
"""Characters that move the cursor, change colours, break a line or reverse the direction of text."""

LONGEST_WORD = 300
"""Characters of a word in a line for people: most paths are shorter."""

LONGEST_LINE = 1_000
"""Characters of a line for people."""

_LONG_WORD = re.compile(rf"\S{{{LONGEST_WORD + 1},}}")

_WHOLE = re.compile("[0-9]{1,20}")

MOST_SPELLED = 1e12
"""`short_number` uses an exponent for numbers of at least this."""

RAW_BYTES = 0xDC80, 0xDCFF
"""Lone surrogates that represent the bytes 0x80 to 0xFF."""


class Told(str):
    """A text for the command line, which may name commands, options and files, with the words of a page for the same.

    Operations on the text (`+`, f-strings) return a plain `str` with the words for the command line.

    Args:
        text: For the command line.
        plain: For a page, which has buttons instead; empty if a page has nothing to say.
    """

    plain: str

    def __new__(cls, text: str, plain: str) -> Told:
        """Make the text, and keep the words of the page with it."""
        made = super().__new__(cls, text)
        made.plain = plain
        return made


def plain_of(text: str) -> str:
    """Return the words of a page for a text: those of `Told`, or the text itself."""
    return text.plain if isinstance(text, Told) else text


def short_number(value: float, digits: int) -> str:
    """Write a number with a few significant digits; a large one with all digits of its whole part, not 1e+03.

    Args:
        value: The number.
        digits: Significant digits.
    """
    text = f"{value:.{digits}g}"
    return f"{value:,.0f}" if "e+" in text and abs(value) < MOST_SPELLED else text


def spelled_seconds(seconds: float) -> str:
    """Write a duration: 12 s, 3 min 40 s, 2 h 5 min."""
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60} s"
    return f"{whole // 3600} h {whole % 3600 // 60} min"


def spelled_bytes(size: float) -> str:
    """Format a size: 1.25 GiB, 204 MiB."""
    return f"{size / 2**30:.3g} GiB" if size >= 2**30 else f"{size / 2**20:.0f} MiB"


def option_flag(name: str) -> str:
    """Return the option of a name: "max_gaussians" becomes "--max-gaussians"."""
    return f"--{name.replace('_', '-')}"


def legible(text: str) -> str:
    """Replace lone surrogates, so that every UTF-8 encoder accepts the text.

    Args:
        text: Any text. Raw bytes that form valid UTF-8, as in names read under LC_ALL=C, are decoded; other raw bytes
            and lone surrogates become backslash escapes.
    """
    if not _SURROGATES.search(text):
        return text
    low, high = RAW_BYTES
    halves = _SURROGATES.sub(lambda m: m[0] if low <= ord(m[0]) <= high else f"\\u{ord(m[0]):04x}", text)
    return halves.encode("utf-8", "surrogateescape").decode("utf-8", "backslashreplace")


def printable(text: str) -> str:
    """Return one line that is safe to print: control characters become backslash escapes.

    Otherwise a file name could clear the screen, hide a warning or fake a line of output.
    """
    return _CONTROLS.sub(_escaped, legible(text))


def shortened(text: str, most: int = 80) -> str:
    """Return a text of limited length: the middle of a longer one is replaced by "...".

    Args:
        text: The text.
        most: Most characters; at least 5.
    """
    if len(text) <= most:
        return text
    end = (most - 3) // 3
    return f"{text[: most - 3 - end]}...{text[len(text) - end :]}"


def first_line(error: BaseException) -> str:
    """Return the kind of an error and the first line that it says."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return f"{type(error).__name__}: {lines[0] if lines else 'no message'}"


def bounded(line: str) -> str:
    """Return a line for people of limited length; values that it quotes may be of any length, and are shortened.

    The start and the end remain, which say what is wrong and what to do.
    """
    words = _LONG_WORD.sub(lambda match: shortened(match[0], LONGEST_WORD), line)
    return shortened(words, LONGEST_LINE)


def whole_of(text: str) -> int | None:
    """Return the number that a text of at most 20 digits from 0 to 9 spells; None for any other text.

    `int` also accepts signs, spaces, underscores and the digits of other scripts, and fails beyond 4,300 digits;
    `str.isdigit` accepts superscripts, which `int` does not.
    """
    return int(text) if _WHOLE.fullmatch(text) else None


def _escaped(match: re.Match[str]) -> str:
    code = ord(match[0])
    return {"\n": "\\n", "\r": "\\r", "\t": "\\t"}.get(
        match[0], f"\\x{code:02x}" if code < 0x100 else f"\\u{code:04x}"
    )


def write_text(path: Path, text: str) -> None:
    """Write a text file as UTF-8; `legible` replaces characters without an encoding.

    Raises:
        OSError: the file cannot be written.
    """
    path.write_text(legible(text), encoding="utf-8")


def decode_file_name(raw: bytes) -> str:
    """Decode the bytes of a file name for the system's functions; every byte survives.

    Windows refuses bytes that are not UTF-8. No file there has such a name, so the text only has to be printable.
    """
    try:
        return os.fsdecode(raw)
    except UnicodeDecodeError:
        return raw.decode("utf-8", "surrogateescape")


def names_a_file(text: str) -> bool:
    """Return whether a file can have this name or path: neither a null character nor an unpaired surrogate.

    The lone surrogates that stand for bytes (PEP 383) count as bytes.
    """
    try:
        text.encode("utf-8", "surrogateescape")
    except UnicodeEncodeError:
        return False
    return "\0" not in text


def as_file_name(name: str) -> str:
    """Convert a file's text to a path for the system's functions, independent of the locale.

    File names are UTF-8 bytes on every system in use, but under LC_ALL=C Python would refuse to encode "ü".
    """
    try:
        return decode_file_name(name.encode("utf-8", "surrogateescape"))
    except UnicodeError:  # an unpaired surrogate: no file has this name
        return name


def install_command(extra: str) -> str:
    """Return the command that adds an extra, in a clone of the repository; there is no published package yet."""
    return f'pip install -c constraints.txt ".[{extra}]"'


def easily_read(count: int) -> int:
    """Round down to two digits, or to three if the first is 1, so that a number is easy to read and type.

    Args:
        count: The number, at least 0.
    """
    digits = 3 if str(count).startswith("1") else 2
    step = int(10 ** max(len(str(count)) - digits, 0))
    return count // step * step


def image_file_names(names: Sequence[str], suffix: str = ".png") -> list[str]:
    """Turn image names into distinct file names for one folder.

    Every character other than letters, digits, ".", "_" and "-" becomes "_", including path separators. The image's
    own suffix is removed.

    Args:
        names: Image names in the capture, for example "left/0001.jpg".
        suffix: Suffix of the file names.

    Returns:
        One file name per image: "left_0001.png".
    """
    result: list[str] = []
    taken: set[str] = set()
    copies: dict[str, int] = {}  # the next number to try, so that equal names do not count up from 2 each
    for index, name in enumerate(names):
        base = re.sub(r"\.[A-Za-z]{3,4}$", "", name)
        stem = re.sub(r"[^\w.-]", "_", base).lstrip(".")[:200] or f"view_{index:04d}"
        chosen, copy = stem, copies.get(stem.lower(), 2)
        while chosen.lower() in taken:  # some file systems ignore case
            chosen, copy = f"{stem}_{copy}", copy + 1
        taken.add(chosen.lower())
        copies[stem.lower()] = copy
        result.append(as_file_name(chosen + suffix))
    return result

"""Opening files that somebody else may have made: regular ones only, and within memory.

JSON either parses or fails with a ValueError, however deep it is nested.
"""

from __future__ import annotations

import errno
import json
import os
import stat
from collections.abc import Callable
from pathlib import Path
from typing import Any, BinaryIO

from gsplat_edu.headroom import require_memory

TOO_LARGE = "close other programs, or read it on a machine with more memory"
"""What to do about a file that does not fit into memory."""

KINDS = {
    stat.S_IFIFO: "is a pipe",
    stat.S_IFSOCK: "is a socket",
    stat.S_IFCHR: "is a device",
    stat.S_IFBLK: "is a device",
    stat.S_IFDIR: "is a folder",
}
"""What is not read, by the kind that the system says it is of."""


def open_file(path: str | Path) -> BinaryIO:
    """Open a regular file to read its bytes.

    A pipe would block until somebody writes to it, and a device may never end.

    Raises:
        OSError: the file cannot be opened, or is a pipe, a socket, a device or a folder.
    """
    path = Path(path)
    _check_regular(path, path.stat().st_mode)  # first: opening a device may have an effect
    descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    try:
        _check_regular(path, os.fstat(descriptor).st_mode)  # it may have been replaced in between
        return os.fdopen(descriptor, "rb")
    except BaseException:
        os.close(descriptor)
        raise


def read_bytes(path: Path) -> bytes:
    """Read a whole regular file.

    Raises:
        OSError: as for `open_file`.
        NotEnoughMemoryError: it is larger than the memory that is free.
    """
    with open_file(path) as file:
        size = os.fstat(file.fileno()).st_size
        require_memory(str(path), size, TOO_LARGE)
        return file.read()


def read_text(path: Path, encoding: str = "utf-8", errors: str = "strict") -> str:
    """Read a whole text file; line ends become LF.

    Raises:
        OSError: as for `open_file`.
        UnicodeDecodeError: it is not in the encoding, and `errors` is "strict".
        NotEnoughMemoryError: as for `read_bytes`.
    """
    return read_bytes(path).decode(encoding, errors).replace("\r\n", "\n").replace("\r", "\n")


def parse_json(text: str | bytes, parse_constant: Callable[[str], Any] | None = None) -> Any:  # noqa: ANN401
    """Parse JSON.

    Args:
        text: The text.
        parse_constant: Called with "NaN", "Infinity" or "-Infinity"; None takes them for numbers.

    Raises:
        ValueError: it is no JSON, is nested too deep to parse, or has a number of thousands of digits.
    """
    try:
        return json.loads(text, parse_constant=parse_constant)
    except RecursionError:
        raise ValueError("nested too deep") from None
    except json.JSONDecodeError:
        raise
    except ValueError as error:
        # Python's own words for it advise to change a limit of the interpreter
        raise ValueError("a number has thousands of digits") if "digits" in str(error) else error from None


def _check_regular(path: Path, mode: int) -> None:
    if not stat.S_ISREG(mode):
        kind = KINDS.get(stat.S_IFMT(mode), "is something else")
        raise OSError(errno.EINVAL, f"{kind}, not a file", str(path))

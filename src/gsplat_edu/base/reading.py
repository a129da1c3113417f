"""Open files of unknown origin safely: only regular files, and only within the available memory.

JSON parses or fails with a ValueError at any depth of nesting.
"""

from __future__ import annotations

import errno
import json
import os
import stat
from io import BufferedReader, FileIO
from pathlib import Path, PureWindowsPath
from typing import Any, NoReturn

from gsplat_edu.base.headroom import require_memory
from gsplat_edu.base.text import names_a_file

TOO_LARGE = "close other programs, or read it on a machine with more memory"
"""Advice for a file that does not fit into memory."""

MOST_TRUSTED = 1 << 20
"""Bytes that are asked for without a look at the file's size."""

KINDS = {
    stat.S_IFIFO: "is a pipe",
    stat.S_IFSOCK: "is a socket",
    stat.S_IFCHR: "is a device",
    stat.S_IFBLK: "is a device",
    stat.S_IFDIR: "is a folder",
}
"""File types that are not read, by the system's mode."""


class _Reader(BufferedReader):
    """A file that allocates no more than it holds, however many bytes a header claims."""

    def read(self, size: int | None = -1, /) -> bytes:
        """Read bytes; see `io.BufferedReader.read`."""
        if size is not None and size > MOST_TRUSTED:
            size = min(size, max(os.fstat(self.fileno()).st_size - self.tell(), 0))
        return super().read(size)


def open_file(path: str | Path) -> BufferedReader:
    """Open a regular file for reading bytes.

    A pipe would block until somebody writes to it, and a device may never end.

    Raises:
        OSError: the file cannot be opened, or is a pipe, a socket, a device or a folder.
    """
    path = Path(path)
    _check_regular(path, path.stat().st_mode)  # before opening: opening a device may have side effects
    descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    try:
        _check_regular(path, os.fstat(descriptor).st_mode)  # the file may have been replaced in between
        return _Reader(FileIO(descriptor, "rb"))
    except BaseException:
        os.close(descriptor)
        raise


def read_bytes(path: Path) -> bytes:
    """Read a whole regular file.

    Raises:
        OSError: as for `open_file`.
        NotEnoughMemoryError: the file is larger than the free memory.
    """
    with open_file(path) as file:
        size = os.fstat(file.fileno()).st_size
        require_memory(str(path), size, TOO_LARGE)
        return file.read()


def read_text(path: Path, encoding: str = "utf-8", errors: str = "strict") -> str:
    """Read a whole text file; line endings become LF.

    Raises:
        OSError: as for `open_file`.
        UnicodeDecodeError: the encoding does not match, and `errors` is "strict".
        NotEnoughMemoryError: as for `read_bytes`.
    """
    return read_bytes(path).decode(encoding, errors).replace("\r\n", "\n").replace("\r", "\n")


def parse_json(text: str | bytes, *, strict: bool = False) -> Any:  # noqa: ANN401
    """Parse JSON.

    Args:
        text: The text.
        strict: Refuse "NaN", "Infinity" and "-Infinity", which are no JSON, instead of reading them as numbers.

    Raises:
        ValueError: the text is not JSON, is nested too deeply, or contains a number with thousands of digits.
    """
    try:
        return json.loads(text, parse_constant=_refuse_constant if strict else None)
    except RecursionError:
        raise ValueError("nested too deeply") from None
    except json.JSONDecodeError:
        raise
    except ValueError as error:
        # Python's own message advises changing a limit of the interpreter.
        raise ValueError("a number has thousands of digits") if "digits" in str(error) else error from None


def stored_path(value: object) -> Path | None:
    """Return a path from a file such as config.json; None if it must not be opened.

    These files are exchanged. On Windows, //server/share is an address: opening it logs in there with the user's name.
    A network share is therefore never taken from a file, only from the command line.

    Args:
        value: The value of a field.
    """
    if not isinstance(value, str) or not value or not names_a_file(value):
        return None
    return None if PureWindowsPath(value).drive.startswith("\\\\") else Path(value)


def kind_of(path: str | Path) -> str | None:
    """Return what a path is instead of a file, such as "is a pipe"; None for a file, and for what does not exist.

    Args:
        path: The path; its links are followed.
    """
    try:
        return KINDS.get(stat.S_IFMT(Path(path).stat().st_mode))
    except (OSError, ValueError):
        return None


def _refuse_constant(name: str) -> NoReturn:
    raise ValueError(f"{name} is not valid JSON")


def _check_regular(path: Path, mode: int) -> None:
    if not stat.S_ISREG(mode):
        kind = KINDS.get(stat.S_IFMT(mode), "is of an unknown type")
        raise OSError(errno.EINVAL, f"{kind}, not a file", str(path))

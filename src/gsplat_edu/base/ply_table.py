"""PLY files as tables: the elements of the header and the rows of one element. Independent of splats."""

from __future__ import annotations

import itertools
import os
import sys
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from gsplat_edu.base.errors import SceneFormatError
from gsplat_edu.base.headroom import require_memory
from gsplat_edu.base.reading import TOO_LARGE

FORMATS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
"""Formats and their byte order in NumPy's notation."""

NUMBERS = {
    "char": "i1",
    "int8": "i1",
    "uchar": "u1",
    "uint8": "u1",
    "short": "i2",
    "int16": "i2",
    "ushort": "u2",
    "uint16": "u2",
    "int": "i4",
    "int32": "i4",
    "uint": "u4",
    "uint32": "u4",
    "float": "f4",
    "float32": "f4",
    "double": "f8",
    "float64": "f8",
}
"""PLY's number types, in both spellings, as NumPy types."""

LINE_LIMIT = 4096
"""Most bytes of a header line."""

HEADER_LIMIT = 10_000
"""Most lines of a header; a file with more is not a PLY, whatever its first line says."""

MOST_ROWS = 10**12
"""Most rows of an element; more indicate a damaged header or a malicious file."""

COPIES = 3
"""Peak number of copies of the rows if they are read at once: the table, its columns and the result."""

BLOCK = 2**18
"""Rows that are read at a time; those of a scene of SH degree 3 take 62 MiB."""

LFS_POINTER = b"version https://git-lfs"


def refuse_lfs_pointer(path: Path, start: bytes) -> None:
    """Refuse a file that only points to the one that Git LFS has.

    Args:
        path: The file's name for the message.
        start: Its first bytes, at least as many as `LFS_POINTER`.

    Raises:
        SceneFormatError: the file is such a pointer.
    """
    if start.startswith(LFS_POINTER):
        raise SceneFormatError(
            f"{path}: is a Git LFS pointer, not the file itself; fetch it with: git lfs pull"
        )


@dataclass(frozen=True)
class Element:
    """An element of a PLY.

    Args:
        name: Its name, for example "vertex".
        count: Number of rows declared in the header.
        properties: Name and NumPy type (without byte order) of each; the type of a list is None.
        lists: For each list its name, and the NumPy types of its length and of its items.
    """

    name: str
    count: int
    properties: tuple[tuple[str, str | None], ...]
    lists: tuple[tuple[str, str, str], ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the properties, in file order."""
        return tuple(name for name, _ in self.properties)

    def dtype(self, path: Path, order: str) -> np.dtype[Any]:
        """Return the type of a row.

        Raises:
            SceneFormatError: a property is a list, so the rows have no fixed size.
        """
        fields = []
        for name, kind in self.properties:
            if kind is None:
                raise SceneFormatError(
                    f"{path}: element {self.name} has the list {name}, so its rows cannot be read as a table;"
                    " export it without the list"
                )
            fields.append((name, order + kind))
        return np.dtype(fields)


@dataclass(frozen=True)
class Header:
    """The contents of the header.

    Args:
        format: "ascii", "binary_little_endian" or "binary_big_endian".
        elements: The elements, in file order.
        comments: Words of each comment, in file order.
    """

    format: str
    elements: tuple[Element, ...]
    comments: tuple[tuple[str, ...], ...] = ()


def read_elements(path: Path, file: BinaryIO | BytesIO) -> Header:
    """Read the header, leaving the file at the first byte after it.

    Raises:
        SceneFormatError: not a PLY, or the header is damaged; the message names the line.
    """
    first = file.readline(LINE_LIMIT)
    refuse_lfs_pointer(path, first)
    if first.strip() != b"ply":
        raise SceneFormatError(f"{path}: is not a PLY: its first line is not 'ply'; give another file")
    header = HeaderLines()
    for number in range(2, HEADER_LIMIT):
        line = file.readline(LINE_LIMIT)
        words = line.decode("ascii", "replace").split()
        if words == ["end_header"]:
            break
        mistake = "the header ends here" if not line else header.add(words)
        if mistake:
            raise SceneFormatError(f"{path}: line {number}: {mistake}; the file is damaged, get it again")
    else:
        raise SceneFormatError(f"{path}: no end_header in {HEADER_LIMIT} lines; the file is damaged")
    if header.format is None:
        raise SceneFormatError(f"{path}: its header names no format; the file is damaged, get it again")
    elements = tuple(
        Element(n, c, tuple(p.items()), tuple(header.lists.get(n, ())))
        for n, (c, p) in header.elements.items()
    )
    return Header(header.format, elements, tuple(header.comments))


class HeaderLines:
    """Collects the lines of a header."""

    def __init__(self) -> None:
        self.format: str | None = None
        self.elements: dict[str, tuple[int, dict[str, str | None]]] = {}
        self.lists: dict[str, list[tuple[str, str, str]]] = {}
        self.comments: list[tuple[str, ...]] = []

    def add(self, words: list[str]) -> str | None:
        """Take a line of the header, given as its words; return what is wrong with it, or None."""
        match words:
            case [] | ["obj_info", *_]:
                return None
            case ["comment", *said]:
                self.comments.append(tuple(said))
            case ["format", name, _] if name in FORMATS and self.format is None:
                self.format = name
            case ["element", name, count] if count.isdecimal() and name not in self.elements:
                if int(count) > MOST_ROWS:
                    return f"element {name[:40]} of {count[:30]} rows is more than any file holds"
                self.elements[name] = (int(count), {})
            case ["property", "list", size, number, name] if size in NUMBERS and number in NUMBERS:
                mistake = self._property(name, None)
                if mistake is None:
                    owner = next(reversed(self.elements))
                    self.lists.setdefault(owner, []).append((name, NUMBERS[size], NUMBERS[number]))
                return mistake
            case ["property", number, name] if number in NUMBERS:
                return self._property(name, NUMBERS[number])
            case _:
                return f"{' '.join(words)[:60]!r} is not a line of a PLY header"
        return None

    def _property(self, name: str, kind: str | None) -> str | None:
        if not self.elements:
            return f"property {name} belongs to no element"
        _, properties = next(reversed(self.elements.values()))
        if name in properties:
            return f"property {name} appears twice"
        properties[name] = kind
        return None


def read_rows(path: Path, file: BinaryIO, header: Header, wanted: Element) -> np.ndarray[Any, np.dtype[Any]]:
    """Read the rows of one element; see `read_blocks`.

    Returns:
        (count,) structured array.
    """
    (rows,) = _blocks(path, file, header, wanted, max(wanted.count, 1), COPIES)
    return rows


def read_blocks(
    path: Path, file: BinaryIO, header: Header, wanted: Element
) -> Iterator[np.ndarray[Any, np.dtype[Any]]]:
    """Yield the rows of one element in blocks, so that the caller's result is the only copy of all rows.

    Nothing is allocated for rows that do not fit into the file.

    Args:
        path: The file's name, for messages.
        file: The open file, just after its header.
        header: The header.
        wanted: The element, one of the header's.

    Returns:
        (n,) structured arrays with the element's properties by name; all are float64 if the file is ASCII, which is
        read in one block.

    Raises:
        SceneFormatError: rows are missing or malformed; the message gives the number present.
    """
    return _blocks(path, file, header, wanted, BLOCK, 1)


def _blocks(
    path: Path, file: BinaryIO, header: Header, wanted: Element, rows: int, copies: int
) -> Iterator[np.ndarray[Any, np.dtype[Any]]]:
    """Yield blocks of rows if memory suffices for a given number of copies of all rows."""
    order = FORMATS[header.format]
    before = header.elements[: header.elements.index(wanted)]
    dtype = wanted.dtype(path, order)
    if header.format == "ascii":
        # rows of an element without properties are blank lines, which are skipped
        skipped = sum(element.count for element in before if element.properties)
        yield _ascii_rows(path, file, skipped, wanted)
        return
    left = os.fstat(file.fileno()).st_size - file.tell()
    skipped = sum(element.count * element.dtype(path, order).itemsize for element in before)
    there = max(0, left - skipped) // dtype.itemsize if dtype.itemsize else 0
    if there < wanted.count:
        raise _truncated(path, wanted, there)
    if not wanted.count:  # the declared rows before it may exceed any file size
        yield np.empty(0, dtype)
        return
    require_memory(str(path), copies * wanted.count * dtype.itemsize, TOO_LARGE)
    file.seek(skipped, os.SEEK_CUR)
    for start in range(0, wanted.count, rows):
        block = np.fromfile(file, dtype=dtype, count=min(rows, wanted.count - start))
        if len(block) < min(rows, wanted.count - start):  # the file was cut meanwhile
            raise _truncated(path, wanted, start + len(block))
        yield block


def _ascii_rows(path: Path, file: BinaryIO, skipped: int, wanted: Element) -> np.ndarray[Any, np.dtype[Any]]:
    names = wanted.names
    lines = itertools.islice(
        (line for line in file if line.strip()),  # blank lines are not rows
        min(skipped, sys.maxsize),
        min(skipped + wanted.count, sys.maxsize),
    )
    rows = np.empty((0, len(names)))
    # a number needs at least two bytes in the file, and eight in the table
    lines_left = os.fstat(file.fileno()).st_size - file.tell()
    require_memory(str(path), min(4 * lines_left, 8 * wanted.count * len(names)), TOO_LARGE)
    if wanted.count:
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", UserWarning)  # no lines at all; reported below
                rows = np.loadtxt(lines, comments=None, ndmin=2, encoding="latin-1")
        except ValueError as error:
            reason = str(error).split(";")[0].rstrip(".")
            raise SceneFormatError(
                f"{path}: rows of {wanted.name} cannot be read ({reason}); the file is damaged, get it again"
            ) from None
    if len(rows) < wanted.count:
        raise _truncated(path, wanted, len(rows))
    if rows.shape[1] != len(names):
        raise SceneFormatError(
            f"{path}: rows of {wanted.name} have {rows.shape[1]} numbers, but the header names {len(names)};"
            " the file is damaged, get it again"
        )
    return np.ascontiguousarray(rows).view([(name, "f8") for name in names])[:, 0]


def _truncated(path: Path, element: Element, there: int) -> SceneFormatError:
    return SceneFormatError(
        f"{path}: is truncated: {there} of {element.count} rows of {element.name} are present; get the file again"
    )

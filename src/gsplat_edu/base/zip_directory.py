"""Measure the directory of a zip file before `zipfile` reads it, which takes time and memory for every entry.

Readers of zip files find the directory in different ways: from the end, by an offset, or past data before or after it.
A file in which these ways lead to different places is refused, so that every version of `zipfile` reads the directory
that was measured. The format: PKWARE, APPNOTE.TXT 6.3.10, sections 4.3.12 to 4.3.16.
"""

from __future__ import annotations

import os
import struct
from typing import BinaryIO

END = struct.Struct("<4sHHHHIIH")
"""End record: signature, two disk numbers, entries on this disk and in all, size and offset of the directory, and the
length of the comment that follows."""

LOCATOR = struct.Struct("<4sIQI")
"""zip64, before the end record: signature, a disk number, offset of the zip64 end record, number of disks."""

END64 = struct.Struct("<4sQHHIIQQQQ")
"""zip64 end record, before the locator: signature, bytes that follow, two versions, and the fields of `END`."""

HEADER = struct.Struct("<4s24xHHH12x")
"""Entry of the directory: signature, and lengths of the name, the extra field and the comment that follow."""

TAIL = END.size + 65_535
"""Bytes at the end of a zip file in which its end record starts: the record and its comment."""

BYTES_PER_ENTRY = 1_000
"""Bytes of the directory per entry, on average at most."""


class TooManyEntriesError(ValueError):
    """A zip file lists more entries than are allowed."""


def check_directory(file: BinaryIO, most: int) -> None:
    """Measure the directory of a zip file, and check that it can be found in one place only.

    Args:
        file: The zip file; it is left at an unspecified position.
        most: Largest number of entries.

    Raises:
        TooManyEntriesError: it lists more entries.
        ValueError: there is no directory, or it is damaged or ambiguous.
    """
    size = file.seek(0, os.SEEK_END)
    file.seek(max(size - TAIL, 0))
    tail = file.read()
    at = tail.rfind(b"PK\x05\x06")
    if at < 0 or len(tail) < at + END.size:
        raise ValueError("is not a zip file")
    _, disk, first, here, count, length, begin, comment = END.unpack_from(tail, at)
    if at + END.size + comment != len(tail):
        raise ValueError("its end is damaged, or something follows it")
    end = size - len(tail) + at
    if (wide := _wide_end(file, end)) is not None:
        narrow = ((disk, 16), (first, 16), (here, 16), (count, 16), (length, 32), (begin, 32))
        if any(
            value not in (other, (1 << bits) - 1) for (value, bits), other in zip(narrow, wide, strict=True)
        ):
            raise ValueError("has two ends that disagree")
        disk, first, here, count, length, begin = wide
        end -= LOCATOR.size + END64.size
    if count > most or length > most * BYTES_PER_ENTRY:
        raise TooManyEntriesError(
            f"lists {count:,} entries in {length:,} bytes; {most:,} entries may be in it"
        )
    if (disk, first) != (0, 0) or here != count or begin + length != end:
        raise ValueError("its directory is not where it claims to be")
    file.seek(begin)
    _count_entries(file.read(length), count)


def _wide_end(file: BinaryIO, end: int) -> tuple[int, ...] | None:
    """Return the fields of the zip64 end record, as those of `END` without the comment; None if there is none.

    Args:
        file: The zip file.
        end: Where its end record starts.

    Raises:
        ValueError: the record is not directly before its locator, where `zipfile` looks for it.
    """
    if end < LOCATOR.size:
        return None
    file.seek(end - LOCATOR.size)
    signature, disk, offset, disks = LOCATOR.unpack(file.read(LOCATOR.size))
    if signature != b"PK\x06\x07":
        return None
    at = end - LOCATOR.size - END64.size
    if at < 0 or offset != at or disk != 0 or disks > 1:
        raise ValueError("its end is not where it claims to be")
    file.seek(at)
    signature, following, _, _, *fields = END64.unpack(file.read(END64.size))
    if signature != b"PK\x06\x06" or following != END64.size - 12:  # without signature and this number
        raise ValueError("its end is damaged")
    return tuple(fields)


def _count_entries(directory: bytes, count: int) -> None:
    """Check that a directory holds as many entries as it claims, and nothing else.

    Raises:
        ValueError: it does not.
    """
    at = found = 0
    while at + HEADER.size <= len(directory) and found < count:
        signature, *lengths = HEADER.unpack_from(directory, at)
        if signature != b"PK\x01\x02":
            break
        at, found = at + HEADER.size + sum(lengths), found + 1
    if at != len(directory) or found != count:
        raise ValueError("its directory is damaged")

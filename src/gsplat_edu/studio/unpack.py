"""Unpack zip files that somebody else made.

A few kilobytes can claim petabytes, name files outside of the folder, be links, or list so many entries that reading
the list takes all memory. So the directory of the file is measured before it is read, every name is checked before
anything is written, and bytes are counted while they are written.

Readers of zip files find the directory in different ways: from the end, by an offset, or past data before or after it.
A file in which these ways lead to different places is refused, so that every version of `zipfile` reads the directory
that was measured. The format: PKWARE, APPNOTE.TXT 6.3.10, sections 4.3.12 to 4.3.16.
"""

from __future__ import annotations

import errno
import stat
import struct
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.reading import open_file
from gsplat_edu.studio.names import checked_path
from gsplat_edu.studio.refusal import RefusedError, too_large

CHUNK = 1 << 20

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

IGNORED = ("__MACOSX", "Thumbs.db", "desktop.ini")
"""Names of what operating systems add."""


@dataclass(frozen=True)
class ZipLimits:
    """What a zip file may hold.

    Args:
        entries: Files and folders.
        total: Unpacked bytes.
        ratio: Unpacked bytes per packed byte, once more than `free` are unpacked.
        free: Unpacked bytes whose ratio does not matter.
    """

    entries: int = 20_000
    total: int = 64 << 30
    ratio: float = 100.0
    free: int = 64 << 20


def unpack(
    path: Path, into: Path, limits: ZipLimits, wanted: Callable[[Path], bool] = lambda name: True
) -> tuple[int, list[str]]:
    """Unpack a zip file into a new folder. A single folder that holds everything is left out.

    Args:
        path: The zip file.
        into: The folder, which must not exist; after an error it may be there in part.
        limits: What the file may hold.
        wanted: Whether a file is unpacked, by its path.

    Returns:
        Number of files written, and the names of those that were not wanted.

    Raises:
        RefusedError: it is not a zip file, exceeds a limit, or holds an entry that is not allowed; names the entry.
        OSError: it cannot be written.
    """
    _check_directory(path, limits)
    try:
        with zipfile.ZipFile(path) as archive:
            entries = _checked(archive, path.stat().st_size, limits)
            chosen = {name: entry for name, entry in entries.items() if wanted(name)}
            into.mkdir()
            room = limits.total
            for name, entry in chosen.items():
                room -= _write(archive, entry, into / name, room)
    except (
        zipfile.BadZipFile,
        LookupError,
        EOFError,
        NotImplementedError,
        RuntimeError,
        struct.error,
        ValueError,
    ) as error:
        if isinstance(error, ArgumentError):
            raise
        raise RefusedError(f"zip: is damaged ({str(error)[:80]}); pack it again") from None
    except OSError as error:
        if error.errno != errno.EINVAL:  # which a seek to a place that no file has ends in
            raise
        raise RefusedError("zip: its directory is damaged; pack it again") from None
    except zlib.error:
        raise RefusedError("zip: its data are damaged; pack it again") from None
    return len(chosen), [name.as_posix() for name in entries if name not in chosen]


def _check_directory(path: Path, limits: ZipLimits) -> None:
    """Measure the directory of a zip file, and check that it can be found in one place only.

    Raises:
        RefusedError: there is none, it is damaged or ambiguous, or it lists too much.
    """
    size = path.stat().st_size
    with open_file(path) as file:
        file.seek(max(size - TAIL, 0))
        tail = file.read()
        at = tail.rfind(b"PK\x05\x06")
        if at < 0 or len(tail) < at + END.size:
            raise RefusedError("zip: is not a zip file; pack the photos as zip")
        _, disk, first, here, count, length, begin, comment = END.unpack_from(tail, at)
        if at + END.size + comment != len(tail):
            raise RefusedError("zip: its end is damaged, or something follows it; pack it again")
        end = size - len(tail) + at
        if (wide := _wide_end(file, end)) is not None:
            narrow = ((disk, 16), (first, 16), (here, 16), (count, 16), (length, 32), (begin, 32))
            if any(
                value not in (other, (1 << bits) - 1)
                for (value, bits), other in zip(narrow, wide, strict=True)
            ):
                raise RefusedError("zip: has two ends that disagree; pack it again")
            disk, first, here, count, length, begin = wide
            end -= LOCATOR.size + END64.size
        if count > limits.entries or length > limits.entries * BYTES_PER_ENTRY:
            raise too_large(
                f"zip: lists {count:,} entries in {length:,} bytes; {limits.entries:,} entries may be in it"
            )
        if (disk, first) != (0, 0) or here != count or begin + length != end:
            raise RefusedError("zip: its directory is not where it claims to be; pack it again, in one part")
        file.seek(begin)
        _count_entries(file.read(length), count)


def _wide_end(file: BinaryIO, end: int) -> tuple[int, ...] | None:
    """Return the fields of the zip64 end record, as those of `END` without the comment; None if there is none.

    Args:
        file: The zip file.
        end: Where its end record starts.

    Raises:
        RefusedError: the record is not directly before its locator, where `zipfile` looks for it.
    """
    if end < LOCATOR.size:
        return None
    file.seek(end - LOCATOR.size)
    signature, disk, offset, disks = LOCATOR.unpack(file.read(LOCATOR.size))
    if signature != b"PK\x06\x07":
        return None
    at = end - LOCATOR.size - END64.size
    if at < 0 or offset != at or disk != 0 or disks > 1:
        raise RefusedError("zip: its end is not where it claims to be; pack it again, in one part")
    file.seek(at)
    signature, following, _, _, *fields = END64.unpack(file.read(END64.size))
    if signature != b"PK\x06\x06" or following != END64.size - 12:  # without signature and this number
        raise RefusedError("zip: its end is damaged; pack it again")
    return tuple(fields)


def _count_entries(directory: bytes, count: int) -> None:
    """Check that a directory holds as many entries as it claims, and nothing else.

    Raises:
        RefusedError: it does not.
    """
    at = found = 0
    while at + HEADER.size <= len(directory) and found < count:
        signature, *lengths = HEADER.unpack_from(directory, at)
        if signature != b"PK\x01\x02":
            break
        at, found = at + HEADER.size + sum(lengths), found + 1
    if at != len(directory) or found != count:
        raise RefusedError("zip: its directory is damaged; pack it again")


def _checked(archive: zipfile.ZipFile, packed: int, limits: ZipLimits) -> dict[Path, zipfile.ZipInfo]:
    """Check every entry; return the files by their paths."""
    infos = archive.infolist()
    if len(infos) > limits.entries:
        raise too_large(f"zip: has {len(infos):,} entries; {limits.entries:,} may be in it")
    total = sum(info.file_size for info in infos)
    if total > limits.total:
        raise too_large(f"zip: unpacks to {total:,} bytes; {limits.total:,} may be in it")
    if total > limits.free and total > limits.ratio * packed:
        raise too_large(f"zip: unpacks to {total / packed:,.0f} times its size, which no photos do")
    found: dict[Path, zipfile.ZipInfo] = {}
    for info in infos:
        if not info.filename:
            raise RefusedError("zip: an entry has no name; pack it again")
        kind = stat.S_IFMT(info.external_attr >> 16)
        if kind not in (0, stat.S_IFREG, stat.S_IFDIR):
            raise RefusedError(f"zip: {info.filename[:60]!r} is a link or a device; pack the file itself")
        if info.flag_bits & 1:
            raise RefusedError(f"zip: {info.filename[:60]!r} is encrypted; pack it without a password")
        if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise RefusedError(f"zip: {info.filename[:60]!r} is packed in an unusual way; use deflate")
        if info.is_dir():
            continue
        parts = info.filename.split("/")
        if any(part.startswith("._") or part in IGNORED or part == ".DS_Store" for part in parts):
            continue
        name = checked_path("zip", info.filename)
        if name in found:
            raise RefusedError(f"zip: {info.filename[:60]!r} is in it twice; pack it again")
        found[name] = info
    if any(parent in found for name in found for parent in name.parents):
        raise RefusedError("zip: a name in it is a file and a folder; pack it again")
    return _without_common_folder(found)


def _without_common_folder(found: dict[Path, zipfile.ZipInfo]) -> dict[Path, zipfile.ZipInfo]:
    tops = {name.parts[0] for name in found}
    if len(tops) != 1 or any(len(name.parts) == 1 for name in found):
        return found
    return {Path(*name.parts[1:]): info for name, info in found.items()}


def _write(archive: zipfile.ZipFile, entry: zipfile.ZipInfo, path: Path, room: int) -> int:
    """Write one file; return its size."""
    path.parent.mkdir(parents=True, exist_ok=True)
    written = 0
    with archive.open(entry) as source, path.open("xb") as target:
        while data := source.read(CHUNK):
            written += len(data)
            if written > min(room, entry.file_size):
                raise too_large(f"zip: {entry.filename[:60]!r} is larger than it claims")
            target.write(data)
    return written

"""Unpack zip files that somebody else made.

A few kilobytes can claim petabytes, name files outside of the folder, be links, or list so many entries that reading
the list takes all memory. So the directory of the file is measured before it is read, every name is checked before
anything is written, and bytes are counted while they are written.
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

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.reading import open_file
from gsplat_edu.base.zip_directory import TooManyEntriesError, check_directory
from gsplat_edu.server.refusal import RefusedError, too_large
from gsplat_edu.studio.names import checked_path

CHUNK = 1 << 20

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
    """Measure the directory of a zip file before it is read; see `gsplat_edu.base.zip_directory`.

    Raises:
        RefusedError: it is damaged or ambiguous, or lists too much.
    """
    with open_file(path) as file:
        try:
            check_directory(file, limits.entries)
        except TooManyEntriesError as error:
            raise too_large(f"zip: {error}") from None
        except ValueError as error:
            raise RefusedError(f"zip: {error}; pack it again") from None


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

"""Detects photo files that change while they are in use."""

from __future__ import annotations

import hashlib
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from gsplat_edu.base.errors import DatasetError
from gsplat_edu.base.locks import ThreadLock

Stamp = tuple[int, int]
"""Size in bytes and modification time in ns; a file is hashed again only if one of them differs."""


@dataclass(frozen=True)
class FileDigest:
    """Content of a file.

    Args:
        size: Number of bytes.
        sha256: Hexadecimal digest.
    """

    size: int
    sha256: str


class FileWatch:
    """Remembers the digest of every file that was read. Thread-safe.

    A file with the same size and time counts as unchanged. If only the time differs, the file is hashed again and
    counts as unchanged if its bytes are the same. Hashing reads the file once more from the system's cache and takes a
    few percent of the decoding time.
    """

    def __init__(self) -> None:
        self._known: dict[Path, tuple[Stamp, FileDigest]] = {}
        self._lock = ThreadLock()

    @contextmanager
    def unchanged(self, *paths: Path | None) -> Iterator[None]:
        """Check that the files read inside the block are unchanged.

        Args:
            paths: The files; None entries are ignored.

        Raises:
            DatasetError: a file has changed since it was first read, or while the block ran.
        """
        given = [path for path in paths if path is not None]
        stamps = [self._check(path) for path in given]
        yield
        for path, stamp in zip(given, stamps, strict=True):
            if stamp is not None and _stamp(path) != stamp:
                self._check(path)

    def digest(self, path: Path) -> FileDigest | None:
        """Return a file's digest at its first reading, or now if it has not been read; None if it is missing."""
        self._check(path)
        with self._lock:
            known = self._known.get(path)
        return known[1] if known else None

    def _check(self, path: Path) -> Stamp | None:
        stamp = _stamp(path)
        with self._lock:
            known = self._known.get(path)
        if stamp is None or (known is not None and known[0] == stamp):
            return stamp
        with path.open("rb") as file:
            digest = FileDigest(stamp[0], hashlib.file_digest(file, "sha256").hexdigest())
        if known is not None and known[1] != digest:
            raise DatasetError(f"{path}: has changed since it was first read; restore the file")
        with self._lock:
            self._known[path] = stamp, digest
        return stamp


def _stamp(path: Path) -> Stamp | None:
    """Return size and time of a regular file; None for anything else, which the decoder will reject."""
    try:
        status = path.stat()
    except (OSError, ValueError):
        return None
    return (status.st_size, status.st_mtime_ns) if stat.S_ISREG(status.st_mode) else None

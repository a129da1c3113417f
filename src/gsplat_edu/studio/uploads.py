"""Take in files: streamed beside their place, limited in size, and renamed once they are complete."""

from __future__ import annotations

import os
import shutil
import threading
from collections.abc import AsyncIterator
from dataclasses import dataclass, field
from functools import partial
from http import HTTPStatus
from importlib.resources import as_file, files
from pathlib import Path
from time import monotonic
from typing import Any

from starlette.concurrency import run_in_threadpool

from gsplat_edu.base.text import legible
from gsplat_edu.data.capture import PHOTO_ENDINGS
from gsplat_edu.data.reader import layout_of
from gsplat_edu.photos.image_files import is_image
from gsplat_edu.server.refusal import RefusedError, conflict, too_large
from gsplat_edu.sfm.video import VIDEO_ENDINGS
from gsplat_edu.studio.contents import files_within, size_of
from gsplat_edu.studio.library import SCENE_ENDINGS, Library
from gsplat_edu.studio.listing import is_unfinished
from gsplat_edu.studio.names import below, checked_path
from gsplat_edu.studio.unpack import ZipLimits, unpack

COUNTED_FOR = 5.0
"""Time for which a count of the library's bytes holds, s: jobs write to it too."""

EXAMPLE_NAME = "garden"
"""Name of the capture that the studio brings along; `tools/build_example.py` makes it."""

MOST_LEFT_OUT = 50
"""Files left out that an answer names; of more, it has the number."""

AT_ONCE = 16
"""Uploads that are received at the same time."""


@dataclass(frozen=True)
class Limits:
    """How much may be taken in.

    Args:
        file: Bytes of one file.
        library: Bytes of the whole library with its trash, without adopted entries.
        spare: Bytes of the disk that stay free.
        entry_files: Files of one entry.
        zipped: What a zip file may hold.
        stall: Seconds after which a request is aborted if its body makes no progress (`gsplat_edu.server.patience`).
    """

    file: int = 4 << 30
    library: int = 200 << 30
    spare: int = 1 << 30
    entry_files: int = 20_000
    zipped: ZipLimits = field(default_factory=ZipLimits)
    stall: float = 30.0

    def document(self) -> dict[str, int]:
        """Return the limits for the page."""
        return {
            "file_bytes": self.file,
            "library_bytes": self.library,
            "spare_bytes": self.spare,
            "entry_files": self.entry_files,
            "zip_bytes": self.zipped.total,
            "zip_entries": self.zipped.entries,
        }


def _is_photo(path: Path) -> bool:
    """Return whether a file is a photo or a video by its ending."""
    return path.suffix.lower() in (*PHOTO_ENDINGS, *VIDEO_ENDINGS)


class Uploads:
    """Receives files for a library.

    Args:
        library: The library.
        limits: How much may be taken in.
    """

    def __init__(self, library: Library, limits: Limits) -> None:
        self.library, self.limits = library, limits
        self._lock = threading.Lock()
        self._expected = 0  # bytes of the uploads that are being received
        self._running = 0
        self._used: int | None = None
        self._unsettled: set[Path] = set()  # captures that were begun here; `settle` says what they are
        self._counted = 0.0  # when

    def used(self, *, fresh: bool = True) -> int:
        """Return the bytes of the library with its trash, records and cache, without adopted entries.

        Args:
            fresh: Whether to count now; else a count of the last `COUNTED_FOR` seconds will do, with later uploads.
        """
        used = self._used  # another thread may forget it meanwhile
        if fresh or used is None or monotonic() - self._counted >= COUNTED_FOR:
            self._counted = monotonic()
            self._used = used = size_of(self.library.root, without=self.library.hidden("uploads"))
        return used

    def trash_size(self) -> int:
        """Return the bytes of the trash."""
        return size_of(self.library.hidden("trash"))

    def recount(self) -> None:
        """Count the library's files again at the next upload, after something else has written or removed some."""
        self._used = None

    def target(self, kind: str, name: str, path: str) -> Path:
        """Return where a file goes.

        Raises:
            RefusedError: a name is not allowed, its ending does not fit the kind of the entry, or the file exists
                already.
        """
        wanted = checked_path("file", path)
        self._check_ending(kind, wanted)
        entry = self.library.place(kind, name)
        if entry.is_symlink():
            raise conflict(
                f"{kind}/{entry.name}: is adopted from elsewhere; add files there, or make a new entry"
            )
        if kind == "scenes" and entry.is_dir() and any(entry.iterdir()):
            raise conflict(f"scenes/{entry.name}: exists already; choose another name")
        target = below(entry, wanted, "file")
        if os.path.lexists(target):
            raise conflict(
                f"{kind}/{entry.name}/{wanted}: exists already; rename the new one or remove the old one"
            )
        return target

    def _check_ending(self, kind: str, path: Path) -> None:
        ending = path.suffix.lower()
        if kind == "runs":
            raise RefusedError("runs: cannot be uploaded; adopt the folder, or upload its scene")
        if kind == "scenes" and (ending not in SCENE_ENDINGS or len(path.parts) > 1):
            raise RefusedError(
                f"file: {path.name!r} is not a scene; scenes end in {', '.join(SCENE_ENDINGS)}"
            )
        if kind == "photos" and not _is_photo(path):
            raise RefusedError(
                f"file: {path.name!r} is neither a photo nor a video by its ending; photos end in"
                f" {', '.join(PHOTO_ENDINGS)}"
            )

    async def receive(self, chunks: AsyncIterator[bytes], length: int | None, target: Path) -> int:
        """Receive a file.

        Args:
            chunks: The body.
            length: Its announced length; None if unknown.
            target: Where it goes; nothing is there until it is complete.

        Returns:
            Its size.

        Raises:
            RefusedError: it is too large, is shorter than announced, or is no photo although its name says so.
        """
        part = self.library.part(target.suffix.lower())
        try:
            size = await self._stream(chunks, length, part)
            await run_in_threadpool(self._place, part, target)
        finally:
            await run_in_threadpool(part.unlink, missing_ok=True)
        return size

    async def receive_zip(
        self, chunks: AsyncIterator[bytes], length: int | None, kind: str, name: str
    ) -> dict[str, Any]:
        """Receive a zip file and unpack it to a new entry.

        Returns:
            Number of files, and the names of files that were left out.

        Raises:
            RefusedError: as for `receive` and `gsplat_edu.studio.unpack.unpack`, or the entry exists.
        """
        if kind not in ("photos", "captures"):
            raise RefusedError(f"{kind}: takes no zip files; upload photos or a capture")
        entry = await run_in_threadpool(self.library.fresh, kind, name)
        part, folder = self.library.part(".zip"), self.library.part()
        try:
            await self._stream(chunks, length, part)
            done = await run_in_threadpool(self._unpack, part, folder, kind, entry.name)
        finally:
            await run_in_threadpool(part.unlink, missing_ok=True)
            await run_in_threadpool(partial(shutil.rmtree, folder, ignore_errors=True))
        return done

    def add_example(self) -> dict[str, Any]:
        """Unpack the example to a new capture; return what `receive_zip` returns.

        Raises:
            RefusedError: there is no room for it.
        """
        folder = self.library.part()
        name = self.library.promise("captures", EXAMPLE_NAME)
        try:
            with as_file(files("gsplat_edu.studio") / "example.zip") as packed:
                return self._unpack(packed, folder, "captures", name)
        finally:
            self.library.release("captures", name)
            shutil.rmtree(folder, ignore_errors=True)

    def _unpack(self, part: Path, folder: Path, kind: str, name: str) -> dict[str, Any]:
        free = max(self._room(), 0)
        zipped = self.limits.zipped
        limits = ZipLimits(zipped.entries, min(zipped.total, free), zipped.ratio, zipped.free)
        count, left_out = unpack(part, folder, limits, _is_photo if kind == "photos" else lambda path: True)
        if not count:
            raise RefusedError("zip: holds nothing that can be used; pack photos, or a capture")
        self._begin(self.library.place(kind, name))
        self.library.publish(folder, kind, name)
        self.recount()
        return {
            "entry": f"{kind}/{name}",
            "files": count,
            "left_out": left_out[:MOST_LEFT_OUT],
            "num_left_out": len(left_out),
        }

    def settle(self, name: str) -> dict[str, Any]:
        """Decide what a capture is that was just taken in: one with poses that a reader knows, or only photos.

        Without poses, it becomes an entry of photos, without its other files. A capture that was there before this
        studio was started stays what it is.

        Returns:
            Its entry, and the names of files that were left out.

        Raises:
            RefusedError: there is none, it is in use or adopted, or it has neither poses nor photos; then it goes to
                the trash.
        """
        library, left_out = self.library, list[str]()
        with library.lock:
            entry = library.entry("captures", name)
            if entry.is_symlink():
                raise conflict(f"captures/{entry.name}: is adopted from elsewhere, and stays what it is")
            kind, is_new = "captures", entry in self._unsettled
            self._unsettled.discard(entry)
            if is_new and layout_of(entry) is None and not is_unfinished(entry):
                kind, paths = "photos", [Path(path) for path, _, _ in files_within(entry)]
                left_out = sorted(path.as_posix() for path in paths if not _is_photo(path))
                if len(left_out) == len(paths):
                    library.discard(entry)
                    raise RefusedError("upload: holds neither photos nor poses; add photos, or a capture")
                moved = library.move(name, "captures", kind)
                for path in left_out:
                    (moved / path).unlink()
        self.recount()
        return {
            "entry": f"{kind}/{legible(entry.name)}",
            "left_out": [legible(path) for path in left_out[:MOST_LEFT_OUT]],
            "num_left_out": len(left_out),
        }

    async def _stream(self, chunks: AsyncIterator[bytes], length: int | None, part: Path) -> int:
        """Write a body to a file; room for it is reserved first, or as it comes if its length is unknown."""
        size, reserved = 0, length or 0
        await run_in_threadpool(self.reserve, reserved, begins=True)
        try:
            with part.open("xb") as file:
                async for chunk in chunks:
                    size += len(chunk)
                    if size > min(self.limits.file, length or size):
                        raise too_large(
                            f"file: has more than {min(self.limits.file, length or size):,} bytes"
                        )
                    if length is None:
                        await run_in_threadpool(self.reserve, len(chunk))
                        reserved += len(chunk)
                    await run_in_threadpool(file.write, chunk)
        finally:
            with self._lock:
                self._running -= 1
                self._expected -= reserved
        if length is not None and size != length:
            raise RefusedError(f"file: has {size:,} of the announced {length:,} bytes; send it again")
        return size

    def _room(self) -> int:
        """Return how many bytes more may be taken in."""
        disk = shutil.disk_usage(self.library.root).free - self.limits.spare
        return min(disk, self.limits.library - self.used(fresh=False)) - self._expected

    def reserve(self, size: int, *, begins: bool = False) -> None:
        """Reserve room for bytes of an upload.

        Raises:
            RefusedError: there is none, the file is too large, or too many uploads are running.
        """
        if size > self.limits.file:
            raise too_large(f"file: has {size:,} bytes, but one file may have {self.limits.file:,}")
        with self._lock:
            if begins and self._running >= AT_ONCE:
                raise RefusedError(
                    "file: too many uploads at once; send it again", HTTPStatus.SERVICE_UNAVAILABLE
                )
            if size > (room := self._room()):
                raise RefusedError(
                    f"file: has {size:,} bytes, but there is room for {max(room, 0):,}; empty the trash,"
                    " remove something first, or set --max-library",
                    HTTPStatus.INSUFFICIENT_STORAGE,
                )
            self._expected += size
            self._running += begins

    def _begin(self, entry: Path) -> None:
        """Remember an entry that does not exist yet."""
        if not entry.exists():
            self._unsettled.add(entry)

    def _place(self, part: Path, target: Path) -> None:
        if target.suffix.lower() in PHOTO_ENDINGS and not is_image(part):
            raise RefusedError(f"file: {target.name!r} is not an image that can be read; export it as JPEG")
        size = part.stat().st_size
        with self.library.lock:
            folder = target.parent
            self._begin(self.library.root / Path(*target.relative_to(self.library.root).parts[:2]))
            if folder.is_dir() and sum(1 for _ in folder.iterdir()) >= self.limits.entry_files:
                raise too_large(f"file: {folder.name} holds {self.limits.entry_files:,} files already")
            folder.mkdir(parents=True, exist_ok=True)
            if os.path.lexists(target):
                raise conflict(
                    f"file: {target.name!r} exists already; rename the new one or remove the old one"
                )
            part.rename(target)
        self.library.changed()
        with self._lock:
            if self._used is not None:
                self._used += size

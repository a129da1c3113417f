"""Locks of folders and of threads.

A folder has one writer; the operating system releases its lock whenever the process ends, even by a kill. A lock of
threads belongs to one process: copies in others are free.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import socket
import stat
import sys
import threading
import time
import weakref
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.files import check_folder, named_failure

LOCK = ".lock"
"""Name of the lock file. It is removed at the end; a file left by a killed process locks nothing."""

_FAR = 1 << 30
"""Offset of the locked byte on Windows, far beyond the contents, because a locked byte cannot be read."""

POLL = 0.1
"""Seconds between two checks of another process or thread: its lock, its files, whether it runs."""

_held: set[int] = set()


class ThreadLock:
    """A lock of the threads of one process.

    What holds it can be pickled, and used after a fork: the copy's lock is a new one, and free. A plain lock cannot be
    pickled, and stays locked for ever in a process that was forked while another thread held it.
    """

    def __init__(self) -> None:
        self.renew()
        _thread_locks.add(self)

    def renew(self) -> None:
        """Replace the lock by a new one, in a process that has none of the threads that might hold it."""
        self._lock = threading.Lock()

    def __enter__(self) -> None:
        self._lock.acquire()

    def __exit__(self, *error: object) -> None:
        self._lock.release()

    def __reduce__(self) -> tuple[type[ThreadLock], tuple[()]]:
        return ThreadLock, ()


_thread_locks: weakref.WeakSet[ThreadLock] = weakref.WeakSet()


def _renew_all() -> None:
    for lock in list(_thread_locks):
        lock.renew()


if hasattr(os, "register_at_fork"):  # Windows does not fork
    os.register_at_fork(after_in_child=_renew_all)


@contextmanager
def locked(
    name: str,
    folder: Path,
    what: str,
    say: Callable[[str], None],
    patience: float = 0.0,
    file: str = LOCK,
    place: Path | None = None,
) -> Iterator[None]:
    """Keep other processes from writing to a folder inside the block. The folder is created if missing.

    The lock is `flock` on Linux and macOS and a locked byte on Windows. Both end with the process, even with kill -9;
    child processes do not inherit them. Threads of one process exclude one another as well.

    Args:
        name: The user's name for the folder, for messages.
        folder: The folder. It is removed again if it was created here and the block leaves it empty.
        what: The activity of this process, for the message shown to another process.
        say: Receives a sentence if the file system has no locks; the block then runs without one.
        patience: Seconds to wait for another process that holds the lock.
        file: Name of the lock file. Locks of different names do not exclude one another.
        place: What the messages say is in use; None for the folder.

    Raises:
        ArgumentError: another process holds the lock (the message names it), the folder is not writable, or the lock
            file is a link.
    """
    check_folder(name, folder)
    made = [parent for parent in (folder, *folder.absolute().parents) if not parent.exists()]
    path = folder / file
    try:
        handle = _acquired(name, path, time.monotonic() + patience, place or folder)
        if handle is None:
            say(
                f"{folder}: its file system has no locks; do not let two commands write to it at the same time"
            )
            yield
            return
        try:
            facts = {"pid": os.getpid(), "host": socket.gethostname(), "since": _now(), "what": what}
            with named_failure(path):
                os.ftruncate(handle, 0)
                os.write(handle, json.dumps(facts).encode())
            yield
        finally:
            _release(handle, path)
    finally:
        for parent in made:
            with contextlib.suppress(OSError):  # not empty: it holds the block's output
                parent.rmdir()


@contextmanager
def locked_file(
    name: str, path: Path, what: str, say: Callable[[str], None], patience: float = 0.0
) -> Iterator[None]:
    """Keep other processes from writing a file, and files that belong to it, inside the block; see `locked`.

    The lock is a hidden file beside it. Other files of the folder may be written meanwhile.

    Args:
        name: The user's name for the file, for messages.
        path: The file.
        what: The activity of this process.
        say: Receives a sentence if the file system has no locks.
        patience: Seconds to wait for another process that writes it.

    Raises:
        ArgumentError: another process writes the file (the message names the process), or as for `locked`.
    """
    with locked(name, path.parent, what, say, patience, f".{path.name}{LOCK}", path):
        yield


def _acquired(name: str, path: Path, until: float, place: Path) -> int | None:
    """Return an open, locked file; None if the file system has no locks."""
    while True:
        if _is_other(path):  # it would be emptied
            raise ArgumentError(f"{name}: {path} is a link or no file; remove it")
        flags = os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0)
        path.parent.mkdir(parents=True, exist_ok=True)  # the previous holder removes it if it leaves it empty
        try:
            handle = os.open(path, flags, 0o666)  # child processes do not inherit it
        except FileNotFoundError:  # removed between our two calls
            continue
        try:
            _lock(handle)
        except (BlockingIOError, PermissionError):
            holder = _holder(handle)
            os.close(handle)
            if time.monotonic() < until:
                time.sleep(POLL)
                continue
            raise ArgumentError(
                f"{name}: {place} is in use by {holder}; wait until it ends, or choose another place"
            ) from None
        except OSError:
            os.close(handle)
            path.unlink(missing_ok=True)
            return None
        if _is_at(path, handle):
            _held.add(handle)
            return handle
        os.close(
            handle
        )  # the previous holder removed it between our two calls: another file, or none, is there now


def _release(handle: int, path: Path) -> None:
    _held.discard(handle)
    if sys.platform != "win32":
        path.unlink(missing_ok=True)  # before the release: afterwards it may belong to another process
    os.close(handle)
    if sys.platform == "win32":
        with contextlib.suppress(OSError):  # another process has opened it in the meantime
            path.unlink()


def _lock(handle: int) -> None:
    if sys.platform == "win32":
        import msvcrt

        os.lseek(handle, _FAR, os.SEEK_SET)
        msvcrt.locking(handle, msvcrt.LK_NBLCK, 1)
        os.lseek(handle, 0, os.SEEK_SET)
    else:
        import fcntl

        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)


def _is_other(path: Path) -> bool:
    """Return whether something lies at a path that is no plain file. One call: its holder may just remove the file."""
    try:
        return not stat.S_ISREG(path.lstat().st_mode)
    except FileNotFoundError:
        return False


def _is_at(path: Path, handle: int) -> bool:
    try:
        return os.path.samestat(path.stat(), os.fstat(handle))
    except FileNotFoundError:
        return False


def _holder(handle: int) -> str:
    """Describe the lock's owner, with control characters removed."""
    try:
        facts = json.loads(os.read(handle, 1000))
        words = [re.sub(r"[^ -~]", "?", str(facts[key]))[:80] for key in ("what", "pid", "host", "since")]
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return "another process"
    return "`{}`, process {} on {}, since {}".format(*words)


def _now() -> str:
    return time.strftime("%Y-%m-%d %H:%M:%S %z")


def _drop_in_child() -> None:
    """Close a forked child's copies; an open copy would keep the lock after its process ended."""
    for handle in _held:
        with contextlib.suppress(OSError):
            os.close(handle)
    _held.clear()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_drop_in_child)

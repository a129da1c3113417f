"""Write files so that an interrupted write never leaves a partial file under the final name."""

from __future__ import annotations

import errno
import hashlib
import os
import re
import secrets
import socket
import stat
import tempfile
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from gsplat_edu.base.errors import ArgumentError


@contextmanager
def written_aside(path: Path) -> Iterator[Path]:
    """Write a file under a temporary name next to `path`, and rename it when the block succeeds.

    Args:
        path: The final name. Missing parent folders are created. The temporary name has the same suffix.

    Yields:
        The temporary path, in the same folder so that the rename is atomic.

    Raises:
        OSError: the folder cannot be created or written to. An existing file at `path` stays unchanged.
    """
    prefix = f".{path.stem}.{this_machine()}-{os.getpid()}-"  # remove_leftovers asks whether this process still runs
    aside = path.parent / f"{prefix}{secrets.token_hex(4)}{path.suffix}"
    with named_failure(path):
        path.parent.mkdir(parents=True, exist_ok=True)
    try:  # the name is known before the file exists, so that an interruption never leaves it
        with named_failure(path):
            handle = os.open(aside, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666)
            try:  # the umask itself can be read only by changing it, for all threads
                permissions = stat.S_IMODE(os.fstat(handle).st_mode)
            finally:
                os.close(handle)
        with named_failure(path, aside):
            yield aside
            aside.chmod(permissions)  # the writer may have made the file anew
            aside.replace(path)
    finally:
        aside.unlink(missing_ok=True)


@contextmanager
def named_failure(path: Path, aside: Path | None = None) -> Iterator[None]:
    """Make an OSError name the intended file instead of a temporary one or none.

    Args:
        path: The file.
        aside: Its temporary name; None if every error inside the block concerns the file, whatever name it has.
    """
    try:
        yield
    except OSError as error:
        named = error.filename
        if error.errno is not None and (aside is None or named is None or str(named) == str(aside)):
            raise OSError(error.errno, error.strerror, str(path)) from error
        raise


def described(error: OSError) -> str:
    """Describe an OSError in words: the file as the user knows it, and the reason."""
    if error.strerror is None:
        return str(error)
    reason = error.strerror[:1].lower() + error.strerror[1:]
    if error.filename is None:
        return reason
    names = [os.fsdecode(name) for name in (error.filename, error.filename2) if isinstance(name, str | bytes)]
    return (
        f"{' to '.join(names) or error.filename}: {reason}; {_ADVICE.get(error.errno or 0, 'check the file')}"
    )


def unreadable(path: Path, error: OSError) -> str:
    """Describe why a file or folder cannot be read, in one line for the user.

    Args:
        path: The file or folder as the user knows it.
        error: What the system reported.
    """
    advice = "check its permissions" if error.errno in (errno.EACCES, errno.EPERM) else "check the file"
    return f"{path}: cannot be read ({error.strerror or error}); {advice}"


_ADVICE = {
    errno.EACCES: "choose another place, or change its permissions",
    errno.EPERM: "choose another place, or change its permissions",
    errno.EROFS: "choose another place",
    errno.ENOSPC: "make room, or choose another place",
    errno.EDQUOT: "make room, or choose another place",
    errno.ENOENT: "check the name",
    errno.ENOTDIR: "check the name",
    errno.EEXIST: "choose another place",
    errno.EISDIR: "give the name of a file",
    errno.ENAMETOOLONG: "choose a shorter name",
}
"""Advice by error number."""


@contextmanager
def named_in_utf8(path: Path) -> Iterator[Path]:
    """Give a file a UTF-8 name inside the block, because OpenCV crashes the process on any other name.

    Args:
        path: An existing file.

    Yields:
        The path; if its name or a parent folder's is not UTF-8, a link to it in a temporary folder.

    Raises:
        OSError: the link cannot be created.
    """
    if not _SURROGATE.search(str(path)):
        yield path
        return
    with tempfile.TemporaryDirectory(prefix="gsplat-edu-") as folder:
        link = Path(folder) / f"file{'' if _SURROGATE.search(path.suffix) else path.suffix}"
        link.symlink_to(path.absolute())
        yield link


_SURROGATE = re.compile("[\ud800-\udfff]")  # represents a byte that is not UTF-8 (PEP 383)

_LEFTOVER = re.compile(
    r"\..*\.([0-9a-f]{8})-(\d+)-[a-z0-9_]{8}(?:\.[^.]+)?"
)  # temporary names of written_aside

ABANDONED = 24 * 3600.0
"""Seconds without a change after which another machine's temporary file counts as left behind."""


def this_machine() -> str:
    """Return eight characters for the machine, or the container on it, in which process numbers mean the same."""
    try:
        processes = os.readlink("/proc/self/ns/pid")  # noqa: PTH115 - a name, not a path
    except OSError:  # not Linux
        processes = ""
    return hashlib.sha256(os.fsencode(f"{socket.gethostname()} {processes}")).hexdigest()[:8]


def remove_leftovers(folder: Path, *, below: bool = True) -> None:
    """Remove temporary files of `written_aside` whose process was killed; keep those of running processes.

    Processes on other machines cannot be checked; their files are removed once they are a day old.

    Args:
        folder: The folder; it need not exist.
        below: Include all subfolders.
    """
    for place, folders, names in os.walk(folder):  # rglob fails if a folder vanishes meanwhile
        for name in names:
            match, path = _LEFTOVER.fullmatch(name), Path(place, name)
            if match and not path.is_symlink() and _is_leftover(path, match[1], int(match[2])):
                path.unlink(missing_ok=True)
        if not below:
            folders.clear()


def _is_leftover(path: Path, machine: str, pid: int) -> bool:
    if machine == this_machine():
        return not _runs(pid)
    try:
        return time.time() - path.stat().st_mtime > ABANDONED
    except FileNotFoundError:  # its process has just renamed or removed it
        return False


def _runs(pid: int) -> bool:
    """Return whether a process is running; always true on Windows, where signal 0 would terminate it."""
    if os.name == "nt" or pid == os.getpid():
        return True
    try:
        os.kill(pid, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        return True
    return True


def newest_first(paths: Iterable[Path]) -> list[Path]:
    """Sort files and folders by the time of their last change; those that have just been removed are left out."""
    times = {}
    for path in paths:
        with suppress(FileNotFoundError):
            times[path] = path.stat().st_mtime_ns
    return sorted(times, key=lambda path: -times[path])


def check_folder(name: str, path: Path) -> None:
    """Check, before hours of work, that files can be written to a folder. Creates nothing.

    Args:
        name: The user's name for the folder, for messages.
        path: The folder; it need not exist.

    Raises:
        ArgumentError: files cannot be written there; the message says why.
    """
    nearest = next(place for place in (path, *path.absolute().parents) if place.exists())
    if not nearest.is_dir():
        raise ArgumentError(f"{name}: {nearest} is a file; give a folder")
    try:
        with tempfile.TemporaryFile(dir=nearest):
            pass
    except OSError as error:
        if not nearest.exists():  # another program has just removed it
            check_folder(name, path)
            return
        raise ArgumentError(
            f"{name}: cannot write to {nearest} ({error.strerror}); choose another place"
        ) from None


def check_writable(name: str, path: Path) -> None:
    """Check, before hours of work, that a file can be written. Parent folders are created.

    Args:
        name: The user's name for the file, for messages.
        path: The file.

    Raises:
        ArgumentError: it cannot be written; the message says why.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path.parent):
            pass
    except OSError as error:
        raise ArgumentError(f"{name}: cannot write {path} ({error.strerror}); choose another place") from None
    if path.is_dir():
        raise ArgumentError(f"{name}: {path} is a folder; give a file name")

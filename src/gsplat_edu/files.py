"""Writing files so that an interrupted write never leaves half a file under the final name."""

from __future__ import annotations

import errno
import os
import re
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from gsplat_edu.errors import ArgumentError


@contextmanager
def written_aside(path: Path) -> Iterator[Path]:
    """Write a file under a temporary name beside `path` and rename it when the block ends well.

    Args:
        path: The final name. Missing parent folders are made. The temporary name keeps its suffix.

    Yields:
        The temporary path to write to, in the same folder, so that the rename is atomic.

    Raises:
        OSError: the folder cannot be made or written to. What stood under `path` before is untouched.
    """
    prefix = (
        f".{path.stem}.{os.getpid()}-"  # the writer's process: remove_leftovers asks whether it still runs
    )
    with named_failure(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(prefix=prefix, suffix=path.suffix, dir=path.parent)
    os.close(handle)
    aside = Path(name)
    try:
        with named_failure(path, aside):
            yield aside
            umask = os.umask(0)
            os.umask(umask)
            aside.chmod(0o666 & ~umask)  # mkstemp makes files that only their owner can read
            aside.replace(path)
    finally:
        aside.unlink(missing_ok=True)


@contextmanager
def named_failure(path: Path, aside: Path | None = None) -> Iterator[None]:
    """Let an OSError name the file that was to be written, not a temporary one beside it, or none at all.

    Args:
        path: The file.
        aside: Its temporary name; None if an error inside of the block is always about the file, whatever it names.
    """
    try:
        yield
    except OSError as error:
        named = error.filename
        if error.errno is not None and (aside is None or named is None or str(named) == str(aside)):
            raise OSError(error.errno, error.strerror, str(path)) from error
        raise


def described(error: OSError) -> str:
    """Say in words what an OSError says in numbers: the file that the user knows, and the reason."""
    if error.strerror is None:
        return str(error)
    reason = error.strerror[:1].lower() + error.strerror[1:]
    if error.filename is None:
        return reason
    names = [os.fsdecode(name) for name in (error.filename, error.filename2) if isinstance(name, str | bytes)]
    return (
        f"{' to '.join(names) or error.filename}: {reason}; {_ADVICE.get(error.errno or 0, 'check the file')}"
    )


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
"""What to do about an error."""


@contextmanager
def named_in_utf8(path: Path) -> Iterator[Path]:
    """Give a file a name in UTF-8 while the block runs: OpenCV crashes the process on any other.

    Args:
        path: A file that is there.

    Yields:
        The path; a link to it in a temporary folder if its name, or that of a folder above, is not UTF-8.

    Raises:
        OSError: the link cannot be made.
    """
    if not _SURROGATE.search(str(path)):
        yield path
        return
    with tempfile.TemporaryDirectory(prefix="gsplat-edu-") as folder:
        link = Path(folder) / f"file{'' if _SURROGATE.search(path.suffix) else path.suffix}"
        link.symlink_to(path.absolute())
        yield link


_SURROGATE = re.compile("[\ud800-\udfff]")  # stands for a byte that is not UTF-8 (PEP 383)

_LEFTOVER = re.compile(r"\..*\.(\d+)-[a-z0-9_]{8}(?:\.[^.]+)?")  # temporary names of written_aside


def remove_leftovers(folder: Path, *, below: bool = True) -> None:
    """Remove temporary files of `written_aside` whose process was killed; those of a running process stay.

    Args:
        folder: Where to look; it need not exist.
        below: Look in all folders below as well.
    """
    for path in folder.rglob(".*") if below else folder.glob(".*"):
        match = _LEFTOVER.fullmatch(path.name)
        if match and path.is_file() and not path.is_symlink() and not _runs(int(match[1])):
            path.unlink(missing_ok=True)


def _runs(pid: int) -> bool:
    """Say whether a process is running; on Windows, where asking with signal 0 would end it, always."""
    if os.name == "nt" or pid == os.getpid():
        return True
    try:
        os.kill(pid, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        return True
    return True


def check_folder(name: str, path: Path) -> None:
    """Find out before hours of work whether files can be written into a folder. Nothing is made.

    Args:
        name: What the user calls the folder, for the message.
        path: The folder; it need not be there yet.

    Raises:
        ArgumentError: files cannot be written there, and why.
    """
    nearest = next(place for place in (path, *path.absolute().parents) if place.exists())
    if not nearest.is_dir():
        raise ArgumentError(f"{name}: {nearest} is a file; name a folder")
    try:
        with tempfile.TemporaryFile(dir=nearest):
            pass
    except OSError as error:
        raise ArgumentError(
            f"{name}: cannot write to {nearest} ({error.strerror}); choose another place"
        ) from None


def check_writable(name: str, path: Path) -> None:
    """Find out before hours of work whether a file can be written in the end. Parent folders are made.

    Args:
        name: What the user calls the file, for the message.
        path: The file.

    Raises:
        ArgumentError: it cannot be written, and why.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=path.parent):
            pass
    except OSError as error:
        raise ArgumentError(f"{name}: cannot write {path} ({error.strerror}); choose another place") from None
    if path.is_dir():
        raise ArgumentError(f"{name}: {path} is a folder; give the name of a file")

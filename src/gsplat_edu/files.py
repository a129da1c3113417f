"""Writing files so that an interrupted write never leaves half a file under the final name."""

from __future__ import annotations

import os
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
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(prefix=f".{path.stem}.", suffix=path.suffix, dir=path.parent)
    os.close(handle)
    aside = Path(name)
    try:
        yield aside
        umask = os.umask(0)
        os.umask(umask)
        aside.chmod(0o666 & ~umask)  # mkstemp makes files that only their owner can read
        aside.replace(path)
    finally:
        aside.unlink(missing_ok=True)


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

"""One change of a capture's own files at a time: the list of photos to leave out, the shapes on masks, the masks."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from gsplat_edu.base.errors import ArgumentError, DatasetError
from gsplat_edu.base.locks import locked
from gsplat_edu.data.capture import capture_folder

CHANGES = ".changes.lock"
"""Name of the lock file. It differs from that of `gsplat-edu sfm`, which writes to a capture for hours."""

PATIENCE = 30.0
"""Seconds to wait for other changes of the same capture; one takes well under a second."""

_turns: dict[Path, threading.Lock] = {}
"""By folder, the lock among the threads of this process; they need not poll for one another."""


@contextmanager
def changing(capture: Path, say: Callable[[str], None] = lambda sentence: None) -> Iterator[None]:
    """Keep other threads and processes from changing a capture between a reading and a writing in the block.

    Args:
        capture: The capture's folder, or its transforms.json. If it does not exist, nothing is locked or created.
        say: Receives a sentence if the file system has no locks; only the threads of this process then take turns.

    Raises:
        DatasetError: another change lasts too long, or the folder is not writable.
        OSError: the lock file cannot be opened.
    """
    if not capture.exists():
        yield
        return
    folder = capture_folder(capture)
    turn = _turns.setdefault(folder.resolve(), threading.Lock())
    if not turn.acquire(timeout=PATIENCE):
        raise DatasetError(f"{folder}: is being changed by another thread; try again")
    try:
        with ExitStack() as held:
            try:
                held.enter_context(
                    locked(str(capture), folder, "a change of this capture", say, PATIENCE, CHANGES)
                )
            except ArgumentError as error:
                raise DatasetError(str(error)) from None
            yield
    finally:
        turn.release()

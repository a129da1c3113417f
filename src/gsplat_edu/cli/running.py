"""Run a command: its failures and interruptions take one line, and decide on the exit code."""

from __future__ import annotations

import signal
import threading
import traceback
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import NoReturn, TextIO

from gsplat_edu.base.errors import BackendWarning, SplatError
from gsplat_edu.base.files import described
from gsplat_edu.base.headroom import shortage
from gsplat_edu.base.printing import complain, escape_unencodable_characters
from gsplat_edu.base.text import bounded, plain_of, printable
from gsplat_edu.jobs import emitter
from gsplat_edu.jobs.events import Failed, Interrupted
from gsplat_edu.jobs.ranks import is_first, speaks_for_all
from gsplat_edu.options.parser import EXIT_BAD_INPUT

EXIT_BUG = 1
"""Exit code of Python for a traceback."""

EXIT_INTERRUPTED = 130

LESS_MEMORY = {
    "train": "close other programs, or reduce --resolution, --max-gaussians or --image-memory; saved checkpoints are "
    "intact",
    "render": "close other programs, or reduce --size",
    "sfm": "close other programs, or reduce --max-image-size or --max-features",
    "train_2d.py": "close other programs, or reduce --size or --splats",
    "train_3d.py": "close other programs, or reduce --size or --cap",
    "demo": "close other programs, or reduce --size or --cap",
}
"""Advice for commands that run out of memory; other commands have no option that reduces it."""


def run_command(program: str, command: Callable[[], None], debug: bool) -> int:
    """Run a command and report a failure in one line on stderr.

    Args:
        program: Name at the start of the line.
        command: The command to run.
        debug: Also print the traceback.

    Returns:
        Exit code: 0; 2 for bad input, a file that cannot be written, or insufficient memory; 130 if interrupted.
    """
    escape_unencodable_characters()
    try:
        with _terminable(), _one_line_warnings(program):
            command()
    except KeyboardInterrupt as interruption:
        if is_first() and speaks_for_all():
            said = interruption.args[0] if interruption.args else "interrupted"
            complain(f"{program}: {said}")
            emitter.emit(Interrupted(plain_of(said)))
        return EXIT_INTERRUPTED
    except Exception as error:
        if (line := _line(program, error)) is None:
            emitter.emit(Failed(f"{program}: {type(error).__name__}: {printable(str(error))}", EXIT_BUG))
            raise
        if debug:
            traceback.print_exc()
        if speaks_for_all():
            complain(f"{program}: {line}")
            emitter.emit(Failed(bounded(printable(f"{program}: {line}")), EXIT_BAD_INPUT))
        return EXIT_BAD_INPUT
    emitter.finish()
    return 0


@contextmanager
def _terminable() -> Iterator[None]:
    """Make SIGTERM end a command like Ctrl-C, so that it removes its temporary files."""
    if (
        threading.current_thread() is not threading.main_thread()
    ):  # only the main thread may set signal handlers
        yield
        return

    def end(number: int, frame: object) -> NoReturn:
        raise KeyboardInterrupt("terminated")

    before = signal.signal(signal.SIGTERM, end)
    try:
        yield
    finally:
        # None stands for a handler that Python did not install and cannot put back
        signal.signal(signal.SIGTERM, signal.SIG_DFL if before is None else before)


@contextmanager
def interruptible_imports() -> Iterator[None]:
    """Let Ctrl-C end imports in the block even if a module that is being imported catches the interruption.

    The signal handlers of the block's beginning raise the interruption. If it was caught, the end of the block raises
    it again. Only the main thread may set signal handlers; other threads get none of these signals.

    Raises:
        KeyboardInterrupt: the user, or a queue of jobs, interrupted the block.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    came: list[KeyboardInterrupt] = []
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}

    def note(number: int, frame: FrameType | None) -> None:
        handler = before[signal.Signals(number)]
        try:
            if callable(handler):
                handler(number, frame)
        except KeyboardInterrupt as interruption:
            came.append(interruption)
            raise

    changed = {number: handler for number, handler in before.items() if callable(handler)}
    for number in changed:
        signal.signal(number, note)
    try:
        yield
    except Exception:
        if not came:
            raise  # else the interruption is what made the import fail
    finally:
        for number, handler in changed.items():
            signal.signal(number, handler)
    if came:
        raise came[0]


@contextmanager
def _one_line_warnings(program: str) -> Iterator[None]:
    """Print our own warnings as a line without file and line number; others as Python does."""
    before = warnings.showwarning

    def show(
        message: Warning | str,
        category: type[Warning],
        filename: str,
        lineno: int,
        file: TextIO | None = None,
        line: str | None = None,
    ) -> None:
        if issubclass(category, BackendWarning) and not is_first():
            return
        if issubclass(category, BackendWarning):
            complain(f"{program}: {message}")
        else:
            before(message, category, filename, lineno, file, line)

    with warnings.catch_warnings():
        warnings.showwarning = show
        warnings.simplefilter("always", BackendWarning)
        yield


def _line(program: str, error: Exception) -> str | None:
    """Describe an error in one line; return None for bugs in this program."""
    if isinstance(error, SplatError):
        return str(error)
    if (said := shortage(error)) is not None:
        return f"ran out of memory ({said}); {LESS_MEMORY.get(program.split()[-1], 'close other programs')}"
    return described(error) if isinstance(error, OSError) else None

"""Command-line parsing; errors take one line instead of a page."""

from __future__ import annotations

import argparse
import difflib
import itertools
import math
import signal
import sys
import threading
import traceback
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any, NoReturn, TextIO, TypeVar

from gsplat_edu.base.constants import AUTO, LOOPBACK
from gsplat_edu.base.errors import ArgumentError, BackendWarning, SplatError
from gsplat_edu.base.files import described
from gsplat_edu.base.headroom import shortage
from gsplat_edu.base.quantities import bytes_of, seconds_of
from gsplat_edu.base.text import bounded, plain_of, printable
from gsplat_edu.cli.printing import complain, escape_unencodable_characters
from gsplat_edu.cli.ranks import is_first, speaks_for_all
from gsplat_edu.jobs import emitter
from gsplat_edu.jobs.events import Failed, Interrupted
from gsplat_edu.render.settings import BACKENDS

Quantity = TypeVar("Quantity", int, float)

EXIT_BUG = 1
"""Exit code of Python for a traceback."""

EXIT_BAD_INPUT = 2
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


class OneLineParser(argparse.ArgumentParser):
    """A parser that reports a mistake in one line: the error and where to find help.

    Options cannot be abbreviated, so that new options never change the meaning of a script's options.
    """

    def __init__(self, **options: Any) -> None:  # noqa: ANN401
        super().__init__(allow_abbrev=False, **options)
        self._common: frozenset[str] | None = None
        self._appendix: Callable[[], str] = str
        self.explain_unknown: Callable[[str, Sequence[str]], str | None] = lambda *_: None
        """Given an unknown option and the known ones, says what to write instead, or returns None."""

    def show_in_help(self, names: Iterable[str], appendix: Callable[[], str] = str) -> None:
        """Make --help show only these options, and add --help-all, which shows every option.

        Args:
            names: Destinations of the options, for example "max_gaussians".
            appendix: Returns what --help-all prints below the options.
        """
        self._appendix = appendix
        self.add_argument("--help-all", action=_HelpAll, nargs=0, help="show every option and exit")
        self._common = frozenset({"help", "help_all", *names})

    def format_help(self) -> str:
        """Return the text of --help; see `show_in_help`."""
        common = self._common
        if common is None:
            return super().format_help()
        hidden = [action for action in self._actions if action.option_strings and action.dest not in common]
        texts = [action.help for action in hidden]
        for action in hidden:
            action.help = argparse.SUPPRESS
        try:
            return super().format_help()
        finally:
            for action, text in zip(hidden, texts, strict=True):
                action.help = text

    def format_help_all(self) -> str:
        """Return the text of --help-all: every option, and what lies below them."""
        return super().format_help() + self._appendix()

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:  # noqa: ANN401
        """Refuse an unknown option before argparse reports missing ones, and suggest the most similar option."""
        words = sys.argv[1:] if args is None else list(args)
        if self._subparsers is None:  # otherwise the words belong to a command, whose parser reads them next
            for word in itertools.takewhile(lambda word: word != "--", words):
                flag = word.partition("=")[0]
                if flag.startswith("--") and flag not in self._option_string_actions:
                    self.error(self._unknown(flag))
        return super().parse_known_args(words, namespace)

    def _unknown(self, flag: str) -> str:
        known = [option for option in self._option_string_actions if option.startswith("--")]
        if said := self.explain_unknown(flag, known):
            return f"unrecognized argument {flag}: {said}"
        alike = difflib.get_close_matches(flag, known, n=1)
        meant = f"did you mean {alike[0]}?" if alike else "it is not known"
        return f"unrecognized argument {flag}: {meant}"

    def error(self, message: str) -> NoReturn:
        """Print the line and exit with 2."""
        end = "" if message.endswith("?") else ";"
        if speaks_for_all():
            line = f"{self.prog}: {message}{end} see {self.prog} --help"
            complain(line)
            emitter.emit(Failed(bounded(printable(line)), EXIT_BAD_INPUT))
        self.exit(EXIT_BAD_INPUT)


class _HelpAll(argparse.Action):
    """Print the help of every option and exit."""

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> NoReturn:
        """Print and exit."""
        assert isinstance(parser, OneLineParser)
        print(parser.format_help_all(), end="")
        parser.exit()


def add_backend(parser: argparse._ActionsContainer) -> None:
    """Add the option --backend."""
    names = ", ".join((AUTO, *BACKENDS))
    parser.add_argument(
        "--backend",
        default=AUTO,
        metavar="NAME",
        help=f"what renders: {names}; auto takes cuda if a GPU passes a comparison with cpu, else cpu; for a"
        " training also webgpu on a GPU that passes and is forecast to be faster than cpu"
        " (default: %(default)s)",
    )


def add_address(parser: argparse.ArgumentParser, port: int) -> None:
    """Add the options of a server's address.

    Args:
        parser: Receives --host and --port.
        port: The default port.
    """
    parser.add_argument(
        "--host",
        default=LOOPBACK,
        metavar="ADDRESS",
        help=f"address to listen on (default: {LOOPBACK}, reachable from this computer only)",
    )
    parser.add_argument(
        "--port",
        type=whole_number_text,
        default=port,
        metavar="N",
        help=f"port to listen on; 0 for any free one (default: {port})",
    )


def add_meshes(parser: argparse.ArgumentParser) -> None:
    """Add --surface and --collider, the meshes of a page."""
    parser.add_argument(
        "--surface",
        type=Path,
        metavar="FILE",
        help="mesh of the scene, from gsplat-edu mesh, that the page shows beside the splats",
    )
    parser.add_argument(
        "--collider",
        type=Path,
        metavar="FILE",
        help="mesh from gsplat-edu mesh --collider that the page lays over --surface and the splats",
    )


def whole_number_text(text: str) -> int:
    """Parse a whole number."""
    try:
        return int(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number") from None


def numbers_text(count: int) -> Callable[[str], tuple[float, ...]]:
    """Return a parser of `count` finite numbers separated by commas."""

    def read(text: str) -> tuple[float, ...]:
        try:
            numbers = tuple(float(part) for part in text.split(","))
        except ValueError:
            numbers = ()
        if len(numbers) != count or not all(map(math.isfinite, numbers)):
            raise argparse.ArgumentTypeError(f"{text!r} is not {count} numbers separated by commas")
        return numbers

    return read


def number_text(text: str) -> float:
    """Parse a finite number."""
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise argparse.ArgumentTypeError(f"{text!r} is not a number")
    return number


def seconds_text(text: str) -> float:
    """Parse a duration; see `gsplat_edu.base.quantities.seconds_of`."""
    return _quantity(seconds_of, text)


def bytes_text(text: str) -> int:
    """Parse a size; see `gsplat_edu.base.quantities.bytes_of`."""
    return _quantity(bytes_of, text)


def _quantity(read: Callable[[str], Quantity], text: str) -> Quantity:
    try:
        return read(text)
    except ArgumentError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


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

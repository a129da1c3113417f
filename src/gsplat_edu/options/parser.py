"""The parser of command lines; a mistake takes one line instead of a page."""

from __future__ import annotations

import argparse
import difflib
import itertools
import sys
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NoReturn

from gsplat_edu.base.printing import complain
from gsplat_edu.base.text import bounded, printable
from gsplat_edu.jobs import emitter
from gsplat_edu.jobs.events import Failed
from gsplat_edu.jobs.ranks import speaks_for_all

EXIT_BAD_INPUT = 2

SUBJECT = ""
"""Stands for what a command works on, which is its first word here."""

MODEL = "model"
"""Stands for a trained model: a command that trains writes it to --out, for others it is the subject."""

ELSEWHERE = {
    **dict.fromkeys(("-s", "--source_path", "--source-path", "--data", "--data_dir", "--data-dir"), SUBJECT),
    **dict.fromkeys(("-m", "--model_path", "--model-path"), MODEL),
    **dict.fromkeys(
        ("--output_dir", "--output-dir", "--result_dir", "--result-dir", "--export-path"), "--out"
    ),
    **dict.fromkeys(("--max_steps", "--max-steps", "--max-num-iterations", "--total-steps"), "--iterations"),
    **dict.fromkeys(("-r", "--data_factor", "--data-factor", "--downscale-factor"), "--resolution"),
    "--eval": "--test-every",
}
"""Options of other programs (Kerbl et al.'s, gsplat's trainer, nerfstudio, Brush), and ours that do the same."""


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

    def options_by_name(self) -> dict[str, str]:
        """Return the options by their destinations: "max_gaussians" and its option, "--max-gaussians"."""
        return {action.dest: action.option_strings[-1] for action in self._actions if action.option_strings}

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
                if (flag.startswith("--") or flag in ELSEWHERE) and flag not in self._option_string_actions:
                    self.error(self._unknown(flag))
        return super().parse_known_args(words, namespace)

    def _unknown(self, flag: str) -> str:
        known = [option for option in self._option_string_actions if option.startswith("--")]
        if said := self._here(flag):
            return f"unrecognized argument {flag}: {said}"
        if said := self.explain_unknown(flag, known):
            return f"unrecognized argument {flag}: {said}"
        alike = difflib.get_close_matches(flag, known, n=1)
        meant = f"did you mean {alike[0]}?" if alike else "it is not known"
        return f"unrecognized argument {flag}: {meant}"

    def _here(self, flag: str) -> str | None:
        """Return what an option of another program is called here; None if nothing of this command does the same."""
        ours = ELSEWHERE.get(flag)
        if ours == MODEL:
            ours = "--out" if "--iterations" in self._option_string_actions else SUBJECT
        if ours in self._option_string_actions:
            return f"it is {ours} here"
        subject = next((one for one in self._actions if not one.option_strings), None)
        if ours != SUBJECT or subject is None:
            return None
        return f"it is {subject.metavar or subject.dest} here, which is written without an option"

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

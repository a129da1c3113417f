"""The command line `gsplat-edu`: one file per command beside this one."""

from __future__ import annotations

import argparse
import functools
import importlib
import re
import sys
from collections.abc import Mapping, Sequence
from importlib.metadata import version

from gsplat_edu.base.errors import ArgumentError, SplatError
from gsplat_edu.base.plugins import plugins
from gsplat_edu.base.printing import complain, escape_unencodable_characters
from gsplat_edu.base.text import option_flag
from gsplat_edu.cli.running import EXIT_INTERRUPTED, interruptible_imports, run_command
from gsplat_edu.jobs import emitter
from gsplat_edu.jobs.events import Interrupted
from gsplat_edu.jobs.ranks import num_processes
from gsplat_edu.options.offers import module_of
from gsplat_edu.options.parser import EXIT_BAD_INPUT, OneLineParser
from gsplat_edu.render.settings import check_backend

COMMANDS = {
    "demo": "train a sphere from 24 renders of it and evaluate the result with a held-out camera",
    "sfm": "estimate the camera poses of photos or a video, and write a capture that train reads",
    "train": "train a scene from a capture, photos or a video",
    "block": "train one block of a run that `train --blocks` split",
    "merge": "merge the trained blocks into one scene, score it and write the report",
    "eval": "score a run's latest scene on its test and training views; write metrics, renders and a report",
    "render": "render images or a video of a run or a scene file, along a path or from a capture's cameras",
    "convert": "write a scene in another format, or as a web page; filter, transform, merge and verify it",
    "clean": "remove floaters, and splats that no camera supports, from a scene",
    "mesh": "make a triangle mesh of a scene's surfaces, and say how far it can be trusted",
    "view": "show a scene or a run in the browser",
    "studio": "take photos to a finished scene on one page in the browser",
    "web": "train a scene inside a browser tab, from photos with camera poses that stay on the computer",
    "doctor": "find problems of a capture before training, or of a run after it, and suggest remedies",
    "leave-out": "take photos out of use in a capture, or bring them back; their files stay",
    "mask": "exclude parts of a photo by its mask, or restore the mask as it was",
    "grade": "give points for each part of an assignment of the course, and say what is wrong",
    "info": "summarise a capture, a run, a scene or mesh file, or this computer on one screen",
}
"""Commands and their summaries. Each has a module in `gsplat_edu.cli`, with `run`, and one in `gsplat_edu.options`."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line.

    Args:
        arguments: Words after the program's name; None takes the words of this process.

    Returns:
        Exit code: 0; 2 for bad input; 130 when interrupted.
    """
    words = sys.argv[1:] if arguments is None else list(arguments)
    escape_unencodable_characters()
    emitter.start_reporting()
    try:
        with interruptible_imports():
            try:
                parser = build_parser(words)
            except ArgumentError as error:  # a plug-in that cannot be loaded
                complain(f"gsplat-edu: {error}")
                return EXIT_BAD_INPUT
        parsed = parser.parse_args(words)
        if parsed.command is None:
            parser.print_help()
            return EXIT_BAD_INPUT
        if num_processes() > 1 and parsed.command != "train":
            parser.error(f"{parsed.command}: runs in one process; torchrun is for train")
        return run_command(f"gsplat-edu {parsed.command}", lambda: parsed.run(parsed), parsed.debug)
    except KeyboardInterrupt:  # interrupted while the options were imported
        complain("gsplat-edu: interrupted")
        emitter.emit(Interrupted("gsplat-edu: interrupted"))
        return EXIT_INTERRUPTED


def build_parser(words: Sequence[str]) -> argparse.ArgumentParser:
    """Build the parser of a command line; only the options of commands that it names are imported."""
    parser = OneLineParser(prog="gsplat-edu", description="3D Gaussian Splatting on the computer you have.")
    parser.add_argument("--version", action="version", version=f"%(prog)s {version('gsplat-edu')}")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", title="commands")
    summaries = COMMANDS | {name: module.SUMMARY for name, module in plugins("commands").items()}
    for name, summary in summaries.items():
        command = commands.add_parser(name, help=summary, description=summary)
        if name not in words:
            continue
        options = module_of(name)
        command.epilog = options.EXAMPLE
        options.add_arguments(command)
        command.add_argument("--debug", action="store_true", help="print the traceback of an error")
        if hasattr(options, "COMMON"):
            command.show_in_help(options.COMMON, options.appendix)
            command.explain_unknown = options.explain_unknown
        command.set_defaults(run=functools.partial(_run, name, command.options_by_name()))
    return parser


def _run(name: str, flags: Mapping[str, str], arguments: argparse.Namespace) -> None:
    """Check the options, import the command, which takes seconds if it needs torch, and run it."""
    if "backend" in arguments:
        check_backend(arguments.backend)
    options = module_of(name)
    try:
        if hasattr(options, "check"):
            options.check(arguments)
        module = options.runner(arguments) if hasattr(options, "runner") else name.replace("-", "_")
        with interruptible_imports():
            command = options if name not in COMMANDS else importlib.import_module(f"gsplat_edu.cli.{module}")
        command.run(arguments)
    except SplatError as error:
        told = _in_options(str(error), flags)
        if told != str(error):
            error.args = (told, *error.args[1:])
        raise


def _in_options(message: str, flags: Mapping[str, str]) -> str:
    """Name the options of what an error of the library names.

    "batch: is" becomes "--batch: is"; `sky=none` in backticks becomes --sky none, or --set sky=none.

    Args:
        message: The error.
        flags: The command's options by their names.
    """
    from gsplat_edu.train.config import BY_NAME  # it loads plug-ins, whose errors `main` tells

    def option(name: str) -> str:
        if name in BY_NAME and "settings" in flags:
            return BY_NAME[name].written
        return flags.get(name) or (option_flag(name) if name in BY_NAME else "")

    def written(quoted: re.Match[str]) -> str:
        flag, value = option(quoted["name"]), quoted["value"]
        if not flag:
            return quoted[0].replace("`", "")
        return flag if value is None else f"{flag}{'=' if flag.startswith('--set ') else ' '}{value}"

    name, colon, rest = message.partition(": ")
    if colon and option(name):
        message = f"{option(name)}: {rest}"
    return re.sub(r"`(?P<name>[a-z_]+)(=(?P<value>[^`]+))?`", written, message)

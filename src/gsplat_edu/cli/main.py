"""The command line `gsplat-edu`: one file per command beside this one."""

from __future__ import annotations

import argparse
import importlib
from collections.abc import Sequence
from importlib.metadata import version

from gsplat_edu.cli.arguments import EXIT_BAD_INPUT, OneLineParser, run_command

COMMANDS = ("demo", "train", "eval", "render", "info")
"""Commands, each a module `gsplat_edu.cli.NAME` with SUMMARY, EXAMPLE, add_arguments and run."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line.

    Args:
        arguments: Words after the program's name; those of the process where None.

    Returns:
        Exit code: 0; 2 for bad input; 130 when interrupted.
    """
    parser = build_parser()
    parsed = parser.parse_args(arguments)
    if parsed.command is None:
        parser.print_help()
        return EXIT_BAD_INPUT
    return run_command(f"gsplat-edu {parsed.command}", lambda: parsed.run(parsed), parsed.debug)


def build_parser() -> argparse.ArgumentParser:
    """Build the parser of all commands."""
    parser = OneLineParser(prog="gsplat-edu", description="3D Gaussian Splatting on the computer you have.")
    parser.add_argument("--version", action="version", version=f"%(prog)s {version('gsplat-edu')}")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", title="commands")
    for name in COMMANDS:
        module = importlib.import_module(f"gsplat_edu.cli.{name}")
        command = commands.add_parser(
            name, help=module.SUMMARY, description=module.SUMMARY, epilog=module.EXAMPLE
        )
        module.add_arguments(command)
        command.add_argument("--debug", action="store_true", help="print the traceback of an error")
        command.set_defaults(run=module.run)
    return parser

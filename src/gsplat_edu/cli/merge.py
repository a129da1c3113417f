"""`gsplat-edu merge`: merge the blocks of a run into one scene."""

from __future__ import annotations

import argparse

from gsplat_edu.base.locks import locked
from gsplat_edu.cli.blocks import merge_and_report
from gsplat_edu.cli.terminal import Terminal
from gsplat_edu.data.reader import CaptureReader
from gsplat_edu.viewer.export import check_target


def run(arguments: argparse.Namespace) -> None:
    """Merge, score and report."""
    console = Terminal()
    for path in arguments.export:
        check_target("--export", path)
    with locked("RUN", arguments.run_folder, "gsplat-edu merge", console.say):
        reader = None if arguments.data is None else CaptureReader(arguments.data)
        merge_and_report(arguments.run_folder, arguments.export, console, reader)

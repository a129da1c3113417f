"""`gsplat-edu sfm`: turn photos or a video without poses into a capture."""

from __future__ import annotations

import argparse
import shlex

from gsplat_edu.base.locks import locked
from gsplat_edu.base.text import Told
from gsplat_edu.cli.findings import say_findings
from gsplat_edu.cli.terminal import Terminal, stage_bars
from gsplat_edu.data.reader import CaptureReader
from gsplat_edu.jobs import emitter
from gsplat_edu.options.sfm import options_from
from gsplat_edu.sfm.reconstruct import reconstruct


def run(arguments: argparse.Namespace) -> None:
    """Find the poses with progress output."""
    options = options_from(arguments)
    console = Terminal()
    say = console.say
    with locked("OUT", options.out, "gsplat-edu sfm", say), stage_bars(console) as progress:
        try:
            reconstruct(options, say, progress)
        except KeyboardInterrupt:
            raise KeyboardInterrupt(
                Told(
                    "interrupted; the same command resumes after the last completed stage",
                    "stopped; it can be continued after the last completed step",
                )
            ) from None
    emitter.report_output(options.out)
    say_findings(CaptureReader(options.out), say)
    say(Told(f"wrote {options.out}; next: gsplat-edu train {shlex.quote(str(options.out))} --out RUN", ""))

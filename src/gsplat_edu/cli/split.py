"""`gsplat-edu split`: train a coarse model, split a capture into blocks, and say how to train them."""

from __future__ import annotations

import argparse

from gsplat_edu.base.locks import locked
from gsplat_edu.cli.blocks import prepared
from gsplat_edu.cli.terminal import Terminal


def run(arguments: argparse.Namespace) -> None:
    """Write the plan and what each block starts from."""
    console = Terminal()

    def say(sentence: str) -> None:
        console.print(sentence, soft_wrap=True)

    with locked("--out", arguments.out, "gsplat-edu split", say):
        planned = prepared(arguments, console, say)
    last = len(planned.blocks) - 1
    say(
        f"wrote {arguments.out}: train blocks 0 to {last} with `gsplat-edu block {arguments.out} K`, on any machine"
        f" that sees it; then `gsplat-edu merge {arguments.out}`"
    )

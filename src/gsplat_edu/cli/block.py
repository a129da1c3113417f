"""`gsplat-edu block`: train one block, for example as a task of a Slurm array."""

from __future__ import annotations

import argparse

from gsplat_edu.blocks.plan import BlockPlan
from gsplat_edu.blocks.task import train_block
from gsplat_edu.cli.block_table import BlockTable
from gsplat_edu.cli.process import interruptible
from gsplat_edu.cli.terminal import Terminal
from gsplat_edu.data.reader import CaptureReader
from gsplat_edu.runs.blocks_folder import BlocksFolder


def run(arguments: argparse.Namespace) -> None:
    """Train the block, unless it is finished."""
    console = Terminal()
    say = console.say
    path, number = arguments.run_folder, arguments.number
    folder, planned = BlocksFolder(path), BlockPlan.read(path)
    if number < len(planned.blocks) and folder.read_done(number, planned.digest()) is not None:
        say(f"block {number}: is finished; nothing to do")
        return
    reader = None if arguments.data is None else CaptureReader(arguments.data)
    with interruptible() as interrupted, BlockTable(console, folder, planned):
        done = train_block(path, number, reader, say, interrupted)
    if done is None:
        raise KeyboardInterrupt(
            f"interrupted in block {number}; the same command resumes from its checkpoint"
        )
    say(f"block {number}: {done.iterations} iterations in {done.seconds:.1f} s, {done.gaussians:,} Gaussians")

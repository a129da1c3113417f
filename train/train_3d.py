"""Train the course's sphere from its own renders, with the budget on the command line.

    python train/train_3d.py --iters 300 --size 64 --out out/sphere.png

Writes the held-out figure, the loss and count curves, and the scene. The work is done in
`gsplat_edu.cli.sphere`, which assembles `gsplat_edu.train`; this script prints the chapter's log.
"""

from __future__ import annotations

import argparse
import sys

from gsplat_edu.cli.running import run_command
from gsplat_edu.cli.sphere import options_from, run_sphere
from gsplat_edu.options.demo import add_arguments
from gsplat_edu.options.parser import OneLineParser
from gsplat_edu.train.events import DensifyEvent, StepEvent
from gsplat_edu.train.trainer import Trainer

LOG_EVERY = 100


def log(trainer: Trainer, event: StepEvent | DensifyEvent) -> None:
    """Print the log lines of the chapter."""
    if isinstance(event, DensifyEvent):
        print(
            f"  densify: +{event.num_cloned} cloned, +{event.num_split_children} split children, "
            f"-{event.num_pruned} pruned -> K={event.num_gaussians}",
            flush=True,
        )
    elif event.iteration % LOG_EVERY == 0:
        print(f"iter {event.iteration:4d}  L1 {event.loss:.4f}  K {event.num_gaussians}", flush=True)


def train(arguments: argparse.Namespace) -> None:
    """Run the training with these arguments."""
    options, notice = options_from(arguments)
    if notice:
        print(notice, flush=True)
    run_sphere(options, [log])


def main() -> int:
    """Read the command line and train."""
    parser = OneLineParser(
        prog="train_3d.py",
        description="Learn a sphere from 24 renders of it and judge the result with a held-out camera.",
        epilog="example: python train/train_3d.py --iters 100 --size 48 --out out/quick.png",
    )
    add_arguments(parser)
    parser.add_argument("--debug", action="store_true", help="print the traceback of an error")
    arguments = parser.parse_args()
    return run_command("train_3d.py", lambda: train(arguments), arguments.debug)


if __name__ == "__main__":
    sys.exit(main())

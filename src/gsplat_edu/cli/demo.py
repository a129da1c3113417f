"""`gsplat-edu demo`: the course's training with a progress bar."""

from __future__ import annotations

import argparse

from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn

from gsplat_edu.cli.sphere import options_from, run_sphere
from gsplat_edu.cli.terminal import Bar, Terminal
from gsplat_edu.train.events import Event, StepEvent
from gsplat_edu.train.trainer import Trainer

LOSS_EVERY = 20
"""Iterations between two updates of the loss; each update waits for the GPU."""


def run(arguments: argparse.Namespace) -> None:
    """Train with a progress bar that shows the loss and the number of Gaussians."""
    console = Terminal()
    options, notice = options_from(arguments)
    if notice:
        console.say(notice)
    columns = (
        "[progress.description]{task.description}",
        "L1 {task.fields[loss]:.4f}  K {task.fields[count]}",
    )
    bar = Bar(
        TextColumn(columns[0]),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn(columns[1]),
        TimeRemainingColumn(),
        console=console,
    )
    closing: list[str] = []
    with bar:
        task = bar.add_task("sphere", total=options.budget.iters, loss=float("nan"), count=options.k0)

        def advance(trainer: Trainer, event: Event) -> None:
            if isinstance(event, StepEvent):
                bar.update(task, advance=1, count=event.num_gaussians)
                if event.iteration % LOSS_EVERY == 0 or trainer.iteration == options.budget.iters:
                    bar.update(task, loss=event.loss)

        run_sphere(options, [advance], say=closing.append)
    console.say(*closing)

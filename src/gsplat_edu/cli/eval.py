"""`gsplat-edu eval`: judge a run by its test and training views."""

from __future__ import annotations

import argparse
import dataclasses
import functools
from collections.abc import Sequence
from pathlib import Path

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from gsplat_edu.cli.arguments import add_backend
from gsplat_edu.cli.terminal import Terminal
from gsplat_edu.evaluate.metrics import ImageScore, summarize, worst
from gsplat_edu.io.ply import load_ply
from gsplat_edu.render.api import render
from gsplat_edu.render.backends import device_of, resolve_backend
from gsplat_edu.runs.dataset import run_dataset
from gsplat_edu.runs.evaluation import Judged, evaluate_run
from gsplat_edu.runs.folder import RunFolder, render_settings

EXAMPLE = "example: gsplat-edu eval out/plush"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's options."""
    parser.add_argument("run_folder", type=Path, metavar="RUN", help="folder of a run")
    parser.add_argument(
        "--dataset",
        type=Path,
        metavar="PATH",
        help="the dataset's folder, where it is not where the run had it",
    )
    add_backend(parser)


def run(arguments: argparse.Namespace) -> None:
    """Score every view, print a line per split, and say what was written."""
    console = Terminal()
    backend = resolve_backend(arguments.backend)
    folder = RunFolder(arguments.run_folder)
    config = folder.read_config()
    settings = dataclasses.replace(render_settings(config), depth=False)
    scene, iteration = folder.latest_scene()
    dataset = run_dataset(config, arguments.dataset)
    gaussians = load_ply(scene, dataset.origin).to(device_of(backend))  # the frame its cameras stand in
    judged = Judged(dataset.test, dataset.train, settings.background, dataset.notes)
    with Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        console=console,
        transient=True,
        disable=not console.is_terminal,
    ) as bar:
        task = bar.add_task("scoring", total=len(judged.test) + len(judged.train))
        result = evaluate_run(
            folder,
            judged,
            gaussians,
            functools.partial(render, settings=settings, backend=backend),
            {"iterations": iteration},
            lambda split, score: bar.advance(task),
        )
    console.print(*score_lines(result.test, result.train), sep="\n", soft_wrap=True)
    wrote = [str(folder.metrics)]
    if result.test:
        wrote.append(f"{folder.renders / 'test'}/")
    console.print(f"wrote {', '.join([*wrote, str(folder.report)])}", soft_wrap=True)


def score_lines(test: Sequence[ImageScore], train: Sequence[ImageScore]) -> list[str]:
    """Return the table of the scores, a line per split."""
    lines = [f"{'':5} {'images':>6} {'PSNR':>7} {'8 bit':>7} {'SSIM':>7} {'L1':>7}  worst view"]
    for name, scores in (("test", test), ("train", train)):
        if not scores:
            lines.append(f"{name:5} {0:6}  no views")
            continue
        means = summarize(scores)
        numbers = f"{means['psnr']:7.2f} {means['psnr_8bit']:7.2f} {means['ssim']:7.4f} {means['l1']:7.4f}"
        low = worst(scores)
        lines.append(f"{name:5} {len(scores):6} {numbers}  {low.name} ({low.psnr:.2f} dB)")
    return lines

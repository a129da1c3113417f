"""`gsplat-edu eval`: evaluate a run on its test and training views."""

from __future__ import annotations

import argparse
import dataclasses
import functools
from collections.abc import Sequence
from typing import Any

from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.locks import LOCK, locked
from gsplat_edu.cli.terminal import Bar, Terminal
from gsplat_edu.evaluate.metrics import ImageScore, summarize, worst
from gsplat_edu.evaluate.verdict import skipped_views, verdict
from gsplat_edu.io.formats import read_scene
from gsplat_edu.render.api import render
from gsplat_edu.render.backends import device_of, resolve_backend
from gsplat_edu.runs.dataset import run_dataset
from gsplat_edu.runs.evaluation import EVALUATED, Evaluation, ScoredViews, evaluate_run
from gsplat_edu.runs.folder import RunFolder, render_settings
from gsplat_edu.runs.identity import capture_difference
from gsplat_edu.survey.finding import command


def run(arguments: argparse.Namespace) -> None:
    """Score every view, print one line per split, and report the written files."""
    console = Terminal()
    folder, into = RunFolder(arguments.run_folder), None
    if arguments.out is not None:
        into = RunFolder(arguments.out)
    name, place = ("RUN", folder.path) if into is None else ("--out", into.path)
    with locked(name, place, "gsplat-edu eval", console.say):
        if into is not None:
            _check_apart(into)  # what another command has just written there counts too
        _evaluate(arguments, folder, into, console)


def _check_apart(out: RunFolder) -> None:
    """Allow overwriting only an earlier evaluation of the same kind."""
    if out.exists():
        raise ArgumentError(f"--out: {out.path} holds a run; choose another folder for this evaluation")
    others = out.path.is_dir() and any(path.name != LOCK for path in out.path.iterdir())
    if others and EVALUATED not in out.read_metrics():
        raise ArgumentError(f"--out: {out.path} holds other files; choose a new folder")


def _evaluate(
    arguments: argparse.Namespace,
    folder: RunFolder,
    into: RunFolder | None,
    console: Terminal,
) -> None:
    backend, config = resolve_backend(arguments.backend), folder.read_config()
    settings = dataclasses.replace(render_settings(config), depth=False)
    scene, iteration = folder.latest_scene()
    dataset = run_dataset(config, arguments.dataset)
    facts: dict[str, Any] = {"iterations": iteration}
    if into is not None:
        facts[EVALUATED] = {"run": str(folder.path.resolve()), "dataset": str(dataset.path.resolve())}
    if found := capture_difference(folder, dataset):
        what = f"{dataset.path} is not the capture of {folder.path}: {found}"
        if into is None:
            raise ArgumentError(
                f"{what}; give the run's capture with --dataset, or add --out FOLDER to write the scores elsewhere"
            )
        console.say(f"{what}; the scores are written to {into.path}")
    gaussians = read_scene(scene).relative_to(dataset.origin).to(device_of(backend))
    judged = ScoredViews(dataset.test, dataset.train, settings.background, dataset.notes)
    with Bar(
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
            facts,
            lambda split, score: bar.advance(task),
            into,
        )
    console.say(*result_lines(result, folder))
    written = into or folder
    wrote = [str(written.metrics)]
    if result.test:
        wrote.append(f"{written.renders / 'test'}/")
    console.say(f"wrote {', '.join([*wrote, str(written.report)])}")
    console.say(verdict_line(result, folder))


def result_lines(result: Evaluation, folder: RunFolder) -> list[str]:
    """Return the table of scores, or a line that says how many views were not scored and how to score them."""
    if skipped := skipped_views(result.metrics):
        how = command("eval", folder.path)
        return [f"--eval-every 0 skipped the scores of {skipped}; to score them: {how}"]
    return score_lines(result.test, result.train)


def verdict_line(result: Evaluation, folder: RunFolder) -> str:
    """Return how good a run is, why, and what to do: the last line about it."""
    return str(verdict(result.metrics, folder.read_config()))


def score_lines(test: Sequence[ImageScore], train: Sequence[ImageScore]) -> list[str]:
    """Return the table of scores, one line per split. "fitted" is `gsplat_edu.evaluate.metrics.psnr_fitted`."""
    lines = [f"{'':5} {'images':>6} {'PSNR':>7} {'8-bit':>7} {'SSIM':>7} {'L1':>7} {'fitted':>7}  worst view"]
    for name, scores in (("test", test), ("train", train)):
        if not scores:
            lines.append(f"{name:5} {0:6}  no views")
            continue
        means = summarize(scores)
        numbers = f"{means['psnr']:7.2f} {means['psnr_8bit']:7.2f} {means['ssim']:7.4f} {means['l1']:7.4f}"
        fitted = means["psnr_fitted"]
        numbers += f" {'-':>7}" if fitted is None else f" {fitted:7.2f}"
        low = worst(scores)
        lines.append(f"{name:5} {len(scores):6} {numbers}  {low.name} ({low.psnr:.2f} dB)")
    return lines

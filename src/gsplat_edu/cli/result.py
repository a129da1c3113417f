"""What `gsplat-edu train` says when a training has ended."""

from __future__ import annotations

import functools
from collections.abc import Callable

from gsplat_edu.cli.eval import result_lines, verdict_line
from gsplat_edu.doctor.moving import moved_line
from gsplat_edu.doctor.remedies import ENOUGH
from gsplat_edu.jobs import emitter
from gsplat_edu.jobs.events import Metric
from gsplat_edu.render.api import render
from gsplat_edu.runs.evaluation import Evaluation
from gsplat_edu.runs.training import CaptureRun


def tell_result(
    capture: CaptureRun, result: Evaluation, say: Callable[[str], None], *, limited: bool
) -> None:
    """Say how a training ended: its time, its scores, its files, and photos that do not fit the scene.

    Args:
        capture: The run, finished.
        result: Its scores.
        say: Receives sentences.
        limited: Whether a time limit is running; then only the command that compares photos is named.
    """
    trainer = capture.trainer
    rate = f"{1e3 * capture.seconds / max(trainer.iteration, 1):.1f} ms/iter"
    say(
        f"{trainer.iteration} iterations in {capture.seconds:.1f} s -> {rate}, {len(trainer.gaussians)} Gaussians"
    )
    folder = capture.folder.path
    for line in result_lines(result, capture.folder):
        say(line)
    for name, unit in (("psnr", "dB"), ("ssim", "")) if result.test else ():
        emitter.emit(Metric(name, result.metrics["test"][name], unit, "test"))
    emitter.report_output(folder)
    say(f"wrote {capture.folder.scene(trainer.iteration)}, {capture.folder.report}")
    _tell_odd_photos(capture, say, limited=limited or not capture.options.scores_at_end)
    if (planned := trainer.config.iterations) > trainer.iteration:
        say(f"the time limit ended training before iteration {planned}; --resume continues it: {folder}")
    say(verdict_line(result, capture.folder))


def _tell_odd_photos(capture: CaptureRun, say: Callable[[str], None], *, limited: bool) -> None:
    """Name the photos that show what others do not; with a time limit or without scores, the command that does."""
    trainer, options = capture.trainer, capture.options
    if trainer.maskers or len(capture.dataset.train) < ENOUGH:
        return
    features = None if limited else functools.partial(render, backend=options.backend)
    line = moved_line(
        capture.folder.path, trainer.gaussians, capture.dataset, features, options.render_settings
    )
    if line:
        say(line)

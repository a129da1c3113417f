"""What `gsplat-edu train` says when a training has ended."""

from __future__ import annotations

import functools
from collections.abc import Callable

from gsplat_edu.cli.eval import result_lines, verdict_line
from gsplat_edu.jobs import emitter
from gsplat_edu.jobs.events import Metric
from gsplat_edu.parts.run_values import Ended
from gsplat_edu.render.api import render
from gsplat_edu.runs.evaluation import Evaluation
from gsplat_edu.runs.training import CaptureRun
from gsplat_edu.train.part import parts


def tell_result(
    capture: CaptureRun, result: Evaluation, say: Callable[[str], None], *, limited: bool
) -> None:
    """Say how a training ended: its time, its scores, its files, and what the parts remark.

    Args:
        capture: The run, finished.
        result: Its scores.
        say: Receives sentences.
        limited: Whether a time limit is running; then no photos are compared for a remark.
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
    _tell_remarks(capture, say, limited=limited or not capture.options.scores_at_end)
    if (planned := trainer.config.iterations) > trainer.iteration:
        say(f"the time limit ended training before iteration {planned}; --resume continues it: {folder}")
    say(verdict_line(result, capture.folder))


def _tell_remarks(capture: CaptureRun, say: Callable[[str], None], *, limited: bool) -> None:
    """Say what the parts remark; with a time limit or without scores, they may not compare photos."""
    options = capture.options
    features = None if limited else functools.partial(render, backend=options.backend)
    run = Ended(
        capture.folder.path, capture.trainer.gaussians, capture.dataset, features, options.render_settings
    )
    for name, part in parts().items():
        if line := part.remark(options.config.settings_of(name), run):
            say(line)

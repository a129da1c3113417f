"""The course's training: learn a sphere from 24 of its own renders, evaluated with a held-out camera.

`gsplat-edu demo` and `train/train_3d.py` both call `run_sphere`.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float32

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.files import check_writable
from gsplat_edu.base.validation import whole_number
from gsplat_edu.data.synthetic import SphereCapture, sphere_capture
from gsplat_edu.evaluate.figures import curves_figure, held_out_figure, save_figure
from gsplat_edu.io.ply import save_ply
from gsplat_edu.ops.losses import l1
from gsplat_edu.options.demo import CHAPTER, REDUCED, Budget as Budget
from gsplat_edu.render.api import render
from gsplat_edu.render.backend import Backend
from gsplat_edu.render.backends import gpu_of, load_backend, resolve_backend
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.train.compose import Start, Views, training
from gsplat_edu.train.course import EXTENT, course_config
from gsplat_edu.train.events import Event
from gsplat_edu.train.initialize import random_ball
from gsplat_edu.train.trainer import Callback, Trainer, TrainResult


@dataclass(frozen=True)
class SphereOptions:
    """Options of the training.

    Args:
        budget: Iterations, cap and image size.
        k0: Initial number of Gaussians.
        seed: Seed of the initialisation, the splits and the view order.
        backend: Name of the rendering backend.
        out: The held-out figure, a .png file; the curves and the scene are written next to it.

    Raises:
        ArgumentError: an option is out of range, or `out` is not a .png path; the message names the flag.
    """

    budget: Budget
    k0: int
    seed: int
    backend: str
    out: Path

    def __post_init__(self) -> None:
        """Check the ranges."""
        for name, value in (*self.budget._asdict().items(), ("k0", self.k0)):
            whole_number(f"--{name}", value, 1)
        whole_number("--seed", self.seed, 0)
        if self.k0 > self.budget.cap:
            raise ArgumentError(
                f"--k0: is {self.k0}, more than --cap {self.budget.cap}; lower --k0 or raise --cap"
            )
        if self.out.suffix.lower() != ".png":
            raise ArgumentError(
                f"--out: {str(self.out)!r} must end in .png; the other files are named after it"
            )

    @property
    def files(self) -> tuple[Path, Path, Path]:
        """The held-out figure, the curves and the scene."""
        return self.out, self.out.with_name(f"{self.out.stem}_curves.png"), self.out.with_suffix(".ply")


class Summary(NamedTuple):
    """Result of a training."""

    result: TrainResult
    initial_l1: float
    final_l1: float


def options_from(arguments: argparse.Namespace) -> tuple[SphereOptions, str | None]:
    """Convert parsed arguments to options, with the default budget of the selected backend.

    Also check, before training, that the files can be written, and create their folder.

    Returns:
        The options, and a sentence if the default budget differs from the chapter's.

    Raises:
        ArgumentError: an option is out of range, or the files cannot be written.
        BackendUnavailableError: the backend is not available here.
    """
    backend = resolve_backend(arguments.backend)
    default = REDUCED if backend == "torch" else CHAPTER
    given = {
        name: getattr(arguments, name) for name in Budget._fields if getattr(arguments, name) is not None
    }
    options = SphereOptions(default._replace(**given), arguments.k0, arguments.seed, backend, arguments.out)
    for path in options.files:
        check_writable("--out", path)
    reduced = [name for name in Budget._fields if name not in given and default != CHAPTER]
    if not reduced:
        return options, None
    chosen, full = (" ".join(f"--{name} {getattr(b, name)}" for name in reduced) for b in (default, CHAPTER))
    return (
        options,
        f"backend torch is slow, so the budget is reduced to {chosen} (the chapter uses {full})",
    )


def run_sphere(
    options: SphereOptions, callbacks: Sequence[Callback] = (), say: Callable[[str], None] = print
) -> Summary:
    """Train the sphere and write the figure, the curves and the scene.

    Args:
        options: The options.
        callbacks: Called after every step and every densification.
        say: Prints the closing lines.
    """
    capture = sphere_capture(options.budget.size)
    backend = load_backend(options.backend)
    settings, iters = RenderSettings(depth=False), options.budget.iters
    middle = 3 * iters // 8  # the chapter shows 300 of its 800

    def held_out(gaussians: Gaussians) -> Float32[np.ndarray, "H W 3"]:
        with torch.no_grad():
            return render(gaussians, capture.held_out.camera, settings=settings, backend=backend).image.numpy(
                force=True
            )

    snapshots = {}

    def take_snapshot(trainer: Trainer, event: Event) -> None:
        if (
            event.iteration == middle
        ):  # called after the step and again after its densification, which is kept
            snapshots["middle"] = held_out(trainer.gaussians)

    trainer = _trainer(options, capture, backend, (take_snapshot, *callbacks))
    start = held_out(trainer.gaussians)
    result = trainer.run()
    final, truth = held_out(trainer.gaussians), capture.held_out.image

    figure_path, curves_path, ply_path = options.files
    panels = [("init (iter 0)", start), (f"iter {middle}", snapshots["middle"]), (f"iter {iters}", final)]
    save_figure(figure_path, held_out_figure([*panels, ("truth", truth)]))
    save_figure(curves_path, curves_figure(result.losses, result.counts))
    save_ply(ply_path, trainer.gaussians)
    summary = Summary(result, _l1(start, truth), _l1(final, truth))
    per_iteration = f"{1e3 * result.seconds / iters:.3f} ms/iter at {options.budget.size} px"
    say(f"{iters} iters in {result.seconds:.1f} s -> {per_iteration}, K~{result.counts[-1]}")
    if gpu := gpu_of(backend.name):
        say(f"rendered by {backend.name} on {gpu}")
    say(f"held-out L1: init {summary.initial_l1:.4f} -> final {summary.final_l1:.4f}")
    say(f"wrote {', '.join(str(path) for path in options.files)}")
    return summary


def _trainer(
    options: SphereOptions, capture: SphereCapture, backend: Backend, callbacks: Sequence[Callback]
) -> Trainer:
    config = course_config(options.budget.iters, options.seed, options.budget.cap)
    generator = torch.Generator().manual_seed(options.seed)
    start = Start(random_ball(options.k0, generator), extent=EXTENT, generator=generator)
    return training(config, Views(capture.train), backend, start, callbacks=callbacks)


def _l1(image: Float32[np.ndarray, "H W 3"], truth: Float32[np.ndarray, "H W 3"]) -> float:
    return float(l1(torch.tensor(image), torch.tensor(truth)))

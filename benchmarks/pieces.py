"""Does a piece of another recipe improve the recipe fast?

    python benchmarks/pieces.py --out FILE.json [--captures NAME ...] [--pieces NAME ...] [--seeds N] [--smoke]

Trains four small captures by the recipe fast at standard quality, as it is and with each piece added: snowmiku97 at a
quarter of its size, fox at a sixth, truck11 at half (300 iterations, since trials make it short), and a traced object
of 200 x 200 px with alpha. The captures lie in $GSPLAT_EDU_DATA or ../shared/data. One thread.

The table has means over the seeds and half the range of PSNR and SSIM on held-out views. "gain" is the mean difference
of PSNR from the recipe without a piece with the same seed, "time" the mean ratio of processor time.

Every finished run is stored in FILE.json, so that an interrupted benchmark continues where it stopped.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import os
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import hardware
import numpy as np
import torch
from jaxtyping import Float
from recipes import Results, mean, spread
from torch import Tensor
from traced import traced_capture

from gsplat_edu.base.constants import ALPHA_MIN
from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.validation import whole_number
from gsplat_edu.cli.running import run_command
from gsplat_edu.data.dataset import Dataset, DataSettings, load_dataset
from gsplat_edu.data.writers import write_blender
from gsplat_edu.evaluate.metrics import score_views, summarize
from gsplat_edu.ops.losses import LossKernel, photo_loss
from gsplat_edu.render.api import render
from gsplat_edu.render.backends import load_backend
from gsplat_edu.render.output import RenderOutput
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.scene.rig import scene_extent
from gsplat_edu.train.capacity import planned_gaussians
from gsplat_edu.train.config import TrainConfig, recipe
from gsplat_edu.train.density.fast import PlannedDensity
from gsplat_edu.train.density.surgery import long_axis_children, replace, sorted_in_space
from gsplat_edu.train.events import Change, DensifyEvent
from gsplat_edu.train.initialize import from_points
from gsplat_edu.train.length import planned_iterations
from gsplat_edu.train.objective import PHOTO, Rendered, Term, make_objective
from gsplat_edu.train.optimizer import Adam
from gsplat_edu.train.schedule import milestone, photo_factor
from gsplat_edu.train.step import StepParts, TensorStepper
from gsplat_edu.train.trainer import Trainer

DATA = Path(os.environ.get("GSPLAT_EDU_DATA", "../shared/data"))

PLAIN = "fast"
"""Name of the recipe without a piece."""


@dataclass(frozen=True)
class Capture:
    """A capture to train.

    Args:
        folder: Name of its folder in `DATA`; None for the traced object.
        resolution: Divisor of the photos' size.
        iterations: Length of a run; None for that of standard quality.
    """

    folder: str | None
    resolution: float = 1.0
    iterations: int | None = None


CAPTURES = {
    "snowmiku97": Capture("snowmiku97", 4.0),
    "fox": Capture("fox", 6.0),
    "truck11": Capture("truck11", 2.0, 300),
    "traced": Capture(None),
}

SIZE, COUNT = 200, 80
"""Side, px, and number of the traced photos."""


class Overgrown(PlannedDensity):
    """Grow to more than the cap, then remove the faintest Gaussians until the cap is met at `fast_stop`.

    Args:
        config: As for `PlannedDensity`.
        gaussians: The start Gaussians.
        most: Largest planned number of Gaussians, as a factor on the cap.
        peak: When it is reached, as a fraction of `fast_stop`. At 0.75 photos take their last step but one.

    Source: the idea is that of GNS, which grows to 1.5 to 3 times its budget.
    """

    def __init__(
        self, config: TrainConfig, gaussians: Gaussians, most: float = 1.5, peak: float = 0.75
    ) -> None:
        super().__init__(config, gaussians)
        self._at = [config.densify_start, round(peak * config.fast.stop), config.fast.stop]
        self._planned = [len(gaussians), round(most * self.cap), self.cap]

    @torch.no_grad()
    def update(self, iteration: int, gaussians: Gaussians, optimizer: Adam) -> tuple[Gaussians, list[Change]]:
        """Split or prune up to the plan, when the schedule says so."""
        config, stop = self.config, self.config.fast.stop
        self.is_over = iteration >= stop
        due = milestone(iteration, config.densify_every, config.batch)
        if due is None or due <= config.densify_start:
            return gaussians, []
        opacities, growing = gaussians.opacities, due <= stop
        keep = gaussians.finite_rows() & (opacities >= (config.min_opacity if growing else ALPHA_MIN))
        room = round(float(np.interp(due, self._at, self._planned))) - int(keep.sum())
        if room < 0:
            keep[torch.argsort(torch.where(keep, opacities, 2.0), stable=True)[:-room]] = False
        split = self._highest(keep, room if growing else 0)
        children = long_axis_children(gaussians.map(lambda tensor: tensor[split]))
        replaced = replace(gaussians, optimizer, keep & ~split, children)
        self._forget(replaced)
        counts = 2 * len(children[0]), int((~keep).sum())
        return replaced, [DensifyEvent(iteration, 0, *counts, num_gaussians=len(replaced))]


class ByAbsoluteGradients(PlannedDensity):
    """Score by the sum over the pixels of the absolute gradient of the mean, not by the absolute value of the sum.

    Source: Ye et al. 2024, "AbsGS".
    """

    collected: Callable[[], dict[str, Tensor]] | None = None

    def observe(self, gaussians: Gaussians, output: RenderOutput) -> None:
        """Add this view's scores to the sums of the Gaussians it shows."""
        if self.is_over or self.collected is None:
            return
        H, W = output.image.shape[:2]
        found = self.collected()["absgrad"]
        norms = (found * found.new_tensor([W / 2, H / 2])).norm(dim=-1)
        self.norm_sums.index_add_(0, output.visible, norms)
        self.times_visible.index_add_(0, output.visible, norms.new_ones(1).expand(len(norms)))


class ByRadius(PlannedDensity):
    """Score by the gradient norm of the mean times the geometric mean of the half axes' extents, in photo widths.

    If the signs of h = alpha dL/dalpha are random over the pixels of a Gaussian, the norm times the radius is about the
    root of the sum of h^2 over the pixels, LiteGS' second moment, which the kernels do not give.
    """

    def observe(self, gaussians: Gaussians, output: RenderOutput) -> None:
        """Add this view's scores to the sums of the Gaussians it shows."""
        if self.is_over:
            return
        scores = output.means2d_grad_norms() * output.radii.prod(dim=-1).sqrt() / output.image.shape[1]
        self.norm_sums.index_add_(0, output.visible, scores)
        self.times_visible.index_add_(0, output.visible, scores.new_ones(1).expand(len(scores)))


@dataclass(frozen=True)
class Collecting:
    """The photo term; before the backward pass it asks for the gradients that a density control scores by.

    Args:
        term: The photo term.
        density: The density control.
    """

    term: Term
    density: PlannedDensity

    def __call__(self, rendered: Rendered) -> Float[Tensor, ""]:
        """Return the photo term."""
        if isinstance(self.density, ByAbsoluteGradients) and not self.density.is_over:
            self.density.collected = rendered.output.collect("absgrad")
        return self.term(rendered)


@dataclass(frozen=True)
class LateSsim:
    """The photo term with a weight of SSIM that rises linearly to `last` over the last third of the run.

    Args:
        config: The run.
        last: Weight at the end of the run.
        loss: Compares image and photo.
    """

    config: TrainConfig
    last: float
    loss: LossKernel

    def __call__(self, rendered: Rendered) -> Float[Tensor, ""]:
        """Return (1 - k) L1 + k (1 - SSIM) with the weight k of the iteration."""
        first, t = self.config.ssim_weight, max(3 * rendered.iteration / self.config.iterations - 2, 0.0)
        weight = first + (self.last - first) * t
        return photo_loss(rendered.image, rendered.target.image, rendered.target.mask, weight, self.loss)


@dataclass(frozen=True)
class Piece:
    """What is added to the recipe fast.

    Args:
        density: Makes the density control.
        late_ssim: Weight of SSIM at the end of the run.
        harmonics_every: Move the higher harmonics only in every n-th step while photos are small, as FastGS does.
        views_late: Views of a step in the last quarter of the run.
    """

    density: Callable[[TrainConfig, Gaussians], PlannedDensity] = PlannedDensity
    late_ssim: float | None = None
    harmonics_every: int = 1
    views_late: int = 1


PIECES = {
    PLAIN: Piece(),
    "overgrowth": Piece(Overgrown),
    "early-cap": Piece(functools.partial(Overgrown, most=1.0)),
    "absolute-gradients": Piece(ByAbsoluteGradients),
    "radius": Piece(ByRadius),
    "late-ssim": Piece(late_ssim=0.4),
    "deferred-harmonics": Piece(harmonics_every=16),
    "two-views-late": Piece(views_late=2),
}


def trainer(piece: Piece, config: TrainConfig, dataset: Dataset, gaussians: Gaussians) -> Trainer:
    """Put a training with a piece together."""
    backend, density = load_backend("cpu"), piece.density(config, gaussians)
    objective = make_objective(config, loss=backend.loss)
    objective.terms[PHOTO] = Collecting(objective.terms[PHOTO], density)
    if piece.late_ssim is not None:
        objective.terms[PHOTO] = LateSsim(config, piece.late_ssim, backend.loss)
    extent = scene_extent([view.camera for view in dataset.train])
    parts = StepParts(objective)
    return Trainer(gaussians, dataset.train, config, backend, extent=extent, density=density, parts=parts)


def defer_harmonics(made: Trainer, every: int) -> None:
    """Move the higher harmonics only in every n-th step until photos have their full size."""
    assert isinstance(made.stepper, TensorStepper), "the backend cpu steps on tensors"
    optimizer, config = made.stepper.optimizer, made.config
    group = optimizer.groups["sh_rest"]

    def rate(iteration: int) -> float:
        waits = photo_factor(config, iteration) > 1.0 and (iteration + 1) % every
        return 0.0 if waits else group.rate_at(iteration)

    optimizer.groups["sh_rest"] = dataclasses.replace(group, rate=rate)


def configured(dataset: Dataset, iterations: int, seed: int) -> TrainConfig:
    """Return the configuration of a run, with the cap that fast plans for the capture."""
    pixels = float(np.mean([view.camera.W * view.camera.H for view in dataset.train]))
    cap = planned_gaussians(pixels, len(dataset.train))
    return recipe(iterations, strategy="fast", seed=seed, max_gaussians=cap)


def trained(piece: Piece, dataset: Dataset, config: TrainConfig) -> dict[str, Any]:
    """Train with a piece; return scores, numbers of Gaussians and times."""
    gaussians = sorted_in_space(from_points(dataset.points, dataset.colors, config))
    wall, processor = time.perf_counter(), time.process_time()
    made = trainer(piece, config, dataset, gaussians)
    if piece.harmonics_every > 1:
        defer_harmonics(made, piece.harmonics_every)
    counts = list[int]()
    if piece.views_late > 1:
        before, change = made, round(0.75 * config.iterations / piece.views_late) * piece.views_late
        counts += before.run(lambda: before.iteration >= change).counts
        state = before.state()
        made = trainer(piece, dataclasses.replace(config, batch=piece.views_late), dataset, before.gaussians)
        made.load_state(*state)
    counts += made.run().counts
    seconds = {"seconds": time.perf_counter() - wall, "processor_seconds": time.process_time() - processor}
    settings = RenderSettings(config.background, jacobian_limit=config.jacobian_limit)
    shown = functools.partial(render, settings=settings, backend="cpu")
    test, train = (
        summarize(score_views(made.gaussians, views, shown, config.background))
        for views in (dataset.test, dataset.train)
    )
    scores = {"psnr": test["psnr"], "ssim": test["ssim"], "train_psnr": train["psnr"]}
    return scores | {"gaussians": len(made.gaussians), "most_gaussians": max(counts)} | seconds


def loaded(name: str, scratch: Path, smoke: bool) -> tuple[Dataset, int]:
    """Return a capture, and the length of its runs."""
    asked = CAPTURES[name]
    if asked.folder is None:
        folder = scratch / name
        write_blender(folder, *traced_capture(*((24, 8) if smoke else (SIZE, COUNT))))
    else:
        folder = DATA / asked.folder
        if not folder.is_dir():
            raise ArgumentError(f"{folder}: does not exist; set GSPLAT_EDU_DATA, or give --captures traced")
    dataset = load_dataset(folder, DataSettings(resolution=asked.resolution))
    dataset.preload()
    length = asked.iterations or planned_iterations("standard", len(dataset.train), dataset.measured)
    return dataset, 20 if smoke else length


def table(runs: Sequence[dict[str, Any]]) -> str:
    """Return the scores as a Markdown table."""
    lines = [
        "| capture | piece | runs | PSNR | gain | SSIM | train PSNR | Gaussians, at most | processor s | time |",
        "|" + "---|" * 10,
    ]
    for capture, name in dict.fromkeys((run["capture"], run["recipe"]) for run in runs):
        rows = [run for run in runs if (run["capture"], run["recipe"]) == (capture, name)]
        plain = {run["seed"]: run for run in runs if (run["capture"], run["recipe"]) == (capture, PLAIN)}
        pairs = [(run, plain[run["seed"]]) for run in rows if run["seed"] in plain]
        gain = np.mean([run["psnr"] - other["psnr"] for run, other in pairs]) if pairs else np.nan
        ratio = np.mean([run["processor_seconds"] / other["processor_seconds"] for run, other in pairs or []])
        counts = f"{mean(rows, 'gaussians'):,.0f}, {mean(rows, 'most_gaussians'):,.0f}"
        cells = [spread(rows, "psnr", 2), f"{gain:+.2f}", spread(rows, "ssim", 4)]
        cells += [f"{mean(rows, 'train_psnr'):.2f}", counts]
        cells += [f"{mean(rows, 'processor_seconds'):.0f}", f"{ratio:.2f}"]
        lines.append(f"| {capture} | {name} | {len(rows)} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def compare(arguments: argparse.Namespace) -> None:
    """Train every capture with every piece and seed that has no result yet; print the table."""
    whole_number("--seeds", arguments.seeds, 1)
    torch.set_num_threads(1)
    results = Results(arguments.out, {"threads": 1, "smoke": arguments.smoke})
    done = {(run["capture"], run["recipe"], run["seed"]) for run in results.runs}
    with tempfile.TemporaryDirectory() as scratch:
        for capture in arguments.captures:
            dataset, length = loaded(capture, Path(scratch), arguments.smoke)
            for seed in range(arguments.seeds):
                config = configured(dataset, length, seed)
                for name in arguments.pieces:
                    if (capture, name, seed) in done:
                        continue
                    found = trained(PIECES[name], dataset, config)
                    results.add({"capture": capture, "recipe": name, "seed": seed} | found)
                    print(f"{capture}, {name}, seed {seed}: {found['psnr']:.2f} dB", flush=True)
    print(", ".join(f"{key}: {value}" for key, value in hardware.describe().items()))
    print(table(results.runs))


def main() -> int:
    """Read the command line and compare the pieces."""
    parser = hardware.parser(__doc__.partition("\n")[0])
    parser.add_argument("--captures", nargs="+", choices=tuple(CAPTURES), metavar="NAME")
    parser.add_argument("--pieces", nargs="+", choices=tuple(PIECES), default=tuple(PIECES), metavar="NAME")
    parser.add_argument("--seeds", type=int, default=3, help="seeds 0 to N - 1 (default: 3)")
    arguments = parser.parse_args()
    if arguments.smoke:
        arguments.seeds = 1
    arguments.captures = arguments.captures or (["traced"] if arguments.smoke else list(CAPTURES))
    return run_command("pieces.py", lambda: compare(arguments), debug=False)


if __name__ == "__main__":
    sys.exit(main())

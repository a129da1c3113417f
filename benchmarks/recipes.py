"""Which recipe gives the best held-out quality per minute and per Gaussian?

    python benchmarks/recipes.py [CAPTURE] --out FILE.json [--recipes NAME ...] [--seeds N] [--resolution R]
        [--length FACTOR] [--smoke]

Trains one capture by several recipes, one after another in this process, and scores the held-out views twenty times
during each run with the clock stopped: PSNR, SSIM, and at the end FLIP (Andersson et al. 2020), a perceptual score
without weights to download. CAPTURE is snowmiku97 in $GSPLAT_EDU_DATA or ../shared/data unless given; the word "rgba"
stands for 100 photos of 800 x 800 px with alpha, traced here.

Finished runs are stored in FILE.json, a file per capture, so an interrupted benchmark resumes. FILE.png beside it
shows the scores over time and over Gaussians. Seeds change a result by several tenths of a dB, so the table shows the
mean over the seeds and half their range.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import hardware
import numpy as np
import torch
from captures import capture
from matplotlib.figure import Figure

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.files import written_aside
from gsplat_edu.base.validation import in_range, whole_number
from gsplat_edu.budget.plan import Limits, plan
from gsplat_edu.cli.running import run_command
from gsplat_edu.data.writers import write_blender
from gsplat_edu.evaluate.figures import save_figure
from gsplat_edu.evaluate.metrics import ImageScore, OnImage, score_views, summarize
from gsplat_edu.options import train as command
from gsplat_edu.options.parser import OneLineParser
from gsplat_edu.runs.training import CaptureRun
from gsplat_edu.scene.views import View
from gsplat_edu.train.events import Event, StepEvent
from gsplat_edu.train.length import QUALITIES, UNIT
from gsplat_edu.train.trainer import Trainer
from lab.captures.traced import traced_capture

try:
    import flip_evaluator
except ModuleNotFoundError as missing:
    raise SystemExit(f"{missing}; pip install -c constraints.txt '.[benchmarks]'") from None

MOMENTS = 20
"""Number of times that the held-out views are scored, at equal distances in iterations."""

RGBA = "rgba"
"""Name of the traced capture."""

CAP = 100_000
"""Cap of mcmc if no run of adc has determined the number of Gaussians."""


@dataclass(frozen=True)
class Recipe:
    """A recipe to compare.

    Args:
        strategy: Density control.
        iterations: Length of the run, before `--length`.
        quality: Lets the plan choose the length from the capture, unless `--length` scales `iterations`.
    """

    strategy: str
    iterations: int
    quality: str | None = None


RECIPES = {
    "adc-7k": Recipe("adc", 7_000),
    "mcmc-7k": Recipe("mcmc", 7_000),
    "adc-30k": Recipe("adc", 30_000),
    **{f"fast-{name}": Recipe("fast", share * UNIT, quality=name) for name, share in QUALITIES.items()},
}
"""Recipes by name: adc and mcmc, and the qualities of the fast recipe."""

DEFAULT = ("adc-7k", "mcmc-7k", *(f"fast-{name}" for name in QUALITIES))


@dataclass
class Results:
    """The finished runs, and the file that stores them.

    Args:
        path: JSON file; None to keep them in memory.
        setting: Settings that all runs share. A file with other settings is refused.
    """

    path: Path | None
    setting: dict[str, Any]
    runs: list[dict[str, Any]] = field(default_factory=list)

    def __post_init__(self) -> None:
        """Read the runs of an earlier call."""
        if self.path is None or not self.path.exists():
            return
        stored = json.loads(self.path.read_text())
        if stored["setting"] != self.setting:
            raise ArgumentError(
                f"--out: {self.path} holds runs of another setting, {stored['setting']}; give another file"
            )
        self.runs = stored["runs"]

    def of(self, recipe: str) -> list[dict[str, Any]]:
        """Return the runs of a recipe."""
        return [run for run in self.runs if run["recipe"] == recipe]

    def recipes(self) -> list[str]:
        """Return the names of the recipes with at least one run, ordered by their first run."""
        return list(dict.fromkeys(run["recipe"] for run in self.runs))

    def check(self, recipe: str, config: dict[str, Any]) -> None:
        """Refuse to mix runs of a recipe before and after its constants changed."""
        if any(run.get("config") != config for run in self.of(recipe)):
            raise ArgumentError(
                f"--out: {self.path} holds runs of {recipe} with other constants; give another file"
            )

    def add(self, run: dict[str, Any]) -> None:
        """Store one more run."""
        self.runs.append(run)
        if self.path is not None:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            result = {"hardware": hardware.describe(), "setting": self.setting, "runs": self.runs}
            with written_aside(self.path) as aside:
                aside.write_text(json.dumps(result, indent=1) + "\n")


def trained(name: str, seed: int, arguments: argparse.Namespace, results: Results) -> dict[str, Any]:
    """Train by one recipe; return its scores.

    Args:
        name: Name of the recipe.
        seed: Seed of the run.
        arguments: Arguments of the benchmark: data, resolution, length.
        results: Earlier runs; mcmc takes its cap from those of adc.
    """
    recipe = RECIPES[name]
    quality = recipe.quality if arguments.length == 1 else None
    length = (
        ["--quality", quality]
        if quality
        else ["--iterations", str(max(1, round(recipe.iterations * arguments.length)))]
    )
    words = ["--strategy", recipe.strategy, *length, "--seed", str(seed)]
    words += ["--eval-every", "0", "--save-every", "0"]
    if arguments.resolution is not None:
        words += ["--resolution", str(arguments.resolution)]
    if recipe.strategy == "mcmc":
        adc = [run["gaussians"] for run in results.of("adc-7k")]
        words += ["--max-gaussians", str(round(float(np.mean(adc))) if adc else CAP)]
    parser = OneLineParser(prog="recipes.py")
    command.add_arguments(parser)
    with tempfile.TemporaryDirectory() as scratch:
        folder = str(Path(scratch) / "run")
        options = command.options_from(parser.parse_args([str(arguments.data), *words, "--out", folder]))
        run = CaptureRun(plan(options, Limits(), quality=quality).options)
        config = settings_of(run)
        results.check(name, config)
        return {"recipe": name, "seed": seed, "options": " ".join(words), "config": config, **measured(run)}


def settings_of(run: CaptureRun) -> dict[str, Any]:
    """Return the settings that all runs of a recipe share, as read from JSON: all except seed and cap."""
    settings = dataclasses.asdict(run.options.config)
    settings = {key: value for key, value in settings.items() if key not in ("seed", "max_gaussians")}
    found: dict[str, Any] = json.loads(json.dumps(settings))
    return found


class Clock:
    """Wall and processor time of a training, without the time while it is stopped."""

    def __init__(self) -> None:
        self._began = np.array([time.perf_counter(), time.process_time()])

    def read(self) -> tuple[float, float]:
        """Return the seconds so far: wall, processor."""
        wall, processor = np.array([time.perf_counter(), time.process_time()]) - self._began
        return float(wall), float(processor)

    @contextmanager
    def stopped(self) -> Iterator[None]:
        """Exclude the time of the block."""
        before = np.array([time.perf_counter(), time.process_time()])
        yield
        self._began += np.array([time.perf_counter(), time.process_time()]) - before


def measured(run: CaptureRun) -> dict[str, Any]:
    """Train, score the held-out views `MOMENTS` times, and return the scores."""
    total = run.options.config.iterations
    due = {math.ceil(total * k / MOMENTS) for k in range(1, MOMENTS + 1)}
    curve: list[dict[str, float]] = []
    clock = Clock()

    def watch(trainer: Trainer, event: Event) -> None:
        if isinstance(event, StepEvent) and trainer.iteration in due:
            seconds, processor = clock.read()
            with clock.stopped():
                scores = scored(run, run.dataset.test)
                curve.append(
                    {"iteration": trainer.iteration, "seconds": seconds, "processor_seconds": processor}
                    | {"gaussians": len(trainer.gaussians), "psnr": scores["psnr"], "ssim": scores["ssim"]}
                )

    run.train(callbacks=[watch])
    train_psnr = scored(run, run.dataset.train)["psnr"]
    return {**curve[-1], "flip": flip(run), "train_psnr": train_psnr, "curve": curve}


def scored(run: CaptureRun, views: Sequence[View], on_image: OnImage | None = None) -> dict[str, Any]:
    """Score the run's Gaussians on views."""
    options = run.options
    return summarize(
        score_views(run.trainer.gaussians, views, options.renderer, options.config.background, on_image)
    )


def flip(run: CaptureRun) -> float:
    """Return the mean FLIP of the held-out views, 0 to 1; 0 for equal images."""
    found: list[float] = []

    def one(_view: View, _score: ImageScore, image: np.ndarray, photo: np.ndarray) -> None:
        pair = (pixels.astype(np.float32) / 255 for pixels in (photo, image))
        found.append(float(flip_evaluator.evaluate(*pair, "LDR", applyMagma=False)[1]))

    scored(run, run.dataset.test, one)
    return float(np.mean(found))


TIME = "processor_seconds"
"""Time by which recipes are compared; other programs on the machine hardly change it."""


def seconds_to(curve: Sequence[dict[str, float]], psnr: float) -> float | None:
    """Return the processor seconds at which a run's held-out PSNR reaches a value, interpolated; None if never."""
    for before, point in zip((None, *curve), curve, strict=False):
        if point["psnr"] >= psnr:
            if before is None:
                return point[TIME]
            share = (psnr - before["psnr"]) / (point["psnr"] - before["psnr"])
            return before[TIME] + share * (point[TIME] - before[TIME])
    return None


def table(results: Results) -> str:
    """Return the recipes' scores as a Markdown table: mean over the seeds and half their range."""
    lines = [
        "| recipe | runs | PSNR | SSIM | FLIP | train PSNR | Gaussians | seconds | processor seconds |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for name in results.recipes():
        runs = results.of(name)
        cells = [spread(runs, key, digits) for key, digits in (("psnr", 2), ("ssim", 4), ("flip", 4))]
        cells += [spread(runs, "train_psnr", 2)]
        cells += [f"{mean(runs, key):,.0f}" for key in ("gaussians", "seconds", "processor_seconds")]
        lines.append(f"| {name} | {len(runs)} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def mean(runs: Sequence[dict[str, Any]], key: str) -> float:
    """Return the mean of a figure over runs."""
    return float(np.mean([run[key] for run in runs]))


def spread(runs: Sequence[dict[str, Any]], key: str, digits: int) -> str:
    """Return the mean of a figure over runs, and half its range if there are several."""
    values = [run[key] for run in runs]
    half = (max(values) - min(values)) / 2
    return f"{np.mean(values):.{digits}f}" + (f" ± {half:.{digits}f}" if len(values) > 1 else "")


def races(results: Results) -> list[str]:
    """Return when recipes reach the final PSNR of adc and mcmc, as fractions of their processor time."""
    said = []
    for other in (name for name in results.recipes() if RECIPES[name].strategy != "fast"):
        target, whole = mean(results.of(other), "psnr"), mean(results.of(other), TIME)
        for name in results.recipes():
            reached = [seconds_to(run["curve"], target) for run in results.of(name)]
            found = [seconds for seconds in reached if seconds is not None]
            if name != other and len(found) == len(reached):
                share = float(np.mean(found)) / whole
                said.append(f"{name} reaches {other}'s {target:.2f} dB in {share:.2f} of its processor time")
            elif name != other:
                said.append(
                    f"{name} reaches {other}'s {target:.2f} dB in {len(found)} of {len(reached)} runs"
                )
    return said


SCORES = (
    ("psnr", "held-out PSNR (dB)", 3.0),
    ("ssim", "held-out SSIM", 0.05),
    ("flip", "held-out FLIP (lower is better)", None),
)
"""Curves of the figure: key, label, and how far the axis extends below the worst final score."""


def figure(results: Results, title: str) -> Figure:
    """Draw PSNR and SSIM during the runs and FLIP at their ends, over processor time and over Gaussians."""
    drawn = Figure(figsize=(11, 11), layout="constrained")
    drawn.suptitle(title)
    grid = drawn.subplots(3, 2)
    colors = {name: f"C{k}" for k, name in enumerate(results.recipes())}
    for row, (score, label, below) in enumerate(SCORES):
        for axes, key in zip(grid[row], (TIME, "gaussians"), strict=True):
            for run in results.runs:
                color = colors[run["recipe"]]
                if below is not None:
                    axes.plot(*columns(run["curve"], key, score), color=color, linewidth=0.7, alpha=0.6)
                axes.plot(run[key], run[score], "o", color=color)
            if below is not None:
                axes.set_ylim(bottom=min(run[score] for run in results.runs) - below)
            axes.set(xlabel="processor time (s)" if key == TIME else "Gaussians", ylabel=label)
            if key == TIME:
                axes.set_xscale("log")
            else:
                axes.locator_params(axis="x", nbins=5)
            axes.grid(alpha=0.3, which="both")
    for name, color in colors.items():
        grid[0, 0].plot([], [], "o-", color=color, label=name)
    grid[0, 0].legend(fontsize=8)
    return drawn


def columns(curve: Sequence[dict[str, float]], *keys: str) -> list[list[float]]:
    """Return columns of a run's curve."""
    return [[point[key] for point in curve] for key in keys]


@contextmanager
def chosen_capture(arguments: argparse.Namespace) -> Iterator[Path]:
    """Yield the folder of the capture that the arguments name. The traced capture is kept beside the results."""
    if str(arguments.capture) != RGBA:
        with capture(arguments.capture, arguments.smoke) as folder:
            yield folder
        return
    size, count = (24, 8) if arguments.smoke else (800, 100)
    with tempfile.TemporaryDirectory() as scratch:
        folder = (arguments.out.parent if arguments.out else Path(scratch)) / RGBA
        if not (folder / "transforms_test.json").exists():  # the file that is written last
            print(f"tracing {count} photos of {size} x {size} px into {folder}", flush=True)
            write_blender(folder, *traced_capture(size, count))
        yield folder


def compare(arguments: argparse.Namespace) -> None:
    """Train by the recipes and seeds that have no result yet; print the table and draw the figure."""
    whole_number("--seeds", arguments.seeds, 1)
    in_range("--length", arguments.length, 0.0, open_low=True)
    with chosen_capture(arguments) as folder:
        arguments.data = folder
        setting = {
            "capture": folder.name,
            "resolution": arguments.resolution,
            "length": arguments.length,
            "threads": torch.get_num_threads(),
        }
        results = Results(arguments.out, setting)
        for seed in range(arguments.seeds):
            for name in arguments.recipes:
                if any(run["seed"] == seed for run in results.of(name)):
                    continue
                found = trained(name, seed, arguments, results)
                results.add(found)
                print(
                    f"{name}, seed {seed}: {found['psnr']:.2f} dB, SSIM {found['ssim']:.4f}, FLIP {found['flip']:.4f}, "
                    f"{found['gaussians']} Gaussians, {found['seconds']:.0f} s",
                    flush=True,
                )
    print(", ".join(f"{key}: {value}" for key, value in {**hardware.describe(), **setting}.items()))
    print(table(results), *races(results), sep="\n")
    if arguments.out is not None:
        title = f"{setting['capture']}, {setting['threads']} threads; lines: during a run, dots: at its end"
        save_figure(arguments.out.with_suffix(".png"), figure(results, title))


def main() -> int:
    """Read the command line and compare the recipes."""
    parser = hardware.parser(__doc__.partition("\n")[0])
    parser.add_argument("capture", nargs="?", type=Path, help=f'folder of a capture, or the word "{RGBA}"')
    parser.add_argument("--recipes", nargs="+", choices=tuple(RECIPES), default=DEFAULT, metavar="NAME")
    parser.add_argument("--seeds", type=int, default=3, help="seeds 0 to N - 1 (default: 3)")
    parser.add_argument("--resolution", type=int, help="divisor of the photos' size, as in train")
    parser.add_argument("--length", type=float, default=1.0, help="factor on all numbers of iterations")
    arguments = parser.parse_args()
    if arguments.smoke:
        arguments.seeds, arguments.length = 2, 0.002
    return run_command("recipes.py", lambda: compare(arguments), debug=False)


if __name__ == "__main__":
    sys.exit(main())

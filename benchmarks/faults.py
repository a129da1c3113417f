"""How much of what a fault of the photos costs does its remedy bring back?

    python benchmarks/faults.py [CAPTURE] --out FILE.json [--resolution R] [--iterations N] [--smoke]

Plants a fault with known truth into a copy of a capture, and trains four times with the fast recipe: the capture and the
copy, each without and with the remedy. CAPTURE is snowmiku97 in $GSPLAT_EDU_DATA or ../shared/data unless given; the word
"traced" stands for 60 photos of 400 x 400 px, traced here, whose own exposure does not vary.

The fault is exposure and white balance: linear light times 2^u for u from -0.7 to 0.7, and its red and blue times 0.85 to
1.15 in addition, rounded to bytes and clipped. Held-out photos have it too, so scenes are compared by the PSNR of their
right half after a fit on the left half. Gains are compared with the truth beyond those found in the capture itself.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import hardware
import numpy as np
from captures import capture
from jaxtyping import Float64
from traced import traced_capture

from gsplat_edu.budget.plan import Limits, plan
from gsplat_edu.cli.arguments import OneLineParser, run_command
from gsplat_edu.cli.options import train as command
from gsplat_edu.data.dataset import load_dataset
from gsplat_edu.data.writers import write_colmap
from gsplat_edu.evaluate.metrics import score_views, summarize
from gsplat_edu.exposure import stops
from gsplat_edu.runs.training import CaptureRun
from gsplat_edu.train.exposure import Exposure
from gsplat_edu.validation import ArrayLike
from gsplat_edu.views import View

TRACED = "traced"
"""Name of the capture that is traced here."""

GREY = 0.4
"""Background of the traced photos, which have to be opaque."""

STOPS, TINT = 0.7, 0.15
"""Largest planted exposure, stops, and largest planted change of red and blue."""

SEED = 7


def linear(encoded: ArrayLike) -> Float64[np.ndarray, "..."]:
    """Decode sRGB to linear light."""
    x = np.asarray(encoded, dtype=np.float64)
    return np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4)


def encoded(light: ArrayLike) -> Float64[np.ndarray, "..."]:
    """Encode linear light as sRGB."""
    x = np.asarray(light, dtype=np.float64)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 1e-12) ** (1 / 2.4) - 0.055)


def uneven(views: Sequence[View]) -> tuple[list[View], Float64[np.ndarray, "V 3"]]:
    """Return the views with other exposures, and the factors on their linear light."""
    rng = np.random.default_rng(SEED)
    scales = 2.0 ** rng.uniform(-STOPS, STOPS, (len(views), 1)) * np.ones(3)
    scales[:, ::2] *= rng.uniform(1 - TINT, 1 + TINT, (len(views), 2))
    changed = []
    for view, scale in zip(views, scales, strict=True):
        photo = view.read()
        light = linear(np.asarray(photo.over((0.0, 0.0, 0.0))) / 255.0) * scale
        image = np.round(255 * np.clip(encoded(light), 0, 1)).astype(np.uint8)
        changed.append(View(view.camera, image, mask=photo.mask, name=view.name))
    return changed, scales


def opaque(views: Sequence[View]) -> list[View]:
    """Return the views before grey."""
    return [View(view.camera, view.read().over((GREY,) * 3), name=view.name) for view in views]


def stored(folder: Path, views: Sequence[View], points: ArrayLike, colors: ArrayLike) -> Path:
    """Write a capture; names end in .png."""
    named = [
        View(view.camera, photo.image, mask=photo.mask, name=str(Path(view.name).with_suffix(".png")))
        for view in views
        for photo in (view.read(),)
    ]
    write_colmap(folder, named, points, colors)
    return folder


def trained(
    folder: Path, appearance: str, arguments: argparse.Namespace
) -> tuple[dict[str, Any], CaptureRun]:
    """Train a capture; return the scores of its held-out views and the run."""
    words = ["--iterations", str(arguments.iterations), "--appearance", appearance, "--eval-every", "0"]
    words += ["--save-every", "0"]
    if arguments.resolution is not None:
        words += ["--resolution", str(arguments.resolution)]
    parser = OneLineParser(prog="faults.py")
    command.add_arguments(parser)
    with tempfile.TemporaryDirectory() as scratch:
        out = str(Path(scratch) / "run")
        options = command.options_from(parser.parse_args([str(folder), *words, "--out", out]))
        run = CaptureRun(plan(options, Limits()).options)
        before = time.process_time()
        run.train()
        seconds = time.process_time() - before
    scores = score_views(
        run.trainer.gaussians, run.dataset.test, run.options.renderer, run.options.config.background
    )
    return {**summarize(scores), "processor_seconds": seconds, "gaussians": len(run.trainer.gaussians)}, run


def gains_of(run: CaptureRun) -> dict[str, Float64[np.ndarray, "3"]]:
    """Return the stops that a run found, by the name of the photo."""
    model = run.trainer.view_model
    if not isinstance(model, Exposure):
        raise TypeError("the run does not correct exposures")
    names = [view.name for view in run.dataset.train]
    return dict(zip(names, stops(model.log_gains()).double().numpy(), strict=True))


def compare(folder: Path, arguments: argparse.Namespace) -> dict[str, Any]:
    """Train the four runs; return their scores, what was regained, and the errors of the gains."""
    dataset = load_dataset(folder)
    views = sorted((*dataset.train, *dataset.test), key=lambda view: view.name)
    if arguments.capture is not None and str(arguments.capture) == TRACED:
        views = opaque(views)
    with tempfile.TemporaryDirectory() as scratch:
        changed, scales = uneven(views)
        clean = stored(Path(scratch) / "clean", views, dataset.points, dataset.colors)
        faulty = stored(Path(scratch) / "faulty", changed, dataset.points, dataset.colors)
        runs: dict[str, dict[str, Any]] = {}
        gains = {}
        for name, place in (("clean", clean), ("faulty", faulty)):
            for appearance in ("none", "exposure"):
                found, run = trained(place, appearance, arguments)
                runs[f"{name}, {appearance}"] = found
                if appearance == "exposure":
                    gains[name] = gains_of(run)
                print(f"{name}, {appearance}: {line(found)}", flush=True)
    names = [str(Path(view.name).with_suffix(".png")) for view in views]
    truth = dict(zip(names, np.log2(scales), strict=True))
    error = np.array([gains["faulty"][name] - gains["clean"][name] - truth[name] for name in gains["clean"]])
    error -= error.mean(axis=0)  # the gauge: the mean of the truth over the training photos is not 0
    best, lost, back = (
        runs[name]["psnr_fitted"] for name in ("clean, none", "faulty, none", "faulty, exposure")
    )
    return {
        "runs": runs,
        "regained": (back - lost) / (best - lost),
        "stops_rms": float(np.sqrt(np.mean(error**2))),
        "stops_p90": float(np.quantile(np.abs(error), 0.9)),
        "stops_max": float(np.abs(error).max()),
    }


def line(found: dict[str, Any]) -> str:
    """Return one run's scores."""
    return (
        f"PSNR {found['psnr']:.2f} dB, exposure fitted {found['psnr_fitted']:.2f} dB,"
        f" {found['gaussians']} Gaussians, {found['processor_seconds']:.0f} s of processor time"
    )


def measure(arguments: argparse.Namespace) -> None:
    """Choose the capture, compare, and report."""
    if arguments.capture is not None and str(arguments.capture) == TRACED:
        size, count = (24, 10) if arguments.smoke else (400, 60)
        with tempfile.TemporaryDirectory() as scratch:
            train, test = traced_capture(size, count)
            rng = np.random.default_rng(SEED)
            points = rng.uniform(-1.5, 1.5, (20_000 if not arguments.smoke else 50, 3))
            folder = stored(
                Path(scratch) / TRACED, opaque((*train, *test)), points, np.full(points.shape, 0.5)
            )
            result = compare(folder, arguments)
    else:
        with capture(arguments.capture, arguments.smoke) as folder:
            result = compare(folder, arguments)
    print(f"regained: {100 * result['regained']:.0f} % of the PSNR, exposure fitted, that the fault costs")
    print(
        f"errors of the gains: {result['stops_rms']:.3f} stops rms, 90 % below {result['stops_p90']:.3f},"
        f" largest {result['stops_max']:.3f}"
    )
    hardware.report(result, arguments.out)


def main() -> int:
    """Read the command line and measure."""
    parser = hardware.parser(__doc__.partition("\n")[0])
    parser.add_argument("capture", nargs="?", type=Path, help=f'folder of a capture, or the word "{TRACED}"')
    parser.add_argument("--resolution", type=float, help="divisor of the photos' size, as in train")
    parser.add_argument("--iterations", type=int, default=3_000, help="length of each run (default: 3000)")
    arguments = parser.parse_args()
    if arguments.smoke:
        arguments.iterations = 20
    return run_command("faults.py", lambda: measure(arguments), debug=False)


if __name__ == "__main__":
    sys.exit(main())

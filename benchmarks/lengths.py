"""Is the planned length of a training right, for many photos and for few?

    python benchmarks/lengths.py [--photos N] [--seeds N] [--smoke] [--out FILE.json]

Many: traces N photos of boxes under a sky (lab/captures), without and with the noise of a sensor, and trains them
for the iterations that standard plans and for four times as many. Few: `truck11`, and 12 training photos each of
`snowmiku97` and `fox` (in $GSPLAT_EDU_DATA or ../shared/data), as `gsplat_edu.runs.thin` tries them: three quarters of
the training photos, 240 px wide, for lengths up to 3,200; PSNR and `psnr_shifted` of the other quarter. One thread.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import hardware
import numpy as np
import torch

from gsplat_edu.base.validation import whole_number
from gsplat_edu.cli.arguments import run_command
from gsplat_edu.data.dataset import Dataset, DataSettings, load_dataset
from gsplat_edu.data.writers import write_colmap
from gsplat_edu.evaluate.metrics import psnr
from gsplat_edu.evaluate.shifted import psnr_shifted
from gsplat_edu.render.api import render
from gsplat_edu.render.backends import load_backend
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.runs.thin import HOLD_OUT, LENGTHS, SIDE
from gsplat_edu.scene.views import View
from gsplat_edu.train.compose import training
from gsplat_edu.train.config import recipe
from gsplat_edu.train.length import planned_iterations
from lab.captures.outdoors import outdoor_capture

DATA = Path(os.environ.get("GSPLAT_EDU_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))

SIZE = (240, 180)
"""Width and height of the traced photos, px."""

NOISE = 4.0
"""Standard deviation of the noise, of 255."""

THIN = {"truck11": None, "snowmiku97": 12, "fox": 12}
"""Captures and their training photos; None for all."""

Score = Callable[[Any, Any], float]


def scores(
    dataset: Dataset, views: Sequence[View], length: int, seed: int, by: Sequence[Score]
) -> list[float]:
    """Train a dataset for a number of iterations; return the mean scores of views, dB."""
    config = recipe(length, strategy="fast", sh_degree=3, seed=seed)
    made = training(config, dataset, load_backend("cpu"))
    made.run()
    settings, found = RenderSettings(config.background, jacobian_limit=config.jacobian_limit), []
    with torch.no_grad():
        for view in views:
            image = render(made.gaussians, view.camera, settings=settings, backend="cpu").image
            found.append([score(image.numpy(), view.read().image) for score in by])
    return [float(mean) for mean in np.mean(found, axis=0)]


def many(folder: Path, arguments: argparse.Namespace) -> dict[str, Any]:
    """Train the traced photos with the planned length and four times as long."""
    width, height = (48, 36) if arguments.smoke else SIZE
    made = outdoor_capture(width, height, arguments.photos, points=8_000)
    found: dict[str, Any] = {}
    for name, noise in (("clean", 0.0), ("noisy", NOISE)):
        rng, views = np.random.default_rng(0), []
        for view in made.views:
            image = view.read().image
            noisy = np.clip(np.rint(image + rng.normal(scale=noise, size=image.shape)), 0, 255)
            views.append(View(view.camera, noisy.astype(np.uint8), name=view.name))
        write_colmap(folder / name, views, made.points, made.colors)
        dataset = load_dataset(folder / name)
        planned = 20 if arguments.smoke else planned_iterations("standard", len(dataset.train))
        for length in (planned, 4 * planned):
            runs = [scores(dataset, dataset.test, length, seed, [psnr])[0] for seed in range(arguments.seeds)]
            found[f"{name}, {length}"] = runs
            told = ", ".join(f"{score:.2f}" for score in runs)
            print(f"{len(dataset.train)} photos, {name}, {length} iterations: {told} dB", flush=True)
    return found


def few(arguments: argparse.Namespace) -> dict[str, Any]:
    """Score trials of captures with few photos, where there are any."""
    found: dict[str, Any] = {}
    for name, count in THIN.items():
        if arguments.smoke or not (DATA / name).is_dir():
            continue
        dataset = load_dataset(DATA / name, DataSettings(resolution=SIDE))
        views = dataset.train
        if count is not None:
            views = tuple(views[round(i * len(views) / count)] for i in range(count))
        judges = views[HOLD_OUT // 2 :: HOLD_OUT]
        kept = tuple(view for i, view in enumerate(views) if i % HOLD_OUT != HOLD_OUT // 2)
        for length in (*LENGTHS, 1_600, 3_200):
            runs = [
                scores(replace(dataset, train=kept), judges, length, seed, [psnr, psnr_shifted])
                for seed in range(arguments.seeds)
            ]
            found[f"{name}, {length}"] = runs
            told = ", ".join(f"{plain:.2f} ({shifted:.2f})" for plain, shifted in runs)
            print(f"{name}, {len(views)} photos, {length} iterations: {told} dB (shifted)", flush=True)
    return found


def measure(arguments: argparse.Namespace) -> dict[str, Any]:
    """Train all captures."""
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        return {"few": few(arguments), "many": many(Path(folder), arguments)}


def main() -> int:
    """Read the command line and measure."""
    parser = hardware.parser(__doc__.partition("\n")[0])
    parser.add_argument("--photos", type=int, default=300, help="traced photos (default: 300)")
    parser.add_argument("--seeds", type=int, default=1, help="seeds 0 to N - 1 (default: 1)")
    arguments = parser.parse_args()
    if arguments.smoke:
        arguments.photos = 16
    whole_number("--photos", arguments.photos, 9)
    return run_command(
        "lengths.py", lambda: hardware.report({"captures": measure(arguments)}, arguments.out), debug=False
    )


if __name__ == "__main__":
    sys.exit(main())

"""How many Gaussians does a capture need whose photos overlap little?

    python benchmarks/overlap.py [--photos N] [--seeds N] [--smoke] [--out FILE.json]

Trains a traced room seen from within and a procedural city seen from the air (lab/captures), where few photos show
the same, and `snowmiku97` at a third of its width (in $GSPLAT_EDU_DATA or ../shared/data), all of whose photos show
one toy, at standard quality with multiples of the number of Gaussians that the recipe would plan if the photos
overlapped. Prints PSNR on held-out photos and processor time; one thread.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from collections.abc import Iterator
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
from gsplat_edu.render.api import render
from gsplat_edu.render.backends import load_backend
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.train.capacity import planned_gaussians
from gsplat_edu.train.compose import training
from gsplat_edu.train.config import recipe
from gsplat_edu.train.length import planned_iterations
from gsplat_edu.train.overlap import separate_views
from lab.captures.city import City, write_city
from lab.captures.room import room_capture

DATA = Path(os.environ.get("GSPLAT_EDU_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))

SIZE = (320, 240)
"""Width and height of the traced photos, px."""

FACTORS = (0.5, 1.0, 2.0, 4.0)


def captures(scratch: Path, photos: int, smoke: bool) -> Iterator[tuple[str, Dataset]]:
    """Make or load the captures, one at a time."""
    width, height = (48, 36) if smoke else SIZE
    write_colmap(scratch / "room", *room_capture(width, height, photos))
    yield "room", load_dataset(scratch / "room")
    write_city(scratch / "city", City(photos, width))
    yield "city", load_dataset(scratch / "city")
    if not smoke and DATA.is_dir():
        yield "snowmiku97", load_dataset(DATA / "snowmiku97", DataSettings(resolution=3.0))


def trained(dataset: Dataset, count: int, iterations: int, seed: int) -> tuple[float, float]:
    """Train with a number of Gaussians; return PSNR on held-out photos, dB, and processor seconds."""
    config = recipe(iterations, strategy="fast", max_gaussians=max(count, len(dataset.points)), seed=seed)
    begun = time.process_time()
    made = training(config, dataset, load_backend("cpu"))
    made.run()
    seconds = time.process_time() - begun
    settings, scores = RenderSettings(config.background, jacobian_limit=config.jacobian_limit), []
    with torch.no_grad():
        for view in dataset.test:
            image = render(made.gaussians, view.camera, settings=settings, backend="cpu").image
            scores.append(psnr(image, view.read().image))
    return float(np.mean(scores)), seconds


def measure(arguments: argparse.Namespace) -> dict[str, Any]:
    """Train every capture with every number of Gaussians."""
    torch.set_num_threads(1)
    found: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as folder:
        for name, dataset in captures(Path(folder), arguments.photos, arguments.smoke):
            cameras = [view.camera for view in dataset.train]
            pixels = float(np.mean([camera.W * camera.H for camera in cameras]))
            plain = planned_gaussians(pixels, len(cameras))
            separate = separate_views(cameras, dataset.points)
            length = 20 if arguments.smoke else planned_iterations("standard", len(cameras))
            row = found[name] = {"views": len(cameras), "separate": separate, "plain": plain}
            row["planned"] = planned_gaussians(pixels, len(cameras), separate)
            for factor in FACTORS:
                runs = [
                    trained(dataset, round(factor * plain), length, seed) for seed in range(arguments.seeds)
                ]
                row[f"x {factor:g}"] = runs
                told = ", ".join(f"{score:.2f} dB in {seconds:.0f} s" for score, seconds in runs)
                print(
                    f"{name}, {separate:g} separate views of {len(cameras)}, x {factor:g}: {told}", flush=True
                )
    return found


def main() -> int:
    """Read the command line and measure."""
    parser = hardware.parser(__doc__.partition("\n")[0])
    parser.add_argument("--photos", type=int, default=96, help="photos of the traced captures (default: 96)")
    parser.add_argument("--seeds", type=int, default=2, help="seeds 0 to N - 1 (default: 2)")
    arguments = parser.parse_args()
    if arguments.smoke:
        arguments.photos, arguments.seeds = 16, 1
    whole_number("--photos", arguments.photos, 9)
    return run_command(
        "overlap.py", lambda: hardware.report({"captures": measure(arguments)}, arguments.out), debug=False
    )


if __name__ == "__main__":
    sys.exit(main())

"""What does a region of interest gain at the same number of Gaussians, over the pixels whose surface is in the box?

    python benchmarks/region.py [--capture snowmiku97|solids] [--quality QUALITY] [--seeds N] [--smoke]
        [--out FILE.json]

Trains `snowmiku97` at a quarter of its size, and traced solids, by the recipe fast: with all pixels ("whole"), and with
those only whose ray meets a box ("region"). The box of snowmiku97 is the one that the page proposes, that of the solids
surrounds one of them. PSNR is measured on held-out photos, over the pixels whose surface lies in the box. The surface
is the median depth of the first whole run; that of the solids is exact. Time is that of the processor.
"""

from __future__ import annotations

import dataclasses
import os
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import hardware
import numpy as np
import torch
from jaxtyping import Bool

from gsplat_edu.cli.arguments import run_command
from gsplat_edu.data.dataset import Dataset, DataSettings, load_dataset
from gsplat_edu.data.region_masks import views_of_region
from gsplat_edu.doctor.geometry import Geometry
from gsplat_edu.doctor.subject import subject_region
from gsplat_edu.evaluate.metrics import psnr
from gsplat_edu.render.api import render
from gsplat_edu.render.backends import load_backend
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.scene.region import Region
from gsplat_edu.scene.views import View
from gsplat_edu.train.compose import training
from gsplat_edu.train.config import TrainConfig, recipe
from gsplat_edu.train.length import QUALITIES, planned_iterations
from lab.captures.solids_photos import solids_capture

DATA = Path(os.environ.get("GSPLAT_EDU_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))

HELD_OUT = 8
"""Every view of this number of the solids is a test view."""

FEWEST = 100
"""Pixels in the box that a photo needs to be scored there."""

SHOWN = RenderSettings(jacobian_limit=TrainConfig.jacobian_limit, median_depth=True)
"""Renders as the training does."""

KINDS = ("whole", "region")


@dataclasses.dataclass(frozen=True, eq=False)
class Traced:
    """A traced capture as `training` takes it."""

    train: Sequence[View]
    points: np.ndarray
    colors: np.ndarray


@dataclasses.dataclass(frozen=True, eq=False)
class Case:
    """A capture with a region.

    Args:
        data: The capture with its region.
        test: Held-out views.
        region: The box.
        depths: The true depth of each held-out view; None if it has to be rendered.
    """

    data: Dataset | Traced
    test: Sequence[View]
    region: Region
    depths: Sequence[np.ndarray] | None = None


def photographed(resolution: float) -> Case:
    """Return snowmiku97 with the box that the page proposes."""
    dataset = load_dataset(DATA / "snowmiku97", DataSettings(resolution=resolution, region=()))
    region = subject_region(Geometry([view.camera for view in dataset.train], dataset.points))
    return Case(dataset, dataset.test, region)


def traced(size: int, count: int) -> Case:
    """Return the traced solids with a box around the first of their shapes."""
    made = solids_capture(size=size, count=count)
    shown = np.concatenate(
        [
            (view.camera.origins() + photo.depth[..., None] * view.camera.rays())[photo.part == 0]
            for view, photo in zip(made.views, made.photos, strict=True)
        ]
    )
    low, high = shown.min(axis=0), shown.max(axis=0)
    region = Region((low + high) / 2, np.eye(3), 0.55 * (high - low))
    train = [view for i, view in enumerate(made.views) if i % HELD_OUT]
    data = Traced(train, made.points, made.colors)
    depths = [photo.depth for photo in made.photos[::HELD_OUT]]
    return Case(data, made.views[::HELD_OUT], region, depths)


def inside(region: Region, points: np.ndarray) -> Bool[np.ndarray, " N"]:
    """Return which points lie in a box."""
    return np.asarray((np.abs((points - region.center) @ region.rotation) <= region.half).all(axis=1))


def mask_of(camera: Camera, depth: np.ndarray, region: Region) -> Bool[np.ndarray, "H W"]:
    """Return the pixels whose surface lies in a box; depth 0 is no surface."""
    points = camera.origins() + depth[..., None] * camera.rays()
    held = inside(region, points.reshape(-1, 3))
    return np.asarray(held.reshape(depth.shape) & (depth > 0))


def trained(case: Case, kind: str, seed: int, iterations: int) -> tuple[Gaussians, float]:
    """Train by one of `KINDS`; return the scene, and the processor's seconds."""
    data = Traced(case.data.train, case.data.points, case.data.colors)
    if kind == "region":
        data = dataclasses.replace(data, train=views_of_region(case.data.train, case.region))
    begun = time.process_time()
    trainer = training(recipe(iterations, strategy="fast", seed=seed), data, load_backend("cpu"))
    trainer.run()
    return trainer.gaussians, time.process_time() - begun


def scored(case: Case, gaussians: Gaussians, masks: Sequence[np.ndarray]) -> dict[str, float]:
    """Return mean PSNR on the held-out views, in the box and in all of the picture."""
    in_box, everywhere = [], []
    with torch.no_grad():
        for view, mask in zip(case.test, masks, strict=True):
            image, photo = (
                render(gaussians, view.camera, settings=SHOWN, backend="cpu").image,
                view.read().image,
            )
            everywhere.append(psnr(image, photo))
            if mask.sum() >= FEWEST:
                in_box.append(psnr(image, photo, mask))
    return {"box": float(np.mean(in_box)), "all": float(np.mean(everywhere))}


def median_depths(case: Case, gaussians: Gaussians) -> list[np.ndarray]:
    """Render the depth of the held-out views."""
    found = []
    with torch.no_grad():
        for view in case.test:
            depth = render(gaussians, view.camera, settings=SHOWN, backend="cpu").median_depth
            assert depth is not None
            found.append(depth.double().numpy())
    return found


def measure(case: Case, seeds: int, iterations: int) -> list[dict[str, Any]]:
    """Train and score each of `KINDS` with each seed."""
    rows, masks = list[dict[str, Any]](), None
    for seed in range(seeds):
        for kind in KINDS:
            gaussians, seconds = trained(case, kind, seed, iterations)
            if masks is None:
                depths = median_depths(case, gaussians) if case.depths is None else case.depths
                pairs = zip(case.test, depths, strict=True)
                masks = [mask_of(view.camera, depth, case.region) for view, depth in pairs]
            held = int(inside(case.region, gaussians.means.detach().double().numpy()).sum())
            row = {"kind": kind, "seed": seed, "seconds": round(seconds, 1), "gaussians": len(gaussians)}
            row |= {"inside": held} | scored(case, gaussians, masks)
            rows.append(row)
            print(
                f"{kind:7} seed {seed}: {row['box']:.2f} dB in the box, {row['all']:.2f} dB in all,"
                f" {row['gaussians']} Gaussians, {held} inside, {seconds:.1f} s",
                flush=True,
            )
    return rows


def main() -> int:
    """Read the command line and measure."""
    parser = hardware.parser(__doc__.partition("\n")[0])
    parser.add_argument("--capture", choices=("snowmiku97", "solids"), help="only this one")
    parser.add_argument("--quality", choices=QUALITIES, default="standard", help="default: standard")
    parser.add_argument("--seeds", type=int, default=2, help="seeds 0 to N - 1 (default: 2)")
    arguments = parser.parse_args()
    default = ("solids",) if arguments.smoke else ("snowmiku97", "solids")

    def run() -> None:
        found = {}
        for name in (arguments.capture,) if arguments.capture else default:
            small = (40, 16) if arguments.smoke else (320, 64)
            case = photographed(4.0) if name == "snowmiku97" else traced(*small)
            iterations = (
                60 if arguments.smoke else planned_iterations(arguments.quality, len(case.data.train))
            )
            print(f"{name}: {iterations} iterations")
            found[name] = measure(case, 1 if arguments.smoke else arguments.seeds, iterations)
        hardware.report({"captures": found}, arguments.out)

    return run_command("region.py", run, debug=False)


if __name__ == "__main__":
    sys.exit(main())

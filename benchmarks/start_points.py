"""How does the start affect the quality if a capture has poses but no points?

    python benchmarks/start_points.py [--seeds N] [--smoke] [--out FILE.json]

Trains a traced room whose walls lie beyond its cameras, `fox` and `snowmiku97` from four starts: random points in a
cube around the cameras' subject (the usual start in the field), random points that two training photos see,
triangulated points, and the capture's own points (for snowmiku97 those of its COLMAP model, for the room points on
its walls, for fox points of another reconstruction that are 2 to 5 px off). Mean PSNR on held-out photos, dB; one
thread.
"""

from __future__ import annotations

import dataclasses
import functools
import os
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import hardware
import numpy as np
import torch

from gsplat_edu.cli.running import run_command
from gsplat_edu.data.capture import Cloud
from gsplat_edu.data.dataset import Dataset, DataSettings, load_dataset
from gsplat_edu.data.points import random_cloud, read_points_ply
from gsplat_edu.data.visible_cloud import cloud_in_view
from gsplat_edu.data.writers import write_colmap
from gsplat_edu.evaluate.metrics import score_views, summarize
from gsplat_edu.render.api import render
from gsplat_edu.render.backends import load_backend
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.scene.rig import point_nearest_axes, scene_extent
from gsplat_edu.sfm.triangulate import triangulate
from gsplat_edu.train.compose import training
from gsplat_edu.train.config import recipe
from lab.captures.room import room_capture

DATA = Path(os.environ.get("GSPLAT_EDU_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))


def cube(dataset: Dataset) -> Cloud:
    """Return random points in a cube of the cameras' extent around the point nearest to their axes."""
    cameras = [view.camera for view in dataset.train]
    centre = point_nearest_axes(cameras)
    if centre is None:
        centre = np.mean([camera.eye for camera in cameras], axis=0)
    return random_cloud(centre, scene_extent(cameras))


def starts(dataset: Dataset, full: Dataset, own: Cloud, scratch: Path) -> dict[str, Cloud]:
    """Return the starts of a capture by name, and print how long triangulation took.

    Args:
        dataset: The capture at training size.
        full: The capture at the size of its files.
        own: The capture's own points.
        scratch: A work folder.
    """
    began = time.perf_counter()
    made = triangulate(full.train, scratch / "work")
    print(f"{dataset.path.name}: triangulated in {time.perf_counter() - began:.1f} s")
    found: dict[str, Cloud | None] = {
        "cube": cube(dataset),
        "in view": cloud_in_view([view.camera for view in dataset.train]),
    }
    found |= {"triangulated": made, "own": own}
    return {name: cloud for name, cloud in found.items() if cloud is not None}


def score(dataset: Dataset, cloud: Cloud, iterations: int, seed: int) -> float:
    """Train from some points; return the mean PSNR on held-out photos, dB."""
    config = recipe(iterations, strategy="fast", seed=seed)
    started = dataclasses.replace(dataset, points=cloud.points, colors=cloud.colors)
    trainer = training(config, started, load_backend("cpu"))
    trainer.run()
    settings = RenderSettings(config.background, jacobian_limit=config.jacobian_limit)
    shown = functools.partial(render, settings=settings, backend="cpu")
    return float(
        summarize(score_views(trainer.gaussians, dataset.test, shown, config.background))["psnr"] or 0.0
    )


def captures(
    scratch: Path, smoke: bool
) -> dict[str, tuple[Path, float | None, int, Callable[[Dataset], Cloud]]]:
    """Return path, resolution, iterations and own points of each capture, by name."""

    def stored(dataset: Dataset) -> Cloud:
        return Cloud(dataset.points, dataset.colors)

    size, count = ((64, 48), 12) if smoke else ((240, 180), 48)
    write_colmap(scratch / "room", *room_capture(*size, count))
    found = {"room": (scratch / "room", None, 20 if smoke else 1_500, stored)}
    if not smoke and DATA.is_dir():
        derived = DATA / "fox" / "points3D_aligned_derived.ply"
        found["fox"] = (DATA / "fox", 6.0, 2_000, lambda _: read_points_ply(derived))
        found["snowmiku97"] = (DATA / "snowmiku97", 4.0, 1_000, stored)
    return found


def measure(arguments: Any) -> dict[str, Any]:  # noqa: ANN401
    """Score every start of every capture."""
    torch.set_num_threads(1)
    table: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as folder:
        for name, (path, size, iterations, own) in captures(Path(folder), arguments.smoke).items():
            dataset, full = load_dataset(path, DataSettings(resolution=size)), load_dataset(path)
            row = table.setdefault(name, {"iterations": iterations})
            for start, cloud in starts(dataset, full, own(dataset), Path(folder)).items():
                row[start] = [score(dataset, cloud, iterations, seed) for seed in range(arguments.seeds)]
                print(name, start, len(cloud.points), [round(value, 2) for value in row[start]])
    return table


def main() -> int:
    """Read the command line and measure."""
    parser = hardware.parser(__doc__.partition("\n")[0])
    parser.add_argument("--seeds", type=int, default=2, help="seeds 0 to N - 1 (default: 2)")
    arguments = parser.parse_args()
    if arguments.smoke:
        arguments.seeds = 1

    def run() -> None:
        hardware.report({"captures": measure(arguments)}, arguments.out)

    return run_command("start_points.py", run, debug=False)


if __name__ == "__main__":
    sys.exit(main())

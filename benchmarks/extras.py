"""How much time do the camera's gradient, features, median depth and statistics add to an iteration?

    python benchmarks/extras.py [CAPTURE] [--scene FILE] [--smoke] [--out FILE.json]

CAPTURE is anything that `gsplat-edu train` accepts (default: snowmiku97 in $GSPLAT_EDU_DATA or ../shared/data, or else
a procedural capture). Gaussians start at its points, or come from FILE. An iteration renders at full size, computes
0.8 L1 + 0.2 (1 - SSIM) with the photo, and takes the backward pass with stored gradients. The gradient of the
features' image is given, because a loss would add its own time. In every round, each variant takes one iteration at
the same view, so a drift of the machine's speed affects all equally. The figures are medians over the rounds, of
milliseconds and of the ratio to the plain variant of the same round.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import hardware
import torch
from captures import capture

from gsplat_edu.base.buffers import reused_buffers
from gsplat_edu.data.dataset import load_dataset
from gsplat_edu.io.formats import read_scene
from gsplat_edu.ops.losses import photo_loss
from gsplat_edu.render.api import render
from gsplat_edu.render.camera_tensors import CameraTensors
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.scene.views import View
from gsplat_edu.train.config import TrainConfig
from gsplat_edu.train.initialize import from_points

WARM_UP = 2
CHANNELS = (1, 3, 7, 16, 32)


class Shot(NamedTuple):
    """A camera and its photo, (H, W, 3) uint8."""

    camera: Camera
    photo: torch.Tensor


def plain(scene: Gaussians, shot: Shot, settings: RenderSettings) -> None:
    """Take one iteration."""
    finish(render(scene, shot.camera, settings=settings, backend="cpu").image, shot)


def finish(image: torch.Tensor, shot: Shot) -> None:
    """Compare an image with the photo and pass the gradient back."""
    photo_loss(image, shot.photo).backward()


def with_camera(scene: Gaussians, shot: Shot, settings: RenderSettings) -> None:
    """Take an iteration with the gradient of pose and intrinsics."""
    camera = CameraTensors.of(shot.camera)
    for tensor in camera.tensors():
        tensor.requires_grad_()
    finish(render(scene, camera, settings=settings, backend="cpu").image, shot)


def with_features(channels: int) -> Callable[[Gaussians, Shot, RenderSettings], None]:
    """Return an iteration with features, whose image gets the same gradient in every iteration."""
    gradients: dict[torch.Size, torch.Tensor] = {}

    def iteration(scene: Gaussians, shot: Shot, settings: RenderSettings) -> None:
        features = torch.full((len(scene), channels), 0.5, requires_grad=True)
        output = render(scene, shot.camera, settings=settings, features=features, backend="cpu")
        assert output.features is not None
        size = output.features.shape
        if size not in gradients:  # first called in rounds that are not counted
            gradients[size] = torch.full(size, 1e-6)
        loss = photo_loss(output.image, shot.photo)
        torch.autograd.backward([loss, output.features], [None, gradients[size]])

    return iteration


def with_median(scene: Gaussians, shot: Shot, settings: RenderSettings) -> None:
    """Take an iteration with the median depth."""
    settings = replace(settings, median_depth=True)
    finish(render(scene, shot.camera, settings=settings, backend="cpu").image, shot)


def with_statistics(scene: Gaussians, shot: Shot, settings: RenderSettings) -> None:
    """Take an iteration that collects all statistics."""
    output = render(scene, shot.camera, settings=settings, backend="cpu")
    errors = torch.ones(shot.camera.H, shot.camera.W)
    found = output.collect("absgrad", "weight_sum", "weight_max", "pixels", "error_sum", errors=errors)
    finish(output.image, shot)
    found()


WAYS = {
    "plain": plain,
    "camera": with_camera,
    **{f"{channels} channels": with_features(channels) for channels in CHANNELS},
    "median depth": with_median,
    "statistics": with_statistics,
}


def measure(scene: Gaussians, views: Sequence[View], rounds: int) -> dict[str, dict[str, float]]:
    """Return the median milliseconds by variant, and the median ratio to the plain variant of the same round."""
    settings = RenderSettings(depth=False, jacobian_limit=TrainConfig().jacobian_limit)
    seconds: dict[str, list[float]] = {name: [] for name in WAYS}
    for k in range(rounds + WARM_UP):
        view = views[k * len(views) // (rounds + WARM_UP)]
        shot = Shot(view.camera, torch.from_numpy(view.read().image))
        for name, iteration in WAYS.items():
            gaussians = scene.trainable()
            started = time.perf_counter()
            iteration(gaussians, shot, settings)
            seconds[name].append(time.perf_counter() - started)
    kept = {name: times[WARM_UP:] for name, times in seconds.items()}
    return {
        name: {
            "ms": 1e3 * statistics.median(times),
            "ratio": statistics.median(a / b for a, b in zip(times, kept["plain"], strict=True)),
        }
        for name, times in kept.items()
    }


def main() -> None:
    """Measure and print the table."""
    parser = hardware.parser("What do extras add to an iteration?")
    parser.add_argument("capture", nargs="?", type=Path, help="the capture")
    parser.add_argument("--scene", type=Path, help="scene file (default: Gaussians at the capture's points)")
    arguments = parser.parse_args()
    with capture(arguments.capture, arguments.smoke) as folder, reused_buffers():
        dataset = load_dataset(folder)
        scene = (
            read_scene(arguments.scene).gaussians
            if arguments.scene
            else from_points(dataset.points, dataset.colors, TrainConfig())
        )
        found = measure(scene, dataset.train, 2 if arguments.smoke else 20)
        hardware.report({"capture": folder.name, "gaussians": len(scene), "ways": found}, arguments.out)
        print(f"{folder.name}, {len(scene):,} Gaussians")
        for name, figures in found.items():
            print(f"{name:14} {figures['ms']:8.2f} ms   {figures['ratio']:.3f} of plain")


if __name__ == "__main__":
    main()

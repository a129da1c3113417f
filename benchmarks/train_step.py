"""How long does each stage of a training iteration of a capture take?

    python benchmarks/train_step.py [CAPTURE] [--smoke] [--out FILE.json]

CAPTURE is anything that `gsplat-edu train` accepts (default: snowmiku97 in $GSPLAT_EDU_DATA or ../shared/data, or else
a procedural capture). Gaussians start at its points, as in the recipe. An iteration renders at full size, computes
0.8 L1 + 0.2 (1 - SSIM) with the uint8 photo, and takes the backward pass and Adam. Times are medians over 20 views,
first with stored gradients, so that every stage has its own time, then with Adam in the backward pass, as in the
trainer.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import hardware
import torch
from captures import capture

from gsplat_edu.base.buffers import reused_buffers
from gsplat_edu.data.dataset import load_dataset
from gsplat_edu.ops.losses import photo_loss
from gsplat_edu.render.api import render
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.scene.views import View
from gsplat_edu.train.config import TrainConfig
from gsplat_edu.train.initialize import from_points
from gsplat_edu.train.optimizer import Adam, ParameterGroup
from gsplat_edu.train.schedule import gaussian_groups

STAGES = ("project", "sort", "intersect", "composite", "composite_backward", "project_backward")
WARM_UP = 3


def measure(
    scene: Gaussians,
    views: Sequence[View],
    rounds: int = 20,
    fused: bool = False,
    clock: Callable[[], float] = time.perf_counter,
) -> dict[str, float]:
    """Time iterations at some of the views; return the median milliseconds of every stage, and the pairs.

    The scene is not changed. If `fused`, Adam is part of project_backward, and "Adam" is what remains outside. The
    kernels' stages are always by the wall clock; `time.process_time` suits iterations of one thread on a busy machine.
    """
    config, gaussians = TrainConfig(), scene.trainable()
    optimizer = Adam(gaussians.tensors(), gaussian_groups(config, 1.0) | {"means": ParameterGroup(0.0)})
    settings = RenderSettings(depth=False, jacobian_limit=config.jacobian_limit)
    found: dict[str, list[float]] = {
        name: [] for name in (*STAGES, "loss", "Adam", "rest", "iteration", "pairs")
    }
    for k in range(rounds + WARM_UP):
        view = views[k * len(views) // (rounds + WARM_UP)]
        photo = view.read()
        t0 = clock()
        output = render(gaussians, view.camera, settings=settings, backend="cpu")
        frame, t1 = output.image.grad_fn.frame, clock()
        in_backward = output.defer() if fused else None
        loss = photo_loss(output.image, torch.from_numpy(photo.image), photo.mask, config.ssim_weight)
        t2 = clock()
        loss.backward()
        t3 = clock()
        optimizer.step(gaussians.tensors(), in_backward)
        t4 = clock()
        adam = t4 - t3 - (sum(frame.seconds[4:]) if fused else 0.0)
        if k < WARM_UP:
            continue
        for stage, seconds in zip(STAGES, frame.seconds, strict=True):
            found[stage].append(1e3 * seconds)
        named = sum(frame.seconds) + (t2 - t1) + adam
        for stage, seconds in (
            ("loss", t2 - t1),
            ("Adam", adam),
            ("rest", t4 - t0 - named),
            ("iteration", t4 - t0),
        ):
            found[stage].append(1e3 * seconds)
        found["pairs"].append(output.num_pairs or 0)
    return {name: statistics.median(values) for name, values in found.items()}


def main() -> None:
    """Measure, print the table and write the JSON."""
    made = hardware.parser("A training iteration of a capture, stage by stage.")
    made.add_argument("capture", nargs="?", type=Path)
    arguments = made.parse_args()
    with capture(arguments.capture, arguments.smoke) as folder:
        dataset = load_dataset(folder)
        dataset.preload()
    scene = from_points(dataset.points, dataset.colors, TrainConfig())
    with reused_buffers():  # as in the trainer
        views, rounds = (*dataset.train, *dataset.test), 1 if arguments.smoke else 20
        medians, fused = (measure(scene, views, rounds, way) for way in (False, True))
    hardware.report({"capture": folder.name, "medians": medians, "fused": fused}, arguments.out)
    raster = medians["composite"] + medians["composite_backward"]
    for name, value in medians.items():
        print(
            f"{name:20} {value:12.2f}"
            + ("" if name == "pairs" else f" ms {100 * value / medians['iteration']:6.1f} %")
        )
    for name in ("project_backward", "iteration"):
        print(f"{name + ', fused':26} {fused[name]:6.2f} ms")
    print(f"outside composite and composite_backward: {100 * (1 - raster / medians['iteration']):.1f} %")


if __name__ == "__main__":
    main()

"""How much memory and time does a training step of millions of Gaussians take?

    python benchmarks/large.py [--count N] [--smoke] [--out FILE.json]

Takes two training steps (render without depth, L1 + SSIM, backward, Adam) of N random Gaussians of SH degree 3 in a
cube (default: ten million), in Morton order as in the trainer. One view, from outside the cube, sees half of them;
another, from the middle, sees a twentieth. Each view runs in a process of its own, whose peak RSS is
counted by the system. Needs Linux, where ru_maxrss is in KiB.
"""

from __future__ import annotations

import multiprocessing
import resource
import time
from typing import Any

import hardware

VIEWS = {"from outside": -6.0, "from the middle": 0.0}
"""Positions of the camera on the z axis; the cube extends from -5 to 5."""

W, H, FOCAL = 1297, 840, 1000.0


def measured(count: int, z: float) -> dict[str, Any]:
    """Take the steps; return memory in GiB and the second step's milliseconds."""
    import torch

    from gsplat_edu.base.buffers import reused_buffers
    from gsplat_edu.ops.losses import photo_loss
    from gsplat_edu.render.api import render
    from gsplat_edu.render.settings import RenderSettings
    from gsplat_edu.train.config import TrainConfig
    from gsplat_edu.train.optimizer import Adam, ParameterGroup
    from gsplat_edu.train.schedule import gaussian_groups

    config, gaussians = TrainConfig(), scene(count)
    optimizer = Adam(gaussians.tensors(), gaussian_groups(config, 1.0) | {"means": ParameterGroup(0.0)})
    before = peak()
    photo = torch.randint(0, 256, (H, W, 3), dtype=torch.uint8)
    settings, milliseconds = RenderSettings(depth=False, jacobian_limit=config.jacobian_limit), 0.0
    with reused_buffers():
        for _ in range(2):
            began = time.perf_counter()
            output = render(gaussians, camera(z), settings=settings, backend="cpu")
            visible, pairs, in_backward = len(output.visible), output.num_pairs, output.defer()
            photo_loss(output.image, photo, None, config.ssim_weight).backward()
            optimizer.step(gaussians.tensors(), in_backward)
            milliseconds = 1e3 * (time.perf_counter() - began)
            del output, in_backward
    memory = {"parameters and moments": before, "peak": peak()}
    return {"visible": visible, "pairs": pairs, "GiB": memory, "step ms": milliseconds}


def scene(count: int) -> Any:  # noqa: ANN401
    """Make the Gaussians without a second copy of their harmonics."""
    import torch

    from gsplat_edu.scene.gaussians import Gaussians
    from gsplat_edu.scene.morton import order_in_space

    generator = torch.Generator().manual_seed(0)

    def draw(*shape: int) -> torch.Tensor:
        return torch.rand((count, *shape), generator=generator)

    means = draw(3).sub_(0.5).mul_(10.0)
    return Gaussians(
        means=means[torch.from_numpy(order_in_space(means.numpy()))].requires_grad_(),
        quats=draw(4).add_(0.1).requires_grad_(),
        log_scales=draw(3).sub_(5.0).requires_grad_(),
        sh0=draw(1, 3).sub_(0.5).requires_grad_(),
        sh_rest=torch.zeros((count, 15, 3)).requires_grad_(),
        logit_opacities=draw().mul_(4.0).sub_(2.0).requires_grad_(),
    )


def camera(z: float) -> Any:  # noqa: ANN401
    """Return a camera that looks along the z axis."""
    import numpy as np

    from gsplat_edu.scene.camera import Camera

    return Camera(np.eye(3), np.array([0.0, 0.0, z]), FOCAL, FOCAL, (W - 1) / 2, (H - 1) / 2, H, W)


def peak() -> float:
    """Return the largest resident set size of this process so far, GiB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20


def main() -> None:
    """Measure both views, print the table and write the JSON."""
    made = hardware.parser(__doc__.partition("\n")[0])
    made.add_argument("--count", type=int, default=10_000_000, metavar="N")
    arguments = made.parse_args()
    count = 1_000 if arguments.smoke else arguments.count
    found = {}
    for name, z in VIEWS.items():
        with multiprocessing.get_context("spawn").Pool(1) as pool:
            found[name] = pool.apply(measured, (count, z))
    print(
        "| view | visible | pairs | parameters and moments GiB | peak GiB | second step ms |\n|---|---|---|---|---|---|"
    )
    for name, row in found.items():
        memory = [f"{value:.2f}" for value in row["GiB"].values()]
        print(
            f"| {name} | {row['visible']:,} | {row['pairs']:,} | {' | '.join(memory)} | {row['step ms']:,.0f} |"
        )
    hardware.report({"count": count, "views": found}, arguments.out)


if __name__ == "__main__":
    main()

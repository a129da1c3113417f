"""How much longer does gsplat's `rasterization` take here than `render`, and what do two processes cost each other?

    python benchmarks/compat.py [--gaussians N ...] [--rounds N] [--smoke] [--out FILE.json]

Random Gaussians with harmonics of degree 3, 400 x 300 px, forward and backward to all parameters. Both draw the same
image: `render` has gsplat's clamp of alpha, end of a pixel and clamp of the Jacobian. Alone, each takes a turn in every
round on one thread, and the figures are medians of processor time and of the ratio within a round. Together, two
processes with torch's own number of threads draw at once, and the figure is the wall time of a turn.
"""

from __future__ import annotations

import math
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from typing import Any

import hardware
import numpy as np
import torch

from gsplat_edu import Camera, Gaussians, render
from gsplat_edu.compat.gsplat import rasterization
from gsplat_edu.render.settings import RenderSettings

W, H, FOCAL, AWAY = 400, 300, 300.0, 4.0
WAYS = ("render", "rasterization")


def turns(count: int) -> dict[str, Callable[[], None]]:
    """Return a turn of each way with this number of Gaussians."""
    draw = torch.Generator().manual_seed(0)
    means, quats = torch.randn(count, 3, generator=draw), torch.randn(count, 4, generator=draw)
    log_scales = torch.log(0.005 + 0.03 * torch.rand(count, 3, generator=draw))
    logits = torch.randn(count, generator=draw)
    sh = 0.1 * torch.randn(count, 16, 3, generator=draw)
    weights = torch.randn(H, W, 3, generator=draw)
    scene = Gaussians(means, quats, log_scales, sh[:, :1], sh[:, 1:], logits).map(torch.clone).trainable()
    centre = (W / 2 - 0.5, H / 2 - 0.5)
    camera = Camera(np.eye(3), np.array([0.0, 0.0, -AWAY]), FOCAL, FOCAL, *centre, H, W)
    settings = RenderSettings(depth=False, jacobian_limit=1.3, stop="pixel", alpha_max=0.999)
    viewmats, Ks = (
        torch.eye(4)[None].clone(),
        torch.tensor([[[FOCAL, 0, W / 2], [0, FOCAL, H / 2], [0, 0, 1]]]),
    )
    viewmats[:, 2, 3] = AWAY
    inputs = [each.requires_grad_() for each in (means, quats, log_scales, logits, sh)]

    def ours() -> None:
        (render(scene, camera, settings=settings).image * weights).sum().backward()
        for tensor in scene.tensors().values():
            tensor.grad = None

    def theirs() -> None:
        shape = (inputs[0], inputs[1], inputs[2].exp(), inputs[3].sigmoid(), inputs[4])
        images, _, _ = rasterization(*shape, viewmats, Ks, W, H, sh_degree=3)
        (images[0] * weights).sum().backward()
        for tensor in inputs:
            tensor.grad = None

    return dict(zip(WAYS, (ours, theirs), strict=True))


def alone(count: int, rounds: int) -> dict[str, float]:
    """Return milliseconds of processor time on one thread, and the ratio."""
    torch.set_num_threads(1)
    found: dict[str, list[float]] = {way: [] for way in WAYS}
    made = turns(count)
    for turn in made.values():
        turn()
    for _ in range(rounds):
        for way, turn in made.items():
            began = time.process_time()
            turn()
            found[way].append(1000 * (time.process_time() - began))
    ratios = [b / a for a, b in zip(*found.values(), strict=True)]
    return {way: statistics.median(each) for way, each in found.items()} | {
        "ratio": statistics.median(ratios)
    }


def together(count: int, rounds: int) -> dict[str, float]:
    """Return milliseconds of wall time of a turn in each of two processes that draw at once."""
    found = {}
    for way in WAYS:
        command = [sys.executable, __file__, "--one", way, "--gaussians", str(count), "--rounds", str(rounds)]
        both = [subprocess.Popen(command, stdout=subprocess.PIPE, text=True) for _ in range(2)]
        found[way] = max(float(one.communicate()[0]) for one in both)
    return found


def one(way: str, count: int, rounds: int) -> None:
    """Print the mean wall time of a turn, ms."""
    turn = turns(count)[way]
    turn()
    began = time.perf_counter()
    for _ in range(rounds):
        turn()
    print(1000 * (time.perf_counter() - began) / rounds)


def main() -> None:
    """Read the command line, take all turns, and print a row for each number of Gaussians."""
    parser = hardware.parser(__doc__.partition("\n")[0])
    parser.add_argument("--gaussians", type=int, nargs="+", default=[20_000, 60_000])
    parser.add_argument("--rounds", type=int, default=20)
    parser.add_argument("--one", choices=WAYS, help="take turns of one way, for the other process")
    arguments = parser.parse_args()
    if arguments.smoke:
        arguments.gaussians, arguments.rounds = [50], 1
    if arguments.one:
        one(arguments.one, arguments.gaussians[0], arguments.rounds)
        return
    rows: list[dict[str, Any]] = []
    for count in arguments.gaussians:
        row = {"alone": alone(count, arguments.rounds), "together": together(count, arguments.rounds)}
        rows.append({"gaussians": count, **row})
        print(f"{count:8,}", *(f"{name} {each:.3g}" for part in row.values() for name, each in part.items()))
        assert all(math.isfinite(each) for part in row.values() for each in part.values())
    hardware.report({"rows": rows}, arguments.out)


if __name__ == "__main__":
    main()

"""How many splats should the dense torch renderer evaluate at once?

    python benchmarks/dense.py [--smoke] [--out FILE.json]

Renders and differentiates a cloud of the course's size (1,600 splats, 128 px, float32) with several chunk sizes
in turn. Prints the median time of each and its ratio to the chapter's chunk of 512 within the same round. Ratios are
comparable, because the machine's speed drifts between runs, but little within a round.
"""

from __future__ import annotations

import statistics
import time

import hardware
import torch

from gsplat_edu import Camera
from gsplat_edu.data.synthetic import sphere_cameras
from gsplat_edu.render.api import render
from gsplat_edu.render.torch import render as torch_reference
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.train.initialize import random_ball

CHUNKS = (512, 128, 64, 32, 16, 8, 4)
CHAPTER = 512
NUM_GAUSSIANS, SIZE, ROUNDS = 1600, 128, 7


def seconds(gaussians: Gaussians, camera: Camera, chunk: int) -> tuple[float, float]:
    """Time one forward and one backward pass."""
    start = time.perf_counter()
    torch_reference.CHUNK = chunk
    output = render(gaussians, camera, backend="torch")
    middle = time.perf_counter()
    output.image.mean().backward()
    return middle - start, time.perf_counter() - middle


def measure(count: int, size: int, num_rounds: int) -> list[dict[str, float]]:
    """Time every chunk size in every round; the first round is a warm-up and is not counted."""
    camera = sphere_cameras(size)[8]
    gaussians = random_ball(count, torch.Generator().manual_seed(0)).trainable()
    rounds = [{chunk: seconds(gaussians, camera, chunk) for chunk in CHUNKS} for _ in range(num_rounds + 1)][
        1:
    ]
    rows = []
    for chunk in CHUNKS:
        forward, backward = (statistics.median(r[chunk][i] for r in rounds) for i in (0, 1))
        ratio = statistics.median(sum(r[CHAPTER]) / sum(r[chunk]) for r in rounds)
        times = {"forward_ms": 1e3 * forward, "backward_ms": 1e3 * backward}
        rows.append({"chunk": chunk, **times, "times_faster": ratio})
    return rows


def main() -> None:
    """Measure, print the table and write the JSON."""
    arguments = hardware.parser("Dense torch renderer: time by chunk size.").parse_args()
    count, size, num_rounds = (20, 8, 1) if arguments.smoke else (NUM_GAUSSIANS, SIZE, ROUNDS)
    rows = measure(count, size, num_rounds)
    hardware.report({"rows": rows}, arguments.out)
    print(f"{count} splats, {size} px, float32, median of {num_rounds} rounds")
    print(f"{'chunk':>6} {'forward ms':>11} {'backward ms':>12} {f'vs {CHAPTER}':>8}")
    for row in rows:
        print("{chunk:6d} {forward_ms:11.1f} {backward_ms:12.1f} {times_faster:7.2f}x".format(**row))


if __name__ == "__main__":
    main()

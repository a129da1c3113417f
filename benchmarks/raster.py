"""What does a pair of Gaussian and tile cost, forward and backward?

    python benchmarks/raster.py [--out FILE.json]

200,000 and 500,000 round Gaussians of 2 px at 1024 x 1024, float32, every instruction set of the machine, one and
two threads. Times are medians of 7 rounds. A pair is one Gaussian in one 16 x 16 tile that its ellipse alpha >=
1/255 meets. The unit beside the nanoseconds is one vector FMA of the native width, measured in the same run on one
thread: machines drift, and that drifts with them.
"""

from __future__ import annotations

import statistics
from typing import NamedTuple

import hardware
import numpy as np
import torch

from gsplat_edu import Camera, _native

SIZE, FOCAL, SIGMA, ROUNDS = 1024, 1000.0, 2.0, 7
STAGES = ("project", "sort", "intersect", "composite", "composite_backward", "project_backward")


def scene(count: int) -> list[torch.Tensor]:
    """Scatter round Gaussians over the image at random depths: means, covariances, colours, opacities."""
    rng = np.random.default_rng(0)
    z, u, v = rng.uniform(2, 10, count), rng.uniform(0, SIZE, count), rng.uniform(0, SIZE, count)
    means = np.stack([(u - SIZE / 2) / FOCAL * z, (v - SIZE / 2) / FOCAL * z, z], axis=1)
    covs = np.eye(3) * ((SIGMA * z / FOCAL) ** 2)[:, None, None]
    arrays = means, covs, rng.uniform(0, 1, (count, 3)), rng.uniform(0.1, 0.99, count)
    return [torch.tensor(array, dtype=torch.float32) for array in arrays]


class Room(NamedTuple):
    """Where results go, made once: the system's handing out of pages is not the raster's cost."""

    image: torch.Tensor
    transmittance: torch.Tensor
    gradient: torch.Tensor
    out: list[torch.Tensor]
    norms: torch.Tensor
    background: torch.Tensor


def room(parameters: list[torch.Tensor]) -> Room:
    """Make room for the results of a scene."""
    gradient = torch.randn(SIZE, SIZE, 3, generator=torch.Generator().manual_seed(0))
    norms, out = torch.zeros(len(parameters[0])), [torch.zeros_like(p) for p in parameters]
    return Room(torch.zeros(SIZE, SIZE, 3), torch.zeros(SIZE, SIZE), gradient, out, norms, torch.zeros(3))


def frame_seconds(parameters: list[torch.Tensor], to: Room, threads: int) -> tuple[tuple[float, ...], int]:
    """Render once and go back once; return the seconds of each stage and the number of pairs."""
    camera = Camera(np.eye(3), (0, 0, 0), FOCAL, FOCAL, SIZE / 2, SIZE / 2, SIZE, SIZE)
    means, covs, colors, opacities = (p.data_ptr() for p in parameters)
    view = [*camera.R.ravel(), *camera.eye, camera.fx, camera.fy, camera.cx, camera.cy, 0.05, 0, 0, 0]
    addresses = [means, 0, 0, 0, 0, 0, covs, colors, opacities]
    frame = _native.FrameF32(len(parameters[0]), 0, addresses, view, SIZE, SIZE, 0, False, threads)
    forward = [to.image.data_ptr(), to.transmittance.data_ptr(), 0]
    frame.composite(*forward)
    outgoing = [to.out[0].data_ptr(), 0, 0, 0, 0, 0, *(o.data_ptr() for o in to.out[1:]), to.norms.data_ptr()]
    incoming = [to.gradient.data_ptr(), 0, 0]
    frame.backward(len(to.norms), 0, addresses, forward, incoming, outgoing, to.background.data_ptr())
    return frame.seconds, frame.num_pairs


def measure(count: int, isa: str, threads: int) -> dict[str, float | str]:
    """Measure one line of the table."""
    _native.choose_isa(isa)
    parameters = scene(count)
    to = room(parameters)
    frame_seconds(parameters, to, threads)
    rounds = [frame_seconds(parameters, to, threads) for _ in range(ROUNDS)]
    rate = statistics.median(_native.fma_rate() for _ in range(3))
    pairs = rounds[0][1]
    row: dict[str, float | str] = {
        "gaussians": count,
        "isa": isa,
        "threads": threads,
        "pairs": pairs,
        "fma_per_s": rate,
    }
    for stage, times in zip(STAGES, zip(*(r[0] for r in rounds), strict=True), strict=True):
        row[f"{stage}_ms"] = 1e3 * statistics.median(times)
    for name, stage in (("forward", "composite"), ("backward", "composite_backward")):
        seconds = float(row[f"{stage}_ms"]) / 1e3 / pairs
        row[f"{name}_ns"], row[f"{name}_fma"] = 1e9 * seconds, seconds * rate
    return row


def main() -> None:
    """Measure, print the table, write the JSON."""
    arguments = hardware.parser("Raster: cost of a pair, per instruction set.").parse_args()
    before = _native.isa()
    lines = [(200_000, isa, t) for isa in _native.isas() for t in (1, 2)]
    rows = [measure(*line) for line in [*lines, (500_000, before, 1), (500_000, before, 2)]]
    _native.choose_isa(before)
    hardware.report({"rows": rows}, arguments.out)
    columns = (
        ("Gaussians", 9),
        ("isa", 8),
        ("thr", 3),
        ("pairs", 9),
        ("fwd ns", 7),
        ("fwd FMA", 8),
        ("bwd ns", 7),
    )
    head = " ".join(f"{name:>{width}}" for name, width in (*columns, ("bwd FMA", 8)))
    print(head + "  ms: " + " ".join(STAGES))
    for row in rows:
        print(
            "{gaussians:9d} {isa:>8} {threads:3d} {pairs:9d} {forward_ns:7.1f} {forward_fma:8.0f}"
            " {backward_ns:7.1f} {backward_fma:8.0f}  ".format(**row)
            + " ".join(f"{row[f'{stage}_ms']:.2f}" for stage in STAGES)
        )


if __name__ == "__main__":
    main()

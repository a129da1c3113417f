"""How much time does a pair of Gaussian and tile take, forward and backward?

    python benchmarks/raster.py [--smoke] [--out FILE.json]

200,000 and 500,000 round Gaussians of 2 px at 1024 x 1024, float32, every instruction set of the machine, one and
two threads. Times are medians of 7 rounds. A pair is one Gaussian in one 16 x 16 tile that its ellipse alpha >= 1/255
meets. Times are also given in vector FMAs of the native width, measured in the same run on one thread, because both
drift with the machine's speed.
"""

from __future__ import annotations

import math
import statistics
from typing import NamedTuple

import hardware
import numpy as np
import torch

from gsplat_edu import _native
from gsplat_edu.base.constants import ALPHA_MAX, DILATION, Z_NEAR

SIZE, FOCAL, SIGMA, ROUNDS = 1024, 1000.0, 2.0, 7
STAGES = ("project", "sort", "intersect", "composite", "composite_backward", "project_backward")


def round_gaussians(count: int, size: int) -> dict[str, torch.Tensor]:
    """Scatter round Gaussians over the image at random depths."""
    rng = np.random.default_rng(0)
    z, u, v = rng.uniform(2, 10, count), rng.uniform(0, size, count), rng.uniform(0, size, count)
    means = np.stack([(u - size / 2) / FOCAL * z, (v - size / 2) / FOCAL * z, z], axis=1)
    covs = np.eye(3) * ((SIGMA * z / FOCAL) ** 2)[:, None, None]
    arrays = {
        "means": means,
        "cov3ds": covs,
        "colors": rng.uniform(0, 1, (count, 3)),
        "opacities": rng.uniform(0.1, 0.99, count),
    }
    parameters = {name: torch.tensor(array, dtype=torch.float32) for name, array in arrays.items()}
    # the kernels take covariances in double precision only
    return parameters | {"cov3ds": torch.tensor(arrays["cov3ds"])}


class Room(NamedTuple):
    """Output buffers, allocated once, so that page allocation by the system is not timed."""

    images: _native.Images
    incoming: _native.Images
    gradients: _native.Gradients


def room(parameters: dict[str, torch.Tensor], size: int) -> Room:
    """Allocate the output buffers for a scene."""
    gradient = torch.randn(size, size, 3, generator=torch.Generator().manual_seed(0))
    out = {name: torch.zeros_like(tensor) for name, tensor in parameters.items()}
    norms = torch.zeros(len(parameters["means"]))
    image, transmittance = torch.zeros(size, size, 3), torch.zeros(size, size)
    return Room(
        _native.Images(image=image, transmittance=transmittance, depth=None, features=None, median=None),
        _native.Images(image=gradient, transmittance=None, depth=None, features=None, median=None),
        _native.Gradients(**out, means2d_norm=norms, background=torch.zeros(3), camera=None, features=None),
    )


def frame_seconds(
    parameters: dict[str, torch.Tensor], to: Room, size: int, threads: int
) -> tuple[tuple[float, ...], int]:
    """Run one forward and one backward pass; return the seconds of each stage and the number of pairs."""
    scene = _native.Scene(**parameters)
    unlimited = (-math.inf, math.inf)
    frame = _native.FrameF32(
        scene=scene,
        camera=_native.Camera(
            R=np.eye(3),
            eye=np.zeros(3),
            fx=FOCAL,
            fy=FOCAL,
            cx=size / 2,
            cy=size / 2,
            x_bounds=unlimited,
            y_bounds=unlimited,
            H=size,
            W=size,
        ),
        settings=_native.Settings(
            z_near=Z_NEAR,
            background=[0.0] * 3,
            sh_degree=0,
            antialiased=False,
            dilation=DILATION,
            alpha_max=ALPHA_MAX,
            pixel_stop=False,
        ),
        needed=None,
        threads=threads,
    )
    frame.composite(images=to.images, features=None)
    frame.backward(
        scene=scene,
        images=to.images,
        incoming=to.incoming,
        gradients=to.gradients,
        features=None,
        collected=None,
    )
    return frame.seconds, frame.num_pairs


def measure(count: int, isa: str, threads: int, size: int, num_rounds: int) -> dict[str, float | str]:
    """Measure one row of the table."""
    _native.choose_isa(isa)
    parameters = round_gaussians(count, size)
    to = room(parameters, size)
    frame_seconds(parameters, to, size, threads)
    rounds = [frame_seconds(parameters, to, size, threads) for _ in range(num_rounds)]
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
    """Measure, print the table and write the JSON."""
    arguments = hardware.parser("Raster: cost of a pair, per instruction set.").parse_args()
    before = _native.isa()
    size, num_rounds, few, many = (64, 1, 200, 500) if arguments.smoke else (SIZE, ROUNDS, 200_000, 500_000)
    lines = [(few, isa, threads) for isa in _native.isas() for threads in (1, 2)]
    lines += [(many, before, threads) for threads in (1, 2)]
    rows = [measure(*line, size, num_rounds) for line in lines]
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

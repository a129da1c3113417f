"""What does a scene show outside of what photos with alpha cut out?

    python benchmarks/alpha.py [--size N] [--views N] [--iterations N] [--out FILE]

Trains the traced object by fast, adc and mcmc, over white alone and over changing colours. Half of the start points lie
on the object, the other half around it: white, or in any colour. "phantom" is the opaque area outside of the cut-outs
of held-out views as a fraction of the cut-outs' own, "two" the PSNR over black and white, "white" that over white.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence

import hardware
import numpy as np
import torch
from jaxtyping import Float64

from gsplat_edu import load_backend, recipe, training
from gsplat_edu.base.buffers import reused_buffers
from gsplat_edu.cli.arguments import run_command
from gsplat_edu.evaluate.metrics import photo_psnr, psnr
from gsplat_edu.render.api import render
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.scene.views import View
from gsplat_edu.train.compose import Views
from lab.captures.traced import traced_capture

WHITE = (1.0, 1.0, 1.0)

POINTS = 1_500
"""Start points on the object, and around it."""


def start_points(
    views: Sequence[View], white: bool
) -> tuple[Float64[np.ndarray, "N 3"], Float64[np.ndarray, "N 3"]]:
    """Return points within the hull of the cut-outs, in mean colours, and points beside it."""
    rng = np.random.default_rng(0)
    places = rng.uniform(-2.0, 2.0, (40 * POINTS, 3))
    inside, seen = np.ones(len(places), dtype=bool), np.zeros_like(places)
    for view in views:
        x, y, z = ((places - view.camera.eye) @ view.camera.R.T).T
        u = np.clip(np.round(view.camera.fx * x / z + view.camera.cx), 0, view.camera.W - 1).astype(int)
        v = np.clip(np.round(view.camera.fy * y / z + view.camera.cy), 0, view.camera.H - 1).astype(int)
        photo = view.read()
        assert photo.alpha is not None
        inside &= photo.alpha[v, u] > 0
        seen += photo.image[v, u] / 255.0
    on, around = places[inside][:POINTS], places[~inside][:POINTS]
    beside = np.ones_like(around) if white else rng.uniform(0.0, 1.0, around.shape)
    return np.concatenate([on, around]), np.concatenate([seen[inside][:POINTS] / len(views), beside])


def scores(gaussians: Gaussians, views: Sequence[View]) -> dict[str, float]:
    """Score a scene on held-out views."""
    outside = inside = 0
    two, one = [], []
    for view in views:
        photo = view.read()
        with torch.no_grad():
            output = render(gaussians, view.camera, settings=RenderSettings(background=WHITE))
        assert photo.alpha is not None
        solid = (output.transmittance < 0.5).numpy()
        outside += int((solid & (photo.alpha == 0)).sum())
        inside += int((photo.alpha > 127).sum())
        two.append(photo_psnr(photo, output, WHITE))
        one.append(psnr(output.image, photo.over(WHITE)))
    return {"phantom": outside / inside, "two": float(np.mean(two)), "white": float(np.mean(one))}


def measure(arguments: argparse.Namespace) -> None:
    """Train and print a line for each training."""
    size, count, iterations = arguments.size, arguments.views, arguments.iterations
    if arguments.smoke:
        size, count, iterations = 32, 16, 10
    train, test = traced_capture(size, count)
    results = []
    for white in (True, False):
        points, colors = start_points(train, white)
        data = Views(train, points, colors)
        for strategy in ("fast", "adc", "mcmc"):
            for behind in ("fixed", "random"):
                cap = {"max_gaussians": 3 * len(points)} if strategy == "mcmc" else {}
                config = recipe(
                    iterations, strategy=strategy, background=WHITE, alpha_background=behind, **cap
                )
                before = time.process_time()
                trainer = training(config, data, load_backend("cpu"))
                with reused_buffers():
                    trainer.run()
                row = {"white points": white, "recipe": strategy, "behind": behind}
                row |= scores(trainer.gaussians, test) | {"processor s": time.process_time() - before}
                results.append(row)
                print(
                    ", ".join(f"{k} {v:.4g}" if isinstance(v, float) else f"{k} {v}" for k, v in row.items())
                )
    hardware.report({"size": size, "views": count, "iterations": iterations, "runs": results}, arguments.out)


def main() -> int:
    """Read the command line and measure."""
    parser = hardware.parser(__doc__.partition("\n")[0])
    parser.add_argument("--size", type=int, default=96, help="width of the photos, px (default: 96)")
    parser.add_argument("--views", type=int, default=48, help="number of photos (default: 48)")
    parser.add_argument("--iterations", type=int, default=1_000, help="length of each run (default: 1000)")
    arguments = parser.parse_args()
    return run_command("alpha.py", lambda: measure(arguments), debug=False)


if __name__ == "__main__":
    sys.exit(main())

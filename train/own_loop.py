"""A training loop of one's own: our renders and losses, torch's Adam, and density control in a function.

    python train/own_loop.py --data captures/plush --iters 2000 --out out/own.png

Without `--data`, it trains on a procedural capture. It prints the PSNR of the held-out photos before and after, and
writes the first of them beside its render. Change what you like: the loop is `train`.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from gsplat_edu import Gaussians, load_dataset, recipe, render
from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.files import check_writable
from gsplat_edu.base.validation import whole_number
from gsplat_edu.cli.running import run_command
from gsplat_edu.data.dataset import Dataset
from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.data.writers import write_colmap
from gsplat_edu.evaluate.images import save_png, side_by_side
from gsplat_edu.evaluate.metrics import psnr
from gsplat_edu.ops.losses import photo_loss
from gsplat_edu.options.parser import OneLineParser
from gsplat_edu.options.values import whole_number_text
from gsplat_edu.scene.rig import scene_extent
from gsplat_edu.train.density.surgery import long_axis_children, replace
from gsplat_edu.train.initialize import from_points

RATES = {"means": 2e-3, "quats": 2e-3, "log_scales": 1e-2, "sh0": 1e-2, "logit_opacities": 5e-2}
"""Learning rates; that of the means is multiplied by the size of the scene."""

REFINE_EVERY = 50
"""Steps between two calls of `refined`."""

SPLIT_SHARE, FAINT = 0.1, 0.01
"""Fraction of the Gaussians that are split, and the opacity below which they are removed."""


class Result(NamedTuple):
    """The trained Gaussians, and the mean PSNR of the held-out photos before and after, dB."""

    gaussians: Gaussians
    start: float
    end: float


def train(dataset: Dataset, iterations: int, seed: int = 0) -> Result:
    """Train on a capture's photos, in an order that depends on the seed."""
    views = dataset.torch("train")
    generator = torch.Generator().manual_seed(seed)
    scene = from_points(dataset.points, dataset.colors, recipe(iterations, sh_degree=0)).trainable()
    start = held_out_psnr(scene, dataset)
    extent = scene_extent([view.camera for view in dataset.train])
    rates = RATES | {"means": extent * RATES["means"]}
    optimizer = torch.optim.Adam(scene.parameter_groups(rates), eps=1e-15)
    norms = torch.zeros(len(scene))
    for step in range(iterations):
        view = views[int(torch.randint(len(views), (), generator=generator))]
        output = render(scene, view.camera)
        loss = photo_loss(output.image, view.image, view.mask)
        optimizer.zero_grad()
        loss.backward()
        norms[output.visible] += output.means2d_grad_norms()
        optimizer.step()
        if (step + 1) % REFINE_EVERY == 0 and step < 0.7 * iterations:
            scene = refined(scene, optimizer, norms)
            norms = torch.zeros(len(scene))
        if step % 100 == 0:
            print(f"step {step:5d}  loss {loss.item():.4f}  {len(scene)} Gaussians", flush=True)
    return Result(scene, start, held_out_psnr(scene, dataset))


def refined(scene: Gaussians, optimizer: torch.optim.Optimizer, norms: torch.Tensor) -> Gaussians:
    """Split the Gaussians whose image gradients are largest, and remove faint ones; Adam's moments follow."""
    split = torch.zeros(len(scene), dtype=torch.bool)
    split[norms.topk(round(SPLIT_SHARE * len(scene))).indices] = True
    keep = (scene.opacities > FAINT) & ~split
    return replace(scene, optimizer, keep, long_axis_children(scene[split]))


@torch.no_grad()
def held_out_psnr(scene: Gaussians, dataset: Dataset) -> float:
    """Return the mean PSNR of the photos that training does not use, dB."""
    views = dataset.torch("test")
    return float(np.mean([psnr(render(scene, each.camera).image, each.image, each.mask) for each in views]))


def run(data: Path | None, iters: int, seed: int, out: Path) -> None:
    """Train, print the PSNRs and write the picture."""
    whole_number("--iters", iters, 1)
    whole_number("--seed", seed, 0)
    if out.suffix.lower() != ".png":
        raise ArgumentError(f"--out: {str(out)!r} must end in .png")
    check_writable("--out", out)
    with tempfile.TemporaryDirectory() as folder:
        if data is None:
            write_colmap(Path(folder), *procedural_capture(size=64, count=16))
        dataset = load_dataset(data or folder)
        result = train(dataset, iters, seed)
        view = dataset.torch("test")[0]
    print(f"held-out PSNR: start {result.start:.2f} -> end {result.end:.2f} dB")
    save_png(out, side_by_side([view.image, render(result.gaussians, view.camera).image]))


def build_parser() -> OneLineParser:
    """Build the parser of the command line."""
    parser = OneLineParser(
        prog="own_loop.py",
        description="Train on a capture by a loop that is written out, with torch's Adam.",
        epilog="example: python train/own_loop.py --data captures/plush --iters 2000 --out out/own.png",
    )
    parser.add_argument(
        "--data", type=Path, metavar="CAPTURE", help="capture to train on (default: a procedural one)"
    )
    for flag, default, text in (("--iters", 400, "iterations"), ("--seed", 0, "seed of the photos' order")):
        number = f"{text} (default: {default})"
        parser.add_argument(flag, type=whole_number_text, metavar="N", default=default, help=number)
    parser.add_argument(
        "--out",
        type=Path,
        metavar="X.png",
        default=Path("out/own.png"),
        help="picture to write, a held-out photo beside its render (default: %(default)s)",
    )
    parser.add_argument("--debug", action="store_true", help="print the traceback of an error")
    return parser


def main(given: list[str] | None = None) -> int:
    """Read the command line and train.

    Args:
        given: The arguments; those of the process if None.
    """
    options = vars(build_parser().parse_args(given))
    debug = options.pop("debug")
    return run_command("own_loop.py", lambda: run(**options), debug)


if __name__ == "__main__":
    sys.exit(main())

"""How much does a sky of far splats improve, and does `--sky auto` harm a capture without a sky?

    python benchmarks/sky.py [CAPTURE] [--strategy NAME] [--iterations N] [--resolution R] [--radius R] [--out FILE]

Without CAPTURE, traces 64 photos of boxes on the ground under a sky with clouds, from a ring of cameras with exact
poses, and trains them without a sky and with one. Every eighth photo is held out. Further views from outside the ring
are compared with traced ones. Scores are means of PSNRs: over whole images, and over the pixels of the sky. "in
front" is the fraction of these pixels' weight that belongs to splats of the scene. With CAPTURE, trains it without
and with a sky, and prints the choice of auto.
"""

from __future__ import annotations

import argparse
import math
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import hardware
import numpy as np
import torch
from jaxtyping import Bool

from gsplat_edu.base.constants import C0, SH_OFFSET
from gsplat_edu.budget.plan import Limits, plan
from gsplat_edu.cli.running import run_command
from gsplat_edu.data.reader import CaptureReader
from gsplat_edu.data.settings import DataSettings
from gsplat_edu.data.writers import write_colmap
from gsplat_edu.doctor.remedies import remedies_for
from gsplat_edu.evaluate.metrics import psnr
from gsplat_edu.options import train as command
from gsplat_edu.options.parser import OneLineParser
from gsplat_edu.parts.sky import start as skies
from gsplat_edu.runs.training import CaptureRun
from gsplat_edu.scene.camera import Camera, look_at
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.scene.shells import far_shell
from gsplat_edu.scene.views import View
from gsplat_edu.survey.capture import Undecided
from lab.captures.outdoors import outdoor_capture, photograph

Judges = Sequence[tuple[View, Bool[np.ndarray, "_ _"]]]
"""Views, and their pixels of sky."""

OUTSIDE, RADIUS, HEIGHTS = 12, 6.5, (1.0, 2.2, 3.0)
"""Cameras outside the ring, whose radius is 3.4 to 4.6: number, distance from the centre, and heights, taken in turn.
"""


def outside(width: int, height: int) -> list[tuple[View, Bool[np.ndarray, "H W"]]]:
    """Photograph the boxes from outside the ring."""
    found = []
    for i in range(OUTSIDE):
        turn = 2 * math.pi * (i + 0.5) / OUTSIDE
        eye = np.array([RADIUS * math.cos(turn), -HEIGHTS[i % len(HEIGHTS)], RADIUS * math.sin(turn)])
        middle = (width - 1) / 2, (height - 1) / 2
        camera = Camera(look_at(eye, (0.0, -1.2, 0.0)), eye, 0.8 * width, 0.8 * width, *middle, height, width)
        image, sky = photograph(camera)
        found.append((View(camera, image, name=f"outside_{i:02d}.png"), sky))
    return found


def trained(folder: Path, sky: str, arguments: argparse.Namespace) -> tuple[CaptureRun, float]:
    """Train a capture; return the run and its processor time, s."""
    words = ["--iterations", str(arguments.iterations), "--eval-every", "0", "--save-every", "0"]
    words += ["--strategy", arguments.strategy, "--appearance", "none", "--sky", sky]
    if arguments.strategy == "mcmc":
        words += ["--max-gaussians", "30000"]
    if arguments.resolution is not None:
        words += ["--resolution", str(arguments.resolution)]
    parser = OneLineParser(prog="sky.py")
    command.add_arguments(parser)
    with tempfile.TemporaryDirectory() as scratch:
        out = str(Path(scratch) / "run")
        options = command.options_from(parser.parse_args([str(folder), *words, "--out", out]))
        before = time.process_time()
        run = CaptureRun(plan(options, Limits()).options)
        run.train()
        return run, time.process_time() - before


def scores(run: CaptureRun, views: Judges) -> dict[str, float]:
    """Score a run on views whose sky is known."""
    gaussians, shown = run.trainer.gaussians, run.options.renderer
    marked = sky_marked(gaussians)
    found = []
    with torch.no_grad():
        for view, sky in views:
            photo = view.read().image
            image = shown(gaussians, view.camera).image
            sky_share = shown(marked, view.camera).image[torch.from_numpy(sky)].mean()
            found.append((psnr(image, photo), psnr(image, photo, sky), 1 - float(sky_share)))
    return dict(zip(("PSNR", "PSNR of the sky", "in front"), np.mean(found, axis=0).tolist(), strict=True))


def sky_marked(gaussians: Gaussians) -> Gaussians:
    """Return the Gaussians with those of the sky in white and all others in black."""
    far = torch.from_numpy(far_shell(gaussians.means.numpy(force=True)))
    color = torch.where(far, (1 - SH_OFFSET) / C0, -SH_OFFSET / C0)
    tensors = {name: tensor.detach() for name, tensor in gaussians.tensors().items()}
    tensors["sh0"] = color.to(tensors["sh0"])[:, None, None].repeat(1, 1, 3)
    tensors["sh_rest"] = tensors["sh_rest"][:, :0]
    return Gaussians(**tensors)


def compare(
    folder: Path, arguments: argparse.Namespace, groups: dict[str, Judges], skies_of: tuple[str, ...]
) -> dict[str, Any]:
    """Train with each value of `--sky` and score all groups of views."""
    found: dict[str, Any] = {}
    for sky in skies_of:
        run, seconds = trained(folder, sky, arguments)
        of_run = {name: scores(run, views) for name, views in groups.items()}
        if not groups:
            test = [psnr_of(run, view) for view in run.dataset.test]
            of_run["held out"] = {"PSNR": float(np.mean(test))}
        far = int(far_shell(run.trainer.gaussians.means.numpy(force=True)).sum())
        of_run["run"] = {"splats": len(run.trainer.gaussians), "of the sky": far, "processor s": seconds}
        found[sky] = of_run
        for name, figures in of_run.items():
            print(
                f"--sky {sky}, {name}: " + ", ".join(f"{key} {value:.4g}" for key, value in figures.items())
            )
    return found


def psnr_of(run: CaptureRun, view: View) -> float:
    """Return the PSNR of a held-out view, dB."""
    photo = view.read()
    with torch.no_grad():
        image = run.options.renderer(run.trainer.gaussians, view.camera).image
    return psnr(image, photo.over(run.options.config.background), photo.mask)


def measure(arguments: argparse.Namespace) -> None:
    """Read or make the capture, compare, and report."""
    if arguments.radius is not None:
        skies.RADIUS = arguments.radius
    with tempfile.TemporaryDirectory() as scratch:
        folder, groups = arguments.capture, dict[str, Judges]()
        if folder is None:
            width, height, count = (48, 36, 16) if arguments.smoke else (320, 240, 64)
            made = outdoor_capture(width, height, count, points=400 if arguments.smoke else 6_000)
            folder = Path(scratch) / "outdoors"
            write_colmap(folder, made.views, made.points, made.colors)
            every = list(zip(made.views, made.sky, strict=True))
            groups = {"held out": every[::8], "outside": outside(width, height)}
        remedy = remedies_for(Undecided(CaptureReader(folder), DataSettings()), ["sky"])["sky"]
        print(f"--sky auto: {remedy.value}{remedy.reason and ': '}{remedy.reason}")
        asked = ("none", "shell") if arguments.capture is None else ("none", remedy.value)
        result = compare(folder, arguments, groups, tuple(dict.fromkeys(asked)))
    hardware.report({"auto": remedy.value, "runs": result}, arguments.out)


def main() -> int:
    """Read the command line and measure."""
    parser = hardware.parser(__doc__.partition("\n")[0])
    parser.add_argument(
        "capture", nargs="?", type=Path, help="folder of a capture; traced photos if left out"
    )
    parser.add_argument("--strategy", default="fast", help="recipe of the training (default: fast)")
    parser.add_argument("--iterations", type=int, default=3_000, help="length of each run (default: 3000)")
    parser.add_argument("--resolution", type=float, help="divisor of the photos' size, as in train")
    parser.add_argument("--radius", type=float, help="radius of the shell, in sizes of the scene")
    arguments = parser.parse_args()
    if arguments.smoke:
        arguments.iterations = 20
    return run_command("sky.py", lambda: measure(arguments), debug=False)


if __name__ == "__main__":
    sys.exit(main())

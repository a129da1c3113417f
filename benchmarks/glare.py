"""How well does a training show the glare of a flat, glossy plate in held-out photos?

    python benchmarks/glare.py [--recipes NAME ...] [--shininess E] [--count N] [--size PX] [--iterations N]
        [--seeds N] [--out FILE]

Traces RGBA photos of blocks on a plate with Phong's highlight of one light (exponent E), and trains them by several
recipes. Training cameras lie on the upper hemisphere, test cameras on a ring that crosses the glare. A test photo has
glare if the highlight adds 0.1 or more to 5 % of the object's pixels. Scores are means of PSNRs over white.

Before the trainings it prints the limits of the harmonics, which hold for any recipe: the colours of points of the
plate in the training photos are fitted by least squares for each degree, and compared with those in the test photos
with glare. "all directions" fits 2,000 directions of the hemisphere instead, whose error is what the degree cannot
represent.
"""

from __future__ import annotations

import argparse
import math
import sys
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path

import hardware
import numpy as np
import torch
from jaxtyping import Bool, Float64

from gsplat_edu.base.constants import SH_MAX_DEGREE
from gsplat_edu.base.validation import whole_number
from gsplat_edu.budget.plan import Limits, plan
from gsplat_edu.cli.arguments import OneLineParser, run_command
from gsplat_edu.cli.options import train as command
from gsplat_edu.data.writers import write_blender
from gsplat_edu.evaluate.metrics import psnr
from gsplat_edu.runs.training import CaptureRun
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.sh import sh_basis
from gsplat_edu.scene.views import View
from lab.captures.traced import LIGHT, Scene, Shape, camera_at, checks, photographed, placed

PLATE, GREY = 0.6, (0.22, 0.3, 0.24)
"""Strength of the plate's highlight and its darker colour; the brighter one is a tenth brighter."""

TESTS = 24
"""Number of test cameras."""

GLARE, SHARE = 0.1, 0.05
"""Least brightness that the highlight adds to a pixel with glare, and least fraction of these pixels in a photo with
glare."""

RIDGE = 1e-3
"""Weight on the squares of the higher harmonics, per sample, in the fit of colours."""

SHAPES = (
    Shape(*placed((0, 0.45, 0), (1.2, 0.08, 1.2), 0.3), True, checks(6, GREY, (0.25, 0.34, 0.27)), PLATE),
    Shape(
        *placed((0.1, 0.12, -0.1), (0.25, 0.25, 0.2), 0.5),
        True,
        checks(9, (0.8, 0.6, 0.1), (0.9, 0.75, 0.3)),
        0.0,
    ),
    Shape(
        *placed((-0.55, 0.27, 0.4), (0.2, 0.1, 0.3), 1.0),
        True,
        checks(11, (0.6, 0.1, 0.1), (0.8, 0.3, 0.3)),
        0.0,
    ),
    Shape(
        *placed((0.6, 0.22, 0.55), (0.15, 0.15, 0.15), 0.2),
        True,
        checks(13, (0.2, 0.2, 0.5), (0.4, 0.5, 0.8)),
        0.0,
    ),
)

RECIPES = {
    "fast": (),
    "rest-1/20": ("--set", "sh_rest_rate=2.5e-4"),
    "rest-1/10": ("--set", "sh_rest_rate=5e-4"),
    "rest-1/4": ("--set", "sh_rest_rate=1.25e-3"),
    "rest-1/2": ("--set", "sh_rest_rate=2.5e-3"),
    "degrees-early": ("--set", "sh_every={third}"),
    "degrees-at-once": ("--set", "sh_every=0"),
    "degree-0": ("--sh-degree", "0"),
    "degree-1": ("--sh-degree", "1"),
    "degree-2": ("--sh-degree", "2"),
    "no-opacity-term": ("--set", "fast_opacity_weight=0"),
    "full-size": ("--set", "fast_start_factor=1"),
    "adc": ("--strategy", "adc"),
    "mcmc": ("--strategy", "mcmc", "--max-gaussians", "20000"),
}
"""Options of `gsplat-edu train` by the name of the recipe. {third}: a third of the recipe's `sh_every`; "rest":
the rate of the higher harmonics over that of degree 0, which is 1/8 in the recipe fast."""


@dataclass(frozen=True)
class Judge:
    """A test photo.

    Args:
        view: The photo.
        glare: (H, W) whether the highlight brightens a pixel by `GLARE` or more.
    """

    view: View
    glare: Bool[np.ndarray, "H W"]

    @property
    def has_glare(self) -> bool:
        """Whether the photo has glare."""
        alpha = self.view.read().alpha
        assert alpha is not None, "traced photos have alpha"
        return bool(self.glare.sum() >= SHARE * (alpha > 0).sum())


def train_camera(index: int, count: int, size: int) -> Camera:
    """Return a camera of a spiral that covers the upper hemisphere evenly."""
    return camera_at(0.98 - 0.96 * index / max(count - 1, 1), index * math.pi * (3 - math.sqrt(5)), size)


def test_camera(index: int, size: int) -> Camera:
    """Return a camera of a ring whose height oscillates around the one at which the plate mirrors the light."""
    turn = 2 * math.pi * index / TESTS
    return camera_at(-float(LIGHT[1, 0]) + 0.1 * math.sin(2 * turn), turn, size)


def capture(arguments: argparse.Namespace) -> tuple[list[View], list[Judge]]:
    """Trace training and test photos."""
    size, count = arguments.size, arguments.count
    scene = Scene(SHAPES, arguments.shininess)
    dull = Scene(tuple(replace(shape, gloss=0.0) for shape in SHAPES), arguments.shininess)
    train = [photographed(scene, f"r_{i:03d}.png", train_camera(i, count, size)) for i in range(count)]
    judges = []
    for i in range(TESTS):
        view = photographed(scene, f"r_{i:03d}.png", test_camera(i, size))
        without = photographed(dull, view.name, view.camera)
        shades = [photo.read().image.astype(float).mean(axis=2) for photo in (view, without)]
        judges.append(Judge(view, shades[0] - shades[1] >= 255 * GLARE))
    return train, judges


def plate_points() -> Float64[np.ndarray, "N 3"]:
    """Return points on the upper side of the plate."""
    plate = SHAPES[0]
    across = np.linspace(-0.95, 0.95, 24)
    grid = np.stack(np.meshgrid(across, [-1.0], across), axis=-1).reshape(-1, 3)
    return np.asarray(plate.center + grid @ np.linalg.inv(plate.axes).T)


def highlight(directions: Float64[np.ndarray, "*n 3"], shininess: float) -> Float64[np.ndarray, "*n"]:
    """Return Phong's highlight of the plate, seen along unit directions away from the camera."""
    mirrored = LIGHT[:, 0] * np.array([-1.0, 1.0, -1.0])
    return np.asarray(PLATE * np.maximum(-(directions @ mirrored), 0) ** shininess)


def towards(
    points: Float64[np.ndarray, "N 3"], eyes: Float64[np.ndarray, "V 3"]
) -> Float64[np.ndarray, "N V 3"]:
    """Return the unit directions from cameras to points."""
    found = points[:, None] - eyes
    return np.asarray(found / np.linalg.norm(found, axis=-1, keepdims=True))


def harmonics(train: list[View], judges: list[Judge], shininess: float) -> dict[str, dict[str, float]]:
    """Return the PSNR of the fitted highlight at places with glare, dB, by degree."""
    points = plate_points()
    tests = np.array([judge.view.camera.eye for judge in judges if judge.has_glare])
    shown = towards(points, tests)
    truth = highlight(shown, shininess)
    glare = truth >= GLARE
    heights = np.linspace(0.02, 1.0, 2_000)
    turns = np.arange(2_000) * math.pi * (3 - math.sqrt(5))
    ring = np.sqrt(1 - heights**2)
    every = np.stack([ring * np.cos(turns), heights, ring * np.sin(turns)], axis=1)
    seen = {
        "training photos": towards(points, np.array([view.camera.eye for view in train])),
        "all directions": np.broadcast_to(every, (len(points), *every.shape)),
    }
    found = {}
    for name, directions in seen.items():
        found[name] = {}
        for degree in range(SH_MAX_DEGREE + 1):
            count = (degree + 1) ** 2
            rows = sh_basis(directions)[..., :count]
            weight = RIDGE * rows.shape[1] * np.diag([0.0] + [1.0] * (count - 1))
            values = np.einsum("nvk,nv->nk", rows, highlight(directions, shininess))
            fitted = np.linalg.solve(np.einsum("nvk,nvl->nkl", rows, rows) + weight, values[..., None])[
                ..., 0
            ]
            error = (np.einsum("nvk,nk->nv", sh_basis(shown)[..., :count], fitted) - truth)[glare]
            found[name][f"degree {degree}"] = -10 * math.log10(np.square(error).mean())
    found["none"] = {"no highlight": -10 * math.log10(np.square(truth[glare]).mean())}
    return found


def trained(folder: Path, name: str, seed: int, arguments: argparse.Namespace) -> tuple[CaptureRun, float]:
    """Train by a recipe; return the run and its processor time, s."""
    words = ["--iterations", str(arguments.iterations), "--seed", str(seed), "--eval-every", "0"]
    words += ["--save-every", "0", "--white-background"]
    words += [word.format(third=max(1, arguments.iterations // 30)) for word in RECIPES[name]]
    parser = OneLineParser(prog="glare.py")
    command.add_arguments(parser)
    with tempfile.TemporaryDirectory() as scratch:
        out = str(Path(scratch) / "run")
        options = command.options_from(parser.parse_args([str(folder), *words, "--out", out]))
        before = time.process_time()
        run = CaptureRun(plan(options, Limits()).options)
        run.train()
        return run, time.process_time() - before


def scores(run: CaptureRun, judges: list[Judge]) -> dict[str, float]:
    """Return the mean PSNR of the test photos with and without glare, and of the pixels with glare, dB."""
    with_glare, others, pixels = [], [], []
    background = run.options.config.background
    with torch.no_grad():
        for judge, view in zip(judges, run.dataset.test, strict=True):
            assert Path(view.name).stem == Path(judge.view.name).stem, (
                "the photos are in the order of their names"
            )
            image = run.options.renderer(
                run.trainer.gaussians, view.camera, background=torch.tensor(background)
            ).image
            photo = view.read().over(background)
            (with_glare if judge.has_glare else others).append(psnr(image, photo))
            if judge.has_glare:
                pixels.append(psnr(image, photo, judge.glare))
    groups = {"glare": with_glare, "others": others, "pixels of glare": pixels}
    return {name: float(np.mean(values)) if values else math.nan for name, values in groups.items()}


def measure(arguments: argparse.Namespace) -> None:
    """Trace, fit, train and report."""
    whole_number("--seeds", arguments.seeds, 1)
    train, judges = capture(arguments)
    print(f"{sum(judge.has_glare for judge in judges)} of {len(judges)} test photos have glare")
    fits = harmonics(train, judges, arguments.shininess)
    for name, of_degree in fits.items():
        print(
            f"highlight fitted to {name}: " + ", ".join(f"{key} {x:.2f} dB" for key, x in of_degree.items())
        )
    runs = []
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch) / "glare"
        write_blender(folder, train, [judge.view for judge in judges])
        for seed in range(arguments.seeds):
            for name in arguments.recipes:
                run, seconds = trained(folder, name, seed, arguments)
                figures = scores(run, judges) | {"splats": len(run.trainer.gaussians), "processor s": seconds}
                runs.append({"recipe": name, "seed": seed, **figures})
                said = ", ".join(f"{key} {value:.4g}" for key, value in figures.items())
                print(f"{name}, seed {seed}: {said}", flush=True)
    setting = {name: getattr(arguments, name) for name in ("shininess", "count", "size", "iterations")}
    hardware.report({"setting": setting, "harmonics": fits, "runs": runs}, arguments.out)


def main() -> int:
    """Read the command line and measure."""
    parser = hardware.parser(__doc__.partition("\n")[0])
    parser.add_argument("--recipes", nargs="+", choices=tuple(RECIPES), default=["fast"], metavar="NAME")
    parser.add_argument("--shininess", type=float, default=30.0, help="Phong's exponent (default: 30)")
    parser.add_argument("--count", type=int, default=50, help="number of training photos (default: 50)")
    parser.add_argument("--size", type=int, default=200, help="width and height, px (default: 200)")
    parser.add_argument("--iterations", type=int, default=3_000, help="length of each run (default: 3000)")
    parser.add_argument("--seeds", type=int, default=1, help="seeds 0 to N - 1 (default: 1)")
    arguments = parser.parse_args()
    if arguments.smoke:
        arguments.size, arguments.count, arguments.iterations = 24, 8, 20
    return run_command("glare.py", lambda: measure(arguments), debug=False)


if __name__ == "__main__":
    sys.exit(main())

"""How much of the quality that a fault of the photos costs does its remedy recover?

    python benchmarks/faults.py [CAPTURE] [--fault exposure|vignetting|poses|transients] [--resolution R]
        [--iterations N] [--seeds N] [--every N] [--test-every N] [--out FILE]

Plants a fault of known truth into a copy of a capture, and trains capture and copy by the fast recipe, each without
and with the remedy. CAPTURE is snowmiku97 in $GSPLAT_EDU_DATA or ../shared/data unless given;
the word "traced" stands for 60 photos of 400 x 400 px, traced here, whose own exposure does not vary.

exposure: linear light times 2^u for u from -0.7 to 0.7, and its red and blue times 0.85 to 1.15 in addition, rounded
to bytes and clipped. Held-out photos have the fault as well, so scenes are compared by the PSNR of the photos' right
half after a fit on the left half. The true gains are relative to the gains found in the capture itself.

vignetting: linear light times 1 / (1 + t r^2)^2, the law of cos^4, with r = 1 in the corners, which lose 0 to 1.5
stops, around a centre that is off by up to 5 % of a side. Held-out photos are clean; scenes are compared by the PSNR of
their right half after a fit of exposure on the left half, and with a training that corrects exposure only.

poses: every camera turned by 0.5 degrees and shifted by 1 % of the extent, in random directions. Held-out cameras
have the fault as well, so scenes are compared by the PSNR of half of each photo after its pose is aligned on the
other half. Errors are measured after the best common move of all cameras (shift, rotation, scale).

transients: one or two blobs in 30 % of the training photos, 5 % of the pixels of each, cut from other photos, mirrored
and tinted. Held-out photos are clean. A fifth run gets the true masks, and the recovery by the remedy is a fraction
of theirs. With few photos, a fault costs more; --every 2 takes every second photo, --test-every 3 holds out every
third of these.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import hardware
import numpy as np
import torch
from captures import capture
from jaxtyping import Bool, Float64

from gsplat_edu.base.validation import ArrayLike
from gsplat_edu.budget.plan import Limits, plan
from gsplat_edu.cli.arguments import OneLineParser, run_command
from gsplat_edu.cli.options import train as command
from gsplat_edu.data.dataset import load_dataset, scene_extent
from gsplat_edu.data.settings import DataSettings
from gsplat_edu.data.writers import write_colmap
from gsplat_edu.evaluate.alignment import aligned_psnr, mean_aligned_psnr
from gsplat_edu.evaluate.metrics import score_views, summarize
from gsplat_edu.ops.exposure import stops
from gsplat_edu.render.camera_tensors import CameraTensors
from gsplat_edu.runs.training import CaptureRun
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.views import Photo, View
from gsplat_edu.train.exposure import Exposure
from gsplat_edu.train.poses import Refinement, gauge
from gsplat_edu.train.transients import resized_mask
from lab.captures.traced import traced_capture

TRACED = "traced"
"""Name of the ray-traced capture."""

GREY = 0.4
"""Background of the traced photos, which are made opaque."""

STOPS, TINT = 0.7, 0.15
"""Largest planted exposure, stops, and largest planted change of red and blue."""

CORNER, OFF_CENTRE = 1.5, 0.05
"""Largest planted vignetting, stops in the corners, and largest error of its centre, fraction of a side."""

DEGREES, SHIFT = 0.5, 0.01
"""Planted errors of the poses: degrees, and fraction of the extent."""

SHARE, AREA = 0.3, 0.05
"""Planted passers-by: fraction of the training photos, and fraction of the pixels of each."""

SEED = 7
"""Seed of the faults for the first seed of the training; both are counted up together."""


def linear(encoded: ArrayLike) -> Float64[np.ndarray, "..."]:
    """Decode sRGB to linear light."""
    x = np.asarray(encoded, dtype=np.float64)
    return np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4)


def encoded(light: ArrayLike) -> Float64[np.ndarray, "..."]:
    """Encode linear light as sRGB."""
    x = np.asarray(light, dtype=np.float64)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 1e-12) ** (1 / 2.4) - 0.055)


def uneven(
    views: Sequence[View], held_out: Sequence[bool], seed: int
) -> tuple[list[View], Float64[np.ndarray, "V 3"]]:
    """Change the exposures of views; return the views and the factors on their linear light."""
    rng = np.random.default_rng(seed)
    scales = 2.0 ** rng.uniform(-STOPS, STOPS, (len(views), 1)) * np.ones(3)
    scales[:, ::2] *= rng.uniform(1 - TINT, 1 + TINT, (len(views), 2))
    changed = []
    for view, scale in zip(views, scales, strict=True):
        photo = view.read()
        light = linear(np.asarray(photo.over((0.0, 0.0, 0.0))) / 255.0) * scale
        image = np.round(255 * np.clip(encoded(light), 0, 1)).astype(np.uint8)
        changed.append(View(view.camera, image, mask=photo.mask, name=view.name))
    return changed, scales


def vignetted(
    views: Sequence[View], held_out: Sequence[bool], seed: int
) -> tuple[list[View], Float64[np.ndarray, " V"]]:
    """Darken the corners of views that are not held out; return all views and the corners' log gains on bytes."""
    rng, changed, truths = np.random.default_rng(seed), [], []
    for view, clean in zip(views, held_out, strict=True):
        stops_lost, (cy, cx) = rng.uniform(0, CORNER), rng.uniform(-OFF_CENTRE, OFF_CENTRE, 2)
        photo, (H, W) = view.read(), (view.camera.H, view.camera.W)
        y, x = np.mgrid[:H, :W]
        r2 = (y - (0.5 + cy) * H) ** 2 + (x - (0.5 + cx) * W) ** 2
        gain = (1 + (2.0 ** (stops_lost / 2) - 1) * r2 / (0.25 * (H * H + W * W))) ** -2.0
        truths.append(-stops_lost * np.log(2.0) / 2.4)
        changed.append(view if clean else relit(view, photo, gain))
    return changed, np.array(truths)


def relit(view: View, photo: Photo, gain: Float64[np.ndarray, "H W"]) -> View:
    """Return a view whose linear light is multiplied, rounded to bytes."""
    light = linear(np.asarray(photo.over((0.0, 0.0, 0.0))) / 255.0) * gain[..., None]
    image = np.round(255 * np.clip(encoded(light), 0, 1)).astype(np.uint8)
    return View(view.camera, image, mask=photo.mask, name=view.name)


def opaque(views: Sequence[View]) -> list[View]:
    """Return the views composited over grey."""
    return [View(view.camera, view.read().over((GREY,) * 3), name=view.name) for view in views]


def stored(folder: Path, views: Sequence[View], points: ArrayLike, colors: ArrayLike) -> Path:
    """Write a capture, with names that end in .png."""
    write_colmap(
        folder, [View.stored(view.camera, view.read, png_name(view.name)) for view in views], points, colors
    )
    return folder


def png_name(name: str) -> str:
    """Return a view's name with the suffix .png."""
    return str(Path(name).with_suffix(".png"))


def misplaced(views: Sequence[View], held_out: Sequence[bool], seed: int) -> tuple[list[View], list[Camera]]:
    """Return the views with wrong poses, and their true cameras."""
    rng, extent = np.random.default_rng(seed), scene_extent([view.camera for view in views])
    changed = []
    for view in views:
        directions = rng.normal(size=(2, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        sizes = np.repeat([np.radians(DEGREES), SHIFT * extent], 3)
        camera = CameraTensors.of(view.camera).moved(torch.from_numpy(directions.ravel() * sizes)).value()
        changed.append(View.stored(camera, view.read, view.name))
    return changed, [view.camera for view in views]


def blob(rng: np.random.Generator, H: int, W: int, area: float) -> Bool[np.ndarray, "H W"]:
    """Return the pixels of a lobed ellipse of about this area, px, taller than wide."""
    aspect = rng.uniform(1.0, 2.5)
    ry = np.sqrt(area * aspect / np.pi)
    rx = ry / aspect
    y, x = (
        np.mgrid[:H, :W] - np.array([rng.uniform(0.15, 0.85) * H, rng.uniform(0.15, 0.85) * W])[:, None, None]
    )
    angle = np.arctan2(y, x)
    lobes = [0.15 * np.sin(3 * angle + rng.uniform(0, 6)), 0.1 * np.sin(5 * angle + rng.uniform(0, 6))]
    inside: Bool[np.ndarray, "H W"] = (y / ry) ** 2 + (x / rx) ** 2 < (1 + sum(lobes)) ** 2
    return inside


def with_passers_by(
    views: Sequence[View], held_out: Sequence[bool], seed: int
) -> tuple[list[View], list[Any]]:
    """Paste blobs into a fraction of the views that are not held out; return all views and the blobs' pixels."""
    rng = np.random.default_rng(seed)
    free = rng.permutation(np.flatnonzero(~np.asarray(held_out)))
    struck = set(free[: round(SHARE * len(free))].tolist())
    changed, truths = [], []
    for i, view in enumerate(views):
        image = np.array(view.read().over((0.0, 0.0, 0.0)))
        covered = np.zeros(image.shape[:2], dtype=bool)
        if i in struck:
            count = int(rng.integers(1, 3))
            for _ in range(count):
                covered |= blob(rng, *covered.shape, AREA * covered.size / count)
            other = views[int(rng.choice(free))].read().over((0.0, 0.0, 0.0))
            other = np.resize(other[:, ::-1], image.shape)
            other = np.roll(other, (int(rng.integers(len(image))), int(rng.integers(image.shape[1]))), (0, 1))
            tint = rng.uniform(0.4, 1.6, 3)
            image[covered] = np.clip(other[covered] * tint, 0, 255).astype(np.uint8)
        changed.append(View(view.camera, image, mask=view.read().mask, name=view.name))
        truths.append(covered)
    return changed, truths


def without_pixels(views: Sequence[View], covered: Sequence[Any]) -> list[View]:
    """Return the views with masks that exclude these pixels."""
    found = []
    for view, pixels in zip(views, covered, strict=True):
        photo = view.read()
        mask = ~pixels if photo.mask is None else photo.mask & ~pixels
        found.append(View(view.camera, photo.image, mask=mask, name=view.name))
    return found


def mask_errors(clean: CaptureRun, faulty: CaptureRun, truth: dict[str, Any]) -> dict[str, float]:
    """Return precision and recall of the masks, in pixels, and the fraction of masked pixels in the clean run."""
    hits = masked = covered = total = excluded = 0
    for run in (clean, faulty):
        found = run.trainer.transients
        assert found is not None, "a run with the remedy has masks"
        for view, mask in zip(run.dataset.train, found.masks, strict=True):
            size = view.camera.H, view.camera.W
            total += size[0] * size[1] if run is clean else 0
            pixels = np.zeros(size, dtype=bool) if mask is None else resized_mask(mask, *size)
            if run is clean:
                excluded += int(pixels.sum())
                continue
            true = resized_mask(truth[view.name], *size)
            hits, masked, covered = (
                hits + int((pixels & true).sum()),
                masked + int(pixels.sum()),
                covered + int(true.sum()),
            )
    return {
        "precision of the masks": hits / max(masked, 1),
        "recall of the masks": hits / max(covered, 1),
        "share of the clean photos that is masked": excluded / max(total, 1),
    }


def trained(folder: Path, words: Sequence[str], arguments: argparse.Namespace, seed: int) -> CaptureRun:
    """Train a capture with further options of `gsplat-edu train`."""
    words = ["--iterations", str(arguments.iterations), "--eval-every", "0", "--save-every", "0", *words]
    words += ["--seed", str(seed)]
    if arguments.test_every is not None:
        words += ["--test-every", str(arguments.test_every)]
    if arguments.resolution is not None and not FAULTS[arguments.fault].reduced:
        words += ["--resolution", str(arguments.resolution)]
    parser = OneLineParser(prog="faults.py")
    command.add_arguments(parser)
    with tempfile.TemporaryDirectory() as scratch:
        out = str(Path(scratch) / "run")
        options = command.options_from(parser.parse_args([str(folder), *words, "--out", out]))
        run = CaptureRun(plan(options, Limits()).options)
        run.train()
    return run


def scores(run: CaptureRun) -> dict[str, Any]:
    """Score the held-out views of a run: as they are, with their exposure fitted, and with their poses aligned."""
    gaussians, options, test = run.trainer.gaussians, run.options, run.dataset.test
    means = summarize(score_views(gaussians, test, options.renderer, options.config.background))
    aligned = [
        aligned_psnr(gaussians, view, options.renderer, options.config.background, run.trainer.extent)
        for view in test
    ]
    return {**means, "psnr_aligned": mean_aligned_psnr(aligned), "gaussians": len(gaussians)}


def gain_errors(clean: CaptureRun, faulty: CaptureRun, truth: dict[str, Any]) -> dict[str, float]:
    """Return errors of the gains, stops: those of the faulty run beyond those of the clean one, against the truth."""
    before, after = (stops(exposure_of(run).log_gains()).double().numpy() for run in (clean, faulty))
    wanted = np.log2([truth[view.name] for view in faulty.dataset.train])
    error = after - before - wanted
    error -= error.mean(axis=0)  # the gauge: the mean of the truth over the training photos is not 0
    found = np.abs(error)
    return {
        "rms error of gains (stops)": float(np.sqrt(np.mean(error**2))),
        "90 % of gains within (stops)": float(np.quantile(found, 0.9)),
        "largest error of gains (stops)": float(found.max()),
    }


def vignetting_errors(clean: CaptureRun, faulty: CaptureRun, truth: dict[str, Any]) -> dict[str, float]:
    """Return errors of k, of the faulty run beyond the clean one, in stops of light in the corners."""
    before, after = (exposure_of(run).vignetting().double().numpy() for run in (clean, faulty))
    wanted = np.array([truth[view.name] for view in faulty.dataset.train])
    error = (after - before - wanted) * 2.4 / np.log(2.0)
    return {
        "mean error of the corners (stops)": float(error.mean()),
        "rms error of the corners (stops)": float(np.sqrt(np.mean(error**2))),
        "planted, standard deviation (stops)": float(wanted.std() * 2.4 / np.log(2.0)),
    }


def pose_errors(clean: CaptureRun, faulty: CaptureRun, truth: dict[str, Any]) -> dict[str, float]:
    """Return mean errors of the poses, degrees and per cent of the extent: planted, left, and of the clean run.

    The best first-order move of all cameras together is taken out: no photo can tell it.
    """
    found: dict[str, float] = {}
    for name, run, refined in (
        ("planted", faulty, False),
        ("left", faulty, True),
        ("clean run", clean, True),
    ):
        views, extent = run.dataset.train, run.trainer.extent
        true = [truth[view.name] for view in views]
        errors = []
        for i, view in enumerate(views):
            camera = refinement_of(run).refined(i, view.camera) if refined else view.camera
            turn = camera.R @ true[i].R.T
            axis = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]) / 2
            errors.append(np.concatenate([axis, (camera.eye + run.dataset.origin - true[i].eye) / extent]))
        moves = gauge(true, extent).reshape(6 * len(views), -1)
        left = np.ravel(errors) - moves @ (moves.T @ np.ravel(errors))
        turns, shifts = np.linalg.norm(left.reshape(-1, 2, 3), axis=2).mean(axis=0)
        found[f"{name}: rotation (degrees)"] = float(np.degrees(turns))
        found[f"{name}: position (% of the extent)"] = float(100 * shifts)
    return found


def exposure_of(run: CaptureRun) -> Exposure:
    """Return the exposures of a run that corrects them."""
    model = run.trainer.view_model
    if not isinstance(model, Exposure):
        raise TypeError("the run does not correct exposures")
    return model


def refinement_of(run: CaptureRun) -> Refinement:
    """Return the refined cameras of a run that refines them."""
    model = run.trainer.view_model
    if not isinstance(model, Refinement):
        raise TypeError("the run does not refine cameras")
    return model


@dataclass(frozen=True)
class Fault:
    """A fault and its remedy.

    Args:
        plant: Returns the views with the fault, and the truth of each view, from the views, which of them are held out,
            and a seed.
        without: Options of `gsplat-edu train` without the remedy.
        remedy: Options with it.
        score: The score of the held-out views that the fault itself does not change.
        errors: Returns the errors of what the remedy found.
        cured: Returns the views without the true fault; None to compare with the clean views.
        reduced: Whether --resolution reduces the photos before the fault is planted, instead of in the training.
    """

    plant: Callable[[Sequence[View], Sequence[bool], int], tuple[list[View], Sequence[Any]]]
    without: tuple[str, ...]
    remedy: tuple[str, ...]
    score: str
    errors: Callable[[CaptureRun, CaptureRun, dict[str, Any]], dict[str, float]]
    cured: Callable[[Sequence[View], Sequence[Any]], list[View]] | None = None
    reduced: bool = False


PLAIN = ("--appearance", "none", "--refine", "none")

FAULTS = {
    "exposure": Fault(
        uneven, PLAIN, ("--appearance", "exposure", "--refine", "none"), "psnr_fitted", gain_errors
    ),
    "vignetting": Fault(
        vignetted,
        ("--appearance", "exposure", "--refine", "none"),
        ("--appearance", "vignetting", "--refine", "none"),
        "psnr_fitted",
        vignetting_errors,
    ),
    "poses": Fault(
        misplaced, PLAIN, ("--appearance", "none", "--refine", "poses"), "psnr_aligned", pose_errors
    ),
    "transients": Fault(
        with_passers_by, PLAIN, (*PLAIN, "--transients", "mask"), "psnr", mask_errors, without_pixels, True
    ),
}
"""The faults by name."""


def compare(folder: Path, arguments: argparse.Namespace, seed: int) -> dict[str, Any]:
    """Train the runs of one seed; return their scores, the recovered fraction, and the remedy's errors."""
    fault = FAULTS[arguments.fault]
    dataset = load_dataset(folder, DataSettings(resolution=arguments.resolution if fault.reduced else None))
    views = sorted((*dataset.train, *dataset.test), key=lambda view: view.name)[:: arguments.every]
    found: dict[str, dict[str, Any]] = {}
    kept = []
    with tempfile.TemporaryDirectory() as scratch:
        place = stored(Path(scratch) / "clean", views, dataset.points, dataset.colors)
        test = {view.name for view in load_dataset(place, DataSettings(test_every=arguments.test_every)).test}
        held_out = [png_name(view.name) in test for view in views]
        changed, truths = fault.plant(views, held_out, SEED + seed)
        states = {"clean": (views, ("without", "with")), "faulty": (changed, ("without", "with"))}
        if fault.cured is not None:
            states["true masks"] = fault.cured(changed, truths), ("without",)
        for state, (given, kinds) in states.items():
            if state != "clean":
                place = stored(Path(scratch) / state, given, dataset.points, dataset.colors)
            for kind in kinds:
                before = time.process_time()
                run = trained(place, fault.remedy if kind == "with" else fault.without, arguments, seed)
                seconds = time.process_time() - before
                found[f"{state}, {kind}"] = {**scores(run), "processor_seconds": seconds}
                print(f"seed {seed}, {state}, {kind}: {line(found[f'{state}, {kind}'])}", flush=True)
                if kind == "with":
                    kept.append(run)
    truth = dict(zip([png_name(view.name) for view in views], truths, strict=True))
    return {"fault": arguments.fault, "runs": found, "errors": fault.errors(kept[0], kept[1], truth)}


def summary(results: Sequence[dict[str, Any]], fault: Fault) -> dict[str, Any]:
    """Return means over the seeds of scores, recovered fraction and errors."""

    def mean(name: str) -> float:
        return float(np.mean([result["runs"][name][fault.score] for result in results]))

    best = mean("clean, without" if fault.cured is None else "true masks, without")
    lost, back = mean("faulty, without"), mean("faulty, with")
    return {
        "scores": {name: mean(name) for name in results[0]["runs"]},
        "regained": (back - lost) / (best - lost),
        "clean lost": mean("clean, without") - mean("clean, with"),
        "errors": {
            name: float(np.mean([result["errors"][name] for result in results]))
            for name in results[0]["errors"]
        },
    }


def line(found: dict[str, Any]) -> str:
    """Return the scores of a run as a line."""
    return (
        f"PSNR {found['psnr']:.2f} dB, exposure fitted {found['psnr_fitted']:.2f}, pose aligned"
        f" {found['psnr_aligned']:.2f}; {found['gaussians']} Gaussians,"
        f" {found['processor_seconds']:.0f} s of processor time"
    )


def measure(arguments: argparse.Namespace) -> None:
    """Choose the capture, compare, and report."""
    if arguments.capture is not None and str(arguments.capture) == TRACED:
        size, count = (24, 10) if arguments.smoke else (400, 60)
        with tempfile.TemporaryDirectory() as scratch:
            train, test = traced_capture(size, count)
            rng = np.random.default_rng(SEED)
            points = rng.uniform(-1.5, 1.5, (20_000 if not arguments.smoke else 50, 3))
            folder = stored(
                Path(scratch) / TRACED, opaque((*train, *test)), points, np.full(points.shape, 0.5)
            )
            results = [compare(folder, arguments, seed) for seed in range(arguments.seeds)]
    else:
        with capture(arguments.capture, arguments.smoke) as folder:
            results = [compare(folder, arguments, seed) for seed in range(arguments.seeds)]
    fault = FAULTS[arguments.fault]
    result = summary(results, fault)
    print(*(f"{name}: {value:.3f} dB" for name, value in result["scores"].items()), sep="\n")
    print(f"regained: {100 * result['regained']:.0f} % of the {fault.score} that the fault costs")
    print(f"the remedy costs a clean capture {result['clean lost']:.3f} dB")
    print(*(f"{name}: {value:.3f}" for name, value in result["errors"].items()), sep="\n")
    hardware.report({"seeds": results, **result}, arguments.out)


def main() -> int:
    """Read the command line and measure."""
    parser = hardware.parser(__doc__.partition("\n")[0])
    parser.add_argument("capture", nargs="?", type=Path, help=f'folder of a capture, or the word "{TRACED}"')
    parser.add_argument(
        "--fault", choices=tuple(FAULTS), default="exposure", help="fault to plant (default: exposure)"
    )
    parser.add_argument("--resolution", type=float, help="divisor of the photos' size, as in train")
    parser.add_argument("--iterations", type=int, default=3_000, help="length of each run (default: 3000)")
    parser.add_argument("--seeds", type=int, default=1, help="number of seeds to average (default: 1)")
    parser.add_argument("--every", type=int, default=1, help="take every N-th photo only (default: 1)")
    parser.add_argument("--test-every", type=int, help="hold out every N-th of these, as in train")
    arguments = parser.parse_args()
    if arguments.smoke:
        arguments.iterations = 20
    return run_command("faults.py", lambda: measure(arguments), debug=False)


if __name__ == "__main__":
    sys.exit(main())

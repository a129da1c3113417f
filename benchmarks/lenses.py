"""Does a training through the photos' own lens beat undistorted photos, and what does an iteration cost?

    python benchmarks/lenses.py --out FILE.json [--questions NAME ...] [--size PX] [--quality draft] [--seeds N]
        [--fox FOLDER] [--smoke]

The questions `fisheye` (180 degrees), `panorama`, `shutter_20`, `shutter_40` and `blur_8` train a ray-traced garden
twice from the same points, with the same number of iterations and Gaussians: natively, and from what a renderer of
pinholes gets. That is the undistorted photo, the eight faces of the panorama, or the photo of the moving camera as if
it had been at rest. Photos of `blur_8` are averages of 16 moments in linear light. Every eighth of the views is held
out. Scores are PSNR in dB:

    common   through the lens, over the pixels that the undistorted photo or the faces show too
    all      through the lens, over every pixel with a ray
    pinhole  by a pinhole of 60 degrees with as many pixels per radian; of a shutter or a blur, by the same camera at
             rest, against a sharp photo
    page     the same without the splats that a page leaves out of a scene trained through lenses
    near     the same without the splats whose means are beyond 45 degrees, outside of the picture

`fox` trains a capture with an OPENCV lens (default: fox in $GSPLAT_EDU_DATA or ../shared/data, `--resolution 4`), both
scenes scored on its held-out photos as they are and undistorted. `cost` times an iteration (render, loss, backward
pass with Adam) at the same poses, size, focal length and Gaussians, in processor time, as the ratio to the pinhole.
Use one thread.

Every finished run is stored in FILE.json, so that an interrupted benchmark continues where it stopped.
"""

from __future__ import annotations

import argparse
import functools
import math
import os
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import hardware
import numpy as np
import torch
from jaxtyping import Bool, UInt8
from recipes import Results, spread
from train_step import measure

from gsplat_edu.base.buffers import reused_buffers
from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.validation import whole_number
from gsplat_edu.cli.arguments import run_command
from gsplat_edu.data.dataset import TEST_EVERY, DataSettings, load_dataset
from gsplat_edu.data.lens import FISHEYE, Lens, undistortion
from gsplat_edu.data.panorama import cut_face, face_pinhole, face_rotations, face_side
from gsplat_edu.evaluate.metrics import psnr
from gsplat_edu.render.api import render
from gsplat_edu.render.backends import load_backend
from gsplat_edu.render.field import within_field
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.scene.intrinsics import Intrinsics
from gsplat_edu.scene.projection import Projection
from gsplat_edu.scene.shutter import AT_ONCE, RollingShutter
from gsplat_edu.scene.views import View
from gsplat_edu.train.compose import Views, training
from gsplat_edu.train.config import recipe
from gsplat_edu.train.length import QUALITIES, planned_iterations
from lab.captures.lens_captures import LENS_KINDS, LENS_SCENES, LensCapture, lens_capture, with_rays

DATA = Path(os.environ.get("GSPLAT_EDU_DATA", "../shared/data"))

SCENE, COUNT, START = "garden", 32, 4_000
"""The ray-traced scene, its views and its start points."""

FIELD = math.radians(60.0)
"""Field of view of the pinholes that score a scene."""

BEYOND = math.radians(45.0)
"""Splats whose means are farther from the optical axis are left out for the score `near`, radians."""

COLUMNS = ("common", "all", "pinhole", "page", "near")

WAYS = ("native", "pinhole")
"""The two trainings of a question."""

QUESTIONS = (*LENS_KINDS, "fox", "cost")

TURNS = 7
"""Rounds of the timing of an iteration, all cameras in turn in each."""


@dataclass(frozen=True)
class Held:
    """What a scene is scored by.

    Args:
        column: Name of the score.
        view: Camera and photo.
        mask: (H, W) the pixels that count; None for all.
    """

    column: str
    view: View
    mask: Bool[np.ndarray, "H W"] | None = None


@dataclass(frozen=True)
class Question:
    """Two sets of training photos of one scene, and the held-out photos.

    Args:
        sets: Training photos and start points by the way of training.
        held: The held-out photos.
    """

    sets: dict[str, Views]
    held: list[Held]


def undistorted(view: View) -> View:
    """Return the photo of a fisheye as `--lens undistort` gives it."""
    lens, photo = fisheye_lens(view.camera), view.read()
    columns, rows, valid = undistortion(lens, slice(0, lens.H))
    image = cv2.remap(photo.image, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    camera = Camera.posed(view.camera.R, view.camera.eye, lens.undistorted())
    return View(camera, image, mask=None if valid.all() else valid, name=view.name)


def fisheye_lens(camera: Camera) -> Lens:
    """Return the lens of an equidistant fisheye."""
    return Lens(camera.W, camera.H, camera.fx, camera.fy, camera.cx, camera.cy, (), FISHEYE)


def faces(view: View) -> list[View]:
    """Return the eight faces of a panorama, cut as `--lens undistort` does."""
    camera, image = view.camera, view.read().image
    side, found = face_side(camera.W), []
    for number, R in enumerate(face_rotations()):
        pixels, _, mask = cut_face(image, None, None, R, side)
        seen = Camera.posed(R @ camera.R, camera.eye, face_pinhole(side))
        found.append(View(seen, pixels, mask=mask, name=f"{number}_{view.name}"))
    return found


def plain_views(kind: str, view: View) -> list[View]:
    """Return what a renderer of pinholes at rest trains with instead of a view."""
    if kind == "fisheye":
        return [undistorted(view)]
    if kind == "panorama":
        return faces(view)
    return [View(view.camera.through(), view.read().image, name=view.name)]


def shown_by(view: View, pinholes: Sequence[View]) -> Bool[np.ndarray, "H W"]:
    """Return which pixels of a view show what one of the pinholes from its place shows, too."""
    rays = np.nan_to_num(view.camera.rays())
    found = np.zeros(rays.shape[:2], dtype=np.bool_)
    for camera in (pinhole.camera for pinhole in pinholes):
        x, y, z = np.moveaxis(rays @ camera.R.T, -1, 0)
        ahead = z > 0
        u, v = (
            f * a / np.where(ahead, z, 1.0) + c
            for f, a, c in ((camera.fx, x, camera.cx), (camera.fy, y, camera.cy))
        )
        found |= (
            ahead
            & (abs(u - (camera.W - 1) / 2) <= camera.W / 2)
            & (abs(v - (camera.H - 1) / 2) <= camera.H / 2)
        )
    return found


def rested(camera: Camera) -> Camera:
    """Return a pinhole at rest of `FIELD`, in the pose of a camera and with its pixels per radian at the middle."""
    side = max(16, round(2 * camera.fx * math.tan(FIELD / 2)))
    middle = (side - 1) / 2
    return Camera.posed(camera.R, camera.eye, Intrinsics(side, side, camera.fx, camera.fx, middle, middle))


def traced_question(kind: str, size: int, count: int, seed: int) -> Question:
    """Photograph the scene by cameras of a kind; divide the views."""
    made: LensCapture = lens_capture(kind, SCENE, size, count, START, seed)
    held = list[Held]()
    for view in made.views[::TEST_EVERY]:
        everything = with_rays(view.camera)
        moves = view.camera.shutter is not None
        common = everything if moves else everything & shown_by(view, plain_views(kind, view))
        camera = view.camera.through() if moves else rested(view.camera)
        photo = View(camera, LENS_SCENES[SCENE].photograph(camera).image, name=view.name)
        held += [Held("common", view, common), Held("all", view, everything), Held("pinhole", photo)]
    train = [view for i, view in enumerate(made.views) if i % TEST_EVERY]
    plain = [other for view in train for other in plain_views(kind, view)]
    return Question(
        {
            way: Views(views, made.points, made.colors)
            for way, views in zip(WAYS, (train, plain), strict=True)
        },
        held,
    )


def fox_question(folder: Path, smoke: bool) -> Question:
    """Load a capture with distorted photos in both ways."""
    if not folder.is_dir():
        raise ArgumentError(f"{folder}: does not exist; set GSPLAT_EDU_DATA, or give --fox")
    sets, held = {}, list[Held]()
    for way, lens in zip(WAYS, ("native", "undistort"), strict=True):
        dataset = load_dataset(folder, DataSettings(resolution=32.0 if smoke else 4.0, lens=lens))
        sets[way] = Views(dataset.train, dataset.points, dataset.colors)
        column = "all" if way == "native" else "pinhole"
        held += [Held(column, view, view.read().mask) for view in dataset.test]
        if way == "native":
            natives = dataset.test
        else:
            pairs = zip(natives, dataset.test, strict=True)
            held += [Held("common", view, shown_by(view, [plain])) for view, plain in pairs]
    return Question(sets, held)


def trained(question: Question, way: str, iterations: int, seed: int) -> tuple[Gaussians, dict[str, Any]]:
    """Train in one way, with the number of Gaussians that the native photos plan for."""
    backend = load_backend("cpu")
    config = recipe(iterations, strategy="fast", seed=seed)
    cap = training(config, question.sets[WAYS[0]], backend).config.max_gaussians
    config = recipe(iterations, strategy="fast", seed=seed, max_gaussians=cap)
    begun = time.process_time()
    made = training(config, question.sets[way], backend)
    made.run()
    seconds = time.process_time() - begun
    gaussians = made.gaussians
    settings = RenderSettings(config.background, jacobian_limit=config.jacobian_limit)
    scores: dict[str, list[float]] = {column: [] for column in COLUMNS}
    radii = list[float]()
    with torch.no_grad():
        for held in question.held:
            camera, image = held.view.camera, held.view.read().image
            output = render(gaussians, camera, settings=settings, backend="cpu")
            scores[held.column].append(psnr(output.image, image, held.mask))
            if held.column == "pinhole":
                radii.append(float(output.radii.prod(dim=-1).sqrt().median()))
                shown = render(within_field(gaussians, camera), camera, settings=settings, backend="cpu")
                scores["page"].append(psnr(shown.image, image, held.mask))
                near = render(ahead(gaussians, camera), camera, settings=settings, backend="cpu")
                scores["near"].append(psnr(near.image, image, held.mask))
    found = {name: float(np.mean(values)) for name, values in scores.items() if values}
    return gaussians, found | {
        "gaussians": len(gaussians),
        "processor_seconds": seconds,
        "radius": statistics.mean(radii) if radii else 0.0,
    }


def ahead(gaussians: Gaussians, camera: Camera) -> Gaussians:
    """Return the splats whose means are within `BEYOND` of the optical axis."""
    points = camera.world_to_cam(gaussians.means.numpy().astype(np.float64))
    kept = torch.from_numpy(np.hypot(points[:, 0], points[:, 1]) < math.tan(BEYOND) * points[:, 2])
    return gaussians.map(lambda tensor: tensor[kept])


def cameras_of_cost(size: int) -> dict[str, list[Camera]]:
    """Return cameras at the same poses, of the same size and focal length."""
    pinholes = LENS_SCENES[SCENE].cameras(20, (size, round(0.75 * size)))
    motion = [0.03, -0.04, 0.01], [0.05, 0.02, 0.0]
    shutter, blur = RollingShutter(*motion), RollingShutter(*motion, AT_ONCE, 0.5)
    changes: dict[str, Callable[[Camera], Camera]] = {
        "pinhole": lambda camera: camera,
        "fisheye": lambda camera: camera.through(Projection("fisheye")),
        "shutter": lambda camera: camera.through(camera.projection, shutter),
        "blur": lambda camera: camera.through(camera.projection, blur),
        "fisheye_shutter": lambda camera: camera.through(Projection("fisheye"), shutter),
    }
    return {name: [change(camera) for camera in pinholes] for name, change in changes.items()}


def cost(gaussians: Gaussians, size: int, turns: int, rounds: int) -> dict[str, dict[str, float]]:
    """Time iterations of a scene by each camera in turn; return medians over the turns, ms, and ratios.

    `project` and `project_backward` are by the wall clock, the iteration by processor time.
    """
    black: UInt8[np.ndarray, "H W 3"] = np.full((round(0.75 * size), size, 3), 128, np.uint8)
    views = {
        name: [View(camera, black) for camera in cameras] for name, cameras in cameras_of_cost(size).items()
    }
    times: dict[str, list[dict[str, float]]] = {name: [] for name in views}
    with reused_buffers():  # as in the trainer
        for _ in range(turns):
            for name in views:
                times[name].append(measure(gaussians, views[name], rounds, True, time.process_time))
    found = {}
    for name, rows in times.items():
        keys = ("project", "project_backward", "iteration", "pairs")
        found[name] = {key: statistics.median(row[key] for row in rows) for key in keys}
        ratios = [
            row["iteration"] / first["iteration"] for row, first in zip(rows, times["pinhole"], strict=True)
        ]
        found[name]["ratio"] = statistics.median(ratios)
    return found


def table(runs: Sequence[dict[str, Any]]) -> str:
    """Return the scores as a Markdown table."""
    lines = [
        "| question | way | runs | common | all | pinhole | near | Gaussians | radius, px | processor s |",
        "|" + "---|" * 10,
    ]
    for name, way in dict.fromkeys((run["question"], run["recipe"]) for run in runs):
        rows = [run for run in runs if (run["question"], run["recipe"]) == (name, way)]
        cells = [spread(rows, column, 2) for column in COLUMNS]
        cells += [
            spread(rows, "gaussians", 0),
            spread(rows, "radius", 2),
            spread(rows, "processor_seconds", 0),
        ]
        lines.append(f"| {name} | {way} | {len(rows)} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def compare(arguments: argparse.Namespace) -> None:
    """Train what has no result yet, then print the tables."""
    whole_number("--seeds", arguments.seeds, 1)
    torch.set_num_threads(1)
    setting = {"threads": 1, "smoke": arguments.smoke, "size": arguments.size, "quality": arguments.quality}
    results = Results(arguments.out, setting)
    done = {(run["question"], run["recipe"], run["seed"]) for run in results.runs}
    make = functools.partial(traced_question, size=arguments.size, count=9 if arguments.smoke else COUNT)
    for seed in range(arguments.seeds):
        for name in arguments.questions:
            if name == "cost" or all((name, way, seed) in done for way in WAYS):
                continue
            question = (
                fox_question(arguments.fox, arguments.smoke) if name == "fox" else make(name, seed=seed)
            )
            length = planned_iterations(arguments.quality, len(question.sets["native"].train))
            for way in WAYS:
                if (name, way, seed) in done:
                    continue
                _, found = trained(question, way, 20 if arguments.smoke else length, seed)
                results.add({"question": name, "recipe": way, "seed": seed} | found)
                scores = ", ".join(f"{key} {found[key]:.2f}" for key in COLUMNS)
                print(f"{name}, {way}, seed {seed}: {scores} dB", flush=True)
    print(", ".join(f"{key}: {value}" for key, value in hardware.describe().items()))
    print(f"load {os.getloadavg()[0]:.1f}\n{table(results.runs)}")
    if "cost" in arguments.questions:
        made = lens_capture("shutter_20", SCENE, arguments.size, 9, START)
        still = Views(made.pinholes, made.points, made.colors)
        gaussians, _ = trained(Question({"native": still}, []), "native", 20 if arguments.smoke else 500, 0)
        found = cost(gaussians, arguments.size, *((1, 1) if arguments.smoke else (TURNS, 20)))
        print(f"{len(gaussians)} Gaussians, load {os.getloadavg()[0]:.1f}")
        for name, row in found.items():
            print(f"{name:16}" + "".join(f"{key} {value:.3f}  " for key, value in row.items()))


def main() -> int:
    """Read the command line and answer the questions."""
    parser = hardware.parser(__doc__.partition("\n")[0])
    parser.add_argument("--questions", nargs="+", choices=QUESTIONS, metavar="NAME")
    parser.add_argument("--size", type=int, default=320, help="width of the traced photos, px (default: 320)")
    parser.add_argument(
        "--quality", choices=tuple(QUALITIES), default="draft", help="length (default: draft)"
    )
    parser.add_argument("--seeds", type=int, default=2, help="seeds 0 to N - 1 (default: 2)")
    parser.add_argument("--fox", type=Path, default=DATA / "fox", help="the capture of the question fox")
    arguments = parser.parse_args()
    if arguments.smoke:
        arguments.seeds, arguments.size = 1, 32
    arguments.questions = arguments.questions or [
        name for name in QUESTIONS if not (arguments.smoke and name == "fox")
    ]
    return run_command("lenses.py", lambda: compare(arguments), debug=False)


if __name__ == "__main__":
    sys.exit(main())

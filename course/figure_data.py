"""Write the data of the site's moving figures: docs/site/static/play/*-data.js and frames.jpg.

    python course/figure_data.py [--only kernels | --only fit | --only scene]

Trains the sphere of chapters 07 and 09 with the backend cpu (half a minute), except for the fit of chapter 08. The
figures read scripts and pictures instead of JSON, because pages that are opened from disk may load these.
"""

from __future__ import annotations

import argparse
import base64
import json
import sys
from pathlib import Path

import numpy as np
import torch
from matplotlib.cbook import get_sample_data
from PIL import Image

from gsplat_edu import Camera, sphere_shell
from gsplat_edu.data.synthetic import SphereCapture, sphere_capture
from gsplat_edu.engine.passes import Program, manifest
from gsplat_edu.evaluate.metrics import to_bytes
from gsplat_edu.fit2d.fit import shrunk_photo
from gsplat_edu.fit2d.splats import random_splats_2d
from gsplat_edu.photos.decoding import decode
from gsplat_edu.render.api import render
from gsplat_edu.render.backends import load_backend
from gsplat_edu.scene.gaussian_math import project_cov3d
from gsplat_edu.scene.gaussians import Gaussians, cov3d_t
from gsplat_edu.train import Start, Views, course, training
from gsplat_edu.train.events import DensifyEvent, StepEvent
from gsplat_edu.train.initialize import random_ball
from gsplat_edu.train.trainer import Trainer

ROOT = Path(__file__).resolve().parent.parent
sys.path.append(str(ROOT / "benchmarks"))
from ladder import gpu  # noqa: E402

OUT = ROOT / "docs" / "site" / "static" / "play"
SIZE, ITERATIONS, CAP, SEED = 128, 800, 1600, 9
"""The budget of chapter 09."""

FRAMES = (0, 5, 10, 20, 30, 40, 50, 60, 80, *range(100, ITERATIONS + 1, 50))
"""Iterations before which a frame is rendered; the last is the end. The beginning changes fastest."""

DENSIFIED = 300
"""The densification that is shown: it clones and splits."""

SHELL = 600
"""Splats of the sphere to turn."""

FIT_SIZE, FIT_SPLATS, FIT_SEED = 56, 90, 8
"""Longer side of chapter 08's photo in px, its splats, and the seed of the chapter."""


def write(name: str, value: object) -> None:
    """Write a script that stores a value as `gsplatData[name]`."""
    text = json.dumps(value, separators=(",", ":"))
    path = OUT / f"{name}-data.js"
    path.write_text(f"(window.gsplatData ??= {{}}).{name} = {text};\n", encoding="utf-8")
    print(f"{path.relative_to(ROOT)}: {path.stat().st_size / 1e3:.0f} kB")


def splats_before(gaussians: Gaussians, norms: torch.Tensor, camera: Camera) -> list[list[float]]:
    """List u, v, xx, xy, yy (px), mean gradient (NDC), largest scale, opacity, and 1 for the near half."""
    with torch.no_grad():
        means = gaussians.means.double().numpy()
        covariances = cov3d_t(gaussians.log_scales.double(), gaussians.quats.double()).numpy()
        rest = (
            torch.stack([norms, gaussians.scales.amax(dim=-1), gaussians.opacities], dim=-1).double().numpy()
        )
    in_camera = camera.world_to_cam(means)
    u, v, z = camera.project(in_camera)
    cov2d = project_cov3d(covariances, in_camera, camera)
    columns = [u, v, cov2d[:, 0, 0], cov2d[:, 0, 1], cov2d[:, 1, 1], *rest.T, z < np.linalg.norm(camera.eye)]
    return [[float(f"{value:.6g}") for value in row] for row in np.stack(columns, axis=-1)]


class Diary:
    """What the figures show of a training; `note` is its callback."""

    def __init__(self, capture: SphereCapture) -> None:
        self.capture = capture
        self.frames: list[np.ndarray] = []
        self.errors: list[float] = []
        self.losses: list[float] = []
        self.counts: list[int] = []
        self.density: dict[str, object] = {}

    def picture(self, gaussians: Gaussians) -> None:
        """Keep the held-out view as bytes, and its mean absolute error."""
        with torch.no_grad():
            image = render(gaussians, self.capture.held_out.camera, backend="cpu").image.numpy()
        self.frames.append(to_bytes(image))
        self.errors.append(round(float(np.abs(image - self.capture.held_out.image).mean()), 4))

    def note(self, trainer: Trainer, event: object) -> None:
        """Keep losses, counts and frames, and what one densification decides on."""
        if isinstance(event, DensifyEvent) and event.iteration == DENSIFIED:
            made = {"cloned": event.num_cloned, "children": event.num_split_children}
            self.density |= made | {"pruned": event.num_pruned, "count": event.num_gaussians}
        if not isinstance(event, StepEvent):
            return
        self.losses.append(round(event.loss, 5))
        self.counts.append(event.num_gaussians)
        if event.iteration + 1 in FRAMES:
            self.picture(trainer.gaussians)
        if event.iteration == DENSIFIED:  # after the step, before the strategy acts
            sums = trainer.density.observed()
            norms = sums["norm_sums"] / sums["times_visible"].clamp(min=1)
            config = trainer.config
            self.density |= {
                "iteration": event.iteration,
                "splats": splats_before(trainer.gaussians, norms, self.capture.held_out.camera),
                "threshold": config.adc.grad_threshold,
                "large": config.adc.percent_dense * trainer.extent,
                "faint": config.min_opacity,
                "cap": config.max_gaussians,
                "size": SIZE,
            }


def kernels() -> dict[str, object]:
    """Return the programs of the figures that run WGSL kernels, by the figure's name: shaders, buffers and passes."""

    def without(program: Program, *parts: str) -> Program:
        kept = {name: passes for name, passes in program.parts.items() if name not in parts}
        used = {name for passes in kept.values() for one in passes for name in (*one.reads, *one.writes)}
        return Program(tuple(buffer for buffer in program.buffers if buffer.name in used | {"live"}), kept)

    tiles = gpu.tiles_program(24)  # figures of 96 x 64 px
    programs = {"naive": gpu.naive_program(), "tiles": without(tiles, "backward"), "slots": tiles}
    return {name: {"program": manifest(program, gpu.source)} for name, program in programs.items()}


def fit_data() -> dict[str, object]:
    """Return chapter 08's photo as bytes and its start: rows u, v, log scales, angle, r, g, b, logit."""
    # Grace Hopper, a portrait by the US Navy, in the public domain. It comes with matplotlib.
    photo = shrunk_photo(decode(Path(get_sample_data("grace_hopper.jpg", asfileobj=False)))[0], FIT_SIZE)
    tall, wide, _ = photo.shape
    start = random_splats_2d(FIT_SPLATS, tall, wide, np.random.default_rng(FIT_SEED))
    rows = np.concatenate([array.reshape(FIT_SPLATS, -1) for array in start.arrays().values()], axis=1)
    pixels = base64.b64encode(to_bytes(photo).tobytes()).decode()
    return {"wide": wide, "tall": tall, "pixels": pixels, "start": np.round(rows, 4).tolist()}


def scene_data(gaussians: Gaussians) -> dict[str, object]:
    """Return raw values as whole numbers: the means of 16 bits, then log scales, quaternions, sh0 and logit of 8 bits.

    A value is its column's low end plus the number times the column's step. Rows follow one another, in base64.
    """
    raw = {name: values.detach().double().numpy() for name, values in gaussians.tensors().items()}
    rest = ("log_scales", "quats", "sh0", "logit_opacities")
    narrow = np.concatenate([raw[name].reshape(len(gaussians), -1) for name in rest], axis=1)
    stored: dict[str, object] = {"count": len(gaussians)}
    for name, values, kind in (("wide", raw["means"], "<u2"), ("narrow", narrow, "<u1")):
        low = values.min(axis=0)
        step = np.ptp(values, axis=0) / np.iinfo(kind).max
        numbers = np.rint((values - low) / step).astype(kind)
        stored[name] = base64.b64encode(numbers.tobytes()).decode()
        stored[f"{name}_columns"] = np.stack([low, step], axis=-1).tolist()
    return stored


def main() -> None:
    """Train, and write the files."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", choices=["kernels", "fit", "scene"], help="write only these data")
    only = parser.parse_args().only
    OUT.mkdir(parents=True, exist_ok=True)
    if only in (None, "kernels"):
        for name, value in kernels().items():
            write(name, value)
    if only in (None, "fit"):
        write("fit", fit_data())
    if only in ("kernels", "fit"):
        return
    diary = Diary(sphere_capture(SIZE))
    generator = torch.Generator().manual_seed(SEED)
    start = Start(random_ball(400, generator), extent=course.EXTENT, generator=generator)
    config = course.course_config(ITERATIONS, SEED, CAP)
    views = Views(diary.capture.train)
    trainer = training(config, views, load_backend("cpu"), start, callbacks=[diary.note])
    diary.picture(trainer.gaussians)
    trainer.run()
    write("scene", scene_data(trainer.gaussians))
    if only:
        return
    truth = to_bytes(diary.capture.held_out.image)
    Image.fromarray(np.concatenate([*diary.frames, truth], axis=1)).save(OUT / "frames.jpg", quality=88)
    print(f"frames.jpg: {(OUT / 'frames.jpg').stat().st_size / 1e3:.0f} kB")
    run = {"frames": FRAMES, "errors": diary.errors, "losses": diary.losses, "counts": diary.counts}
    write("training", run | {"size": SIZE})
    write("density", diary.density)
    means, _, _, opacities = sphere_shell(SHELL)
    shell = {"s_t": 0.06 * (2500 / SHELL) ** 0.5, "s_n": 0.01, "opacity": float(opacities[0])}
    write("sphere", shell | {"means": np.round(means, 5).tolist()})


if __name__ == "__main__":
    main()

"""How long does an iteration of the course's training take with the kernels and with the dense renderer?

    python benchmarks/sphere.py [--smoke] [--out FILE.json]

The chapter's run ends with 1,600 Gaussians at 128 px. From that scene, with a fixed number of Gaussians, the
benchmark times alternately the kernels, and the dense renderer with the chapter's chunks of 512 splats and with the
16 used for training. The kernels also train all 800 iterations.
"""

from __future__ import annotations

import dataclasses
import functools
import statistics
import time

import hardware
import torch

from gsplat_edu import Camera
from gsplat_edu.data.synthetic import SphereCapture, sphere_capture
from gsplat_edu.ops.losses import l1
from gsplat_edu.render.api import render
from gsplat_edu.render.backend import Backend
from gsplat_edu.render.backends import load_backend
from gsplat_edu.render.output import Extra, RenderOutput
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.render.torch import render as torch_reference
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.train import Start, Views, training
from gsplat_edu.train.course import EXTENT, course_config
from gsplat_edu.train.initialize import random_ball

SETTINGS = RenderSettings(depth=False)
NATIVE = functools.partial(render, backend="cpu")


def dense(chunk: int) -> Backend:
    """Return the dense backend that evaluates `chunk` splats at a time."""
    backend = load_backend("torch")

    def rasterize(
        gaussians: Gaussians, camera: Camera, settings: RenderSettings, extra: Extra
    ) -> RenderOutput:
        torch_reference.CHUNK = chunk
        return backend.rasterize(gaussians, camera, settings, extra)

    return dataclasses.replace(backend, rasterize=rasterize)


CHUNKS = (512, 16)


def whole_run(size: int, iterations: int) -> tuple[Gaussians, float]:
    """Train as in the chapter; return the scene and the milliseconds per iteration."""
    capture, config = sphere_capture_once(size), course_config(iterations)
    generator = torch.Generator().manual_seed(9)
    start = Start(random_ball(400, generator), extent=EXTENT, generator=generator)
    trainer = training(config, Views(capture.train), load_backend("cpu"), start)
    result = trainer.run()
    return trainer.gaussians, 1e3 * result.seconds / len(result.losses)


def iteration_ms(scene: Gaussians, backend: Backend, size: int, iterations: int) -> float:
    """Return milliseconds per iteration with a fixed number of Gaussians."""
    capture = sphere_capture_once(size)
    config = course_config(iterations=iterations).changed(strategy="none")
    trainer = training(config, Views(capture.train), backend, Start(scene, extent=EXTENT))
    return 1e3 * trainer.run().seconds / iterations


@functools.cache
def sphere_capture_once(size: int) -> SphereCapture:
    """Return the sphere capture, rendered once per size."""
    return sphere_capture(size)


def stages(scene: Gaussians, size: int, rounds: int) -> dict[str, float]:
    """Return milliseconds of each stage of an iteration with the kernels."""
    view = sphere_capture_once(size).train[0]
    target, leaves = torch.tensor(view.image), scene.trainable()
    names = ("project", "sort", "intersect", "composite", "composite_backward", "project_backward")
    found: dict[str, list[float]] = {name: [] for name in (*names, "render", "loss", "backward")}
    for _ in range(rounds):
        start = time.perf_counter()
        output = NATIVE(leaves, view.camera, settings=SETTINGS)
        frame = output.image.grad_fn.frame
        rendered = time.perf_counter()
        loss = l1(output.image, target)
        compared = time.perf_counter()
        loss.backward()
        done = time.perf_counter()
        for name, seconds in zip(names, frame.seconds, strict=True):
            found[name].append(seconds)
        found["render"].append(rendered - start)
        found["loss"].append(compared - rendered)
        found["backward"].append(done - compared)
    return {name: 1e3 * statistics.median(times) for name, times in found.items()}


def main() -> None:
    """Measure, print the table and write the JSON."""
    arguments = hardware.parser("The course's training: kernels against the dense renderer.").parse_args()
    size, iterations, few, rounds_of_stages, turns = (
        (16, 5, 1, 2, 1) if arguments.smoke else (128, 800, 200, 200, 3)
    )
    runs = [whole_run(size, iterations) for _ in range(turns)]
    scene = runs[0][0]
    rounds = []
    for _ in range(turns):
        rounds.append({"native": iteration_ms(scene, load_backend("cpu"), size, few)})
        rounds[-1] |= {
            f"dense {chunk}": iteration_ms(scene, dense(chunk), size, min(few, 3)) for chunk in CHUNKS
        }
    ratios = {name: statistics.median(r[name] / r["native"] for r in rounds) for name in rounds[0]}
    medians = {name: statistics.median(r[name] for r in rounds) for name in rounds[0]}
    split = stages(scene, size, rounds_of_stages)
    result = {
        "run_ms": [ms for _, ms in runs],
        "iteration_ms": medians,
        "times_native": ratios,
        "stages_ms": split,
    }
    hardware.report(result, arguments.out)
    print(
        f"{iterations} iterations, {turns} runs: {', '.join(f'{ms:.3f}' for _, ms in runs)} ms per iteration"
    )
    print(f"one iteration at K = {len(scene)}:")
    for name in medians:
        print(f"  {name:10} {medians[name]:10.3f} ms   {ratios[name]:8.1f} x the kernels")
    print("stages, ms: " + ", ".join(f"{name} {ms:.3f}" for name, ms in split.items()))


if __name__ == "__main__":
    main()

"""Check the engine on this computer's adapter, and measure its passes.

    python -m gsplat_edu.engine.check [--gaussians N] [--size WxH] [--rounds N] [--out FILE.json]

Scan and sort of a million numbers are compared with NumPy, two renders and their gradients with one another, and three
steps of training with the same three, bit by bit. Then the device measures every pass of a render, of its gradients and
of a step of training that stays on the device, with its own clock if it has one; the host measures how long it takes to
record and submit a step, and counts the bytes that cross. Beside the step's stages stands what a model computes for
them (`gsplat_edu.engine.model`). `render(..., backend="webgpu")` compares images and gradients with the CPU itself,
before its first use. Exits with 1 if a comparison fails, with 2 if there is no adapter.
"""

from __future__ import annotations

import argparse
import json
import platform
import sys
import time
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path

import numpy as np

from gsplat_edu.base.errors import BackendUnavailableError
from gsplat_edu.engine.adapters import adapters
from gsplat_edu.engine.frame import (
    GRADS,
    DeviceFrame,
    FrameGradients,
    Pool,
    Scene,
    differentiate_frame,
    draw_frame,
)
from gsplat_edu.engine.host import Device
from gsplat_edu.engine.measure import as_table, measure_step
from gsplat_edu.engine.passes import WORD, Buffer, Program, Size, scan, scan_scratch, sort, sort_scratch
from gsplat_edu.engine.view import DeviceView
from gsplat_edu.scene.camera import Camera

SUMMARY = "Check the engine on this computer's adapter, and measure its passes."

NUMBERS = 1 << 20
"""Numbers that are scanned and sorted."""

MANY, FEW = 1_000_000, 10_000
"""Gaussians that are measured on a GPU, and on an adapter that computes on the CPU."""

HARMONICS = 15
"""Harmonics of each, besides the first."""

PARTS = ("render", "composite_backward", "project_backward")
"""Parts of a program that are measured."""


def sort_and_scan() -> Program:
    """Return a program that sorts `keys` with `values` and scans `numbers`; `live` has count, a spare and the sum."""
    numbers = Size("keys")
    return Program(
        (
            Buffer("live", Size("live")),
            *(Buffer(name, numbers) for name in ("keys", "values", "numbers")),
            Buffer("sums", scan_scratch(numbers)),
            *sort_scratch("spare", "keys"),
        ),
        {
            "sort": sort("keys", "values", "spare", "keys", 0, 32, 1),
            "scan": scan("numbers", "sums", numbers, 2),
        },
    )


def _exact(device: Device, count: int) -> dict[str, bool]:
    """Return whether scan and sort of so many numbers are those of NumPy; a third of the keys are equal."""
    rng = np.random.default_rng(0)
    keys = rng.integers(0, 2**32, count, dtype=np.uint32)
    keys[::3] = 12345
    numbers = rng.integers(0, 2**11, count, dtype=np.uint32)
    memory = device.allocate(sort_and_scan(), {"keys": count, "live": 3}, poison=True)
    memory.write("live", np.array([count, 0, 0], dtype=np.uint32))
    memory.write("keys", keys)
    memory.write("values", np.arange(count, dtype=np.uint32))
    memory.write("numbers", numbers)
    order = memory.play("sort", read=("values",))["values"][:count]
    sums = memory.play("scan", read=("numbers",))["numbers"][:count]
    expected = np.cumsum(numbers, dtype=np.uint64) - numbers
    return {
        "the sort is stable and right": bool((order == np.argsort(keys, kind="stable")).all()),
        "the scan is right": bool((sums == expected).all()),
    }


def _random_scene(count: int) -> Scene:
    """Return random Gaussians in a cube of edge 2 around the origin, a few pixels large in a large image."""
    rng = np.random.default_rng(1)
    columns = (
        rng.uniform(-1, 1, (count, 3)),
        rng.normal(size=(count, 4)),
        rng.normal(size=(count, 3)) * 0.5 - 4.6,
        rng.normal(size=(count, 3)),
        rng.normal(size=(count, 1)),
    )
    rest = 0.2 * rng.normal(size=(count, HARMONICS, 3)).astype(np.float32)
    return Scene(np.concatenate(columns, axis=1).astype(np.float32), rest)


def _view(width: int, height: int) -> DeviceView:
    """Return a camera in front of that cube."""
    focal = 1.2 * width
    camera = Camera(np.eye(3), (0.0, 0.0, -3.0), focal, focal, width / 2, height / 2, height, width)
    return DeviceView(camera, (0.0, 0.0, 0.0), 3, False, 0.3, 1.3, 0.99, 0.05)


def _same_bits(first: tuple[DeviceFrame, FrameGradients], second: tuple[DeviceFrame, FrameGradients]) -> bool:
    """Return whether two frames and their gradients have the same bits."""
    return all(
        np.array_equal(getattr(one, name), getattr(other, name))
        for one, other, names in zip(
            first, second, (("image", "depth", "visible", "radii"), ("core", "rest", "camera")), strict=True
        )
        for name in names
    )


def measure_frame(pool: Pool, scene: Scene, view: DeviceView, rounds: int) -> tuple[bool, dict[str, object]]:
    """Render and differentiate; return whether two runs have the same bits, and what was counted and measured.

    Times are medians over the rounds, in milliseconds: of the device by part and entry point, and of the host's calls.
    """
    grads = np.random.default_rng(2).normal(size=(view.camera.H, view.camera.W, GRADS)).astype(np.float32)
    results: list[tuple[DeviceFrame, FrameGradients]] = []
    forward, backward = [], []
    for _ in range(max(rounds, 2) + 1):  # the first one compiles
        began = time.perf_counter()
        frame = draw_frame(pool, scene, view)
        drawn = time.perf_counter()
        gradients = differentiate_frame(frame, scene, grads, None)
        forward.append(1e3 * (drawn - began))
        backward.append(1e3 * (time.perf_counter() - drawn))
        results = [*results[-1:], (frame, gradients)]
    stages: dict[str, dict[str, float]] = {}
    if pool.device.measures:
        for part in PARTS:
            runs = [frame.memory.times(part) for _ in range(rounds)]
            stages[part] = {name: float(np.median([run[name] for run in runs])) for name in runs[0]}
    counted = {"visible": len(frame.visible), "pairs": frame.num_pairs}
    calls = {
        "draw_frame": float(np.median(forward[1:])),
        "differentiate_frame": float(np.median(backward[1:])),
    }
    return _same_bits(*results), {
        "counted": counted,
        "milliseconds of calls": calls,
        "milliseconds of passes": stages,
    }


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the checks; see the module."""
    parser = argparse.ArgumentParser(prog="python -m gsplat_edu.engine.check", description=SUMMARY)
    parser.add_argument(
        "--gaussians", type=int, help="default: 1000000, or what fits; 10000 if it computes on the CPU"
    )
    parser.add_argument("--size", default="990x742", help="of the image, px (default: 990x742)")
    parser.add_argument("--rounds", type=int, default=5, help="measurements of each pass (default: 5)")
    parser.add_argument("--out", type=Path, help="write the results as JSON")
    given = parser.parse_args(arguments)
    try:
        width, height = map(int, given.size.split("x"))
        report = _report(given.gaussians, width, height, given.rounds)
    except ValueError:
        parser.error(f"--size: is {given.size!r}, but has to be WIDTHxHEIGHT, such as 990x742")
    except BackendUnavailableError as error:
        print(error, file=sys.stderr)
        return 2
    print(json.dumps(report, indent=2))
    print(as_table(report["step"]["stages"]))  # type: ignore[arg-type]
    if given.out:
        given.out.write_text(json.dumps(report, indent=2) + "\n", encoding="utf-8")
    return 0 if all(report["checks"].values()) else 1


def default_count(software: bool, binding: int) -> int:
    """Return how many Gaussians to measure.

    Args:
        software: Whether the adapter computes on the CPU.
        binding: Bytes of its largest binding, into which their harmonics have to fit.
    """
    return FEW if software else min(MANY, binding // (WORD * 3 * HARMONICS))


def _report(given: int | None, width: int, height: int, rounds: int) -> dict[str, dict[str, object]]:
    device = Device.default()
    name, binding = device.name, device.limits["max-storage-buffer-binding-size"]
    count = default_count(name.software, binding) if given is None else given
    checks = _exact(device, min(NUMBERS, max(count, 1)))
    scene, view = _random_scene(count), _view(width, height)
    same, found = measure_frame(Pool(device), scene, view, rounds)
    step = measure_step(device, scene, view, rounds)
    return {
        "adapter": {"name": name.name, "kind": name.kind, "interface": name.interface, "driver": name.driver},
        "adapters": {str(place): other.name for place, other in enumerate(adapters())},
        "limits": dict(device.limits),
        "versions": {
            "wgpu": version("wgpu"),
            "python": platform.python_version(),
            "system": platform.platform(),
        },
        "scene": {"gaussians": count, "width": width, "height": height},
        "checks": {
            **checks,
            "two runs have the same bits": same,
            "two trainings have the same bits": step.same_bits,
        },
        "step": step.report(),
        **{key: value for key, value in found.items() if isinstance(value, dict)},
    }


if __name__ == "__main__":
    sys.exit(main())

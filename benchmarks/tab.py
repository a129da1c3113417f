"""How fast does the WebAssembly module train, and how well, beside the native module on one thread?

    python benchmarks/tab.py [CAPTURE] [--resolution F] [--iterations N] [--smoke] [--out FILE.json]

CAPTURE is anything that `gsplat-edu train` accepts (default: snowmiku97 in $GSPLAT_EDU_DATA or ../shared/data, or else
a procedural capture). Both train the recipe fast, with the same planned number of Gaussians, from the same points, on
the same photos: the native module with the instructions of AVX2 where the processor has them, and the WebAssembly
module in node. Figures are processor seconds of the whole training and after each quarter of it, PSNR of the held-out
views, and memory.
"""

from __future__ import annotations

import json
import os
import resource
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import hardware
import numpy as np
from captures import capture

ROOT = Path(__file__).resolve().parents[1]
QUARTERS = 4


def views_of(folder: Path, resolution: float) -> Any:  # noqa: ANN401
    """Return the dataset of a capture, undistorted to pinholes."""
    from gsplat_edu.data.dataset import load_dataset
    from gsplat_edu.data.settings import DataSettings

    return load_dataset(folder, DataSettings(resolution=resolution))


def native(folder: Path, resolution: float, iterations: int) -> dict[str, Any]:
    """Train with the native module on one thread; return the figures."""
    import torch

    from gsplat_edu.base.threads import native_threads
    from gsplat_edu.evaluate.metrics import psnr
    from gsplat_edu.render.api import render
    from gsplat_edu.render.backends import load_backend
    from gsplat_edu.render.settings import RenderSettings
    from gsplat_edu.train.compose import planned_cap, training
    from gsplat_edu.train.config import recipe

    torch.set_num_threads(1)
    assert native_threads() == 1
    dataset = views_of(folder, resolution)
    cap = planned_cap(dataset)
    trainer = training(recipe(iterations, strategy="fast", max_gaussians=cap), dataset, load_backend("cpu"))
    seconds, scores, begin = [], [], time.process_time()
    settings = RenderSettings(jacobian_limit=1.3)
    for quarter in range(1, QUARTERS + 1):
        trainer.run(lambda end=quarter: trainer.iteration * QUARTERS >= end * iterations)  # type: ignore[misc]
        seconds.append(time.process_time() - begin)
        paused = time.process_time()
        found = [
            psnr(render(trainer.gaussians, view.camera, settings=settings).image, view.read().image / 255)
            for view in dataset.test
        ]
        scores.append(float(np.mean(found)))
        begin += time.process_time() - paused
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    return {"cap": cap, "seconds": seconds, "psnr": scores, "GiB": memory}


def in_node(folder: Path, resolution: float, iterations: int, cap: int) -> dict[str, Any]:
    """Train with the WebAssembly module in node; return the figures."""
    from wasm_host import Host, options_of, view_of

    dataset = views_of(folder, resolution)
    node = shutil.which("node")
    if node is None:
        raise SystemExit("node is not installed")
    host = Host(node)
    host.ask("load", limit=4 << 30)
    settings = {"iterations": iterations, "maxGaussians": cap}
    host.ask("train", **options_of(list(dataset.train), dataset.points, dataset.colors, **settings))
    held_out = [view_of(view) for view in dataset.test]
    seconds, scores, taken = [], [], 0.0
    for quarter in range(1, QUARTERS + 1):
        begin = host.ask("facts")["seconds"]
        host.ask("step", count=iterations * quarter // QUARTERS - iterations * (quarter - 1) // QUARTERS)
        taken += host.ask("facts")["seconds"] - begin
        seconds.append(taken)
        scores.append(float(np.mean([host.ask("score", view=view)["psnr"] for view in held_out])))
    memory = host.ask("facts")["bytes"] / 2**30
    host.close()
    return {"seconds": seconds, "psnr": scores, "GiB": memory}


def main() -> None:
    """Train in both ways, and print the figures."""
    parser = hardware.parser(__doc__ or "")
    parser.add_argument("capture", nargs="?", type=Path)
    parser.add_argument(
        "--resolution", type=float, default=2.0, help="divisor of the photos' size (default: 2)"
    )
    parser.add_argument("--iterations", type=int, default=1_000)
    parser.add_argument("--natively", nargs=3, help="for the process that trains natively")
    options = parser.parse_args()
    if options.natively:
        folder, resolution, iterations = options.natively
        print(json.dumps(native(Path(folder), float(resolution), int(iterations))))
        return
    iterations, resolution = (12, 1.0) if options.smoke else (options.iterations, options.resolution)
    with capture(options.capture, options.smoke) as folder:
        from gsplat_edu import _native

        isa = "v3" if "v3" in _native.isas() else _native.isa()
        words = [sys.executable, __file__, "--natively", str(folder), str(resolution), str(iterations)]
        environment = os.environ | {"GSPLAT_EDU_ISA": isa, "OMP_NUM_THREADS": "1"}
        done = subprocess.run(words, env=environment, stdout=subprocess.PIPE, text=True, check=True)
        ours = json.loads(done.stdout.splitlines()[-1])
        theirs = in_node(folder, resolution, iterations, ours["cap"])
    print(
        f"{Path(folder).name}, photos divided by {resolution:g}, {iterations} iterations, {ours['cap']} Gaussians"
    )
    for name, found in ((f"native, {isa}", ours), ("WebAssembly", theirs)):
        per_step = 1e3 * found["seconds"][-1] / iterations
        quarters = ", ".join(
            f"{s:.1f} s {p:.2f} dB" for s, p in zip(found["seconds"], found["psnr"], strict=True)
        )
        print(f"{name:14} {per_step:7.1f} ms a step; {quarters}; {found['GiB']:.2f} GiB")
    print(f"ratio {theirs['seconds'][-1] / ours['seconds'][-1]:.2f}")
    hardware.report({"native": ours, "wasm": theirs}, options.out)


if __name__ == "__main__":
    sys.path.append(str(ROOT / "tools"))
    main()

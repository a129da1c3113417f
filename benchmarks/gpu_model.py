"""What would a training step cost on GPUs that are not at hand, by a model of its bytes and operations?

    python benchmarks/gpu_model.py [RUN] [--smoke] [--out FILE.json]

Everything in the table is computed, not measured: bytes and operations come from the shaders' text and the declared
buffers (gsplat_edu.engine.model has the assumptions), milliseconds from the peaks of GPUs. The counters are real: the
Gaussians of a run are drawn in each held-out view on the adapter of webgpu, which may compute on the processor, and the
median view by pairs counts. "Drawn" is the share of pixels, of all in the tile of a composited splat, that it draws.
Without a run, the counters are those of a typical scene of a million Gaussians at 990 x 742 px; with --smoke, those of
a random scene.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import hardware

import gpu
from gsplat_edu import Camera
from gsplat_edu.engine.frame import Pool, draw_frame
from gsplat_edu.engine.host import Device
from gsplat_edu.engine.measure import as_table
from gsplat_edu.engine.model import GPUS, PIXELS, Counters, forecast, step_costs
from gsplat_edu.render.api import render
from gsplat_edu.render.backends import load_backend, unavailable
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.render.webgpu.render import engine_view
from gsplat_edu.runs.cleaning import open_subject
from gsplat_edu.scene.gaussians import Gaussians


def counted(gaussians: Gaussians, cameras: list[Camera], settings: RenderSettings) -> tuple[Counters, float]:
    """Return the counters of the median view by pairs, and the share of its pixels and splats that meet."""
    pool, scene, found = Pool(Device.default()), gpu.packed(gaussians), []
    for camera in cameras:
        view = engine_view(camera, settings, settings.background, gaussians.sh_degree)
        frame = draw_frame(pool, scene, view)
        counters = Counters.of(frame.memory, scene.rest.shape[1], gaussians.sh_degree, (camera.W, camera.H))
        found.append((counters.pairs, len(found), counters))
        del frame
    _, place, counters = sorted(found)[len(found) // 2]
    output = render(gaussians.trainable(), cameras[place], settings=settings, backend="cpu")
    pixels = output.collect("pixels")
    output.image.sum().backward()
    return counters, float(pixels()["pixels"].sum()) / max(PIXELS * counters.taken, 1)


def main() -> int:
    """Print the forecast and write the JSON."""
    parser = hardware.parser("A training step on GPUs, by a model.")
    parser.add_argument(
        "run", nargs="?", type=Path, help="run whose Gaussians and held-out views are counted"
    )
    arguments = parser.parse_args()
    counts_here = arguments.run is not None or arguments.smoke
    if counts_here and (reason := unavailable("webgpu")):
        print(f"gpu_model.py: no GPU draws the scene: {reason}", file=sys.stderr)
        return 2
    result: dict[str, Any] = {"assumptions": "computed, not measured; see gsplat_edu.engine.model"}
    if arguments.run is not None:
        subject = open_subject(arguments.run, None, load_backend("cpu"))
        cameras = [view.camera for view in subject.dataset.test or subject.dataset.train]
        counters, result["drawn"] = counted(subject.source.scene.gaussians, cameras, subject.source.settings)
    elif arguments.smoke:
        gaussians, camera = gpu.scene(500, "cpu"), gpu.camera(64, 48)
        counters, result["drawn"] = counted(gaussians, [camera], gpu.SETTINGS)
    else:
        counters = Counters.assumed(1_000_000, (990, 742))
    rows = forecast((*step_costs(counters), *step_costs(counters, "noise")))
    result |= {"counted": dict(vars(counters)), "stages": rows}
    result["steps per s (computed)"] = {
        one.name: 1e3 / rows["step"][f"{one.name}, ms (computed)"] for one in GPUS
    }
    hardware.report(result, arguments.out)
    print("Computed by a model, not measured.")
    for name in ("counted", "drawn", "steps per s (computed)"):
        if name in result:
            print(f"{name}: {result[name]}")
    print(as_table(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())

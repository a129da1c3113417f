"""How long does `gsplat-edu mesh` take for a run of 100 photos, and how much memory, stage by stage?

    python benchmarks/mesh_run.py [--photos N] [--size PX] [--iterations N] [--keep FOLDER] [--texture]
                                  [--max-memory SIZE] [--threads N] [--smoke] [--out FILE.json]

Photographs the textured box, 100 photos of 800 x 800, and trains a run of them by the recipe `fast`. Start points lie
0.01 beside the surface. Then the command runs in its own process, which notes for each stage the seconds, the seconds
of all cores together (user and system), and the largest resident set (RSS). The load
of the machine before it is printed, because other programs make seconds longer, but hardly those of the cores.

--keep names a folder for capture and run; a run that is there is meshed again without a training. Needs Linux, for
/proc.
"""

from __future__ import annotations

import functools
import hashlib
import importlib
import json
import os
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import hardware
import numpy as np
import torch

from gsplat_edu.cli.main import main as command
from gsplat_edu.cli.running import run_command
from gsplat_edu.data.textured_box import box_orbit, photograph_box
from gsplat_edu.data.writers import write_transforms
from gsplat_edu.scene.views import View

POINTS = 60_000
"""Number of start points."""

NOISE = 0.01
"""Standard deviation of a start point's distance from the surface along each axis, world units."""

STAGES = {
    "read": ("gsplat_edu.cli.mesh", ("open_source", "open_subject")),
    "depth maps": ("gsplat_edu.mesh.extract", ("render_depths",)),
    "checks": ("gsplat_edu.mesh.extract", ("checked",)),
    "volume": ("gsplat_edu.mesh.extract", ("_integrate",)),
    "tidying": ("gsplat_edu.mesh.extract", ("tidied",)),
    "texture": ("gsplat_edu.cli.mesh", ("painted",)),
    "writing": ("gsplat_edu.cli.mesh", ("write_mesh",)),
    "held-out depths": ("gsplat_edu.cli.mesh", ("render_depths",)),
    "trust": ("gsplat_edu.cli.mesh", ("trust_of",)),
    "record": ("gsplat_edu.cli.mesh", ("write_mesh_record",)),
}
"""By stage, the module that calls it and the names that it is called by."""

GIB = 2.0**30


def make_capture(folder: Path, size: int, count: int) -> None:
    """Write the photos of the box and points near its surface."""
    from surfaces import box_of

    made = box_of(64, 8, 0, 0.06)
    rng = np.random.default_rng(0)
    corners = made.truth.corners
    area = np.linalg.norm(made.truth.face_normals(), axis=1)
    near = np.abs(corners).max(axis=(1, 2)) < 4.0
    face = rng.choice(len(corners), POINTS, p=area * near / (area * near).sum())
    weights = rng.dirichlet(np.ones(3), POINTS)
    points = np.einsum("nk,nkd->nd", weights, corners[face]) + NOISE * rng.normal(size=(POINTS, 3))
    cameras = box_orbit(count, size=(size, size))
    views = [View(camera, photograph_box(camera), name=f"{i:03d}.png") for i, camera in enumerate(cameras)]
    write_transforms(folder, views, points, np.full(points.shape, 0.5))


def measured(name: str, called: Callable[..., Any], table: dict[str, dict[str, float]]) -> Callable[..., Any]:
    """Wrap a function so that each call adds its cost to a row of the table."""

    @functools.wraps(called)
    def wrapper(*args: Any, **kwargs: Any) -> Any:  # noqa: ANN401
        forget_peak()
        began, used = time.perf_counter(), sum(os.times()[:2])
        try:
            return called(*args, **kwargs)
        finally:
            row = table.setdefault(name, {"seconds": 0.0, "cpu": 0.0, "peak": 0.0})
            row["seconds"] += time.perf_counter() - began
            row["cpu"] += sum(os.times()[:2]) - used
            row["peak"] = max(row["peak"], peak())

    return wrapper


def forget_peak() -> None:
    """Let the kernel note the largest resident set anew."""
    Path("/proc/self/clear_refs").write_text("5")


def peak() -> float:
    """Return the largest resident set since the last `forget_peak`, bytes."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return 1024.0 * next(int(line.split()[1]) for line in lines if line.startswith("VmHWM"))


def mesh_in_child(words: list[str], note: Path, threads: int | None) -> None:
    """Run the command, and write its stages to a file."""
    if threads is not None:
        torch.set_num_threads(threads)
    table: dict[str, dict[str, float]] = {}
    for stage, (name, functions) in STAGES.items():
        module = importlib.import_module(name)
        for function in functions:
            setattr(module, function, measured(stage, getattr(module, function), table))
    volume = importlib.import_module("gsplat_edu.mesh.volume").SparseVolume
    volume.mesh = measured("marching cubes", volume.mesh, table)
    code = command(words)
    note.write_text(json.dumps(table))
    sys.stdout.flush()
    os._exit(code)


def mesh(words: list[str], note: Path, threads: int | None) -> dict[str, Any]:
    """Run the command in a process of its own, and return what it took."""
    load, began = os.getloadavg()[0], time.perf_counter()
    sys.stdout.flush()
    arguments = [sys.executable, __file__, "--child", json.dumps([words, str(note), threads])]
    pid = os.spawnv(os.P_NOWAIT, sys.executable, arguments)
    _, status, usage = os.wait4(pid, 0)
    if status:
        raise SystemExit("mesh_run.py: the command failed")
    stages = json.loads(note.read_text())
    return {
        "load before": load,
        "seconds": time.perf_counter() - began,
        "cpu": usage.ru_utime + usage.ru_stime,
        "peak": max(row["peak"] for row in stages.values()),
        "stages": stages,
    }


def measure(options: Any) -> None:  # noqa: ANN401
    """Make the run unless it is there, mesh it, and print the table."""
    size, count, iterations = (
        (64, 8, 60) if options.smoke else (options.size, options.photos, options.iterations)
    )
    with tempfile.TemporaryDirectory() as scratch:
        folder = options.keep or Path(scratch)
        run, capture, out = folder / "run", folder / "capture", folder / "box.glb"
        if not (run / "point_cloud").exists():
            make_capture(capture, size, count)
            words = ["train", str(capture), "--strategy", "fast", "--iterations", str(iterations)]
            if command([*words, "--eval-every", "0", "--out", str(run)]):
                raise SystemExit("mesh_run.py: the training failed")
        extra = ["--texture"] * options.texture
        extra += ["--max-memory", options.max_memory] * (options.max_memory is not None)
        found = mesh(["mesh", str(run), str(out), *extra], folder / "stages.json", options.threads)
        found["sha256"] = hashlib.sha256(out.read_bytes()).hexdigest()
    rows = found["stages"] | {"command": {k: found[k] for k in ("seconds", "cpu", "peak")}}
    print(f"load before: {found['load before']:.1f}; sha256 of the mesh {found['sha256'][:16]}")
    print(f"{'':18}{'seconds':>10}{'cores, s':>10}{'peak, GiB':>11}")
    for name, row in rows.items():
        print(f"{name:18}{row['seconds']:10.1f}{row['cpu']:10.1f}{row['peak'] / GIB:11.2f}")
    hardware.report({"mesh_run": found, "photos": count, "size": size}, options.out)


def main() -> int:
    """Read the command line and measure."""
    if sys.argv[1:2] == ["--child"]:
        words, note, threads = json.loads(sys.argv[2])
        mesh_in_child(words, Path(note), threads)
    parser = hardware.parser(__doc__.partition("\n")[0])
    parser.add_argument("--photos", type=int, default=100, help="number (default: %(default)s)")
    parser.add_argument("--size", type=int, default=800, help="sides of a photo, px (default: %(default)s)")
    parser.add_argument("--iterations", type=int, default=600, help="steps (default: %(default)s)")
    parser.add_argument("--keep", type=Path, help="folder of capture and run (default: a temporary one)")
    parser.add_argument("--texture", action="store_true", help="paint the mesh with the photos")
    parser.add_argument("--max-memory", metavar="SIZE", help="that of the command (default: what is free)")
    parser.add_argument("--threads", type=int, help="threads of the command (default: its own choice)")
    options = parser.parse_args()
    return run_command("mesh_run.py", lambda: measure(options), debug=False)


if __name__ == "__main__":
    sys.exit(main())

"""Does the memory of a training stay constant over its iterations?

    python benchmarks/memory.py [--smoke] [--size PX] [--photos N] [--iterations N] [--keep FOLDER] [--out FILE.json]
                                [-- options of gsplat-edu train]

Makes a capture in Blender's layout: RGBA photos of a patterned ball. Runs `gsplat-edu train` on it in its own process,
with few Gaussians so that images dominate the memory. Reads the resident set size (RSS) of that process from /proc
while the log grows; wait4 reports the peak. Prints a table of iterations and RSS. The default is 5,000 iterations
with 100 photos of 800 x 800 on white. Needs Linux, for /proc.
"""

from __future__ import annotations

import argparse
import json
import math
import multiprocessing
import os
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

COMMAND = "import sys; from gsplat_edu.cli.main import main; sys.exit(main())"

OPTIONS = "--strategy adc --white-background --max-gaussians 2000 --no-rescale --eval-every 0"
"""Default options of the training."""

TEST_PHOTOS = 4

INTERVAL = 0.1
"""Seconds between readings."""

ROWS = 12
"""Rows of the printed table."""

MIB = 2.0**20


def make_capture(folder: Path, size: int, count: int) -> None:
    """Photograph a patterned ball from a spiral of cameras; alpha falls from 1 to 0 within a pixel at its rim.

    Args:
        folder: The capture, in Blender's layout.
        size: Height and width of the photos, px.
        count: Number of training photos.
    """
    from gsplat_edu.data.writers import write_blender
    from gsplat_edu.scene.camera import Camera, look_at
    from gsplat_edu.scene.views import View

    views, total, focal = [], count + TEST_PHOTOS, 1.2 * size
    for i in range(total):
        height, turn = 1.6 * (i + 0.5) / total - 0.8, 2.4 * i  # the golden angle
        across = math.sqrt(1 - height * height)
        eye = 3.0 * np.array([across * math.sin(turn), height, across * math.cos(turn)])
        camera = Camera(
            look_at(eye, np.zeros(3)), eye, focal, focal, (size - 1) / 2, (size - 1) / 2, size, size
        )
        image, alpha = _photograph(camera)
        views.append(View(camera, image, alpha=alpha, name=f"photo_{i:03d}.png"))
    write_blender(folder, views[:count], views[count:])


def _photograph(camera: Any) -> tuple[np.ndarray, np.ndarray]:  # noqa: ANN401
    """Render a ball of radius 1 around the origin by ray casting; return RGB and alpha."""
    u, v = np.meshgrid(np.arange(camera.W) - camera.cx, np.arange(camera.H) - camera.cy)
    rays = np.stack([u / camera.fx, v / camera.fy, np.ones_like(u)], axis=-1) @ camera.R
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    along = -rays @ camera.eye
    miss = np.sqrt(camera.eye @ camera.eye - along**2)
    hit = camera.eye + (along - np.sqrt(np.maximum(1 - miss**2, 0)))[..., None] * rays
    color = 0.5 + 0.25 * np.sin(9 * hit) + 0.2 * np.sin(31 * hit[..., [1, 2, 0]] + 1)
    pixel = np.linalg.norm(camera.eye) / camera.fx
    alpha = np.clip(0.5 + (1 - miss) / pixel, 0, 1)
    return np.round(255 * color).astype(np.uint8), np.round(255 * alpha).astype(np.uint8)


def watch(capture: Path, run: Path, words: list[str]) -> dict[str, Any]:
    """Train in a separate process; return its curve [iteration, RSS in bytes], peak, seconds, exit code and output.

    Args:
        capture: The capture to train on.
        run: The run's folder; the command's output is written beside it.
        words: Options of the training.
    """
    command = [sys.executable, "-c", COMMAND, "train", str(capture), "--out", str(run), *words]
    curve: list[list[int]] = []
    with run.with_suffix(".txt").open("w") as said:
        actions = [(os.POSIX_SPAWN_DUP2, said.fileno(), descriptor) for descriptor in (1, 2)]
        began = time.perf_counter()
        child = os.posix_spawn(command[0], command, os.environ, file_actions=actions)
        while True:
            ended, status, usage = os.wait4(child, os.WNOHANG)
            if ended:
                break
            iteration = _last_iteration(run / "log.jsonl")
            if iteration and (not curve or iteration > curve[-1][0]) and (resident := _resident(child)):
                curve.append([iteration, resident])
            time.sleep(INTERVAL)
    return {
        "curve": curve,
        "peak_rss": 1024 * usage.ru_maxrss,
        "seconds": time.perf_counter() - began,
        "code": os.waitstatus_to_exitcode(status),
        "said": run.with_suffix(".txt").read_text(),
    }


def _resident(process: int) -> int:
    """Return the RSS of a process in bytes; 0 after it has ended."""
    try:
        fields = Path(f"/proc/{process}/statm").read_text().split()
    except (FileNotFoundError, ProcessLookupError):
        return 0
    return int(fields[1]) * os.sysconf("SC_PAGE_SIZE") if len(fields) > 1 else 0


def _last_iteration(log: Path) -> int:
    """Return the iteration of the log's last complete line; 0 if there is none."""
    try:
        with log.open("rb") as file:
            file.seek(max(0, log.stat().st_size - 1000))
            lines = file.read().split(b"\n")[:-1]
        return int(json.loads(lines[-1])["iteration"]) if lines else 0
    except (FileNotFoundError, ValueError, KeyError):
        return 0


def table(curve: list[list[int]]) -> list[list[int]]:
    """Pick rows evenly spaced in iterations, including the first and the last."""
    if not curve:
        return []
    wanted = np.linspace(curve[0][0], curve[-1][0], ROWS)
    iterations = np.array([iteration for iteration, _ in curve])
    return [curve[k] for k in sorted({int(np.abs(iterations - moment).argmin()) for moment in wanted})]


def main() -> None:
    """Make the capture, train, print the table and write the JSON."""
    made = argparse.ArgumentParser(description="Memory of a training by iteration.")
    made.add_argument("--smoke", action="store_true", help="a tiny capture and a few iterations, as a test")
    made.add_argument("--size", type=int, default=800, help="height and width of the photos, px")
    made.add_argument("--photos", type=int, default=100, help="number of training photos")
    made.add_argument("--iterations", type=int, default=5_000)
    made.add_argument("--keep", type=Path, help="folder for capture and run (default: a temporary one)")
    made.add_argument("--out", type=Path, help="JSON file to write")
    made.add_argument(
        "options", nargs="*", help=f"options of gsplat-edu train, after -- (default: {OPTIONS})"
    )
    given = made.parse_args()
    if given.smoke:
        given.size, given.photos, given.iterations = 48, 4, 60
    options = given.options or OPTIONS.split()
    with tempfile.TemporaryDirectory() as scratch:
        folder = given.keep or Path(scratch)
        capture, run = folder / "capture", folder / "run"
        if (
            not capture.exists()
        ):  # made in another process, because a child's peak includes its parent's memory at the start
            maker = multiprocessing.get_context("spawn").Process(
                target=make_capture, args=(capture, given.size, given.photos)
            )
            maker.start()
            maker.join()
            if maker.exitcode:
                raise SystemExit(f"memory.py: making the capture failed with exit code {maker.exitcode}")
        found = watch(capture, run, ["--iterations", str(given.iterations), *options])
    print("iteration  RSS MiB")
    for iteration, resident in table(found["curve"]):
        print(f"{iteration:9,}  {resident / MIB:7.1f}")
    print(f"peak {found['peak_rss'] / MIB:.1f} MiB, {found['seconds']:.1f} s")
    if found["code"]:
        raise SystemExit(
            f"memory.py: the training failed with exit code {found['code']}: {found['said'].strip()[-500:]}"
        )
    import hardware  # imported late, because torch's memory would count as the child's

    parts = ("curve", "peak_rss", "seconds")
    hardware.report(
        {
            "size": given.size,
            "photos": given.photos,
            "options": options,
            **{name: found[name] for name in parts},
        },
        given.out,
    )


if __name__ == "__main__":
    main()

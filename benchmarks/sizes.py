"""Held-out PSNR of files of limited size: `convert --size`, and splat-transform with as many bytes.

    python benchmarks/sizes.py RUN [MB ...]

splat-transform (npm ci --prefix tests/npm) removes splats by `-d`, for each SH degree as few as the budget allows; the
best of its degrees counts. Both write SPZ. Photos are those of the run's test views.
"""

from __future__ import annotations

import functools
import subprocess
import sys
import tempfile
from pathlib import Path

from gsplat_edu.evaluate.metrics import score_views, summarize
from gsplat_edu.io.axes import half_turned
from gsplat_edu.io.formats import write_scene
from gsplat_edu.io.scene import Scene
from gsplat_edu.render.api import render
from gsplat_edu.render.backends import load_backend
from gsplat_edu.runs.cleaning import open_subject
from gsplat_edu.runs.importance import importance_of
from gsplat_edu.runs.source import Source, open_source
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.viewer.export import read_back
from gsplat_edu.viewer.page import Tour
from gsplat_edu.viewer.sizing import write_sized

PROGRAM = (
    Path(__file__).parents[1] / "tests" / "npm" / "node_modules" / "@playcanvas" / "splat-transform" / "bin"
)

SIZES = (0.5, 1.0, 2.0, 4.0)
"""Budgets, MB of 10⁶ bytes."""

HALVINGS = 9
"""Steps of the search for the number of splats."""


def converted(*words: object) -> None:
    """Run splat-transform."""
    command = ["node", PROGRAM / "cli.mjs", "-q", "-w", "-g", "cpu", *words]
    subprocess.run(list(map(str, command)), check=True, capture_output=True)


def theirs(scene: Path, degree: int, most: int, out: Path) -> int:
    """Write the largest SPZ of splat-transform within a budget; return its number of splats."""
    low, high, best = 0, len(read_back(scene).gaussians), 0
    for _ in range(HALVINGS):
        count = (low + high) // 2
        converted(scene, "-H", degree, out.with_suffix(".ply"), "-d", count)
        converted(out.with_suffix(".ply"), out.with_suffix(".try.spz"))
        if out.with_suffix(".try.spz").stat().st_size <= most:
            low = best = count
            out.with_suffix(".try.spz").replace(out)
        else:
            high = count
    return best


def main(run: str, *sizes: str) -> None:
    """Print a row for each size."""
    source: Source = open_source(run)
    views = open_subject(source.path, None, load_backend("cpu")).dataset.test
    shown = functools.partial(render, settings=source.settings, backend="cpu")

    def scored(gaussians: Gaussians) -> str:
        found = summarize(score_views(gaussians, views, shown, source.settings.background))
        return f"{len(gaussians):,} splats, {found['psnr']:.2f} dB, SSIM {found['ssim']:.4f}"

    print(f"scene: {scored(source.scene.gaussians)}", flush=True)
    importance = importance_of(source)
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        write_scene(place / "scene.ply", Scene(source.scene.gaussians))
        for size in map(float, sizes or SIZES):
            most = round(1e6 * size)
            write_sized(place / "ours.spz", source, Tour(), importance, most)
            ours = read_back(place / "ours.spz").relative_to(source.origin)
            print(
                f"{size} MB, ours: {(place / 'ours.spz').stat().st_size:,} bytes, {scored(ours)}", flush=True
            )
            for degree in range(4):
                if not theirs(place / "scene.ply", degree, most, place / "theirs.spz"):
                    continue
                back = half_turned(read_back(place / "theirs.spz").gaussians)  # it does not turn an SPZ
                used = (place / "theirs.spz").stat().st_size
                print(f"{size} MB, splat-transform, SH {degree}: {used:,} bytes, {scored(back)}", flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])

"""How long does each format take to write and read a scene, how large is the file, and how accurate is it?

    python benchmarks/formats.py [SCENE|RUN] [--count N] [--formats .ply .spz ...] [--smoke]
        [--out FILE.json]

Without a scene, N random Gaussians of SH degree 3 (default: a million) are written and read, but not rendered. Their
file sizes differ from those of trained scenes. For a scene, PSNR is that of `gsplat-edu convert --verify`. Each time is
the best of three in one process, with the file in the operating system's cache.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import hardware
import torch

from gsplat_edu.cli.running import run_command
from gsplat_edu.io.formats import FORMATS
from gsplat_edu.io.scene import Scene
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.runs.source import Source, open_source
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.viewer import export

ROUNDS = 3


def random_source(count: int) -> Source:
    """Make Gaussians with the sizes and opacities typical of scenes."""
    generator = torch.Generator().manual_seed(0)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator)

    gaussians = Gaussians(
        means=normal(count, 3),
        quats=normal(count, 4),
        log_scales=0.7 * normal(count, 3) - 4.5,
        sh0=normal(count, 1, 3),
        sh_rest=0.1 * normal(count, 15, 3),
        logit_opacities=1.5 * normal(count),
    )
    return Source(Path("random"), Scene(gaussians, False), (), RenderSettings(depth=False))


def best(call: Callable[[], object], rounds: int) -> float:
    """Return the shortest time of several rounds, s."""
    times = []
    for _ in range(rounds):
        began = time.perf_counter()
        call()
        times.append(time.perf_counter() - began)
    return min(times)


def measure(source: Source, suffix: str, folder: Path, compare: bool, rounds: int) -> dict[str, Any]:
    """Measure one format: writing, reading, file size and, with `compare`, PSNR."""
    path = folder / f"scene{suffix}"
    row: dict[str, Any] = {"format": suffix}
    row["write_s"] = best(lambda: export.write(path, source), rounds)
    row["read_s"] = best(lambda: export.read_back(path), rounds)
    row["bytes_per_splat"] = path.stat().st_size / len(source.scene.gaussians)
    if compare:
        row["psnr"] = export.check(path, source, "cpu").psnr
    path.unlink()
    return row


def main() -> int:
    """Read the command line and measure."""
    parser = hardware.parser("Every scene format: time, size and accuracy.")
    parser.add_argument("scene", nargs="?", type=Path, help="scene or run (default: random Gaussians)")
    parser.add_argument(
        "--count", type=int, default=1_000_000, help="random Gaussians (default: %(default)s)"
    )
    suffixes = [*(found.suffix for found in FORMATS), export.PAGE]
    parser.add_argument(
        "--formats", nargs="+", default=suffixes, metavar="SUFFIX", help="formats to measure (default: all)"
    )
    parser.add_argument("--rounds", type=int, default=ROUNDS, help="repetitions (default: %(default)s)")
    options = parser.parse_args()
    if options.smoke:
        options.count, options.rounds = min(options.count, 300), 1

    def run() -> None:
        source = open_source(options.scene) if options.scene else random_source(options.count)
        print(f"{source.path}: {len(source.scene.gaussians):,} Gaussians, {torch.get_num_threads()} threads")
        rows = []
        with tempfile.TemporaryDirectory() as folder:
            for suffix in options.formats:
                row = measure(source, suffix, Path(folder), options.scene is not None, options.rounds)
                shown = f"{row['psnr']:8.2f} dB" if "psnr" in row else ""
                times = f"write {row['write_s']:7.2f} s   read {row['read_s']:7.2f} s"
                print(
                    f"{suffix:16} {times}   {row['bytes_per_splat']:7.1f} bytes per splat {shown}", flush=True
                )
                rows.append(row)
        hardware.report(
            {"scene": source.path.name, "count": len(source.scene.gaussians), "formats": rows}, options.out
        )

    return run_command("formats.py", run, debug=False)


if __name__ == "__main__":
    sys.exit(main())

"""Which quality does `train` reach in how much time, counted from the start of the command?

    python benchmarks/quality_over_time.py [CAPTURE ...] --out FILE.json [--lengths N ...] [--seeds N]
        [--options "WORDS"] [--beside FILE.json ...] [--smoke]

Each point is a whole command in a process of its own: imports, reading, the comparison of poses and photos, training,
scoring and report. Its wall and processor time are those of wait4, its PSNR that of the held-out photos. A length
is a number of iterations; the recipe plans each of them anew, so that the curve is that of commands, not of one run.

FILE.png beside FILE.json draws PSNR over both times, and runs of other files of this kind beside them: those of an
older commit, or of another program whose figures were written down in the same fields.
"""

from __future__ import annotations

import argparse
import json
import shlex
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from captures import capture
from limits import train

TIMES = {"processor_seconds": "processor time of the command (s)", "seconds": "wall time of the command (s)"}
"""The times that are drawn, and their labels."""


def measured(
    captures: Sequence[Path], lengths: Sequence[int], seeds: int, words: list[str]
) -> list[dict[str, Any]]:
    """Run every command; print a row for each of them, and return all rows."""
    rows = []
    for folder in captures:
        for length in lengths:
            for seed in range(seeds):
                own = ["--iterations", str(length), "--seed", str(seed)]
                found = train(folder, [*own, *words])
                row = {"capture": folder.name, "length": length, "seed": seed}
                rows.append(
                    row | {key: found[key] for key in (*TIMES, "test_psnr", "num_gaussians", "peak_rss")}
                )
                print(
                    f"{folder.name} {length:6} seed {seed}: {row_text(rows[-1])}, {found['num_gaussians']:,} Gaussians",
                    flush=True,
                )
    return rows


def row_text(row: Mapping[str, Any]) -> str:
    """Return a point in words."""
    times = f"{row['processor_seconds']:.1f} s of processor, {row['seconds']:.1f} s of wall time"
    return f"{row['test_psnr']:.2f} dB after {times}"


def draw(named: Mapping[str, Sequence[Mapping[str, Any]]], path: Path) -> None:
    """Draw PSNR over time: a row for each capture, a colour for each file.

    Args:
        named: The runs by the name of their file.
        path: The PNG to write.
    """
    from matplotlib.figure import Figure

    from gsplat_edu.evaluate.figures import save_figure

    captures = list(dict.fromkeys(run["capture"] for runs in named.values() for run in runs))
    drawn = Figure(figsize=(11, 3.5 * len(captures)), layout="constrained")
    for name, axes_of in zip(captures, drawn.subplots(len(captures), 2, squeeze=False), strict=True):
        for axes, (key, label) in zip(axes_of, TIMES.items(), strict=True):
            for color, (file, runs) in enumerate(named.items()):
                own = [run for run in runs if run["capture"] == name]
                axes.plot(
                    *([run[field] for run in own] for field in (key, "test_psnr")),
                    "o",
                    color=f"C{color}",
                    label=file,
                )
            axes.set(title=name, xlabel=label, ylabel="PSNR of held-out photos (dB)", xscale="log")
            axes.grid(alpha=0.3, which="both")
    drawn.axes[0].legend(fontsize=8)
    save_figure(path, drawn)


def main() -> None:
    """Read the command line, run the commands, write the JSON and the picture."""
    made = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    made.add_argument("captures", nargs="*", type=Path)
    made.add_argument("--lengths", nargs="+", type=int, default=[300, 1000, 3000], metavar="N")
    made.add_argument("--seeds", type=int, default=3, help="seeds 0 to N - 1 (default: 3)")
    made.add_argument("--options", default="", help="further words of train, in one string")
    made.add_argument("--beside", nargs="+", type=Path, default=[], metavar="FILE.json")
    made.add_argument("--out", type=Path, required=True, help="JSON file to write, with a PNG beside it")
    made.add_argument("--smoke", action="store_true", help="two tiny commands")
    arguments = made.parse_args()
    lengths, seeds = ([2, 4], 1) if arguments.smoke else (arguments.lengths, arguments.seeds)
    with capture(arguments.captures[0] if arguments.captures else None, arguments.smoke) as first:
        folders = [first, *arguments.captures[1:]]
        rows = measured(folders, lengths, seeds, shlex.split(arguments.options))
    others = {path.stem: json.loads(path.read_text())["runs"] for path in arguments.beside}
    import hardware  # imported late, because torch's memory would count as the children's

    hardware.report({"options": arguments.options, "runs": rows}, arguments.out)
    draw({arguments.out.stem: rows, **others}, arguments.out.with_suffix(".png"))


if __name__ == "__main__":
    sys.exit(main())

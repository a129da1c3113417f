"""How long does a training of a capture take, and how do the stages of an iteration change as the scene grows?

    python benchmarks/train_capture.py [CAPTURE] [--run FOLDER] [--smoke] [--out FILE.json] [options of train]

Trains as `gsplat-edu train CAPTURE --strategy adc --iterations 7000` does (default: snowmiku97 in $GSPLAT_EDU_DATA or
../shared/data, or else a procedural capture). Times the stages of an iteration at the start, after 1,000 and 3,000
iterations, and at the end: medians over 20 views. The wall time includes checkpoints and evaluations but not these
measurements.
"""

from __future__ import annotations

import argparse
import resource
import sys
import tempfile
from pathlib import Path

import hardware
from captures import capture
from train_step import STAGES, measure

from gsplat_edu.budget.plan import Limits, plan
from gsplat_edu.cli.running import run_command
from gsplat_edu.options import train as command
from gsplat_edu.options.parser import OneLineParser
from gsplat_edu.runs.training import CaptureRun, document
from gsplat_edu.train.events import Event, StepEvent
from gsplat_edu.train.trainer import Trainer

MOMENTS = (0, 1_000, 3_000)
ROWS = (*STAGES, "loss", "Adam", "rest", "iteration", "pairs")


def train(options: argparse.Namespace, out: Path | None) -> None:
    """Train, measure at `MOMENTS`, then print and write the results."""
    run = CaptureRun(plan(command.options_from(options), Limits()).options, print)
    table: dict[int, dict[str, float]] = {}

    def take_apart(trainer: Trainer, event: Event) -> None:
        if isinstance(event, StepEvent) and trainer.iteration in MOMENTS:
            with run.clock_stopped():
                table[trainer.iteration] = measure(trainer.gaussians, run.dataset.train)

    trainer = run.trainer
    table[0] = measure(trainer.gaussians, run.dataset.train)
    run.train(callbacks=[take_apart])
    table[trainer.iteration] = measure(trainer.gaussians, run.dataset.train)
    evaluation = run.finish()
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    result = {"seconds": run.seconds, "peak_rss_gib": peak, "metrics": evaluation.metrics, "stages_ms": table}
    hardware.report({"capture": options.data.name, "config": document(run.options), **result}, out)
    metrics = evaluation.metrics
    print(
        f"{trainer.iteration} iterations in {run.seconds:.0f} s, {len(trainer.gaussians)} Gaussians, "
        f"peak {peak:.2f} GiB"
    )
    for split in ("test", "train"):
        if metrics[split]["num_images"]:
            print(f"{split}: PSNR {metrics[split]['psnr']:.3f} dB, SSIM {metrics[split]['ssim']:.4f}")
    print(f"{'ms after iterations':20}" + "".join(f"{moment:12}" for moment in table))
    for name in ROWS:
        print(f"{name:20}" + "".join(f"{found[name]:12.2f}" for found in table.values()))


def main() -> int:
    """Read the command line and train."""
    outer = argparse.ArgumentParser(add_help=False)
    hardware.add_options(outer)
    outer.add_argument("--run", type=Path, help="folder of the run (default: a temporary one)")
    mine, theirs = outer.parse_known_args()
    parser = OneLineParser(
        prog="train_capture.py", description="A whole training of a capture, timed by stage."
    )
    command.add_arguments(parser)
    named = None if not theirs or theirs[0].startswith("-") else Path(theirs.pop(0))
    words = ["--strategy", "adc", "--iterations", "10" if mine.smoke else "7000"]
    with tempfile.TemporaryDirectory() as scratch, capture(named, mine.smoke) as data:
        folder = str(mine.run or Path(scratch) / "run")
        options = parser.parse_args([str(data), *words, *theirs, "--out", folder])
        return run_command("train_capture.py", lambda: train(options, mine.out), debug=False)


if __name__ == "__main__":
    sys.exit(main())

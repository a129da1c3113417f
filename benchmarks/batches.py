"""How do batches change the quality, and how many bytes do several processes send?

    python benchmarks/batches.py [CAPTURE] [--resolution R] [--iterations N] [--smoke] [--out FILE.json]

Trains CAPTURE (anything that `gsplat-edu train` accepts with poses) with batches of 1, 2 and 4 views and the same
number of images, and scores the held-out photos. Then torchrun trains with a batch of 4 on one and on two processes
of one thread each, and bytes and time are counted. The processes share this machine, so the speed-up of several
machines is modelled, not measured:

    step(N) = shared / N + repeated + messages(N) + bytes(N) / bandwidth

"shared" and "repeated" follow from the processor time of a step on one and on two processes.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import hardware
from captures import capture

from gsplat_edu.budget.plan import Limits, plan
from gsplat_edu.data.settings import DataSettings
from gsplat_edu.evaluate.metrics import score_views, summarize
from gsplat_edu.jobs.ranks import num_processes
from gsplat_edu.runs.options import RunOptions
from gsplat_edu.runs.processes import Member, Processes, joined
from gsplat_edu.runs.training import CaptureRun
from gsplat_edu.train.config import recipe
from gsplat_edu.train.team import ALONE

BATCHES = (1, 2, 4)
SHARED = 4
"""Batch of the training on two processes."""
MACHINES = (2, 4, 8)
MODELLED = (8, 32)
"""Batches of the model."""
NETWORKS = {"1 Gbit/s": 1e9 / 8, "10 Gbit/s": 10e9 / 8}
"""Bytes per second that a machine sends and receives at the same time: the nominal rate in both directions."""
LATENCY = 1e-4
"""Assumed latency of a message between two machines, s."""
MESSAGES = 6
"""Number of messages that a process waits for in a step: lengths and contents of gradients, Gaussians, stop flag."""


@dataclass(frozen=True)
class Steps:
    """Means over the steps in the second half of a training, in one process.

    Args:
        gaussians: Number of Gaussians.
        sent: Bytes sent.
        wall: Seconds.
        waited: Seconds in exchanges.
        compute: Processor seconds outside of exchanges.
        exchange: Processor seconds of exchanges: packing, copying and the kernel's part of sending.
    """

    gaussians: float
    sent: float
    wall: float
    waited: float
    compute: float
    exchange: float


def options(folder: Path, out: Path, resolution: float | None, iterations: int, batch: int) -> RunOptions:
    """Return the options of a training by the recipe fast with a planned number of Gaussians."""
    config = recipe(iterations, strategy="fast", batch=batch)
    settings = DataSettings(resolution=resolution)
    given = RunOptions(folder, out, config, settings, eval_every=0, save_every=0)
    return plan(given, Limits(), ["iterations"]).options


def train(given: RunOptions, team: Member = ALONE) -> tuple[CaptureRun, Steps]:
    """Train, and measure the second half of the steps."""
    run = CaptureRun(given, team=team)
    half, marks, counts = given.config.iterations // 2, list[tuple[float, ...]](), list[int]()

    def note(*_: object) -> None:
        if run.trainer.iteration < half:
            return
        several = isinstance(team, Processes)
        exchanged = (team.sent, team.waited, team.worked) if several else (0.0, 0.0, 0.0)
        marks.append((*exchanged, time.perf_counter(), time.process_time(), run.trainer.iteration))
        counts.append(len(run.trainer.gaussians))

    run.train(callbacks=[note])
    sent, waited, worked, wall, processor, images = (b - a for a, b in zip(marks[0], marks[-1], strict=True))
    steps = max(images / given.config.batch, 1)
    sums = sent, wall, waited, processor - worked, worked
    return run, Steps(sum(counts) / len(counts), *(value / steps for value in sums))


def score(run: CaptureRun) -> float:
    """Return the mean PSNR of the held-out photos, dB."""
    given = run.options
    scores = score_views(run.trainer.gaussians, run.dataset.test, given.renderer, given.config.background)
    return float(summarize(scores)["psnr"])


def quality(folder: Path, arguments: Any) -> dict[str, Any]:  # noqa: ANN401
    """Train with each batch; print and return the scores."""
    found = {}
    for batch in BATCHES:
        with TemporaryDirectory() as out:
            given = options(folder, Path(out) / "run", arguments.resolution, arguments.iterations, batch)
            run, steps = train(given)
        found[batch] = {"psnr": score(run), "gaussians": len(run.trainer.gaussians), "steps": asdict(steps)}
        print(
            f"batch {batch}: {given.config.iterations} images, held-out PSNR {found[batch]['psnr']:.2f} dB,"
            f" {found[batch]['gaussians']} Gaussians, {1e3 * steps.compute / batch:.1f} ms of processor time per image",
            flush=True,
        )
    return found


def on_two(folder: Path, arguments: Any) -> dict[str, Steps]:  # noqa: ANN401
    """Train on one and on two processes of one thread each; return the means of their steps."""
    found = {}
    for size in (1, 2):
        with TemporaryDirectory() as scratch:
            out = Path(scratch) / "steps.json"
            launcher = ["-m", "torch.distributed.run", "--standalone", f"--nproc-per-node={size}"]
            words = [str(folder), "--iterations", str(arguments.iterations), "--rank", "--out", str(out)]
            words += [] if arguments.resolution is None else ["--resolution", str(arguments.resolution)]
            subprocess.run(
                [sys.executable, *launcher, __file__, *words],
                env={**os.environ, "OMP_NUM_THREADS": "1"},
                stdout=subprocess.DEVNULL,
                check=True,
            )
            found[str(size)] = Steps(**json.loads(out.read_text()))
    return found


def rank(arguments: Any) -> None:  # noqa: ANN401
    """Train as one of torchrun's processes; the first one writes the means of its steps."""
    with joined(num_processes()) as team, TemporaryDirectory() as scratch:
        out = Path(scratch) / "run"
        given = options(arguments.capture, out, arguments.resolution, arguments.iterations, SHARED)
        _, steps = train(given, team)
        if team.rank == 0:
            arguments.out.write_text(json.dumps(asdict(steps)))


def model(one: Steps, two: Steps) -> list[dict[str, Any]]:
    """Print and return the speed-up of several machines by batch and network."""
    shared = 2 * max(one.compute - two.compute, 0.0)
    repeated = max(one.compute - shared, 0.0)
    rows = []
    for batch in MODELLED:
        views = shared * batch / SHARED
        for name, rate in NETWORKS.items():
            found = {}
            for machines in MACHINES:
                # each of two processes sends half of the bytes twice
                sent = two.sent * 2 * (machines - 1) / machines
                talk = sent / rate + MESSAGES * LATENCY + two.exchange * sent / two.sent
                found[machines] = (views + repeated) / (views / machines + repeated + talk)
            rows.append({"batch": batch, "network": name, "speedups": found})
            told = ", ".join(f"{machines} machines {value:.2f}" for machines, value in found.items())
            print(f"model, batch {batch}, {name}: {told} times one machine of one thread")
    return rows


def main() -> None:
    """Measure, print and write the JSON."""
    made = hardware.parser("Quality of batches, bytes and time of processes that share steps.")
    made.add_argument("capture", nargs="?", type=Path)
    made.add_argument("--resolution", type=float, help="as for gsplat-edu train (default: 4)")
    made.add_argument("--iterations", type=int, default=1_000, help="images, a multiple of 4")
    made.add_argument("--rank", action="store_true", help="used by torchrun's processes")
    arguments = made.parse_args()
    if arguments.rank:
        rank(arguments)
        return
    if arguments.smoke:
        arguments.iterations = 16
    elif arguments.resolution is None:
        arguments.resolution = 4.0
    with capture(arguments.capture, arguments.smoke) as folder:
        scores = quality(folder, arguments)
        steps = on_two(folder, arguments)
    one, two = steps["1"], steps["2"]
    print(
        f"two processes, batch {SHARED}, {two.gaussians:.0f} Gaussians: each sends {two.sent / 1e6:.2f} MB per step;"
        f" of {1e3 * two.wall:.1f} ms wall time {100 * two.waited / two.wall:.0f} % are exchanges, of"
        f" {1e3 * (two.compute + two.exchange):.1f} ms processor time"
        f" {100 * two.exchange / (two.compute + two.exchange):.0f} %; one process: {1e3 * one.compute:.1f} ms"
    )
    told = {"quality": scores, "steps": {size: asdict(found) for size, found in steps.items()}}
    hardware.report(told | {"model": model(one, two)}, arguments.out)


if __name__ == "__main__":
    main()

"""Which part of a training iteration is serial, and how much faster do more cores make it?

    python benchmarks/serial.py [CAPTURE] [--scene FILE] [--smoke] [--out FILE.json]

One thread trains FILE (default: 160,000 Gaussians around the capture's points) on CAPTURE, anything that
`gsplat-edu train` accepts. Native stages count as parallel where they run in the pool's tasks. Everything else,
including torch's operations and Python, counts as serial. The model for more cores is Amdahl's law by stage, with the
number of tasks and the memory bandwidth as further bounds; docs/KERNELS.md has its assumptions.
"""

from __future__ import annotations

import statistics
import time
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path

import hardware
import numpy as np
import torch
from captures import capture

from gsplat_edu.base.buffers import reused_buffers
from gsplat_edu.data.dataset import Dataset, load_dataset
from gsplat_edu.io.formats import read_scene
from gsplat_edu.ops.kernels import native
from gsplat_edu.ops.losses import photo_loss
from gsplat_edu.render.api import render
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.scene.views import View
from gsplat_edu.train.config import TrainConfig
from gsplat_edu.train.density.base import DensityStrategy
from gsplat_edu.train.feed import ViewFeed
from gsplat_edu.train.initialize import from_points, make_strategy
from gsplat_edu.train.optimizer import Adam, ParameterGroup
from gsplat_edu.train.schedule import gaussian_groups

STAGES = ("project", "sort", "intersect", "composite", "composite_backward", "project_backward, Adam")
COUNT = 160_000
WARM_UP = 3
CORES = (8, 16, 64)
BUS = {8: 40e9, 16: 60e9, 64: 180e9}
"""Assumed memory bandwidth of all cores together, bytes/s: two channels of DDR4, two of DDR5, eight of DDR4."""
CALL = 5e-6
"""Assumed seconds to start the threads and to wait for the last one, per call of `parallel`."""
LONGEST_TILE = 4.0
"""Assumed time of the slowest tile, as a multiple of the mean."""


@dataclass
class Stage:
    """One stage of an iteration on one thread, in processor time.

    Args:
        seconds: Total.
        parallel: Part of it in the pool's tasks.
        calls: Number of times that work was handed to the pool.
    """

    seconds: float
    parallel: float
    calls: float = 0.0


class Clock:
    """Collects the times of the stages, a list over the rounds for each."""

    def __init__(self) -> None:
        self.found: dict[str, list[Stage]] = defaultdict(list)

    @contextmanager
    def stage(self, name: str, within: Sequence[Stage] = ()) -> Iterator[None]:
        """Time a block, minus the stages that are timed within it and named in the list."""
        (parallel, calls), start = native().parallel_time(), time.thread_time()
        yield
        seconds, (after, calls_after) = time.thread_time() - start, native().parallel_time()
        seconds -= sum(stage.seconds for stage in within)
        parallel = after - parallel - sum(stage.parallel for stage in within)
        self.found[name].append(Stage(seconds, parallel, calls_after - calls))

    def medians(self) -> dict[str, Stage]:
        """Return the median of every stage."""
        keys = ("seconds", "parallel", "calls")
        return {
            name: Stage(*(statistics.median(getattr(s, key) for s in stages) for key in keys))
            for name, stages in self.found.items()
        }


@dataclass(frozen=True)
class Size:
    """Sizes that determine the cost of an iteration."""

    gaussians: int
    visible: float
    pairs: float
    height: int
    width: int
    numbers: int

    @property
    def pixels(self) -> int:
        """Pixels of an image."""
        return self.height * self.width

    @property
    def tiles(self) -> int:
        """Tiles of an image."""
        return -(-self.height // 16) * -(-self.width // 16)


@dataclass
class Loop:
    """State that the iterations of a training share."""

    gaussians: Gaussians
    feed: ViewFeed
    optimizer: Adam
    strategy: DensityStrategy
    config: TrainConfig

    def iterate(self, clock: Clock) -> tuple[int, int, int, int]:
        """Time one iteration; return its visible Gaussians and pairs, and the image's height and width.

        As in the trainer, its tensors are released at the end, so that the next iteration reuses their memory.
        """
        config, gaussians = self.config, self.gaussians
        settings = RenderSettings(depth=False, jacobian_limit=config.jacobian_limit)
        with clock.stage("feed"):
            draw = self.feed.next()
            target = self.feed.target(draw, settings.background)
        forward: list[Stage] = []
        with clock.stage("render, Python", forward):
            output = render(gaussians, draw.view.camera, settings=settings, backend="cpu")
            frame = output.image.grad_fn.frame
            forward += map(Stage, frame.processor_seconds[:4], frame.parallel_seconds[:4])
        with clock.stage("loss"):
            loss = photo_loss(output.image, target.image, target.mask, config.ssim_weight)
        in_backward = output.defer()
        with clock.stage("autograd"):
            loss.backward()  # up to the image; the step runs the kernels
        backward: list[Stage] = []
        with clock.stage("step, Python", backward):
            self.optimizer.step(gaussians.tensors(), in_backward)
            backward += map(Stage, frame.processor_seconds[4:], frame.parallel_seconds[4:])
        for name, stage in zip(STAGES, forward + backward, strict=True):
            clock.found[name].append(stage)
        with clock.stage(f"{config.strategy}, observe"):
            self.strategy.observe(gaussians, output)
        with clock.stage(f"{config.strategy}, update"):  # of a step that neither adds nor removes Gaussians
            self.strategy.update(1, gaussians, self.optimizer)
        return len(output.visible), output.num_pairs, draw.view.camera.H, draw.view.camera.W


def train(scene: Gaussians, views: Sequence[View], config: TrainConfig, rounds: int) -> tuple[Clock, Size]:
    """Time training iterations with the strategy of the configuration; the scene is not changed."""
    gaussians, clock = scene.trainable(), Clock()
    optimizer = Adam(gaussians.tensors(), gaussian_groups(config, 1.0) | {"means": ParameterGroup(0.0)})
    strategy = make_strategy(config, 1.0, gaussians)
    loop = Loop(gaussians, ViewFeed(views, "shuffled", 0), optimizer, strategy, config)
    for _ in range(WARM_UP):
        loop.iterate(Clock())
    drawn = [loop.iterate(clock) for _ in range(rounds)]
    visible, pairs, height, width = np.median(drawn, axis=0).tolist()
    numbers = sum(tensor.numel() for tensor in gaussians.tensors().values())
    return clock, Size(len(gaussians), visible, pairs, int(height), int(width), numbers)


def measure(scene: Gaussians, views: Sequence[View], rounds: int) -> tuple[dict[str, Stage], Size]:
    """Return the stages of an iteration by strategy, and the sizes that they depend on."""
    stages: dict[str, Stage] = {}
    for strategy in ("adc", "mcmc"):
        config = TrainConfig(strategy=strategy, max_gaussians=len(scene))
        clock, size = train(scene, views, config, rounds)
        stages = clock.medians() | stages
    return stages, size


def traffic(size: Size) -> dict[str, float]:
    """Return the least number of bytes that the stages read and write in memory; a written line is read first."""
    n, visible, pairs, pixels = size.gaussians, size.visible, size.pairs, size.pixels
    return {
        "project": 44 * n + (192 + 2 * 64) * visible,
        "sort": 3 * (12 + 12 + 2 * 12) * visible,
        "intersect": (64 + 3 * 28) * visible + 2 * 8 * pairs,
        "composite": 8 * pairs + 64 * visible + 2 * 16 * pixels,
        "composite_backward": (8 + 2 * 40) * pairs + 64 * visible + 28 * pixels,
        "project_backward, Adam": 8 * visible + 40 * pairs + 6 * 4 * size.numbers,
        "loss": 3 * 13 * pixels,
        "mcmc, update": 56 * n,
    }


def tasks(size: Size) -> dict[str, int]:
    """Return the number of tasks of the stages; stages that are not listed have enough tasks."""
    return {
        "project": -(-size.gaussians // 256),
        "project_backward, Adam": -(-size.gaussians // 256),
        "loss": -(-3 * size.width // 768) * -(-size.height // 160),
        "mcmc, update": -(-size.gaussians // (1 << 12)),
    }


def model(stages: dict[str, Stage], size: Size, cores: int, bandwidth: float) -> dict[str, tuple[float, str]]:
    """Return the seconds of every stage on a number of cores, and its limit: work, tasks, memory or serial."""
    moved, split, found = traffic(size), tasks(size), {}
    rate = min(cores * bandwidth, BUS[cores])
    for name, stage in stages.items():
        serial = stage.seconds - stage.parallel + stage.calls * CALL
        bounds = {"work": stage.parallel / cores, "memory": moved.get(name, 0.0) / rate}
        if name in split:
            bounds["tasks"] = stage.parallel * -(-split[name] // cores) / split[name]
        if name in ("composite", "composite_backward"):
            bounds["tasks"] = stage.parallel / cores + LONGEST_TILE * stage.parallel / size.tiles
        limit = max(bounds, key=lambda key: bounds[key])
        if limit == "tasks" and bounds["tasks"] < 1.1 * bounds["work"]:
            limit = "work"
        found[name] = serial + max(bounds.values()), "serial" if serial > max(bounds.values()) else limit
    return found


def copy_rate(megabytes: int) -> float:
    """Measure the bytes per second that one thread reads and writes, a written line read first."""
    source, target = (torch.zeros(megabytes << 18) for _ in range(2))
    seconds = []
    for _ in range(9):
        start = time.perf_counter()
        target.copy_(source)
        seconds.append(time.perf_counter() - start)
    return 3 * source.nbytes / min(seconds)


def load(arguments: object, smoke: bool) -> tuple[Gaussians, Dataset]:
    """Read the capture and the scene, or make Gaussians around the capture's points."""
    with capture(arguments.capture, smoke) as folder:  # type: ignore[attr-defined]
        dataset = load_dataset(folder)
        dataset.preload()
    if arguments.scene:  # type: ignore[attr-defined]
        return read_scene(arguments.scene).gaussians, dataset  # type: ignore[attr-defined]
    count, rng = 500 if smoke else COUNT, np.random.default_rng(0)
    chosen = rng.integers(len(dataset.points), size=count)
    spread = 0.005 * float(np.linalg.norm(dataset.points.std(axis=0)))
    points = dataset.points[chosen] + rng.normal(scale=spread, size=(count, 3))
    return from_points(points, dataset.colors[chosen], TrainConfig()), dataset


def show(stages: dict[str, Stage], size: Size, bandwidth: float) -> dict[str, object]:
    """Print the table; return its figures for the JSON."""
    ours = {k: v for k, v in stages.items() if not k.startswith("mcmc")}
    total = sum(stage.seconds for stage in ours.values())
    modelled = {cores: model(stages, size, cores, bandwidth) for cores in CORES}
    print(
        f"{'':20} {'ms':>8} {'serial ms':>10} {'% of iter.':>10}" + "".join(f"{c:>12} cores" for c in CORES)
    )
    for name, stage in stages.items():
        serial = stage.seconds - stage.parallel
        row = f"{name:20} {1e3 * stage.seconds:8.2f} {1e3 * serial:10.3f} {100 * serial / total:10.3f}"
        print(row + "".join(f"{1e3 * modelled[c][name][0]:9.3f} {modelled[c][name][1]:8}" for c in CORES))
    serial = sum(stage.seconds - stage.parallel for stage in ours.values())
    speedups = {c: total / sum(modelled[c][name][0] for name in ours) for c in CORES}
    print(
        f"iteration with adc: {1e3 * total:.1f} ms, serial {1e3 * serial:.2f} ms, {100 * serial / total:.2f} %; "
        + ", ".join(f"{c} cores: {s:.1f} times" for c, s in speedups.items())
    )
    return {"serial_share": serial / total, "speedups": speedups, "model": modelled}


def main() -> None:
    """Measure on one thread, print the table and write the JSON."""
    made = hardware.parser("The serial share of a training iteration, and a model of many cores.")
    made.add_argument("capture", nargs="?", type=Path)
    made.add_argument(
        "--scene", type=Path, help="a trained scene of the capture; its axes have to be the capture's"
    )
    arguments = made.parse_args()
    torch.set_num_threads(1)
    scene, dataset = load(arguments, arguments.smoke)
    with reused_buffers():
        stages, size = measure(scene, (*dataset.train, *dataset.test), 1 if arguments.smoke else 20)
    bandwidth = copy_rate(1 if arguments.smoke else 256)
    print(f"{size}, one thread moves {bandwidth / 1e9:.1f} GB/s")
    result = {
        "size": asdict(size),
        "bandwidth": bandwidth,
        "stages": {k: asdict(v) for k, v in stages.items()},
    }
    hardware.report(result | show(stages, size, bandwidth), arguments.out)


if __name__ == "__main__":
    main()

"""Measure a step of training as it stays on the device: passes, what the host does, and what crosses between them."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from gsplat_edu.engine.frame import PAIRS, Scene, rounded_pairs
from gsplat_edu.engine.host import Device, Memory
from gsplat_edu.engine.model import Counters, by_stage, forecast, step_costs
from gsplat_edu.engine.passes import sort_bits
from gsplat_edu.engine.step import GROUPS, HALT, LIVE, STATE, PackedPhoto, StepNumbers, step_program
from gsplat_edu.engine.transfers import Kept
from gsplat_edu.engine.view import DeviceView

NUMBERS = StepNumbers(
    dict.fromkeys(GROUPS, (1e-4, 0.9, 0.999, 1e-15, 0.1, 1e-3)),
    opacity_weight=0.01,
    scale_weight=0.01,
    collects=True,
)
"""Rates of every group, both penalties and statistics, so that no pass has less to do than in any training."""


@dataclass(frozen=True)
class MeasuredStep:
    """A step of training, measured.

    Args:
        counters: What was counted in it.
        passes: Dispatches.
        same_bits: Whether three steps from one state gave the same bits twice.
        step_ms: Wall time of a step in a row of them, of which the host waits for the one before the last.
        record_ms: Of it, the host's time to record the passes, median.
        submit_ms: Of it, the host's time to hand them over, median.
        sent: Bytes from the host to the device per step.
        received: Bytes from the device to the host per step.
        entries: Milliseconds of each entry point by the device's clock, medians; empty without timestamps.
    """

    counters: Counters
    passes: int
    same_bits: bool
    step_ms: float
    record_ms: float
    submit_ms: float
    sent: float
    received: float
    entries: Mapping[str, float]

    def table(self) -> dict[str, dict[str, float]]:
        """Return for each stage, and the whole step, what was measured and what the model computes for it."""
        costs = step_costs(self.counters)
        found = forecast(costs)
        spent = {
            stage: sum(self.entries.get(name, 0.0) for name in {one.entry for one in some})
            for stage, some in by_stage(costs)
        }
        if self.entries:
            for stage, ms in (spent | {"step": sum(spent.values())}).items():
                found[stage] = {"ms (measured)": ms} | found[stage]
        return found

    def report(self) -> dict[str, object]:
        """Return everything as values for JSON."""
        return {
            "counted": dict(vars(self.counters)),
            "passes": self.passes,
            "ms a step (measured)": self.step_ms,
            "ms to record (host, measured)": self.record_ms,
            "ms to submit (host, measured)": self.submit_ms,
            "bytes sent a step": self.sent,
            "bytes received a step": self.received,
            "ms of passes (measured)": dict(self.entries),
            "stages": self.table(),
        }


class StepRun:
    """Buffers of a training with room for its pairs."""

    def __init__(self, device: Device, scene: Scene, view: DeviceView) -> None:
        self.device, self.scene, self.view = device, scene, view
        self.host: list[tuple[float, float]] = []  # milliseconds to record and submit each step
        pixels = view.camera.H * view.camera.W
        photo = PackedPhoto(
            np.random.default_rng(3).integers(0, 2**24, pixels, dtype=np.uint32) | np.uint32(255 << 24)
        )
        self.photo: Kept = device.keep(photo.words)
        count, rest = len(scene.core), scene.rest.shape[1]
        self.block = view.packed(rest) + NUMBERS.packed(pixels, count, photo.floats)
        self.counts = {
            "gaussians": count,
            "rest": scene.rest.size,
            "pixels": pixels,
            "edges": view.tiles + 2,
            "live": LIVE,
        }
        self.memory = self._with_room()

    def _with_room(self) -> Memory:
        program, room = (
            step_program(sort_bits(self.view.tiles.bit_length())),
            rounded_pairs(2 * len(self.scene.core)),
        )
        while True:
            self.memory = self.device.allocate(program, self.counts | {"pairs": room})
            self.begin()
            live = next(self.steps(1))
            if not live[HALT]:
                return self.memory
            room = rounded_pairs(int(live[PAIRS]))

    def begin(self) -> None:
        """Start again, from the scene and without moments and statistics."""
        given = {"core": self.scene.core, "rest": self.scene.rest}
        for name in STATE:
            size = {"core": self.scene.core.size, "rest": self.scene.rest.size}.get(name.partition("_")[0])
            nothing = np.zeros(2 * len(self.scene.core) if size is None else size, dtype=np.float32)
            self.memory.write(name, given.get(name, nothing))
        self.memory.write("live", np.zeros(LIVE, dtype=np.uint32))

    def steps(self, count: int) -> Iterator[np.ndarray]:
        """Take steps; yield what each leaves in `live`, a step late."""
        waiting = None
        for _ in range(count):
            recording, submitting = self.device.recording, self.device.submitting
            ticket = self.memory.submit("step", self.block, "live", self.photo, "photo")
            spent = self.device.recording - recording, self.device.submitting - submitting
            self.host.append((1e3 * spent[0], 1e3 * spent[1]))
            if waiting is not None:
                yield waiting.words()
            waiting = ticket
        if waiting is not None:
            yield waiting.words()

    def state(self) -> dict[str, np.ndarray]:
        """Return everything that steps change."""
        return {name: self.memory.read(name) for name in STATE}


def measure_step(device: Device, scene: Scene, view: DeviceView, rounds: int) -> MeasuredStep:
    """Measure a step of training.

    Args:
        device: The device.
        scene: The Gaussians.
        view: Camera and settings.
        rounds: Steps to measure, and runs of each pass.

    Raises:
        BackendUnavailableError: the device fails, or has too little memory.
    """
    run = StepRun(device, scene, view)
    states = []
    for _ in range(2):
        run.begin()
        list(run.steps(3))
        states.append(run.state())
    same = all(np.array_equal(states[0][name], states[1][name]) for name in STATE)
    size = view.camera.W, view.camera.H
    counters = Counters.of(run.memory, scene.rest.shape[1], view.sh_degree, size)
    before = device.sent, device.received
    run.host.clear()
    began = time.perf_counter()
    list(run.steps(rounds))
    spent = 1e3 * (time.perf_counter() - began) / rounds
    sent, received = (device.sent - before[0]) / rounds, (device.received - before[1]) / rounds
    recording, submitting = np.median(run.host, axis=0).tolist()
    entries: dict[str, float] = {}
    if device.measures:
        runs = [run.memory.times("step") for _ in range(rounds)]
        entries = {name: float(np.median([one[name] for one in runs])) for name in runs[0]}
    passes = sum(one.groups(run.memory.counts) > 0 for one in run.memory.program.parts["step"])
    return MeasuredStep(counters, passes, same, spent, recording, submitting, sent, received, entries)


def as_table(rows: Mapping[str, Mapping[str, float]]) -> str:
    """Return rows of numbers as a Markdown table; columns are those of the first row."""
    columns = list(next(iter(rows.values())))
    lines = ["| stage | " + " | ".join(columns) + " |", "|---" * (len(columns) + 1) + "|"]
    for name, row in rows.items():
        lines.append(f"| {name} | " + " | ".join(f"{row[column]:.4g}" for column in columns) + " |")
    return "\n".join(lines)

"""What a step of training costs by a model: bytes and operations of each pass, and milliseconds on GPUs by their peaks.

    time of a pass = max(bytes / bandwidth, operations / (FLOP/s / 2));   a step is the sum of its passes

The bytes are those of the buffers that `frame.py` and `step.py` declare, as far as the shader's text reads and writes
them; the operations are counted in that text (`operations.py`). The counts of Gaussians, pairs and pixels come from a
real frame. Assumed:

- Each byte of a buffer crosses memory once in a pass, however many threads read it; but composite and
  composite_backward fetch the record of a splat again for each tile.
- Peaks count a product that is added as two operations; it is one here, so half the peak counts.
- Threads of a workgroup wait for one another: a pixel that a splat of its tile misses takes as long as one that it
  meets, and a splat whose turn in composite_backward has not come as long as one whose turn it is.
- Passes neither overlap nor wait, and a dispatch costs nothing: small scenes take longer than this.

It is computed, not measured.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from gsplat_edu.engine.frame import PAIRS, VISIBLE, rounded_pairs
from gsplat_edu.engine.host import Memory
from gsplat_edu.engine.operations import Rates, Shader
from gsplat_edu.engine.passes import BLOCK, WORD, Pass, Program, module_source, sort_bits
from gsplat_edu.engine.step import LIVE, step_program

BATCH = 64
"""Splats that compositing takes at a time."""

PIXELS = 256
"""Pixels of a tile."""

STAGES = {
    "project": "project",
    "composite": "composite",
    "gate": "loss",
    "loss_maps": "loss",
    "total": "loss",
    "loss_gradient": "loss",
    "composite_backward": "composite_backward",
    "project_backward": "project_backward",
    "penalties": "Adam",
    "gaussian_step": "Adam",
    "rest_step": "Adam",
    "add_noise": "noise",
}
"""Stage of each entry point; those that are missing belong to `LISTS`."""

LISTS = "sorts and lists"
"""Stage of the passes between project and composite."""

FETCHED_AGAIN = frozenset({("composite", "records"), ("composite_backward", "records")})
"""Entry points and buffers where a byte may cross memory several times; see the module."""


@dataclass(frozen=True)
class Counters:
    """What was counted in a frame.

    Args:
        gaussians: Their number.
        harmonics: K, per Gaussian besides the first.
        degree: Degree of the harmonics that are used.
        visible: Gaussians that are drawn.
        pairs: Pairs of Gaussian and tile.
        taken: Pairs that are composited before their tiles stop.
        batches: Batches of 64 of these, of all tiles.
        stopped: Tiles that stop before their last pair.
        width: Of the image, px.
        height: Of the image, px.
        room: Pairs that there is room for.
    """

    gaussians: int
    harmonics: int
    degree: int
    visible: int
    pairs: int
    taken: int
    batches: int
    stopped: int
    width: int
    height: int
    room: int

    @property
    def tiles(self) -> int:
        """Tiles of the image."""
        return -(-self.width // 16) * -(-self.height // 16)

    @property
    def counts(self) -> dict[str, int]:
        """The counts of `step_program`."""
        rest, pixels = 3 * self.harmonics * self.gaussians, self.width * self.height
        return {
            "gaussians": self.gaussians,
            "rest": rest,
            "pixels": pixels,
            "edges": self.tiles + 2,
            "pairs": self.room,
            "live": LIVE,
        }

    @property
    def program(self) -> Program:
        """The program of a step for this image."""
        return step_program(sort_bits(self.tiles.bit_length()))

    @staticmethod
    def of(memory: Memory, harmonics: int, degree: int, size: tuple[int, int]) -> Counters:
        """Read the counters of the frame or step that was played last.

        Args:
            memory: Its buffers.
            harmonics: K.
            degree: Of the harmonics.
            size: Width and height of the image, px.

        Raises:
            BackendUnavailableError: the device fails.
        """
        width, height = size
        tiles = -(-width // 16) * -(-height // 16)
        live, edges = memory.read("live"), memory.read("tiles").astype(np.int64)[: tiles + 1]
        done = memory.read("done").astype(np.int64)[:tiles]
        return Counters(
            memory.counts["gaussians"], harmonics, degree, int(live[VISIBLE]), int(live[PAIRS]), int(done.sum()),
            int((-(-done // BATCH)).sum()), int((done < np.diff(edges)).sum()), width, height,
            memory.counts["pairs"],
        )  # fmt: skip

    @staticmethod
    def assumed(gaussians: int, size: tuple[int, int]) -> Counters:
        """Return the counters of a typical trained scene: 0.7 visible, 3 pairs a Gaussian, 88 % of them composited."""
        width, height = size
        tiles, pairs = -(-width // 16) * -(-height // 16), 3 * gaussians
        taken = 88 * pairs // 100
        batches = taken // BATCH + tiles // 2
        return Counters(
            gaussians, 15, 3, 7 * gaussians // 10, pairs, taken, batches, tiles // 2, width, height,
            rounded_pairs(pairs),
        )  # fmt: skip


@dataclass(frozen=True)
class Cost:
    """What a pass costs.

    Args:
        entry: Its entry point.
        operations: Of all threads.
        read: Bytes, by buffer.
        written: Bytes, by buffer.
    """

    entry: str
    operations: float
    read: Mapping[str, float]
    written: Mapping[str, float]

    @property
    def stage(self) -> str:
        """Its stage."""
        return STAGES.get(self.entry, LISTS)

    @property
    def bytes(self) -> float:
        """All bytes."""
        return sum(self.read.values()) + sum(self.written.values())

    def milliseconds(self, gpu: Gpu) -> float:
        """Return the time on a GPU by its peaks."""
        return max(self.bytes / gpu.gb_per_s / 1e6, self.operations / (gpu.tflop_per_s / 2) / 1e9)


@dataclass(frozen=True)
class Gpu:
    """A GPU by its peaks.

    Args:
        name: Its name.
        gb_per_s: Bandwidth of its memory, GB/s.
        tflop_per_s: Float32 TFLOP/s.
    """

    name: str
    gb_per_s: float
    tflop_per_s: float


GPUS = (Gpu("integrated GPU", 100.0, 2.0), Gpu("M2", 100.0, 3.6), Gpu("RTX 4070", 504.0, 29.0))
"""The GPUs of the forecast; figures of their makers, as far as known, the first a typical one."""


def rates_of(one: Pass, counters: Counters) -> Rates:
    """Return turns of loops and shares of branches in a pass, as `operations.py` takes them."""
    c = counters
    seen, each = c.visible / max(c.gaussians, 1), c.pairs / max(c.visible, 1)
    used, batches = (c.degree + 1) ** 2 - 1, c.batches / c.tiles
    batch = c.taken / max(c.batches, 1)
    job = one.job(c.counts)
    sorted_part = seen if one.items.count == "gaussians" else c.pairs / max(c.room, 1)
    field, rows = 676 / PIXELS, 416 / PIXELS  # numbers that a workgroup of the loss loads and blurs
    return {
        "view.antialiased != 0u": 0.0,
        "view.antialiased != 0u && g.det0 > DET_FLOOR": 0.0,
        "lane == 0u": 0.0,
        "thread == 0u": 0.0,
        # lists
        "project: any(g.uv - rim > farthest) || any(g.uv + rim < vec2 < f32 >(0.0))": 1.0 - seen,
        "color_along.j": used,
        "count_tiles.row": math.sqrt(each),  # as many rows of tiles as tiles in each
        "list_seen: depth > 0.0": seen,
        "gather_spans: k < live[job.live]": seen,
        "emit_pairs: k >= min(job.count, live[job.live])": 1.0 - seen,
        "emit_pairs.row": math.sqrt(each),
        "emit_pairs.column": math.sqrt(each),
        "emit_pairs.slot": 0.0,
        "find_ranges.while": math.log2(c.pairs + 1),
        "scan_sums.chunk": -(-job[2] // BLOCK),
        "at < end": sorted_part,
        "first + k < end": sorted_part,
        # compositing
        "COPIES == 1": 1.0,  # of a pinhole's image
        "run_of.while": 0.0,
        "run_of.while#2": 0.0,
        "composite.k": batches,
        "blended.j": batch,
        "composite: lane < count": batch / PIXELS,
        "composite: last <= count": c.stopped / max(c.batches, 1),
        "composite_backward.lane": PIXELS / BATCH,
        "composite_backward.k": batches,
        "composite_backward: mine": batch / BATCH,
        "composite_backward.turn": PIXELS - 1 + batch,
        "composite_backward.k#2": (c.pairs - c.taken) / c.tiles / BATCH,
        # loss
        "pair_at: view.numbers[RULES].z == 0u": 1.0,  # photos of bytes
        **{f"{name}.k": field for name in ("load_pairs", "load_maps")},
        **{f"{name}.k": rows for name in ("blur_pairs_across", "blur_maps_across")},
        # gradients and Adam
        "project_backward: spans[i].x > 0u": seen,
        "project_backward: thread < CAMERA && block < job.blocks": 16 / 64,
        "sum_slots.k": each,
        "color_gradient.j": c.harmonics,
        "color_gradient: j < (view.degree + 1u) * (view.degree + 1u)": min(used / max(c.harmonics, 1), 1.0),
        "clear.k#2": 3.0 * c.harmonics,
        "total.k": -(-job[0] // 256),
    }


@functools.cache
def _shader(module: str) -> Shader:
    return Shader(module_source(module))


def bindings_of(one: Pass) -> dict[str, str]:
    """Return the buffer of each variable that the pass's entry point may use."""
    bound = (*one.reads, *one.writes)
    return {name: bound[place] for name, place in _shader(one.module).bindings.items() if place < len(bound)}


def cost_of(one: Pass, counters: Counters) -> Cost:
    """Return what a pass costs."""
    shader, counts = _shader(one.module), counters.counts
    threads = one.groups(counts) * shader.threads[one.entry]
    work = shader.work(one.entry, rates_of(one, counters))
    live = counts | {"pairs": counters.pairs} if "live" in one.reads else counts
    sizes = {  # a sort counts digits for all blocks that there is room for
        buffer.name: WORD * buffer.size.of(live if buffer.size.per == 1 else counts)
        for buffer in counters.program.buffers
    }
    bound = bindings_of(one)

    def moved(words: Mapping[str, float]) -> dict[str, float]:
        """Return bytes by buffer, once at most."""
        found = {}
        for variable, each in words.items():
            name, touched = bound[variable], WORD * each * threads
            again = (one.entry, name) in FETCHED_AGAIN
            found[name] = touched if again else min(touched, sizes[name])
        return found

    return Cost(one.entry, work.operations * threads, moved(work.loaded), moved(work.stored))


def step_costs(counters: Counters, part: str = "step") -> tuple[Cost, ...]:
    """Return what each pass of a step costs, or of "noise", in order."""
    return tuple(
        cost_of(one, counters) for one in counters.program.parts[part] if one.groups(counters.counts)
    )


def by_stage(costs: Iterable[Cost]) -> Iterator[tuple[str, list[Cost]]]:
    """Yield the stages in order, each with its passes."""
    found: dict[str, list[Cost]] = {}
    for cost in costs:
        found.setdefault(cost.stage, []).append(cost)
    yield from found.items()


def forecast(costs: Iterable[Cost], gpus: Iterable[Gpu] = GPUS) -> dict[str, dict[str, float]]:
    """Return dispatches, megabytes, billions of operations and milliseconds by stage, and "step" for their sum.

    The milliseconds are computed from the peaks of the GPUs, not measured.
    """
    costs, gpus = tuple(costs), tuple(gpus)

    def row(some: Iterable[Cost]) -> dict[str, float]:
        some = tuple(some)
        counted = {
            "dispatches": len(some),
            "MB": sum(one.bytes for one in some) / 1e6,
            "G operations": sum(one.operations for one in some) / 1e9,
        }
        return counted | {
            f"{gpu.name}, ms (computed)": sum(one.milliseconds(gpu) for one in some) for gpu in gpus
        }

    return {stage: row(some) for stage, some in by_stage(costs)} | {"step": row(costs)}

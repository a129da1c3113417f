"""Choose settings that keep a training within a memory or time limit, before it starts.

Options given by the user stay; the others follow from the forecast: the size of the photos, how many of them stay in
memory, the maximum number of Gaussians, and the iterations. The chosen values are printed and stored in config.json.
Given as options, they reproduce the training bit for bit. A new plan may choose other values, since it measures time.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Collection
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from gsplat_edu.base.constants import FAR_BELOW
from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.text import Told, easily_read, spelled_seconds
from gsplat_edu.budget.costs import (
    LATER,
    Facts,
    Footprint,
    Measurements,
    photo_copies,
    step_profile,
)
from gsplat_edu.budget.deadline import TrialTime
from gsplat_edu.budget.forecast import Forecast, predict, spelled_bytes
from gsplat_edu.budget.length import tried, with_planned_length
from gsplat_edu.budget.on_device import cap_sentence, check_device, room_of
from gsplat_edu.budget.planned import flags, taken_up
from gsplat_edu.budget.probe import probe, resident_bytes
from gsplat_edu.budget.request import Limits as Limits, Request as Request
from gsplat_edu.data.dataset import Dataset
from gsplat_edu.data.reader import CaptureReader
from gsplat_edu.render.backends import load_backend
from gsplat_edu.runs.dataset import reader_for
from gsplat_edu.runs.start import scene_start
from gsplat_edu.runs.training import RunOptions
from gsplat_edu.train.capacity import SEPARATE
from gsplat_edu.train.config import TrainConfig

FACTORS = (1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0, 12.0, 16.0)
"""Factors by which photos may be downscaled."""

SMALLEST_SIDE = 64
"""Photos are not downscaled below this side, px."""

START_PAIRS = 16
"""Assumed pairs of Gaussian and tile per start Gaussian before they are counted: more than most scenes have."""

LEAST_GAUSSIANS = 1_000

DENSITY = 0.05
"""Downscale the photos if memory allows fewer Gaussians per pixel than this; snowmiku97 ends with 0.2."""

MEMORY_SHARE = 0.95
"""Fraction of the memory limit that a plan uses."""

LEAST_ITERATIONS = 50

WORTHWHILE_ITERATIONS = 1_500
"""Photos are downscaled, at most to `WORTHWHILE_PIXELS`, until this many iterations fit into the time limit."""

WORTHWHILE_PIXELS = 100_000

TIME_SHARE = 0.95
"""Fraction of the time limit for which the schedule is planned; `gsplat_edu.budget.pace` fits it to the time later."""

TOO_SHORT = "the time limit is far too short"
"""Beginning of the sentence about a limit that allows no usable scene."""


@dataclass(frozen=True)
class Plan:
    """The chosen settings.

    Args:
        options: The run with the chosen values.
        by_time: Whether the time limit chose the iterations; `gsplat_edu.budget.pace` then fits them to the machine.
        forecast: Expected time and memory; None if nothing had to be chosen.
        sentences: Explanation for the user.
        full_length: Iterations that the run would have without a time limit.
        profile: Expected seconds of every iteration if `by_time`.
    """

    options: RunOptions
    by_time: bool = False
    forecast: Forecast | None = None
    sentences: tuple[str, ...] = ()
    full_length: int | None = None
    profile: Float64[np.ndarray, " iterations"] | None = dataclasses.field(default=None, compare=False)

    @property
    def resolution(self) -> float | None:
        """As in `DataSettings`."""
        return self.options.data_settings.resolution

    @property
    def image_memory(self) -> int:
        """Bytes, as in `DataSettings`."""
        return self.options.data_settings.image_memory

    @property
    def max_gaussians(self) -> int | None:
        """As in `TrainConfig`."""
        return self.options.config.max_gaussians

    @property
    def iterations(self) -> int:
        """As in `TrainConfig`."""
        return self.options.config.iterations


@dataclass(frozen=True)
class Outlook:
    """What a forecast says of a time limit before any trial.

    Args:
        request: Input of the plan.
        measured: Measurements of this machine.
        shortest: Seconds that the shortest training takes, its evaluation included.
        warning: A sentence if the limit allows no usable scene; empty otherwise.
    """

    request: Request
    measured: Measurements
    shortest: float
    warning: str = ""


def look_ahead(
    options: RunOptions, limits: Limits, given: Collection[str], *, rescale: bool, reader: CaptureReader
) -> Outlook | None:
    """Check by a forecast that a time limit can be kept, before trials use a part of it.

    Args:
        options: The run as it would be without limits; settings may still be open.
        limits: The limits.
        given: Names of `PLANNED` that the user gave.
        rescale: Whether milestones that are not given stretch with the iterations.
        reader: Has read the capture.

    Returns:
        The outlook; None if no time limit chooses the iterations, or the run is resumed.

    Raises:
        ArgumentError: the limit is too short; the message names a sufficient one.
        DatasetError: the capture cannot be read.
    """
    if limits.time is None or "iterations" in given or (options.resume and options.folder.exists()):
        return None
    request, measured = _measured(options, limits, given, rescale, reader)
    found = choose(request, measured, limits.time.spent)
    warning = next((line for line in found.sentences if line.startswith(TOO_SHORT)), "")
    return Outlook(request, measured, _shortest(request, measured), warning)


@dataclass(frozen=True)
class _Choice:
    """Settings that fit into memory."""

    factor: float
    image_memory: int
    cap: int | None


def plan(
    options: RunOptions,
    limits: Limits,
    given: Collection[str] = (),
    *,
    rescale: bool = True,
    reader: CaptureReader | None = None,
    quality: str | None = None,
    progress: Callable[[], None] = lambda: None,
    outlook: Outlook | None = None,
) -> Plan:
    """Choose the settings that the user did not give so that the limits hold. The probe takes a few seconds.

    Without limits, only the iterations (of a quality) and the number of Gaussians of the recipe fast are chosen. A
    training with a time limit and a given number of iterations is cut short at the limit. A resumed run keeps the
    values of its config.json.

    Args:
        options: The run as it would be without limits.
        limits: The limits.
        given: Names of `PLANNED` that the user gave.
        rescale: Whether milestones that are not given stretch with the iterations.
        reader: Has read the capture already; None to read it.
        quality: Of `gsplat_edu.train.length.QUALITIES`, to choose the iterations; None to keep them.
        progress: Called after every iteration of a trial of lengths.
        outlook: Of the same run, to measure only once.

    Raises:
        ArgumentError: even the smallest settings exceed a limit (the message names a sufficient one), or the backend is
            the dense one.
        DatasetError: the capture cannot be read.
        SceneFormatError: the start scene cannot be read.
        CheckpointError: the config.json of a run to resume is damaged.
    """
    reader, first_sentences = reader_for(options, reader), tuple[str, ...]()
    if quality is not None:
        options, said = with_planned_length(
            options, quality, reader, given, rescale=rescale, progress=progress
        )
        given, first_sentences = (*given, "iterations"), (said,)
    if options.resume and options.folder.exists():
        said = f"{limits}: a resumed run keeps the values of its config.json; memory is not planned again"
        options = taken_up(options, given)
        check_device(options, reader)
        return Plan(options, sentences=(said,) if limits.memory is not None else ())
    if limits.memory is None and (limits.seconds is None or "iterations" in given):
        found = _with_planned_count(options, given, reader)
        check_device(found.options, reader)
        return dataclasses.replace(found, sentences=(*first_sentences, *found.sentences))
    if outlook is not None and outlook.measured.backend == options.backend:
        request, measured = dataclasses.replace(outlook.request, options=options), outlook.measured
    else:
        request, measured = _measured(options, limits, given, rescale, reader)
    if request.by_time:
        time = None if limits.time is None else TrialTime(limits.time, _shortest(request, measured))
        trial = tried(options, reader, request.facts.train, progress, time)
        request = dataclasses.replace(request, trial=trial)
    found = choose(request, measured, 0.0 if limits.time is None else limits.time.spent)
    check_device(found.options, reader)
    return dataclasses.replace(found, sentences=(*first_sentences, *found.sentences))


def _measured(
    options: RunOptions, limits: Limits, given: Collection[str], rescale: bool, reader: CaptureReader
) -> tuple[Request, Measurements]:
    """Return the input of a plan with limits, and measurements with the largest photos that fit into memory."""
    if "forecast" in load_backend(options.backend).lacks:
        raise ArgumentError(
            f"{limits}: cannot be planned for --backend {options.backend}; choose cpu, cuda or webgpu"
        )
    settings = options.data_settings
    chosen = {"resolution": settings.resolution, "max_gaussians": options.config.max_gaussians}
    fixed = frozenset(given) | {name for name, value in chosen.items() if value is not None}
    dataset_at = functools.partial(Dataset.of, reader, points=options.points)
    files = dataset_at(dataclasses.replace(settings, resolution=None))
    dataset = files if settings.resolution is None else dataset_at(settings)
    factors: tuple[float, ...] = (1.0,)
    if "resolution" not in fixed:
        side = min(min(view.camera.W, view.camera.H) for view in (*files.train, *files.test))
        factors += tuple(factor for factor in FACTORS if factor > 1 and side / factor >= SMALLEST_SIDE)
    facts, scene = Facts.of(dataset, files, asked=options.asked), None
    if options.scene is not None:
        scene, _ = scene_start(options.scene, options.config, dataset.origin)
        facts = dataclasses.replace(facts, points=len(scene))
    room = room_of(options.backend)
    request = Request(options, limits, fixed, rescale, facts, factors, room=room)
    length = options.config.iterations
    first = _within_memory(request, resident_bytes() + LATER, START_PAIRS * facts.points, length, factors)
    reduced = dataclasses.replace(settings, resolution=_resolution(request, first.factor), image_memory=0)
    measured = probe(
        dataset_at(reduced), request.config(length, first.factor, first.cap), options.backend, scene
    )
    probed = tuple(factor for factor in factors if factor >= first.factor)
    return dataclasses.replace(request, factors=probed), measured


def _with_planned_count(options: RunOptions, given: Collection[str], reader: CaptureReader) -> Plan:
    """Choose the number of Gaussians that the fast recipe grows to, or a cap that a device needs; keep one given."""
    config, room = options.config, room_of(options.backend)
    if config.max_gaussians is not None or not (config.strategy == "fast" or room is not None):
        return Plan(options)
    dataset = Dataset.of(reader, options.data_settings, points=options.points)
    facts = Facts.of(dataset, asked=options.asked)
    if options.scene is not None:
        facts = dataclasses.replace(facts, points=len(scene_start(options.scene, config, dataset.origin)[0]))
    request = Request(options, Limits(), frozenset({*given, "iterations"}), True, facts, room=room)
    config = request.config(config.iterations, 1.0, None)
    sentences = _device_sentences(request, config)
    if config.strategy == "fast" and not sentences:
        planned = f"the recipe plans {config.max_gaussians:,}"
        much = facts.separate > SEPARATE
        why = f", because the photos show as much as {facts.separate:g} that do not overlap" if much else ""
        said = f"{planned} Gaussians{why}; --max-gaussians changes that"
        sentences = (Told(said, f"{planned} splats{why}"),)
    return Plan(dataclasses.replace(options, config=config), sentences=sentences)


def _device_sentences(request: Request, config: TrainConfig, factor: float = 1.0) -> tuple[str, ...]:
    """Return a sentence that explains a cap that the device's buffers need; none if they need none."""
    capped = "max_gaussians" not in request.given and bool(request.device_caps(config, factor))
    wanted = request.wanted(config, factor)
    return (cap_sentence(request.room, config, wanted),) if request.room is not None and capped else ()


def choose(request: Request, measured: Measurements, spent: float) -> Plan:
    """Compute a plan from measurements.

    Args:
        request: Input of the plan.
        measured: Measurements of this machine, taken with photos downscaled by the first factor.
        spent: Seconds since the command began.

    Raises:
        ArgumentError: even the smallest settings exceed a limit; the message names a sufficient one.
    """
    length, factors = request.options.config.iterations, request.factors
    process, pairs = measured.process, measured.pairs
    choice = _within_memory(request, process, pairs, length, factors)
    if request.by_time:
        # Twice, because fewer iterations need fewer Gaussians, which leaves room for more photos.
        for _ in range(2):
            length, factor = _within_time(request, measured, choice, spent)
            factors = tuple(f for f in request.factors if f >= factor)
            choice = _within_memory(request, process, pairs, length, factors)
    config = request.config(length, choice.factor, choice.cap)
    settings = dataclasses.replace(
        request.options.data_settings,
        resolution=_resolution(request, choice.factor),
        image_memory=choice.image_memory,
    )
    options = dataclasses.replace(request.options, config=config, data_settings=settings)
    facts = request.facts.smaller(choice.factor)
    profile = None
    by_time = request.by_time and (request.trial is None or length != request.trial.longest)
    if by_time:
        profile = step_profile(config, request.facts.smaller(choice.factor), measured.speed)
    forecast = _predicted(request, measured, choice, config)
    found = Plan(options, by_time, forecast, full_length=request.full_length, profile=profile)
    at_cap = Footprint(
        facts, process + photo_copies(config, facts), pairs, config.sh_degree, config.batch, request.room
    ).peak(found.max_gaussians or 0, found.image_memory)
    needed = _device_sentences(request, config, choice.factor)
    full, warning = request.full_length, tuple[str, ...]()
    if by_time and full is not None and length < FAR_BELOW * full:
        seconds = spent + _seconds(request, measured, choice, full)
        warning = (
            f"{TOO_SHORT} for a usable scene: it leaves {length:,} iterations of {full:,}; all of them need about"
            f" {spelled_seconds(5 * math.ceil(seconds / 5))}",
        )
    return dataclasses.replace(found, sentences=(*needed, *_sentences(request, found, at_cap), *warning))


def _within_memory(
    request: Request, process: int, pairs: int, iterations: int, factors: tuple[float, ...]
) -> _Choice:
    """Choose the largest photos that leave room for enough Gaussians, how many photos to keep, and the cap."""
    settings, limit = request.options.data_settings, request.limits.memory
    if limit is None:
        return _Choice(factors[0], settings.image_memory, None)
    aim, least = int(MEMORY_SHARE * limit), 0
    for factor in factors:
        facts = request.facts.smaller(factor)
        reduced = photo_copies(request.options.config, facts)
        config = request.config(iterations, factor, None)
        footprint = Footprint(facts, process + reduced, pairs, config.sh_degree, config.batch, request.room)
        wanted = facts.wanted(config)
        if config.strategy == "none":
            wanted = facts.points
        wanted = min(wanted, config.max_gaussians or wanted)
        enough = min(wanted, max(LEAST_GAUSSIANS, round(DENSITY * facts.pixels)))
        if "max_gaussians" in request.given:
            enough = wanted = config.max_gaussians or wanted
        elif factor == factors[-1]:
            enough = min(wanted, LEAST_GAUSSIANS)
        enough = max(enough, request.least)
        kept = settings.image_memory if "image_memory" in request.given else 0
        least = footprint.peak(enough, kept)
        if least > aim:
            continue
        if "image_memory" not in request.given:
            kept = _photos_kept(footprint, aim, enough, wanted)
        return _Choice(factor, kept, footprint.most_gaussians(aim, kept))
    needed = math.ceil(least / MEMORY_SHARE / 2**20)
    raise ArgumentError(
        f"--max-memory {spelled_bytes(limit)}: is too little for this capture and these options; "
        f"{needed}MiB would do"
    )


def _photos_kept(footprint: Footprint, aim: int, enough: int, wanted: int) -> int:
    """Choose how many bytes of photos to keep: all if they fit, otherwise half of the free memory or more."""
    photos = footprint.facts.photo_bytes
    if footprint.peak(wanted, photos) <= aim:
        return photos
    half, spare = (aim - footprint.peak(0, 0)) // 2, aim - footprint.peak(wanted, 0)
    room = aim - footprint.peak(enough, 0)
    part = max(min(photos, max(half, spare), room), 0) // 2**20 * 2**20
    # Photos that are read again are decoded at full size, which may take more memory than keeping all of them.
    return photos if footprint.most_gaussians(aim, photos) >= footprint.most_gaussians(aim, part) else part


def _within_time(
    request: Request, measured: Measurements, choice: _Choice, spent: float
) -> tuple[int, float]:
    """Choose the number of iterations, and smaller photos if too few iterations fit."""
    limit = request.limits.seconds or 0.0
    found, least = 0, math.inf

    def takes(iterations: int, choice: _Choice) -> float:
        return spent + _seconds(request, measured, choice, iterations)

    for factor in (f for f in request.factors if f >= choice.factor):
        smaller = dataclasses.replace(choice, factor=factor)
        least = takes(LEAST_ITERATIONS, smaller)
        low, high = LEAST_ITERATIONS - 1, request.most_iterations + 1
        while high - low > 1:
            middle = (low + high) // 2
            low, high = (middle, high) if takes(middle, smaller) <= limit else (low, middle)
        found, choice = low, smaller
        pixels = request.facts.smaller(factor).pixels
        if found >= min(WORTHWHILE_ITERATIONS, request.most_iterations) or pixels < 2 * WORTHWHILE_PIXELS:
            break
    if found < LEAST_ITERATIONS:
        raise ArgumentError(
            f"--time-limit {spelled_seconds(limit)}: is too short: startup, reading and evaluation leave no time to "
            f"train; give at least {spelled_seconds(5 * math.ceil(least / 5))}"
        )
    return easily_read(found), choice.factor


def _seconds(request: Request, measured: Measurements, choice: _Choice, iterations: int) -> float:
    """Return the seconds of a training, with the margin of a plan."""
    config = request.config(iterations, choice.factor, choice.cap)
    return _predicted(request, measured, choice, config).total / TIME_SHARE


def _shortest(request: Request, measured: Measurements) -> float:
    """Return the seconds of the shortest training that a plan may choose, with the smallest photos."""
    length, last = request.options.config.iterations, request.factors[-1:]
    choice = _within_memory(request, measured.process, measured.pairs, length, last)
    return _seconds(request, measured, choice, LEAST_ITERATIONS)


def _predicted(request: Request, measured: Measurements, choice: _Choice, config: TrainConfig) -> Forecast:
    facts, options = request.facts.smaller(choice.factor), request.options
    return predict(facts, measured, config, choice.image_memory, options.eval_every, options.save_every)


def _resolution(request: Request, factor: float) -> float | None:
    return request.options.data_settings.resolution if factor == 1.0 else factor


def _sentences(request: Request, plan: Plan, at_cap: int) -> tuple[str, ...]:
    found, cap = plan.forecast, plan.max_gaussians
    chosen = flags(plan.options, request.given, photos=request.limits.memory is not None)
    sentences = [f"{request.limits}: chosen {chosen or 'nothing, because every option was given'}"]
    if request.by_time and not plan.by_time:
        sentences.append(f"the training ends before the limit: {request.trial}")
    if request.trial is not None and request.trial.cut:
        sentences.append("a quarter of the time did not suffice to try how long so few photos may be trained")
    if found is not None:
        sentences += [f"forecast: {line}" for line in found.lines()]
        if cap is not None and cap > found.gaussians[1]:
            sentences.append(f"with all of {cap:,} Gaussians: up to {spelled_bytes(at_cap)}")
    return tuple(sentences)

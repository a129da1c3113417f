"""Choose the backend of a training: cuda, or webgpu on a real GPU that is forecast to be faster, or cpu."""

from __future__ import annotations

import dataclasses
import functools
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

from gsplat_edu.base.errors import ArgumentError, BackendUnavailableError
from gsplat_edu.base.text import spelled_seconds
from gsplat_edu.budget.costs import Facts, Measurements
from gsplat_edu.budget.forecast import Forecast, predict
from gsplat_edu.budget.on_device import check_room, room_of
from gsplat_edu.budget.probe import probe
from gsplat_edu.data.dataset import Dataset
from gsplat_edu.data.reader import CaptureReader
from gsplat_edu.engine.adapters import ADAPTER_VARIABLE, AdapterName, Listing, listed_outside
from gsplat_edu.render.backends import resolve_backend, unavailable
from gsplat_edu.runs.options import RunOptions
from gsplat_edu.runs.start import scene_start
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.train.config import TrainConfig
from gsplat_edu.train.resident import leaves_device

GPUS = ("DiscreteGPU", "IntegratedGPU", "VirtualGPU")
"""Kinds of adapters that may be chosen."""

OPENGL = "OpenGL"
"""The interface whose adapters repeat those of the others."""


@dataclass(frozen=True)
class Decision:
    """A backend, and why.

    Args:
        backend: Its name.
        reason: Why, in one line.
        matters: Whether there is a GPU, so that the user may have expected another backend.
        seconds: Forecasts of the whole training by backend, where they were made.
    """

    backend: str
    reason: str
    matters: bool = False
    seconds: Mapping[str, float] = field(default_factory=dict)

    def __str__(self) -> str:
        """Return backend and reason."""
        return f"--backend {self.backend}: {self.reason}"


def decide(
    listing: Listing,
    obstacle: str | None,
    check: Callable[[], str | None],
    seconds: Callable[[str], float],
    *,
    wanted: str = "",
    allow_software: bool = False,
) -> Decision:
    """Decide between webgpu and cpu.

    Args:
        listing: The adapters; webgpu uses the first whose name contains `wanted`.
        obstacle: Why no device can do the training by itself; None if one can.
        check: Returns why the adapter cannot be used for the training, its self check included; None if it can.
        seconds: Returns the forecast of the training on a backend; it may raise a `BackendUnavailableError`.
        wanted: Part of the adapter's name.
        allow_software: Whether an adapter may be chosen that computes on the processor. For tests.
    """
    adapter = _usable(listing.adapters, wanted, allow_software)
    if adapter is None:
        return Decision("cpu", _no_gpu(listing))
    name = f"{adapter.name} ({adapter.interface})"
    if obstacle is not None:
        return Decision("cpu", f"{name} cannot do this training by itself, because {obstacle}", True)
    if (failure := check()) is not None:
        return Decision("cpu", f"{name} is not used: {failure}", True)
    try:
        found = {backend: seconds(backend) for backend in ("webgpu", "cpu")}
    except BackendUnavailableError as error:
        return Decision("cpu", f"{name} is not used: {error}", True)
    ours, native = (spelled_seconds(found[backend]) for backend in ("webgpu", "cpu"))
    if found["webgpu"] < found["cpu"]:
        return Decision("webgpu", f"{name} is forecast to take {ours}, the processor {native}", True, found)
    return Decision("cpu", f"the processor is forecast to take {native}, {name} {ours}", True, found)


def _usable(adapters: Sequence[AdapterName], wanted: str, allow_software: bool) -> AdapterName | None:
    """Return the adapter that webgpu uses if it may be chosen."""
    named = [one for one in adapters if wanted.lower() in one.name.lower() and one.interface != OPENGL]
    allowed = (*GPUS, "CPU") if allow_software else GPUS
    return named[0] if named and named[0].kind in allowed else None


def _no_gpu(listing: Listing) -> str:
    if listing.reason is not None:
        return f"no GPU for cuda, and for webgpu {listing.reason}"
    software = ", ".join(one.name for one in listing.adapters)
    return f"no GPU, only {software}, which computes on the processor"


@dataclass(frozen=True, eq=False)
class Prospect:
    """A training whose backend is to be chosen.

    Args:
        dataset: The capture at training size.
        full: The capture at the size of its files; the same dataset if that is the training size.
        config: The run, with the cap that it plans.
        scene: Gaussians that it starts from; None for the capture's points.
        image_memory: Bytes of photos kept in memory.
        eval_every: Iterations between evaluations; 0 for none, not even at the end.
        save_every: Iterations between checkpoints; 0 for none.
        asked: As for `RunOptions`.
    """

    dataset: Dataset
    full: Dataset
    config: TrainConfig
    scene: Gaussians | None = None
    image_memory: int = 4 * 2**30
    eval_every: int = RunOptions.eval_every
    save_every: int = RunOptions.save_every
    asked: Mapping[str, str] = dataclasses.field(default_factory=dict)

    @classmethod
    def of(cls, options: RunOptions, reader: CaptureReader) -> Prospect:
        """Return the prospect of a run whose cap and length may not be planned yet.

        Raises:
            DatasetError: the capture cannot be read.
            ArgumentError: the start scene does not fit the run.
        """
        settings, scene = options.data_settings, None
        # the probe reads a few photos and keeps none
        settings = dataclasses.replace(settings, image_memory=0)
        dataset = Dataset.of(reader, settings, points=options.points)
        full = Dataset.of(reader, dataclasses.replace(settings, resolution=None), points=options.points)
        config = options.config
        if options.scene is not None:
            scene, _ = scene_start(options.scene, config, dataset.origin)
        found = cls(
            dataset,
            full,
            config,
            scene,
            options.data_settings.image_memory,
            options.eval_every,
            options.save_every,
            options.asked,
        )
        if config.strategy in ("fast", "mcmc") and config.max_gaussians is None:
            facts = found.facts
            cap = max(facts.wanted(config), facts.points)
            found = dataclasses.replace(found, config=config.changed(max_gaussians=cap))
        return found

    @functools.cached_property
    def facts(self) -> Facts:
        """The properties of the capture that determine the cost."""
        facts = Facts.of(self.dataset, self.full, asked=self.asked)
        return facts if self.scene is None else dataclasses.replace(facts, points=len(self.scene))

    def measured(self, backend: str) -> Measurements:
        """Measure a backend by a few steps."""
        return probe(self.dataset, self.config, backend, self.scene)

    def forecast(self, measured: Measurements) -> Forecast:
        """Return the forecast that follows from measurements."""
        return predict(self.facts, measured, self.config, self.image_memory, self.eval_every, self.save_every)


@dataclass(frozen=True)
class Chosen:
    """A decision, and the measurements that were made for it by backend."""

    decision: Decision
    measured: Mapping[str, Measurements]

    @property
    def backend(self) -> str:
        """The chosen backend."""
        return self.decision.backend


def choose_backend(prospect: Prospect, *, allow_software: bool = False) -> Chosen:
    """Choose the backend of a training by what this computer has, and by forecasts if it has a GPU for webgpu.

    Args:
        prospect: The training.
        allow_software: As for `decide`.

    Raises:
        BackendUnavailableError: no backend runs here.
        DatasetError: a photo cannot be read.
    """
    if resolve_backend("auto") == "cuda":
        return Chosen(Decision("cuda", "torch sees a GPU whose kernels pass their check"), {})
    measured: dict[str, Measurements] = {}

    def seconds(backend: str) -> float:
        measured[backend] = prospect.measured(backend)
        return prospect.forecast(measured[backend]).total

    decision = decide(
        listed_outside(),
        leaves_device(prospect.config, prospect.asked),
        lambda: _failure(prospect),
        seconds,
        wanted=os.environ.get(ADAPTER_VARIABLE, ""),
        allow_software=allow_software,
    )
    return Chosen(decision, measured)


def _failure(prospect: Prospect) -> str | None:
    """Return why the training cannot run on webgpu's adapter: it fails its check, or the training does not fit."""
    if reason := unavailable("webgpu"):
        return reason
    try:
        if (room := room_of("webgpu")) is not None:
            check_room(room, prospect.config, prospect.dataset)
    except ArgumentError as error:
        return str(error)
    return None


def resumed_backend(stored: object) -> Decision:
    """Return the backend with which a run goes on: its own if that is webgpu and runs here, as its bits need it.

    Args:
        stored: "backend" of the run's config.json.

    Raises:
        BackendUnavailableError: no backend runs here.
    """
    usual = resolve_backend("auto")
    if stored != "webgpu":
        return Decision(usual, "the run goes on")
    if reason := unavailable("webgpu"):
        return Decision(usual, f"the run began on webgpu, which does not run here: {reason}", True)
    return Decision("webgpu", "the run began on it", True)


def usual_choice(listing: Listing | None = None) -> str:
    """Return what `--backend auto` takes on this computer, and why, without a training to forecast.

    Args:
        listing: The adapters; None to list them.

    Raises:
        BackendUnavailableError: no backend runs here.
    """
    usual = resolve_backend("auto")
    if usual == "cuda":
        return "cuda"
    listing = listing or listed_outside()
    if (adapter := _usable(listing.adapters, os.environ.get(ADAPTER_VARIABLE, ""), False)) is None:
        return f"{usual}: {_no_gpu(listing)}"
    name = f"{adapter.name} ({adapter.interface})"
    if reason := unavailable("webgpu"):
        return f"{usual}: {name} is not used: {reason}"
    return f"{usual}; webgpu for a training that is forecast to be faster on {name}"

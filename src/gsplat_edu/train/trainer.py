"""The training loop.

Chapter: 09_train_in_3d.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gsplat_edu.base.buffers import reused_buffers
from gsplat_edu.base.errors import ArgumentError, DatasetError
from gsplat_edu.base.pictures import curve_html
from gsplat_edu.base.validation import of_type, offers
from gsplat_edu.render.backend import Backend, check_backend_value
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.scene.views import View
from gsplat_edu.train.config import TrainConfig
from gsplat_edu.train.density.base import DensityStrategy
from gsplat_edu.train.events import Change, Event, Losses, StepEvent
from gsplat_edu.train.feed import Draw, ViewFeed
from gsplat_edu.train.optimizer import MOMENTS
from gsplat_edu.train.part import parts as registered_parts
from gsplat_edu.train.part_values import Masker
from gsplat_edu.train.resident import make_stepper
from gsplat_edu.train.saved import check_entries, check_numpy_generator, check_whole
from gsplat_edu.train.schedule import gaussian_groups, photo_factor, sh_degree
from gsplat_edu.train.step import StepParts as StepParts, StepView
from gsplat_edu.train.tempo import Tempo
from gsplat_edu.train.view_model import ViewModel

Callback = Callable[["Trainer", Event], None]
"""Called after every step and every change of the Gaussians, with the trainer and the event."""

GROUPS = ("gaussians", "view_model", *MOMENTS, "density")
"""Groups of a checkpoint's tensors, the first word of their names; others are named after parts."""

BACKGROUND_STREAM = 1
"""Second word of the random backgrounds' seed, so that they are independent of the view order."""


@dataclass(frozen=True)
class TrainResult:
    """The record of one call of `Trainer.run`.

    Args:
        losses: Loss of every step of this call.
        counts: Gaussians rendered in every step of this call.
        seconds: Wall time of the loop, callbacks included.
    """

    losses: list[float]
    counts: list[int]
    seconds: float


class Trainer:
    """Optimises Gaussians until their renders match the views.

    Each step computes the gradients of the objective for the views it draws, reduces them, and applies the result.
    Then the density strategy may change the Gaussians. `gsplat_edu.train.training` makes a trainer.

    Args:
        gaussians: The start Gaussians; not changed.
        views: Training views, at least one.
        config: Budget, rates, schedule and seed.
        backend: The kernels.
        parts: The parts of a step.
        extent: Size of the scene, world units: the means' learning rate is a fraction of it.
        callbacks: Called after every step and every change, in this order.

    Raises:
        ArgumentError: there are no Gaussians, more Gaussians than the cap, or parts that do not fit a batch.

    Attributes:
        stepper: Holds the Gaussians and what moves them.
        iteration: Images trained on so far: a step has `TrainConfig.batch` of them.
    """

    def __init__(
        self,
        gaussians: Gaussians,
        views: Sequence[View],
        config: TrainConfig,
        backend: Backend,
        parts: StepParts,
        *,
        extent: float = 1.0,
        callbacks: Sequence[Callback] = (),
    ) -> None:
        _check_kinds(gaussians, config, backend, parts)
        if not len(gaussians):
            raise ArgumentError("gaussians: is empty; give at least one Gaussian to start from")
        if config.max_gaussians is not None and len(gaussians) > config.max_gaussians:
            raise ArgumentError(
                f"gaussians: are {len(gaussians)}, more than max_gaussians = {config.max_gaussians}; start with fewer"
            )
        self.config, self.extent, self.density = config, extent, parts.density
        self.iteration = 0
        self._losses: list[float] = []
        self._callbacks = tuple(callbacks)
        drawn = config.random_background or config.alpha_background == "random"
        behind, device = None if drawn else config.background, gaussians.means.device
        outside = parts.objective.needs(0).outside
        groups = gaussian_groups(config, extent)
        self.stepper = make_stepper(gaussians, backend, groups, parts, config.batch)
        room = self.stepper.photo_room
        self._feed = ViewFeed(views, config.view_order, config.seed, behind, device, room, outside)
        self._backgrounds = np.random.default_rng((config.seed, BACKGROUND_STREAM))

    def __repr__(self) -> str:
        """Return one line: how far it is, the number of Gaussians, and the last loss."""
        loss = f", loss {self._losses[-1]:.4g}" if self._losses else ""
        count = f"{len(self.gaussians):,} Gaussians"
        return f"Trainer(iteration {self.iteration} of {self.config.iterations}, {count}{loss})"

    def _repr_html_(self) -> str:
        return curve_html(self._losses, repr(self))

    @property
    def gaussians(self) -> Gaussians:
        """The current Gaussians."""
        return self.stepper.gaussians

    @property
    def view_model(self) -> ViewModel:
        """The view model of the run's steps."""
        return self.stepper.parts.view_model

    @property
    def maskers(self) -> Mapping[str, Masker]:
        """What finds masks during the run, by the names of parts."""
        return self.stepper.parts.maskers

    @property
    def tempo(self) -> Tempo:
        """Which iteration of the recipe each iteration of this run stands for."""
        return Tempo.parsed(self.config.tempo, self.config.iterations, self.config.batch)

    @property
    def position(self) -> int:
        """The iteration of the recipe that the next step stands for; rates and sizes follow it."""
        return self.tempo.position(self.iteration)

    @property
    def last(self) -> tuple[Tensor, Tensor, Tensor | None] | None:
        """The last image that was compared, its photo and its mask, for display; None before the first step."""
        shown = self.stepper.shown
        return None if shown is None else (shown.image, shown.target.image, shown.target.mask)

    @property
    def last_name(self) -> str:
        """The name of the view of `last`; empty before the first step."""
        return "" if self.stepper.shown is None else self.stepper.shown.name

    def run(
        self, stop: Callable[[], bool] = lambda: False, callbacks: Sequence[Callback] = ()
    ) -> TrainResult:
        """Run the remaining iterations of the budget.

        Args:
            stop: Called after every iteration; if it returns true, the run ends and can be resumed.
            callbacks: Receive every event of this call, after the callbacks of the constructor.
        """
        receivers = (*self._callbacks, *callbacks)
        losses, counts = Losses(self.gaussians.means.detach()), []
        start = time.perf_counter()
        try:
            with reused_buffers():
                while self.iteration < self.config.iterations:
                    step = self._step()
                    losses.add(step.terms)
                    counts.append(step.num_gaussians)
                    self._tell(step, receivers)
                    for event in self._change(step.iteration):
                        self._tell(event, receivers)
                    if stop():
                        break
        except KeyboardInterrupt:  # a notebook's user may look at the curve
            self._losses += losses.read()
            raise
        found = losses.read()
        self._losses += found
        return TrainResult(found, counts, time.perf_counter() - start)

    def _step(self) -> StepEvent:
        """Take one step: draw the views, and let the stepper move the Gaussians."""
        position = self.position
        factor = photo_factor(self.config, position)
        self._feed.use_factor(factor)
        for masker in self.maskers.values():
            if any(masker.is_due(passed, self.config.batch) for passed in self.tempo.passed(self.iteration)):
                settings = self._settings(self.config.background)
                masker.find(self.gaussians, settings, self.view_model.camera, factor)
        terms = self.stepper.step(self.step_views(), position)
        self.iteration += self.config.batch
        return StepEvent(self.iteration - 1, self.stepper.count, terms, factor)

    def _change(self, iteration: int) -> Iterator[Change]:
        """Let the density strategy act at every position that the step passed; yield what it did.

        Args:
            iteration: The last image of the step.
        """
        batch = self.config.batch
        for position in self.tempo.passed(iteration - batch + 1):
            for event in self.stepper.change(position + batch - 1):
                yield event if event.iteration == iteration else replace(event, iteration=iteration)

    def step_views(self) -> Iterator[StepView]:
        """Draw the views of the next step that this process renders; yield them with targets and settings.

        Raises:
            DatasetError: a photo cannot be read; then all views of the step remain due.
        """
        return self._views(self._draw())

    def _draw(self) -> list[Draw]:
        """Return the views of the next step that this process renders. If a photo cannot be read, all remain due."""
        places, batch = self.stepper.places, self.config.batch
        if batch == 1:
            return [self._feed.next()]
        before, draws = self._feed.state(), []
        try:
            for place in range(batch):
                if place in places:
                    last = place + 1 == places.stop
                    draws.append(self._feed.next(batch - len(places) + 1 if last else 1))
                else:
                    self._feed.skip()
        except DatasetError:
            self._feed.load_state(before)
            raise
        return draws

    def _views(self, draws: Sequence[Draw]) -> Iterator[StepView]:
        """Yield the views of a step with targets and settings. All processes draw the backgrounds of all places."""
        places, batch = self.stepper.places, self.config.batch
        backgrounds = [self.config.background] * batch
        if self.config.random_background:
            backgrounds = [tuple(self._backgrounds.uniform(size=3).tolist()) for _ in range(batch)]
        for place, draw in zip(places, draws, strict=True):
            background = backgrounds[place]
            if draw.opaque is not None and not self.config.random_background:
                background = self._behind_alpha(place)
            target = self._feed.target(draw, background)
            for masker in self.maskers.values():
                target = masker.applied(draw.index, target)
            yield StepView(draw, target, self._settings(background))

    def _behind_alpha(self, place: int) -> tuple[float, float, float]:
        """Return the colour behind a photo with alpha at a place of this step's batch.

        A fixed colour would hide splats of that colour outside of what the photos cut out. The colour depends on
        nothing but seed, iteration and place, so every process and every resumed run draws the same.
        """
        if self.config.alpha_background == "fixed":
            return self.config.background
        rng = np.random.default_rng((self.config.seed, BACKGROUND_STREAM, self.iteration + place))
        red, green, blue = rng.uniform(size=3).tolist()
        return red, green, blue

    def _settings(self, background: tuple[float, float, float]) -> RenderSettings:
        """Return the render settings of the iteration."""
        return RenderSettings(
            background=background,
            sh_degree=sh_degree(self.config, self.position),
            antialiased=self.config.antialiased,
            jacobian_limit=self.config.jacobian_limit,
        )

    def _tell(self, event: Event, receivers: Sequence[Callback]) -> None:
        for callback in receivers:
            callback(self, event)

    def state(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """Return the state from which a run resumes with identical results: tensors, and values for JSON."""
        parts, steps = self.stepper.state()
        numbers: dict[str, Any] = {
            "iteration": self.iteration,
            "steps": steps,
            "feed": self._feed.state(),
            "backgrounds": self._backgrounds.bit_generator.state,
        }
        if self.density is not None:
            parts["density"], numbers["density"] = self.density.state()
        parts |= {name: dict(masker.state()) for name, masker in self.maskers.items()}
        flat = {
            f"{part}.{name}": t.detach() for part, tensors in parts.items() for name, t in tensors.items()
        }
        return flat, numbers

    def load_state(self, tensors: dict[str, Tensor], numbers: object) -> None:
        """Restore what `state` returned, in a trainer made with the same arguments.

        The whole state is checked before any of it is used.

        Raises:
            ArgumentError: the state does not fit this trainer, which stays unchanged; the message names the entry.
        """
        parts: dict[str, dict[str, Tensor]] = {part: {} for part in (*GROUPS, *registered_parts())}
        for key, tensor in tensors.items():
            part, _, name = key.partition(".")
            if part not in parts:
                raise ArgumentError(f"{key[:60]!r}: is unknown")
            parts[part][name] = tensor
        keys = ("iteration", "steps", "feed", "backgrounds", *(["density"] if self.density else []))
        given = check_entries("state", numbers, keys)
        iteration = check_whole("iteration", given["iteration"], self.config.iterations)
        if check_whole("steps", given["steps"], self.config.iterations) != iteration:
            raise ArgumentError("steps: has to equal the iteration")
        if iteration % self.config.batch:
            raise ArgumentError(f"iteration: has to be a multiple of batch = {self.config.batch}")
        self._feed.check_state(given["feed"])
        check_numpy_generator("backgrounds", given["backgrounds"], self._backgrounds)
        loaded = self.stepper.loaded(parts, iteration)
        count, cap = len(loaded.gaussians), self.config.max_gaussians
        if not count or (cap is not None and count > cap):
            raise ArgumentError(
                f"gaussians: there are {count}; their number has to be from 1 to {cap or 'any'}"
            )
        for name in registered_parts():
            if name in self.maskers:
                self.maskers[name].check_state(parts[name])
            elif parts[name]:
                raise ArgumentError(f"{name}: are present, but this run has none")
        if self.density is not None:  # the last check that can fail
            if not isinstance(given["density"], dict):
                raise ArgumentError("density: has to be an object")
            device = loaded.gaussians.means.device
            density = {
                name: tensor if tensor.dtype == torch.uint8 else tensor.to(device)
                for name, tensor in parts["density"].items()
            }
            self.density.load_state(density, given["density"], loaded.gaussians)
        elif parts["density"]:
            raise ArgumentError("density: is present, but this run has no density control")
        self.stepper.take_over(loaded)
        self.iteration = iteration
        for name, masker in self.maskers.items():
            masker.load_state(parts[name])
        self._feed.load_state(given["feed"])
        self._backgrounds.bit_generator.state = given["backgrounds"]


def _check_kinds(gaussians: Gaussians, config: TrainConfig, backend: Backend, parts: StepParts) -> None:
    """Check that every part has the methods that a step calls, before the first step.

    Raises:
        ArgumentError: a part is of another kind; the message names the part, and what it lacks.
    """
    of_type("gaussians", gaussians, Gaussians)
    of_type("config", config, TrainConfig)
    check_backend_value(backend)
    of_type("parts", parts, StepParts)
    offers("parts.view_model", parts.view_model, ViewModel)
    if parts.density is not None:
        offers("parts.density", parts.density, DensityStrategy)

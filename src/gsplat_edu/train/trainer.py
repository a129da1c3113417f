"""The training loop.

Chapter: 09_train_in_3d.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch
from torch import Tensor

from gsplat_edu.adam import AdamKernel, adam_step
from gsplat_edu.buffers import reused_buffers
from gsplat_edu.camera import Camera
from gsplat_edu.errors import ArgumentError, DatasetError
from gsplat_edu.gaussians import Gaussians
from gsplat_edu.moments import AdamInBackward
from gsplat_edu.render.camera_tensors import CameraTensors
from gsplat_edu.render.output import RenderOutput
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.threads import one_thread
from gsplat_edu.train.batches import Batch, check_measured
from gsplat_edu.train.config import TrainConfig
from gsplat_edu.train.density.base import DensityStrategy
from gsplat_edu.train.events import Event, Losses, StepEvent
from gsplat_edu.train.feed import Draw, ViewFeed
from gsplat_edu.train.objective import PHOTO, Objective, Rendered, make_objective
from gsplat_edu.train.optimizer import MOMENTS, Adam
from gsplat_edu.train.saved import check_entries, check_numpy_generator, check_tensor_kind, check_whole
from gsplat_edu.train.schedule import gaussian_groups, photo_factor, sh_degree
from gsplat_edu.train.team import ALONE, SharedAdam, Team, places_of, share_results
from gsplat_edu.train.transients import Transients
from gsplat_edu.train.view_model import Identity, Seen, ViewModel
from gsplat_edu.views import View


@runtime_checkable
class Renderer(Protocol):
    """Renders Gaussians from a camera, differentiably. The trainer does not depend on the backend."""

    def __call__(
        self, gaussians: Gaussians, camera: Camera | CameraTensors, *, settings: RenderSettings
    ) -> RenderOutput:
        """Render; see `gsplat_edu.render.api.render`."""
        ...


Callback = Callable[["Trainer", Event], None]
"""Called after every step and every change of the Gaussians, with the trainer and the event."""

PARTS = ("gaussians", "view_model", *MOMENTS, "density", "transients")
"""Groups of a checkpoint's tensors: the first word of their names."""

BACKGROUND_STREAM = 1
"""Second word of the random backgrounds' seed, so that they are independent of the view order."""


Reduce = Callable[[Mapping[str, Tensor], int], None]
"""Called with all parameters and the number of views: turns the sum over the views in each `grad` into the gradient to
apply. Processes that share a step call it with the rows that each of them moves."""


@one_thread()
def mean_over_views(parameters: Mapping[str, Tensor], num_views: int) -> None:
    """Divide every gradient by the number of views; the gradient of a single view is unchanged."""
    if num_views > 1:
        for parameter in parameters.values():
            if parameter.grad is not None:
                parameter.grad /= num_views


@dataclass(frozen=True)
class StepParts:
    """The replaceable parts of a step.

    Args:
        objective: The objective to minimise; `make_objective` of the configuration if None.
        view_model: Corrects the camera and the image of a view before the loss compares it.
        reduce: Combines the gradients of a step's views before they are applied.
        adam: Updates one tensor by Adam's rule; by default the fastest kernel that supports it.
        transients: Finds and applies masks of things that move; None for none.
        fused: Takes Adam's step for the Gaussians in the backward pass where that gives the same bits, so that their
            gradients need no memory; see `Trainer.fuses`.
        team: The processes that share each step.
    """

    objective: Objective | None = None
    view_model: ViewModel = field(default_factory=Identity)
    reduce: Reduce = mean_over_views
    adam: AdamKernel = adam_step
    transients: Transients | None = None
    fused: bool = True
    team: Team = ALONE


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
    Then the density strategy may change the Gaussians.

    Args:
        gaussians: The start Gaussians; not changed.
        views: Training views, at least one.
        config: Budget, rates, schedule and seed.
        render: The renderer.
        extent: Size of the scene, world units: the means' learning rate is a fraction of it.
        density: The density strategy; None keeps the number of Gaussians.
        callbacks: Called after every step and every change, in this order.
        parts: The other parts of a step; the recipe's if None.

    Raises:
        ArgumentError: there are no views, no Gaussians, more Gaussians than the cap, or parts that do not fit a batch.

    Attributes:
        gaussians: The current Gaussians.
        iteration: Images trained on so far: a step has `TrainConfig.batch` of them.
        last: The last image that was compared, its photo and its mask, for display.
        last_name: The name of their view.
    """

    def __init__(
        self,
        gaussians: Gaussians,
        views: Sequence[View],
        config: TrainConfig,
        *,
        render: Renderer,
        extent: float = 1.0,
        density: DensityStrategy | None = None,
        callbacks: Sequence[Callback] = (),
        parts: StepParts | None = None,
    ) -> None:
        if not views:
            raise ArgumentError("views: is empty; give at least one view to learn from")
        if not len(gaussians):
            raise ArgumentError("gaussians: is empty; give at least one Gaussian to start from")
        if config.max_gaussians is not None and len(gaussians) > config.max_gaussians:
            raise ArgumentError(
                f"gaussians: are {len(gaussians)}, more than max_gaussians = {config.max_gaussians}; start with fewer"
            )
        parts = parts or StepParts()
        self.gaussians = gaussians.trainable()
        self.config, self.extent, self.density = config, extent, density
        self.iteration = 0
        self.last: tuple[Tensor, Tensor, Tensor | None] | None = None
        self.last_name = ""
        self._render, self._callbacks = render, tuple(callbacks)
        behind, device = None if config.random_background else config.background, gaussians.means.device
        empty = config.outside_masks == "empty"
        self._feed = ViewFeed(views, config.view_order, config.seed, behind, device, outside=empty)
        self._parts, self._objective = parts, parts.objective or make_objective(config)
        self._learned = dict(parts.view_model.parameters())
        if taken := sorted(set(self._learned) & set(self.gaussians.tensors())):
            raise ArgumentError(f"view_model: {taken[0]!r} is the name of a parameter of the Gaussians")
        self._groups = gaussian_groups(config, extent) | dict(parts.view_model.groups())
        self._places = places_of(parts.team, config.batch)
        if config.batch > 1:
            check_measured(self._measured(), len(views))
        if parts.team.size > 1 and not self._blind:
            raise ArgumentError("density: observes more than renders; train it in one process")
        self._optimizer = self._make_optimizer(self.parameters())
        self._backgrounds = np.random.default_rng((config.seed, BACKGROUND_STREAM))

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
        with reused_buffers():
            while self.iteration < self.config.iterations:
                step = self._step()
                losses.add(step.loss_tensor)
                counts.append(step.num_gaussians)
                self._tell(step, receivers)
                if self.density is not None:
                    with one_thread():
                        changed = self.density.update(step.iteration, self.gaussians, self._optimizer)
                    self.gaussians, events = changed
                    for event in events:
                        self._tell(event, receivers)
                if stop():
                    break
        return TrainResult(losses.read(), counts, time.perf_counter() - start)

    def _step(self) -> StepEvent:
        """Take one step: gradients of the views, reduce, apply."""
        factor = photo_factor(self.config, self.iteration)
        self._feed.use_factor(factor)
        transients = self._parts.transients
        if transients is not None and transients.is_due(self.iteration, self.config.batch):
            settings = self._settings(self.config.background)
            transients.find(self.gaussians, settings, self._parts.view_model.camera, factor)
        draws = self._draw()
        if self._parts.team.size > 1:
            terms = self._shared_step(draws)
        elif len(draws) == 1 and self.fuses:
            terms = self._fused_step(draws[0])
        else:
            terms = self.gradients(draws)
            self._parts.reduce(self.parameters(), len(draws))
            self.apply()
        return StepEvent(self.iteration - 1, terms[PHOTO], len(self.gaussians), terms, factor)

    @property
    def view_model(self) -> ViewModel:
        """The view model of the run's steps."""
        return self._parts.view_model

    @property
    def transients(self) -> Transients | None:
        """The masks of things that move, if the run finds any."""
        return self._parts.transients

    @property
    def fuses(self) -> bool:
        """Whether the Gaussians may be moved in the backward pass of a single view, with the same bits.

        Not if something needs their gradients: another `reduce` or `adam`, a subclass of `Objective` (it may pass
        backward more than once), or a density strategy without a true attribute `observes_renders_only`. A render
        without `RenderOutput.defer` stores its gradients in any case, and so does a batch: its views are rendered
        from the same Gaussians.
        """
        parts = self._parts
        plain = (
            parts.reduce is mean_over_views and parts.adam is adam_step and type(self._objective) is Objective
        )
        return parts.fused and plain and self._blind

    @property
    def _blind(self) -> bool:
        return self.density is None or getattr(self.density, "observes_renders_only", False)

    def _measured(self) -> dict[str, Tensor]:
        return {name: tensor for name, tensor in self._learned.items() if name not in self._groups}

    def _make_optimizer(self, parameters: Mapping[str, Tensor]) -> Adam:
        kernel, team = self._parts.adam, self._parts.team
        if team.size > 1:
            return SharedAdam(parameters, self._groups, kernel, team)
        return Adam(parameters, self._groups, kernel)

    def _fused_step(self, draw: Draw) -> dict[str, Tensor]:
        """Take a step with one view, moving the Gaussians in the backward pass if the backend offers it."""
        rendered = self._rendered(draw)
        in_backward = rendered.output.defer() if rendered.output.defer else None
        terms = self._objective.backward(rendered)
        if in_backward is None:
            self._observe(rendered)
            self.apply()
        else:
            self.apply(in_backward)
            self._observe(rendered)
        return terms

    def _draw(self) -> list[Draw]:
        """Return the views of the next step that this process renders. If a photo cannot be read, all remain due."""
        places, batch = self._places, self.config.batch
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

    def gradients(self, draws: Sequence[Draw]) -> dict[str, Tensor]:
        """Add the gradients of the objective for these views to the parameters' `grad`.

        Those of several views are summed in the tree of `gsplat_edu.train.batches`.

        Args:
            draws: Views from the feed; density control observes each of them.

        Returns:
            () the mean over the views of every term of the objective, by name.
        """
        if len(draws) == 1:
            rendered = self._rendered(draws[0])
            terms = self._objective.backward(rendered)
            self._observe(rendered)
            return terms
        batch, names = self._differentiated(draws, range(len(draws)), len(draws))
        batch.commit()
        for name, gradient in batch.sums.total.items():
            batch.learned[name].grad = gradient
        return batch.mean_terms(names)

    def _differentiated(self, draws: Sequence[Draw], places: range, count: int) -> tuple[Batch, list[str]]:
        """Render and differentiate views of a batch of `count`; return what they leave, and the terms' names."""
        learned = {name: tensor for name, tensor in self.parameters().items() if name in self._groups}
        batch, names = Batch(count, learned, self._measured()), list[str]()
        alone, listens = len(places) == count, self.density and not getattr(self.density, "is_over", False)
        for place, draw in zip(places, draws, strict=True):
            rendered = self._rendered(draw)
            terms = self._objective.backward(rendered)
            names = list(terms)
            self._observe(rendered, alone)
            batch.take(place, draw.index, terms, rendered.output if listens and not alone else None)
        return batch, names

    def _shared_step(self, draws: Sequence[Draw]) -> dict[str, Tensor]:
        """Take a step together with other processes, of whose views density control learns from their messages."""
        count, places, team, optimizer = self.config.batch, self._places, self._parts.team, self._optimizer
        assert isinstance(optimizer, SharedAdam)
        self._skip_backgrounds(places.start)
        batch, names = self._differentiated(draws, places, count)
        self._skip_backgrounds(count - places.stop)
        sums = share_results(team, batch, optimizer.outgoing(batch.sums))
        batch.commit()
        for place in range(count):
            if self.density is not None:
                with one_thread():
                    self.density.observe(self.gaussians, batch.results[place].output())
        rows = optimizer.own(self.parameters())
        for name, gradient in optimizer.summed(list(batch.learned), sums, count).items():
            rows[name].grad = gradient
        self._parts.reduce(rows, count)
        optimizer.schedule(self.iteration, count)
        optimizer.step(rows)
        optimizer.spread(self.gaussians.tensors())
        self.iteration += count
        return batch.mean_terms(names)

    def _skip_backgrounds(self, count: int) -> None:
        if self.config.random_background:
            self._backgrounds.uniform(size=3 * count)

    def _observe(self, rendered: Rendered, tell: bool = True) -> None:
        if self.density is not None and tell:
            with one_thread():
                self.density.observe(self.gaussians, rendered.output)
        self.last = rendered.image.detach(), rendered.target.image, rendered.target.mask
        self.last_name = rendered.draw.view.name

    def _rendered(self, draw: Draw) -> Rendered:
        """Render a view with the settings of the iteration, and apply the view model."""
        background = self.config.background
        if self.config.random_background:
            background = tuple(self._backgrounds.uniform(size=3).tolist())
        target = self._feed.target(draw, background)
        if self._parts.transients is not None:
            target = self._parts.transients.applied(draw.index, target)
        model = self._parts.view_model
        camera = model.camera(draw.index, draw.view.camera)
        output = self._render(self.gaussians, camera, settings=self._settings(background))
        seen = Seen(output.image, output.transmittance, background, camera, output.median_depth)
        image = model.image(draw.index, seen, target, self.iteration)
        return Rendered(self.gaussians, draw, output, image, target, self.iteration)

    def _settings(self, background: tuple[float, float, float]) -> RenderSettings:
        """Return the render settings of the iteration."""
        return RenderSettings(
            background=background,
            sh_degree=sh_degree(self.config, self.iteration),
            antialiased=self.config.antialiased,
            jacobian_limit=self.config.jacobian_limit,
            depth=self._objective.needs_depth,
            median_depth=self._parts.view_model.needs_depth,
        )

    def apply(self, in_backward: AdamInBackward | None = None) -> None:
        """Take an optimiser step with the stored gradients at the rates of the iteration, then clear them.

        Args:
            in_backward: The step for the Gaussians, if their gradients are not stored; see `Adam.step`.
        """
        self._optimizer.schedule(self.iteration, self.config.batch)
        self._optimizer.step(self.parameters(), in_backward)
        self.iteration += self.config.batch

    def parameters(self) -> dict[str, Tensor]:
        """Return all learned tensors by name: the raw parameters of the Gaussians and those of the view model."""
        return self.gaussians.tensors() | self._learned

    def _tell(self, event: Event, receivers: Sequence[Callback]) -> None:
        for callback in receivers:
            callback(self, event)

    def state(self) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """Return the state from which a run resumes with identical results: tensors, and values for JSON."""
        moments, steps = self._optimizer.state()
        parts = {"gaussians": self.gaussians.tensors(), "view_model": self._learned, **moments}
        numbers: dict[str, Any] = {
            "iteration": self.iteration,
            "steps": steps,
            "feed": self._feed.state(),
            "backgrounds": self._backgrounds.bit_generator.state,
        }
        if self.density is not None:
            parts["density"], numbers["density"] = self.density.state()
        if self._parts.transients is not None:
            parts["transients"] = self._parts.transients.state()
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
        parts: dict[str, dict[str, Tensor]] = {part: {} for part in PARTS}
        for key, tensor in tensors.items():
            part, _, name = key.partition(".")
            if part not in parts:
                raise ArgumentError(f"{key[:60]!r}: is unknown")
            parts[part][name] = tensor
        gaussians = self._checked_gaussians(parts["gaussians"])
        keys = ("iteration", "steps", "feed", "backgrounds", *(["density"] if self.density else []))
        given = check_entries("state", numbers, keys)
        iteration = check_whole("iteration", given["iteration"], self.config.iterations)
        if check_whole("steps", given["steps"], self.config.iterations) != iteration:
            raise ArgumentError("steps: has to equal the iteration")
        if iteration % self.config.batch:
            raise ArgumentError(f"iteration: has to be a multiple of batch = {self.config.batch}")
        self._feed.check_state(given["feed"])
        check_numpy_generator("backgrounds", given["backgrounds"], self._backgrounds)
        learned = check_entries("view_model", parts["view_model"], tuple(self._learned))
        for name, like in self._learned.items():
            check_tensor_kind(f"view_model.{name}", learned[name], like.dtype, like.shape)
        transients = self._parts.transients
        if transients is not None:
            transients.check_state(parts["transients"])
        elif parts["transients"]:
            raise ArgumentError("transients: are present, but this run has none")
        parameters = gaussians.tensors() | self._learned
        optimizer = self._make_optimizer(parameters)
        optimizer.load_state({part: parts[part] for part in MOMENTS}, iteration, parameters)
        if self.density is not None:  # the last check that can fail
            if not isinstance(given["density"], dict):
                raise ArgumentError("density: has to be an object")
            device = gaussians.means.device
            density = {
                name: tensor if tensor.dtype == torch.uint8 else tensor.to(device)
                for name, tensor in parts["density"].items()
            }
            self.density.load_state(density, given["density"], gaussians)
        elif parts["density"]:
            raise ArgumentError("density: is present, but this run has no density control")
        self.gaussians, self._optimizer, self.iteration = gaussians, optimizer, iteration
        with torch.no_grad():
            for name, parameter in self._learned.items():
                parameter.copy_(learned[name])
        if transients is not None:
            transients.load_state(parts["transients"])
        self._feed.load_state(given["feed"])
        self._backgrounds.bit_generator.state = given["backgrounds"]

    def _checked_gaussians(self, given: dict[str, Tensor]) -> Gaussians:
        """Check dtypes and shapes against the start Gaussians, and return the stored ones; NaN and infinity pass."""
        like = self.gaussians.tensors()
        check_entries("gaussians", given, tuple(like))
        count = given["means"].shape[0] if given["means"].ndim else 0
        for name, tensor in like.items():
            check_tensor_kind(f"gaussians.{name}", given[name], tensor.dtype, (count, *tensor.shape[1:]))
        cap = self.config.max_gaussians
        if not count or (cap is not None and count > cap):
            raise ArgumentError(
                f"gaussians: there are {count}; their number has to be from 1 to {cap or 'any'}"
            )
        return Gaussians(**given).to(self.gaussians.means.device).trainable()

"""One step of a training: render the views, differentiate the objective, move the parameters.

`Trainer` draws views and decides what happens between steps; a stepper holds everything that a step changes. If a
backend keeps Gaussians, moments and photos on its device for a whole run, the stepper of `train/resident.py` takes the
steps there: `step` then moves nothing that grows with Gaussians or pixels, `change` and `state` read the scene back,
and `gaussians` does so when it is asked for.

Chapter: 09_train_in_3d.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple, Protocol, runtime_checkable

import torch
from torch import Tensor

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.threads import one_thread
from gsplat_edu.ops.moments import AdamInBackward
from gsplat_edu.render.api import render
from gsplat_edu.render.backend import Backend
from gsplat_edu.render.camera_tensors import split_camera
from gsplat_edu.render.planes import facing_normals
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.train.batches import Batch
from gsplat_edu.train.density.base import DensityStrategy
from gsplat_edu.train.events import Change, Terms as Terms
from gsplat_edu.train.far import Shell, features_before
from gsplat_edu.train.feed import Draw, Target
from gsplat_edu.train.objective import Objective, Rendered
from gsplat_edu.train.optimizer import MOMENTS, Adam, ParameterGroup
from gsplat_edu.train.part_values import Masker
from gsplat_edu.train.rendered import without_shell
from gsplat_edu.train.saved import check_entries, check_tensor_kind
from gsplat_edu.train.team import ALONE, SharedAdam, Team, places_of, share_results
from gsplat_edu.train.view_model import Identity, Rows, ViewModel, ViewRender


@one_thread()
def mean_over_views(parameters: Mapping[str, Tensor], num_views: int) -> None:
    """Divide every gradient by the number of views; the gradient of a single view is unchanged."""
    if num_views > 1:
        for parameter in parameters.values():
            if parameter.grad is not None:
                parameter.grad /= num_views


@dataclass(frozen=True)
class StepParts:
    """What a step consists of; `gsplat_edu.train.compose` makes what a configuration asks for.

    The parts of a training (`gsplat_edu.train.part.Part`) contribute terms, view models and maskers to it.

    Args:
        objective: The objective to minimise.
        density: Clones, splits, prunes or moves Gaussians after a step; None keeps them.
        view_model: Corrects the camera and the image of a view before the loss compares it.
        maskers: Find masks and apply them, by the names of their parts.
        fused: Takes Adam's step for the Gaussians in the backward pass where that gives the same bits, so that their
            gradients need no memory; see `TensorStepper.fuses`.
        team: The processes that share each step.
        shell: Where far splats lie, which terms of depth and normals leave out; None if there are none.
    """

    objective: Objective
    density: DensityStrategy | None = None
    view_model: ViewModel = field(default_factory=Identity)
    maskers: Mapping[str, Masker] = field(default_factory=dict)
    fused: bool = True
    team: Team = ALONE
    shell: Shell | None = None


@dataclass(frozen=True, eq=False)
class StepView:
    """One view of a step.

    Args:
        draw: The view and its index.
        target: What its render is compared with.
        settings: How it is rendered.
    """

    draw: Draw
    target: Target
    settings: RenderSettings


class Shown(NamedTuple):
    """The last image of a training that was compared with a photo.

    Args:
        image: (H, W, 3) the image.
        target: Its photo and mask.
        name: Name of the view.
    """

    image: Tensor
    target: Target
    name: str


class Loaded(NamedTuple):
    """A checked state of a stepper, ready to be taken over.

    Args:
        gaussians: The Gaussians, as leaves that collect gradients.
        optimizer: The optimiser with its moments.
        learned: The view model's tensors, by name.
    """

    gaussians: Gaussians
    optimizer: Adam
    learned: Mapping[str, Tensor]


@runtime_checkable
class Stepper(Protocol):
    """Holds the Gaussians and what moves them, and takes steps.

    The trainer asks for `count` after every step, and for `gaussians` only where something reads them: callbacks,
    milestones, checkpoints and the end of a run.

    Attributes:
        gaussians: The current Gaussians; a stepper on a device reads them back.
        count: Their number.
        shown: The last image that was compared; None before the first step.
        parts: The parts of a step.
        places: The places of a batch whose views this process renders.
        photo_room: Bytes of targets that the feed is to keep; None for the rule of `ViewFeed`.
    """

    @property
    def gaussians(self) -> Gaussians: ...  # noqa: D102

    @property
    def photo_room(self) -> int | None: ...  # noqa: D102

    @property
    def count(self) -> int: ...  # noqa: D102

    @property
    def shown(self) -> Shown | None: ...  # noqa: D102

    @property
    def parts(self) -> StepParts: ...  # noqa: D102

    @property
    def places(self) -> range: ...  # noqa: D102

    def step(self, views: Iterable[StepView], iteration: int) -> Terms:
        """Take one step with the gradients of these views, each drawn when the one before it is done.

        Args:
            views: The views of the step that this process renders.
            iteration: The step's first image, counted from 0.

        Returns:
            The mean of every term of the objective over the views.
        """
        ...

    def change(self, iteration: int) -> list[Change]:
        """Let the density strategy change the Gaussians after a step whose last image is `iteration`."""
        ...

    def state(self) -> tuple[dict[str, dict[str, Tensor]], int]:
        """Return the tensors of a checkpoint by group and name, and the number of views of the steps taken."""
        ...

    def loaded(self, tensors: Mapping[str, dict[str, Tensor]], iteration: int) -> Loaded:
        """Check the tensors of a checkpoint, without changing anything.

        Args:
            tensors: By group and name, as `state` returns them.
            iteration: Images of the steps taken.

        Raises:
            ArgumentError: the state does not fit; the message names the entry.
        """
        ...

    def take_over(self, loaded: Loaded) -> None:
        """Continue from a state that `loaded` returned."""
        ...


class TensorStepper:
    """Steps on torch's tensors: the backend renders and differentiates, and Adam moves all tensors with gradients.

    Args:
        gaussians: The start Gaussians; not changed.
        backend: The kernels.
        groups: Settings of the optimiser by the names of the parameters.
        parts: The parts of a step.
        batch: Views of a step, of all processes.

    Raises:
        ArgumentError: parts do not fit one another, the batch or the backend.
    """

    photo_room: int | None = None

    def __init__(
        self,
        gaussians: Gaussians,
        backend: Backend,
        groups: Mapping[str, ParameterGroup],
        parts: StepParts,
        batch: int,
    ) -> None:
        self.gaussians, self.parts = gaussians.trainable(), parts
        self.shown: Shown | None = None
        self._backend, self._batch = backend, batch
        self._learned = dict(parts.view_model.parameters())
        if taken := sorted(set(self._learned) & set(self.gaussians.tensors())):
            raise ArgumentError(f"view_model: {taken[0]!r} is the name of a parameter of the Gaussians")
        self._groups = dict(groups) | dict(parts.view_model.groups())
        self._measured = {name: t for name, t in self._learned.items() if name not in self._groups}
        self.places = places_of(parts.team, batch)
        if parts.team.size > 1:
            backend.require("processes", f"team: of {parts.team.size} processes")
            if not self._reads_output_only:
                raise ArgumentError("density: observes more than renders; train it in one process")
        self.optimizer = self._make_optimizer(self.parameters())

    @property
    def count(self) -> int:
        """Number of Gaussians."""
        return len(self.gaussians)

    @property
    def fuses(self) -> bool:
        """Whether the Gaussians may be moved in the backward pass of a single view, with the same bits.

        False if something needs their gradients: a subclass of `Objective` (it may pass backward more than once), or a
        density strategy without a true attribute `observes_renders_only`. A render without `RenderOutput.defer` stores
        its gradients in any case, and so does a batch: its views are rendered from the same Gaussians.
        """
        return self.parts.fused and type(self.parts.objective) is Objective and self._reads_output_only

    @property
    def _reads_output_only(self) -> bool:
        density = self.parts.density
        return density is None or getattr(density, "observes_renders_only", False)

    def _make_optimizer(self, parameters: Mapping[str, Tensor]) -> Adam:
        kernel, team = self._backend.adam, self.parts.team
        if team.size > 1:
            return SharedAdam(parameters, self._groups, kernel, team)
        return Adam(parameters, self._groups, kernel)

    def parameters(self) -> dict[str, Tensor]:
        """Return all learned tensors by name: the raw parameters of the Gaussians and those of the view model."""
        return self.gaussians.tensors() | self._learned

    def step(self, views: Iterable[StepView], iteration: int) -> Terms:
        """Take one step; see `Stepper.step`."""
        if self.parts.team.size > 1:
            return self._shared_step(views, iteration)
        if self._batch == 1:
            (view,) = views
            return self._single_step(view, iteration)
        terms = self.gradients(list(views), iteration)
        mean_over_views(self.parameters(), self._batch)
        self.apply(iteration)
        return terms

    def _single_step(self, view: StepView, iteration: int) -> Terms:
        """Take a step with one view, moving the Gaussians in the backward pass if the backend offers it.

        `RenderOutput.defer` then keeps that pass from the Gaussians until `apply` finishes it, with Adam's step in it.
        The norms that density control observes are known only then.
        """
        rendered, rows = self._rendered(view, iteration)
        defer = rendered.output.defer if self.fuses else None
        in_backward = None if defer is None else defer()
        terms = self.parts.objective.backward(rendered)
        self._store(view.draw.index, rows)
        if in_backward is None:
            self._observe(rendered)
            self.apply(iteration)
        else:
            self.apply(iteration, in_backward)
            self._observe(rendered)
        return terms

    def gradients(self, views: Sequence[StepView], iteration: int) -> Terms:
        """Add the gradients of the objective for these views to the parameters' `grad`.

        Gradients of several views are summed in the tree of `gsplat_edu.train.batches`.

        Args:
            views: Views from the feed; density control observes each of them.
            iteration: The step's first image, counted from 0.

        Returns:
            The mean over the views of every term of the objective.
        """
        if len(views) == 1:
            rendered, rows = self._rendered(views[0], iteration)
            terms = self.parts.objective.backward(rendered)
            self._store(views[0].draw.index, rows)
            self._observe(rendered)
            return terms
        batch, names = self._differentiated(views, range(len(views)), len(views), iteration)
        batch.store_rows(self._measured)
        for name, gradient in batch.sums.total.items():
            batch.learned[name].grad = gradient
        return batch.mean_terms(names)

    def _differentiated(
        self, views: Iterable[StepView], places: range, count: int, iteration: int
    ) -> tuple[Batch, list[str]]:
        """Render and differentiate views of a batch of `count`; return their results, and the terms' names."""
        learned = {name: tensor for name, tensor in self.parameters().items() if name in self._groups}
        batch, names = Batch(count, learned), list[str]()
        alone, listens = (
            len(places) == count,
            self.parts.density and not getattr(self.parts.density, "is_over", False),
        )
        for place, view in zip(places, views, strict=True):
            rendered, rows = self._rendered(view, iteration)
            terms = self.parts.objective.backward(rendered)
            names = list(terms)
            self._observe(rendered, alone)
            output = rendered.output if listens and not alone else None
            batch.take(place, view.draw.index, terms, rows, output)
        return batch, names

    def _shared_step(self, views: Iterable[StepView], iteration: int) -> Terms:
        """Take a step together with other processes. Density control observes their views through messages."""
        count, team, optimizer = self._batch, self.parts.team, self.optimizer
        assert isinstance(optimizer, SharedAdam)
        batch, names = self._differentiated(views, self.places, count, iteration)
        sums = share_results(team, batch, optimizer.outgoing(batch.sums))
        batch.store_rows(self._measured)
        for place in range(count):
            if self.parts.density is not None:
                with one_thread():
                    self.parts.density.observe(self.gaussians, batch.results[place].output())
        rows = optimizer.own(self.parameters())
        for name, gradient in optimizer.summed(list(batch.learned), sums, count).items():
            rows[name].grad = gradient
        mean_over_views(rows, count)
        optimizer.schedule(iteration, count)
        optimizer.step(rows)
        optimizer.spread(self.gaussians.tensors())
        return batch.mean_terms(names)

    def _rendered(self, view: StepView, iteration: int) -> tuple[Rendered, Rows]:
        """Render a view, measure it for the view model, and correct the image that is compared."""
        index, target, model = view.draw.index, view.target, self.parts.view_model
        camera = model.camera(index, view.draw.view.camera)
        at, _ = split_camera(camera)
        needs = self.parts.objective.needs(iteration) | model.needs.at(iteration)
        depth = needs.depth or needs.normals
        features = facing_normals(self.gaussians, at) if needs.normals else None
        shell = self.parts.shell if depth else None
        if shell is not None:
            features = features_before(shell, self.gaussians, at, features)
        output = render(
            self.gaussians,
            camera,
            settings=replace(view.settings, depth=depth, median_depth=needs.median_depth),
            features=features,
            needed=None if needs.every_pixel else target.mask,
            backend=self._backend,
        )
        given = ViewRender(
            output.image, output.transmittance, view.settings.background, camera, output.median_depth
        )
        rows = model.measure(index, given, target, iteration)
        image = model.correct(index, given, target, rows)
        scene = None if shell is None else without_shell(output)
        return Rendered(self.gaussians, view.draw, output, image, target, iteration, at, scene), rows

    def _store(self, index: int, rows: Rows) -> None:
        """Write what was measured of a view into the view model's tensors."""
        for name, tensor in self._measured.items():
            tensor[index] = rows[name]

    def _observe(self, rendered: Rendered, tell: bool = True) -> None:
        if self.parts.density is not None and tell:
            with one_thread():
                self.parts.density.observe(self.gaussians, rendered.output)
        self.shown = Shown(rendered.image.detach(), rendered.target, rendered.draw.view.name)

    def apply(self, iteration: int, in_backward: AdamInBackward | None = None) -> None:
        """Take an optimiser step at the rates of the iteration with the stored gradients, which the optimiser clears.

        Args:
            iteration: The step's first image, counted from 0.
            in_backward: The step for the Gaussians, if their gradients are not stored; see `Adam.step`.
        """
        self.optimizer.schedule(iteration, self._batch)
        self.optimizer.step(self.parameters(), in_backward)

    def change(self, iteration: int) -> list[Change]:
        """Let the density strategy change the Gaussians; see `Stepper.change`."""
        if self.parts.density is None:
            return []
        with one_thread():
            self.gaussians, events = self.parts.density.update(iteration, self.gaussians, self.optimizer)
        return events

    def state(self) -> tuple[dict[str, dict[str, Tensor]], int]:
        """Return the state; see `Stepper.state`."""
        moments, steps = self.optimizer.state()
        return {"gaussians": self.gaussians.tensors(), "view_model": self._learned, **moments}, steps

    def loaded(self, tensors: Mapping[str, dict[str, Tensor]], iteration: int) -> Loaded:
        """Check a state; see `Stepper.loaded`. The number of Gaussians may differ from the start's."""
        gaussians = self._checked_gaussians(tensors["gaussians"])
        learned = check_entries("view_model", tensors["view_model"], tuple(self._learned))
        for name, like in self._learned.items():
            check_tensor_kind(f"view_model.{name}", learned[name], like.dtype, like.shape)
        parameters = gaussians.tensors() | self._learned
        optimizer = self._make_optimizer(parameters)
        optimizer.load_state({moment: tensors[moment] for moment in MOMENTS}, iteration, parameters)
        return Loaded(gaussians, optimizer, learned)

    def take_over(self, loaded: Loaded) -> None:
        """Go on from a checked state; see `Stepper.take_over`."""
        self.gaussians, self.optimizer = loaded.gaussians, loaded.optimizer
        with torch.no_grad():
            for name, parameter in self._learned.items():
                parameter.copy_(loaded.learned[name])

    def _checked_gaussians(self, given: dict[str, Tensor]) -> Gaussians:
        """Check dtypes and shapes against the start Gaussians, and return the stored ones; NaN and infinity pass."""
        like = self.gaussians.tensors()
        check_entries("gaussians", given, tuple(like))
        count = given["means"].shape[0] if given["means"].ndim else 0
        for name, tensor in like.items():
            check_tensor_kind(f"gaussians.{name}", given[name], tensor.dtype, (count, *tensor.shape[1:]))
        return Gaussians(**given).to(self.gaussians.means.device).trainable()

"""Steps of a training that stays on a device, and the rule which trainings can.

The host keeps a `TensorStepper` whose Gaussians, moments and statistics are those of the last time they were read.
Density control works on it, unchanged, when it is due; checkpoints come from it. In between, a step sends a camera and
a few numbers, and its losses are read after the next step was sent.
"""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping

import torch
from torch import Tensor

from gsplat_edu.base.errors import BackendWarning
from gsplat_edu.render.backend import Backend
from gsplat_edu.render.resident import ResidentRun, RunRules, RunState, RunSums, RunTarget
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.train.config import TrainConfig
from gsplat_edu.train.density.base import DensityStrategy, FollowsDevice
from gsplat_edu.train.events import PHOTO, Change
from gsplat_edu.train.objective import MeanOpacity, MeanScale, Objective, PhotoTerm
from gsplat_edu.train.optimizer import ParameterGroup
from gsplat_edu.train.part import parts
from gsplat_edu.train.step import (
    Loaded,
    Shown,
    StepParts,
    Stepper,
    StepView,
    TensorStepper,
    Terms,
)
from gsplat_edu.train.view_model import Identity

PHOTO_ROOM = 1 << 30
"""Bytes of targets in memory, so that a photo is read and decoded once; the device has photos of its own."""

OPACITY, SCALE = "opacity", "scale"
"""Names of the terms besides the photo's that a device can differentiate."""


def make_stepper(
    gaussians: Gaussians,
    backend: Backend,
    groups: Mapping[str, ParameterGroup],
    parts: StepParts,
    batch: int,
) -> Stepper:
    """Make the stepper of a training: on the backend's device if it offers that and can do all parts.

    Args:
        gaussians: The start Gaussians; not changed.
        backend: The kernels.
        groups: Settings of the optimiser by the names of the parameters.
        parts: The parts of a step.
        batch: Views of a step, of all processes.

    Raises:
        ArgumentError: parts do not fit one another, the batch or the backend.

    Warns:
        BackendWarning: the training does not stay on the device; the message says why.
    """
    host = TensorStepper(gaussians, backend, groups, parts, batch)
    if backend.resident is None:
        return host
    if reason := why_not(gaussians, backend, parts, batch):
        warnings.warn(
            f"backend {backend.name!r}: Gaussians and images pass through the host at every step, because {reason}",
            BackendWarning,
            stacklevel=3,
        )
        return host
    run = backend.resident(gaussians.sh_rest.shape[1], backend.photo_room)
    # who limits the photos on the device keeps those of the processor too
    room = PHOTO_ROOM if backend.photo_room is None else None
    return ResidentStepper(host, run, room)


def why_not(
    gaussians: Gaussians,
    backend: Backend,
    parts: StepParts,
    batch: int,
) -> str | None:
    """Return what of a training a device cannot do; None if it can do all."""
    reasons = {
        "a batch has several views": batch > 1,
        "processes share the step": parts.team.size > 1,
        "the view model corrects images or cameras": type(parts.view_model) is not Identity,
        "masks of moving things are found": bool(parts.maskers),
        "gradients are to be stored (fused=False)": not parts.fused,
        f"the Gaussians are {gaussians.means.dtype}": gaussians.means.dtype != torch.float32,
        "the density strategy does not follow a device": not _follows(parts.density),
        "the objective is another class": type(parts.objective) is not Objective,
    }
    for reason, holds in reasons.items():
        if holds:
            return reason
    for name, term in parts.objective.terms.items():
        if not _known(name, term, backend):
            return f"the objective has the term {name!r}"
    return None


def leaves_device(config: TrainConfig, asked: Mapping[str, str]) -> str | None:
    """Return what of a training no device can do, so that its steps pass through the processor; None if it can do all.

    It says beforehand what `why_not` says of the parts that a configuration leads to.

    Args:
        config: The configuration.
        asked: As in `gsplat_edu.runs.options.RunOptions`.
    """
    if config.batch > 1:
        return f"batch is {config.batch}"
    said = (part.leaves_device(config.settings_of(name), asked.get(name)) for name, part in parts().items())
    return next(filter(None, said), None)


def _follows(density: DensityStrategy | None) -> bool:
    """Return whether a device can collect and wait for a strategy; a subclass with other methods may need more."""
    if density is None:
        return True
    owners = {
        next(each for each in type(density).__mro__ if name in vars(each))
        for name in ("observe", "update", "is_due")
        if hasattr(density, name)
    }
    return isinstance(density, FollowsDevice) and len(owners) == 1


def _known(name: str, term: object, backend: Backend) -> bool:
    if type(term) is PhotoTerm:
        return name == PHOTO and term.loss in (None, backend.loss)
    return (name, type(term)) in ((OPACITY, MeanOpacity), (SCALE, MeanScale))


class _LateTerms(Mapping[str, Tensor]):
    """The terms of a step, read from the device when one is asked for."""

    def __init__(self, names: tuple[str, ...], sums: Callable[[], RunSums]) -> None:
        self._names, self._sums = names, sums

    def __getitem__(self, name: str) -> Tensor:
        if name not in self._names:
            raise KeyError(name)
        return torch.tensor(getattr(self._sums(), name), dtype=torch.float32)

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)


class ResidentStepper:
    """Steps on a device; see `Stepper`.

    Args:
        host: Has the start; holds what was read last.
        run: The training on the device.
        photo_room: Bytes of targets that the feed is to keep; None for its own rule.
    """

    def __init__(
        self,
        host: TensorStepper,
        run: ResidentRun,
        photo_room: int | None = PHOTO_ROOM,
    ) -> None:
        self.photo_room = photo_room
        density = host.parts.density
        assert density is None or isinstance(density, FollowsDevice)
        self._host, self.device_run, self._density = host, run, density
        self.parts, self.places = host.parts, host.places
        self._loaded = False  # whether the device has the run
        self._ahead = False  # whether it has taken steps since the host read it
        self._view: StepView | None = None
        self._image: Tensor | None = None

    @property
    def gaussians(self) -> Gaussians:
        """The current Gaussians, read from the device if it is ahead."""
        self._read()
        return self._host.gaussians

    @property
    def count(self) -> int:
        """Number of Gaussians."""
        return self._host.count

    @property
    def shown(self) -> Shown | None:
        """The last image that was compared, read from the device; None before the first step."""
        if self._view is None:
            return None
        if self._image is None:
            self._image = self.device_run.image()
        return Shown(self._image, self._view.target, self._view.draw.view.name)

    def step(self, views: Iterable[StepView], iteration: int) -> Terms:
        """Take one step; see `Stepper.step`. Reading a term waits for the step."""
        (view,) = views
        self._load()
        optimizer, photo = self._host.optimizer, view.draw.photo
        optimizer.schedule(iteration)
        constant = view.draw.view if photo is None or photo.alpha is None else None
        target = RunTarget(view.draw.index, view.target.image, view.target.mask, constant)
        sums = self.device_run.step(
            view.draw.view.camera, view.settings, target, optimizer.advance(), self._rules(iteration)
        )
        self._ahead, self._view, self._image = True, view, None
        return _LateTerms(tuple(self.parts.objective.terms), sums)

    def _rules(self, iteration: int) -> RunRules:
        """Return the weights of the terms at an iteration."""
        terms = self.parts.objective.terms
        photo, opacity, scale = (terms.get(name) for name in (PHOTO, OPACITY, SCALE))
        assert isinstance(photo, PhotoTerm)
        rules = RunRules(photo.ssim_weight, shell=self._shell)
        if isinstance(opacity, MeanOpacity) and (opacity.until is None or iteration < opacity.until):
            rules = dataclasses.replace(rules, opacity_weight=opacity.weight, least_share=opacity.least_share)
        if isinstance(scale, MeanScale):
            rules = dataclasses.replace(rules, scale_weight=scale.weight)
        collects = self._density is not None and not getattr(self._density, "is_over", False)
        return dataclasses.replace(rules, collects=collects)

    @property
    def _shell(self) -> tuple[float, float, float, float] | None:
        shell = getattr(self._density, "shell", None)
        if shell is None:
            return None
        x, y, z = shell.centre
        return float(x), float(y), float(z), float(shell.radius)

    def change(self, iteration: int) -> list[Change]:
        """Let the density strategy change the Gaussians on the host when it is due; see `Stepper.change`."""
        density = self._density
        if density is None:
            return []
        if density.is_due(iteration):
            self._read()
            self._keep_image()
            self._loaded = False
            return self._host.change(iteration)
        noise = density.passed(iteration, self._host.optimizer.learning_rates["means"])
        if noise is not None:
            self._load()
            self.device_run.add_noise(noise, self._rules(iteration))
            self._ahead = True
        return []

    def state(self) -> tuple[dict[str, dict[str, Tensor]], int]:
        """Return the tensors of a checkpoint, read from the device; see `Stepper.state`."""
        self._read()
        return self._host.state()

    def loaded(self, tensors: Mapping[str, dict[str, Tensor]], iteration: int) -> Loaded:
        """Check the tensors of a checkpoint; see `Stepper.loaded`."""
        return self._host.loaded(tensors, iteration)

    def take_over(self, loaded: Loaded) -> None:
        """Continue from a checked state; see `Stepper.take_over`."""
        self._keep_image()
        self._host.take_over(loaded)
        self._loaded = self._ahead = False

    def _keep_image(self) -> None:
        """Read the last image before the device gives its buffers back."""
        if self._view is not None and self._image is None:
            self._image = self.device_run.image()

    def _load(self) -> None:
        """Give the device the run of the host, unless it has it."""
        if self._loaded:
            return
        host, count = self._host, self._host.count
        statistics = {} if self._density is None else self._density.observed()
        norm_sums, times_visible = (
            statistics.get(name, torch.zeros(count)) for name in ("norm_sums", "times_visible")
        )
        gaussians = {name: tensor.detach() for name, tensor in host.gaussians.tensors().items()}
        first, second = host.optimizer.first, host.optimizer.second
        self.device_run.load(RunState(gaussians, first, second, norm_sums, times_visible))
        self._loaded = True

    def _read(self) -> None:
        """Give the host the run of the device, if that is ahead."""
        if not self._ahead:
            return
        state, host = self.device_run.read(), self._host
        host.gaussians = Gaussians(**state.gaussians).trainable()
        host.optimizer.first, host.optimizer.second = dict(state.first), dict(state.second)
        if self._density is not None:
            self._density.absorb({"norm_sums": state.norm_sums, "times_visible": state.times_visible})
        self._ahead = False

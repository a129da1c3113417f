"""The one place where a training is put together from a configuration, a dataset and a backend."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float64

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.validation import of_type, offers, one_of
from gsplat_edu.render.backend import Backend, check_backend_value
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.scene.rig import scene_extent
from gsplat_edu.scene.views import View
from gsplat_edu.train.capacity import planned_gaussians
from gsplat_edu.train.config import TrainConfig
from gsplat_edu.train.density.surgery import sorted_in_space
from gsplat_edu.train.far import Shell
from gsplat_edu.train.initialize import from_points, make_strategy
from gsplat_edu.train.objective import Term, joined_terms, make_objective
from gsplat_edu.train.overlap import separate_views
from gsplat_edu.train.part import parts as registered_parts
from gsplat_edu.train.part_values import Masker, Setup
from gsplat_edu.train.step import StepParts
from gsplat_edu.train.trainer import Callback, Trainer
from gsplat_edu.train.view_model import ViewModel, chained


@runtime_checkable
class TrainingData(Protocol):
    """What a training needs of a dataset; `gsplat_edu.data.dataset.Dataset` is one.

    Attributes:
        train: Training views, at least one.
        points: (N, 3) initial point cloud, world units.
        colors: (N, 3) their colours, 0 to 1.
    """

    @property
    def train(self) -> Sequence[View]: ...  # noqa: D102

    @property
    def points(self) -> Float64[np.ndarray, "N 3"]: ...  # noqa: D102

    @property
    def colors(self) -> Float64[np.ndarray, "N 3"]: ...  # noqa: D102


@dataclass(frozen=True, eq=False)
class Views:
    """Training views without a point cloud, for a training that starts from Gaussians.

    Args:
        train: The views.
    """

    train: Sequence[View]
    points: Float64[np.ndarray, "0 3"] = field(default_factory=lambda: np.zeros((0, 3)))
    colors: Float64[np.ndarray, "0 3"] = field(default_factory=lambda: np.zeros((0, 3)))


@dataclass(frozen=True, eq=False)
class Start:
    """Where a training starts, if not at the points of its dataset.

    Args:
        gaussians: The start Gaussians, in the order in which they are to lie in memory.
        shell: Where far splats lie; None if there are none.
        extent: Size of the scene, world units; that of the training cameras if None.
        generator: Source of the density strategy's draws; one with the configuration's seed if None.
    """

    gaussians: Gaussians
    shell: Shell | None = None
    extent: float | None = None
    generator: torch.Generator | None = None


def training(
    config: TrainConfig,
    dataset: TrainingData,
    backend: Backend,
    start: Start | None = None,
    *,
    callbacks: Sequence[Callback] = (),
    **parts: Any,  # noqa: ANN401
) -> Trainer:
    """Put a training together: everything that the configuration asks for is made and wired, or refused.

    Args:
        config: The configuration. For the strategy fast without `max_gaussians`, the cap follows from the views.
        dataset: The views, and the points to start from.
        backend: The kernels; see `gsplat_edu.render.backends.load_backend`.
        start: Where to start instead of at the dataset's points.
        callbacks: Called after every step and every change of the Gaussians.
        parts: Parts of a step to use instead of those that the configuration asks for, by the names of `StepParts`:
            another `objective` or `density`, a `team` of processes, `fused=False`, and so on.

    Returns:
        The trainer; `Trainer.run` trains.

    Raises:
        ArgumentError: there are no views or no points, or the configuration asks for what nothing here can give: mcmc
            without a cap, or what a part refuses.
    """
    of_type("config", config, TrainConfig)
    for name in parts:
        one_of("part", name, [each.name for each in dataclasses.fields(StepParts)])
    check_backend_value(backend)
    offers("dataset", dataset, TrainingData)
    config, start = _begin(config, dataset, start)
    cameras = [view.camera for view in dataset.train]
    _check_lenses(dataset.train, backend)
    extent = scene_extent(cameras) if start.extent is None else start.extent
    gaussians, shell = start.gaussians.to(backend.device), start.shell
    terms, view_model, maskers = _begun(Setup(config, dataset.train, extent, gaussians, backend, shell))
    made = StepParts(
        make_objective(config, shell, backend.loss, terms),
        make_strategy(config, extent, gaussians, shell, backend.add_noise, start.generator),
        view_model,
        maskers=maskers,
        shell=shell,
    )
    return Trainer(
        gaussians,
        dataset.train,
        config,
        backend,
        dataclasses.replace(made, **parts),
        extent=extent,
        callbacks=callbacks,
    )


def _begin(config: TrainConfig, dataset: TrainingData, start: Start | None) -> tuple[TrainConfig, Start]:
    """Return the configuration with its cap, and where the training starts."""
    if not dataset.train:
        raise ArgumentError("dataset: has no training views; give at least one")
    config = _with_cap(config, dataset, 0 if start is None else len(start.gaussians))
    if start is None:
        start = Start(sorted_in_space(from_points(dataset.points, dataset.colors, config)))
    return config, start


def _with_cap(config: TrainConfig, dataset: TrainingData, start: int) -> TrainConfig:
    """Return the configuration with the cap that fast plans for these views, unless it has one."""
    if config.strategy != "fast" or config.max_gaussians is not None:
        return config
    return dataclasses.replace(config, max_gaussians=max(planned_cap(dataset), start))


def planned_cap(dataset: TrainingData) -> int:
    """Return the number of Gaussians that the recipe fast grows to for the training views of a dataset."""
    cameras = [view.camera for view in dataset.train]
    pixels = float(np.mean([camera.W * camera.H for camera in cameras]))
    return planned_gaussians(pixels, len(cameras), separate_views(cameras, dataset.points))


def _begun(setup: Setup) -> tuple[dict[str, Term], ViewModel, dict[str, Masker]]:
    """Let all parts begin, in turn; return their terms, their view models as one, and what masks pixels.

    Raises:
        ArgumentError: as for `Part.begin`, or two terms have one name.
    """
    terms, models, maskers = dict[str, Term](), list[ViewModel](), dict[str, Masker]()
    for name, part in registered_parts().items():
        settings = setup.config.settings_of(name)
        begun = part.begin(settings, dataclasses.replace(setup, view_model=chained(models)))
        if begun is not None:
            terms = joined_terms(terms, begun.terms)
            models += [] if begun.view_model is None else [begun.view_model]
            maskers |= {} if begun.masker is None else {name: begun.masker}
        named = {f"{name}.{own}": term for own, term in part.terms(settings, setup.extent).items()}
        terms = joined_terms(terms, named)
    return terms, chained(models), maskers


def _check_lenses(views: Sequence[View], backend: Backend) -> None:
    """Check that the backend renders the views' lenses.

    Raises:
        ArgumentError: a view is no pinhole, and the backend knows pinholes only.
    """
    odd = next((view for view in views if not view.camera.pinhole), None)
    if odd is not None:
        backend.require("lens", f"the lens of {odd.name or 'a photo'}")

"""The one place where a training is put together from a configuration, a dataset and a backend."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float64

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.validation import of_type, offers, one_of
from gsplat_edu.render.api import render
from gsplat_edu.render.backend import Backend, check_backend_value
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.scene.rig import scene_extent
from gsplat_edu.scene.views import View
from gsplat_edu.train.capacity import planned_gaussians
from gsplat_edu.train.config import TrainConfig
from gsplat_edu.train.density.surgery import sorted_in_space
from gsplat_edu.train.far import Shell
from gsplat_edu.train.initialize import from_points, make_strategy, make_transients, make_view_model
from gsplat_edu.train.objective import make_objective
from gsplat_edu.train.overlap import separate_views
from gsplat_edu.train.patches import neighbourhood_for
from gsplat_edu.train.poses import NEED_LENSES
from gsplat_edu.train.step import StepParts
from gsplat_edu.train.trainer import Callback, Trainer


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
            without a cap, a sky without its splats in `start`, masks of things that move with too few views.
    """
    of_type("config", config, TrainConfig)
    for name in parts:
        one_of("part", name, [each.name for each in dataclasses.fields(StepParts)])
    check_backend_value(backend)
    offers("dataset", dataset, TrainingData)
    config, start = _begin(config, dataset, start)
    cameras = [view.camera for view in dataset.train]
    _check_lenses(config, dataset.train, backend)
    extent = scene_extent(cameras) if start.extent is None else start.extent
    gaussians, shell = start.gaussians.to(backend.device), start.shell
    features = functools.partial(render, backend=backend)
    view_model = make_view_model(config, cameras, extent, gaussians, backend.recolored)
    around = neighbourhood_for(config, dataset.train, view_model, extent)
    has_depth = any(view.depth is not None for view in dataset.train)
    made = StepParts(
        make_objective(config, shell, backend.loss, extent, around, has_depth),
        make_strategy(config, extent, gaussians, shell, backend.add_noise, start.generator),
        view_model,
        transients=make_transients(config, dataset.train, features),
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
    if config.sky != "none" and (start is None or start.shell is None):
        raise ArgumentError(
            f"sky: is {config.sky!r}, but start has no shell of splats; gsplat_edu.runs.skies makes it, or set"
            " sky='none'"
        )
    if start is None:
        start = Start(sorted_in_space(from_points(dataset.points, dataset.colors, config)))
    return config, start


def _with_cap(config: TrainConfig, dataset: TrainingData, start: int) -> TrainConfig:
    """Return the configuration with the cap that fast plans for these views, unless it has one."""
    if config.strategy != "fast" or config.max_gaussians is not None:
        return config
    cameras = [view.camera for view in dataset.train]
    pixels = float(np.mean([camera.W * camera.H for camera in cameras]))
    planned = planned_gaussians(pixels, len(cameras), separate_views(cameras, dataset.points))
    return dataclasses.replace(config, max_gaussians=max(planned, start))


def _check_lenses(config: TrainConfig, views: Sequence[View], backend: Backend) -> None:
    """Check that everything the configuration asks for works with the views' lenses.

    Raises:
        ArgumentError: a view is no pinhole, and the backend knows pinholes only; or one is orthographic, and a surface
            is to be learned.
    """
    if config.refine in NEED_LENSES:
        backend.require("lens", f"refine: {config.refine}")
    odd = next((view for view in views if not view.camera.pinhole), None)
    if odd is None:
        return
    backend.require("lens", f"the lens of {odd.name or 'a photo'}")
    if config.surface and (
        flat := next((v for v in views if v.camera.projection.kind == "orthographic"), None)
    ):
        raise ArgumentError(
            f"surface: needs rays that meet in the camera, and {flat.name or 'a photo'} is orthographic; "
            "leave it out, or train without --surface"
        )

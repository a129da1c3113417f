"""Options of a training run. The module imports nothing slow, so that the command line can check its options first."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from gsplat_edu.base.validation import one_of, whole_number
from gsplat_edu.data.settings import DataSettings
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.runs.folder import RunFolder
from gsplat_edu.train.config import TrainConfig
from gsplat_edu.train.part import OWN_PARTS, PLUGGED_PARTS


@dataclass(frozen=True)
class RunOptions:
    """Options of one training run.

    Args:
        data: The capture.
        out: The run's folder.
        config: The recipe.
        data_settings: How the capture is read.
        points: A file of points to start from; the capture's own points if None.
        scene: A trained scene to start from instead of points: a scene file or the folder of a run.
        backend: Name of the rendering backend.
        eval_every: Iterations between evaluations on the test views; the end of the run scores all views. 0 scores none
            at any time.
        save_every: Iterations between checkpoints; 0 writes one only at the end or when the run is stopped.
        resume: Continue from the last checkpoint of the folder.
        asked: What the user asked of parts beside the settings, by part: the value of its option, such as a folder;
            empty for an option without one. config.json has what `Part.recorded` says of it.
        records: What led to the options, for config.json by its key there: short trainings, facts about the photos.

    Raises:
        ArgumentError: a number is out of range, or `asked` names no part.
    """

    data: Path
    out: Path
    config: TrainConfig
    data_settings: DataSettings
    points: Path | None = None
    scene: Path | None = None
    backend: str = "cpu"
    eval_every: int = 1_000
    save_every: int = 500
    resume: bool = False
    asked: Mapping[str, str] = field(default_factory=dict)
    records: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Check the ranges."""
        for name in ("eval_every", "save_every"):
            whole_number(name, getattr(self, name), 0)
        for name in self.asked:
            one_of("asked", name, (*OWN_PARTS, *PLUGGED_PARTS))

    @property
    def folder(self) -> RunFolder:
        """The run's folder."""
        return RunFolder(self.out)

    @property
    def render_settings(self) -> RenderSettings:
        """Settings to render the trained scene with."""
        config = self.config
        return RenderSettings(
            background=config.background,
            sh_degree=config.sh_degree,
            antialiased=config.antialiased,
            jacobian_limit=config.jacobian_limit,
            depth=False,
        )

    @property
    def scores_at_end(self) -> bool:
        """Whether the end of the run scores the views."""
        return self.eval_every > 0

    @property
    def renderer(self) -> Callable[..., Any]:
        """A function of Gaussians and a camera that renders with these settings."""
        from gsplat_edu.render.api import render  # it imports torch

        return functools.partial(render, settings=self.render_settings, backend=self.backend)

"""What a run hands to the parts of its training, and what they give back; `gsplat_edu.train.part.Part` says when."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from gsplat_edu.base.validation import ArrayLike
from gsplat_edu.data.dataset import Dataset
from gsplat_edu.data.reader import CaptureReader
from gsplat_edu.evaluate.alignment import TensorRenderer
from gsplat_edu.evaluate.metrics import Renderer
from gsplat_edu.render.backend import Backend
from gsplat_edu.render.output import RenderOutput
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.scene.views import View
from gsplat_edu.train.config import TrainConfig
from gsplat_edu.train.far import Shell
from gsplat_edu.train.part import parts
from gsplat_edu.train.trainer import Trainer


@dataclass(frozen=True, eq=False)
class Captured:
    """The capture of a run, before the training.

    Args:
        dataset: The capture, with what the parts before gave it.
        reader: It has read the capture.
        points: The run's file of start points; None if it has none.
        asked: What the user asked of the part (`gsplat_edu.runs.options.RunOptions`); None for nothing.
        starts_from_scene: Whether the run starts from a scene, which may have far splats, instead of points.
        is_new: Whether the run begins now; false if it is resumed.
        say: Receives sentences for the user.
    """

    dataset: Dataset
    reader: CaptureReader
    points: Path | None
    asked: str | None
    starts_from_scene: bool
    is_new: bool
    say: Callable[[str], None]


@dataclass(frozen=True)
class Tried:
    """The value of a setting that short trainings chose or judged.

    Args:
        value: The value.
        reason: Why, as a clause.
        record: Entries of config.json; empty if no training was judged.
    """

    value: str
    reason: str
    record: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Added:
    """What a part adds to the start of a training.

    Args:
        gaussians: Start Gaussians beside those of the points; None for none. The cap leaves room for them.
        shell: Where far splats lie; None if there are none.
    """

    gaussians: Gaussians | None = None
    shell: Shell | None = None


@dataclass(frozen=True, eq=False)
class Unwritten:
    """A scene that is trained and not written yet.

    Args:
        gaussians: The scene, as the parts before left it.
        dataset: The capture as the parts' `learned` returned it.
        settings: The run's render settings.
        asked: As for `Captured`.
        say: Receives sentences for the user.
    """

    gaussians: Gaussians
    dataset: Dataset
    settings: RenderSettings
    asked: str | None
    say: Callable[[str], None]


@dataclass(frozen=True, eq=False)
class Revised:
    """What a part makes of a trained scene.

    Args:
        gaussians: The scene.
        facts: Entries of metrics.json.
    """

    gaussians: Gaussians
    facts: Mapping[str, Any]


@dataclass(frozen=True, eq=False)
class Compared:
    """A trained scene and the photos that it is compared with.

    Args:
        dataset: The capture, as the parts before left it.
        gaussians: The scene, on the backend's device.
        settings: How it is rendered.
        backend: What renders it.
    """

    dataset: Dataset
    gaussians: Gaussians
    settings: RenderSettings
    backend: Backend

    def photos(self, config: TrainConfig) -> Dataset:
        """Return the capture as the parts of a training leave it.

        Args:
            config: The training that made the scene.

        Raises:
            DatasetError: a photo cannot be read.
        """
        dataset = self.dataset
        for name, part in parts().items():
            dataset = part.compared(config.settings_of(name), replace(self, dataset=dataset))
        return dataset


@dataclass(frozen=True, eq=False)
class Finished:
    """A run whose training is over and whose scene is written.

    Args:
        path: The run's folder.
        trainer: The training.
        dataset: The capture.
        learned: The capture as the parts' `learned` returned it.
        gaussians: The scene.
        renderer: Renders Gaussians from a camera with the run's settings.
        is_scored: Whether the views are scored.
        say: Receives sentences for the user.
    """

    path: Path
    trainer: Trainer
    dataset: Dataset
    learned: Dataset
    gaussians: Gaussians
    renderer: TensorRenderer
    is_scored: bool
    say: Callable[[str], None]


@dataclass(frozen=True, eq=False)
class Ended:
    """A run that has just been scored.

    Args:
        path: The run's folder.
        gaussians: The trained scene.
        dataset: The capture.
        render: Renders features (`gsplat_edu.render.api.render`); None if there is no time to compare photos.
        settings: The run's render settings.
    """

    path: Path
    gaussians: Gaussians
    dataset: Dataset
    render: Callable[..., RenderOutput] | None
    settings: RenderSettings


@dataclass(frozen=True, eq=False)
class Reported:
    """A run for whose report the parts write sections.

    Args:
        path: The run's folder.
        config: The contents of config.json.
        metrics: The contents of metrics.json.
        log: The entries of the log.
        views: The training views that were scored.
        gaussians: The scene, without gradients.
        renderer: Renders Gaussians from a camera, over `background`.
        background: (3,) colour behind photos that are not opaque.
    """

    path: Path
    config: Mapping[str, Any]
    metrics: Mapping[str, Any]
    log: Sequence[Mapping[str, Any]]
    views: Sequence[View]
    gaussians: Gaussians
    renderer: Renderer
    background: ArrayLike

"""Parts of a training: what one is, and the registry of all. Plug-ins add parts and strategies; see docs/PLUGINS.md.

What composes a training, takes its steps, runs it on a capture and reports it loops over `parts()` and names none.
"""

from __future__ import annotations

import dataclasses
import functools
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from importlib.metadata import EntryPoint
from typing import Any, ClassVar

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.plugins import package_of, plugins
from gsplat_edu.train.setting import Question


@dataclasses.dataclass(frozen=True)
class NoSettings:
    """The settings of a plug-in that has none."""


class Part:
    """What a training can have besides Gaussians, photos and a strategy. Each method by default does nothing.

    The module of a plug-in imports torch only in functions: the command line reads the settings. `settings` are the
    run's `Settings`; those of our own parts are fields of `TrainConfig`, which they get whole.
    """

    Settings: ClassVar[type] = NoSettings
    """Frozen dataclass whose fields `gsplat_edu.train.strategy_config.number` declares; their names in options and
    config.json begin with the plug-in's name."""

    question: ClassVar[Question | None] = None
    """An option with which the user asks the part for something besides its settings; the methods get it as `asked`."""

    off_device: ClassVar[tuple[str, ...]] = ()
    """Settings of which a device can only do the default: those that add a term, correct views or mask pixels."""

    untimed: ClassVar[tuple[str, ...]] = ()
    """Settings that have their default in the steps that a forecast times, as when `cost` adds their time."""

    def leaves_device(self, settings: Any, asked: str | None) -> str | None:  # noqa: ANN401
        """Return what of the part no device can do, as "appearance is exposure"; None if it can do all.

        Args:
            settings: The run's `Settings`.
            asked: What the user asked of the part (`gsplat_edu.runs.options.RunOptions`); None for nothing.
        """
        values = ((name, getattr(settings, name)) for name in self.off_device)
        changed = (each for each in values if each[1] != getattr(type(settings), each[0]))
        return next((f"{name} is {'on' if value is True else value}" for name, value in changed), None)

    def cost(self, settings: Any, asked: str | None, capture: Any) -> Any:  # noqa: ANN401
        """Return what the part's terms add to a forecast, a `gsplat_edu.train.part_values.Cost`; None for nothing.

        Args:
            settings: The run's `Settings`.
            asked: As for `leaves_device`.
            capture: The capture at training size, a `gsplat_edu.budget.costs.Facts`.
        """
        return None

    def terms(self, settings: Any, extent: float) -> Mapping[str, Any]:  # noqa: ANN401
        """Return terms of the objective (`gsplat_edu.train.objective.Term`) by name, for a part that only has terms.

        Log and report call them PART.TERM; those that `begin` returns are called by their names as they are. With the
        settings' defaults there must be none: every training asks.

        Args:
            settings: The run's `Settings`.
            extent: Size of the scene, world units.
        """
        return {}

    def examine(self, survey: Any) -> Any:  # noqa: ANN401
        """Return what the doctor has to say of a capture, a `gsplat_edu.survey.finding.Examined`; None for nothing.

        Args:
            survey: The capture, a `gsplat_edu.survey.capture.Survey`, perhaps without a readable photo.
        """
        return None

    def choose(self, setting: str, capture: Any) -> Any:  # noqa: ANN401
        """Return the value of a setting that is auto, a `gsplat_edu.survey.finding.Remedy`; None if another has it.

        Args:
            setting: Its name.
            capture: The capture, a `gsplat_edu.survey.capture.Undecided`.

        Raises:
            DatasetError: the capture cannot be read.
        """
        return None

    tried: ClassVar[str] = ""
    """The setting that short trainings choose if it is auto; empty for none."""

    def needs_trial(self, value: str) -> bool:
        """Return whether short trainings also judge a value of `tried` that the user gave."""
        return False

    def try_out(self, asked: str, bench: Any) -> Any:  # noqa: ANN401
        """Choose the value of `tried` by short trainings, or judge the value that the user gave.

        Args:
            asked: That value; "" chooses.
            bench: Trains and scores, a `gsplat_edu.parts.bench.Bench`.

        Returns:
            A `gsplat_edu.parts.run_values.Tried`.

        Raises:
            ArgumentError: the backend cannot learn what was asked for.
            OutOfTimeError: the bench's time is over (`gsplat_edu.parts.bench`).
        """
        raise NotImplementedError(f"{type(self).__name__}: tried is {self.tried!r}, but nothing tries it out")

    def judge(self, settings: Any, run: Any) -> Any:  # noqa: ANN401
        """Return what the doctor has to say of a run, a `gsplat_edu.survey.finding.Examined`; None for nothing.

        Args:
            settings: The run's `Settings`.
            run: The run, a `gsplat_edu.survey.trained.Trained`.

        Raises:
            DatasetError: a photo cannot be read.
        """
        return None

    def remark(self, settings: Any, run: Any) -> str:  # noqa: ANN401
        """Return a sentence to say at the end of a training; empty for none.

        Args:
            settings: The run's `Settings`.
            run: The run, a `gsplat_edu.parts.run_values.Ended`.

        Raises:
            DatasetError: a photo cannot be read.
        """
        return ""

    def section(self, settings: Any, run: Any) -> Any:  # noqa: ANN401
        """Return the part's section in the report, a `gsplat_edu.evaluate.report_parts.Section`; None for none.

        Args:
            settings: The run's `Settings`.
            run: The run, a `gsplat_edu.parts.run_values.Reported`.
        """
        return None

    def reads(self, settings: Any, data: Any) -> Any:  # noqa: ANN401
        """Return how the photos of a run are read, for the training and for scores.

        Args:
            settings: The run's `Settings`.
            data: As the parts before read them, a `gsplat_edu.data.settings.DataSettings`.
        """
        return data

    def recorded(self, asked: str | None) -> Mapping[str, Any]:
        """Return what the section data of config.json says of what the user asked of the part; None is not written.

        A resumed run may have other values, as files may have moved; it is refused if `digest` differs.

        Args:
            asked: As for `leaves_device`.
        """
        return {}

    def captured(self, settings: Any, capture: Any) -> Any:  # noqa: ANN401
        """Return the dataset that a run trains on: that of the capture, perhaps with more.

        Args:
            settings: The run's `Settings`.
            capture: The capture before its photos are read, a `gsplat_edu.parts.run_values.Captured`.

        Raises:
            ArgumentError: the settings do not fit the capture.
            DatasetError: a file that the part needs cannot be used.
        """
        return capture.dataset

    def digest(self, dataset: Any) -> str | None:  # noqa: ANN401
        """Return a digest of what `captured` added to the dataset; None for nothing.

        A resumed run and the processes that share one are refused if theirs differ.
        """
        return None

    def start(self, settings: Any, capture: Any) -> Any:  # noqa: ANN401
        """Return what the part adds to the start, a `gsplat_edu.parts.run_values.Added`; None for nothing.

        Args:
            settings: The run's `Settings`.
            capture: The capture, a `gsplat_edu.parts.run_values.Captured`.

        Raises:
            ArgumentError: the settings do not fit the capture.
        """
        return None

    def begin(self, settings: Any, setup: Any) -> Any:  # noqa: ANN401
        """Return what the part does in the steps, a `gsplat_edu.train.part_values.Begun`; None for nothing.

        Args:
            settings: The run's `Settings`.
            setup: The training, a `gsplat_edu.train.part_values.Setup`.

        Raises:
            ArgumentError: the settings do not fit the training.
        """
        return None

    def learned(self, trainer: Any, dataset: Any) -> Any:  # noqa: ANN401
        """Return a dataset with what the part learned of it, for example its cameras.

        Args:
            trainer: The training, a `gsplat_edu.train.trainer.Trainer`.
            dataset: The dataset, with what the parts before learned.
        """
        return dataset

    def revise(self, settings: Any, scene: Any) -> Any:  # noqa: ANN401
        """Return what the part makes of the scene before it is written, a `gsplat_edu.parts.run_values.Revised`.

        None leaves the scene as it is.

        Args:
            settings: The run's `Settings`.
            scene: The scene, a `gsplat_edu.parts.run_values.Unwritten`.

        Raises:
            DatasetError: a photo cannot be read.
        """
        return None

    def compared(self, settings: Any, scene: Any) -> Any:  # noqa: ANN401
        """Return the capture with photos as the trained scene is compared with them, for example at its exposure.

        Args:
            settings: The run's `Settings`.
            scene: The scene and the capture, a `gsplat_edu.parts.run_values.Compared`.

        Raises:
            DatasetError: a photo cannot be read.
        """
        return scene.dataset

    def scored(self, settings: Any) -> Mapping[str, Any]:  # noqa: ANN401
        """Return what metrics.json says beside the scores of views, for example how they were corrected.

        Args:
            settings: The run's `Settings`.
        """
        return {}

    def finish(self, settings: Any, run: Any) -> Mapping[str, Any]:  # noqa: ANN401
        """Write what the part has to write into a run's folder; return entries of metrics.json.

        Args:
            settings: The run's `Settings`.
            run: The run, a `gsplat_edu.parts.run_values.Finished`.
        """
        return {}


class Strategy(ABC):
    """A density strategy that a plug-in adds: `--strategy NAME`."""

    Settings: ClassVar[type] = NoSettings
    """As for `Part`."""

    @abstractmethod
    def make(self, settings: Any, gaussians: Any, extent: float, generator: Any) -> Any:  # noqa: ANN401
        """Return the strategy of a run, a `gsplat_edu.train.density.base.DensityStrategy`.

        Args:
            settings: The run's `Settings`.
            gaussians: The start Gaussians.
            extent: Size of the scene, world units.
            generator: torch.Generator, the source of its draws.
        """


OWN_PARTS = {
    "sky": "gsplat_edu.parts.sky.part:SKY",
    "poses": "gsplat_edu.parts.poses.part:POSES",
    "exposure": "gsplat_edu.parts.exposure.part:EXPOSURE",
    "transients": "gsplat_edu.parts.transients.part:TRANSIENTS",
    "empty_outside": "gsplat_edu.parts.empty_outside.part:EMPTY_OUTSIDE",
    "surface": "gsplat_edu.parts.surface.part:SURFACE",
    "given_depth": "gsplat_edu.parts.given_depth.part:GIVEN_DEPTH",
    "floaters": "gsplat_edu.parts.floaters.part:FLOATERS",
}
"""Entry points of our own parts, in the order in which they act: poses move a camera before its image is corrected.
A part that only adds terms may stand anywhere."""

OWN_QUESTIONS = {
    "given_depth": "gsplat_edu.parts.given_depth.question:DEPTH",
    "floaters": "gsplat_edu.parts.floaters.question:CLEAN",
}
"""What our own parts ask for, as `Part.question`; apart, because the command line reads it without torch."""

PLUGGED_PARTS: Mapping[str, Part] = plugins("parts")
PLUGGED_STRATEGIES: Mapping[str, Strategy] = plugins("strategies")


@functools.cache
def parts() -> Mapping[str, Part]:
    """Return all parts by name: ours, then those of plug-ins. Ours import torch.

    Raises:
        ArgumentError: a plug-in has the name of one of ours.
    """
    if taken := sorted(set(OWN_PARTS) & set(PLUGGED_PARTS)):
        raise ArgumentError(
            f"plug-in {taken[0]} of {package_of('parts', taken[0])}: has the name of a part of gsplat_edu;"
            " remove the package, or rename the entry point"
        )
    return _loaded(OWN_PARTS) | dict(PLUGGED_PARTS)


@functools.cache
def questions() -> Mapping[str, Question]:
    """Return what parts ask for besides their settings, by part: ours, then those of plug-ins. Imports no torch."""
    plugged = {name: part.question for name, part in PLUGGED_PARTS.items() if part.question is not None}
    return _loaded(OWN_QUESTIONS) | plugged


def _loaded(entry_points: Mapping[str, str]) -> dict[str, Any]:
    return {name: EntryPoint(name, value, "gsplat_edu.parts").load() for name, value in entry_points.items()}


def flat_name(part: str, setting: str) -> str:
    """Return the name of a part's setting in config.json: with the part's name before it if it is a plug-in."""
    return f"{part}_{setting}" if part in PLUGGED_PARTS else setting


def default_settings() -> dict[str, Any]:
    """Return the settings of every plug-in that has some, by its name."""
    kinds: dict[str, type] = {name: part.Settings for name, part in PLUGGED_PARTS.items()}
    kinds |= {name: strategy.Settings for name, strategy in PLUGGED_STRATEGIES.items()}
    return {name: settings() for name, settings in kinds.items()}


def packages_of(names: Sequence[str]) -> dict[str, str]:
    """Return the packages of plug-ins by their names, for config.json."""
    return {name: package_of("parts" if name in PLUGGED_PARTS else "strategies", name) for name in names}

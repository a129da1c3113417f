"""Parts and strategies of a training that plug-ins add; see docs/PLUGINS.md."""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

from gsplat_edu.base.plugins import package_of, plugins


@dataclasses.dataclass(frozen=True)
class NoSettings:
    """The settings of a plug-in that has none."""


class Part:
    """What a plug-in adds to each training: settings, terms of the objective, findings, a section of the report.

    Its module imports torch only in functions: the command line reads the settings.
    """

    Settings: ClassVar[type] = NoSettings
    """Frozen dataclass whose fields `gsplat_edu.train.strategy_config.number` declares; their names in options and
    config.json begin with the plug-in's name."""

    def terms(self, settings: Any, extent: float) -> Mapping[str, Any]:  # noqa: ANN401
        """Return terms of the objective (`gsplat_edu.train.objective.Term`) by name.

        With the settings' defaults there must be none: every training asks.

        Args:
            settings: The run's `Settings`.
            extent: Size of the scene, world units.
        """
        return {}

    def findings(self, settings: Any, run: Path) -> Sequence[tuple[str, str]]:  # noqa: ANN401
        """Return what the doctor has to say of a run: sentences, each with what to do about it.

        Args:
            settings: The run's `Settings`.
            run: The run's folder.
        """
        return ()

    def section(self, settings: Any, log: Sequence[Mapping[str, Any]]) -> Sequence[str]:  # noqa: ANN401
        """Return the sentences of the plug-in's section in the report.

        Args:
            settings: The run's `Settings`.
            log: The entries of the run's log.
        """
        return ()


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


PARTS: Mapping[str, Part] = plugins("parts")
PLUGGED_STRATEGIES: Mapping[str, Strategy] = plugins("strategies")


def default_settings() -> dict[str, Any]:
    """Return the settings of every plug-in that has some, by its name."""
    parts: dict[str, type] = {name: part.Settings for name, part in PARTS.items()}
    parts |= {name: strategy.Settings for name, strategy in PLUGGED_STRATEGIES.items()}
    return {name: settings() for name, settings in parts.items()}


def packages_of(names: Sequence[str]) -> dict[str, str]:
    """Return the packages of plug-ins by their names, for config.json."""
    return {name: package_of("parts" if name in PARTS else "strategies", name) for name in names}

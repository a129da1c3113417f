"""What a training hands to its parts, and what they give back; `gsplat_edu.train.part.Part` says when."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

from torch import Tensor

from gsplat_edu.render.backend import Backend
from gsplat_edu.render.camera_tensors import CameraTensors
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.gaussians import Gaussians
from gsplat_edu.scene.views import View
from gsplat_edu.train.config import TrainConfig
from gsplat_edu.train.far import Shell
from gsplat_edu.train.feed import Target
from gsplat_edu.train.view_model import Identity, ViewModel


@dataclass(frozen=True, eq=False)
class Setup:
    """A training that is put together, as its parts see it.

    Args:
        config: The configuration.
        views: The training views.
        extent: Size of the scene, world units.
        gaussians: The start Gaussians, on the backend's device.
        backend: The kernels.
        shell: Where far splats lie; None if there are none.
        view_model: That of the parts before.
    """

    config: TrainConfig
    views: Sequence[View]
    extent: float
    gaussians: Gaussians
    backend: Backend
    shell: Shell | None = None
    view_model: ViewModel = field(default_factory=Identity)


@runtime_checkable
class Masker(Protocol):
    """Finds pixels that do not count, several times during a training, and takes them out of the targets."""

    def is_due(self, iteration: int, batch: int = 1) -> bool:
        """Return whether masks are found before the step of `batch` images whose first is `iteration`."""
        ...

    def find(
        self,
        gaussians: Gaussians,
        settings: RenderSettings,
        camera: Callable[[int, Camera], Camera | CameraTensors],
        factor: float,
    ) -> None:
        """Find the masks of all views anew.

        Args:
            gaussians: The scene.
            settings: How it is rendered.
            camera: Returns the camera of a view, given its index and its stored camera.
            factor: By how much the step divides the sides of photos.
        """
        ...

    def applied(self, index: int, target: Target) -> Target:
        """Return the target of a view without its masked pixels."""
        ...

    def state(self) -> Mapping[str, Tensor]:
        """Return the state for a checkpoint."""
        ...

    def check_state(self, state: Mapping[str, Tensor]) -> None:
        """Check a state before `load_state` uses it.

        Raises:
            ArgumentError: it does not fit; the message names the entry.
        """
        ...

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Restore what `state` returned."""
        ...


@dataclass(frozen=True, eq=False)
class Begun:
    """What a part does in the steps of a training.

    Args:
        terms: Terms of the objective (`gsplat_edu.train.objective.Term`) by name; each says what it `needs`.
        view_model: Corrects cameras or images; None for none.
        masker: Masks pixels of the photos; None for none.
    """

    terms: Mapping[str, Any] = field(default_factory=dict)
    view_model: ViewModel | None = None
    masker: Masker | None = None


@dataclass(frozen=True)
class Cost:
    """What a part adds to the time and memory of a training.

    Args:
        time: Further time of a step, in times of a plain one, on the average of all steps from `since` on.
        since: First iteration that takes longer.
        memory: Bytes that are kept.
    """

    time: float
    since: int = 0
    memory: int = 0

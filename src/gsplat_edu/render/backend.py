"""A backend: the kernels of one processor, as one value that is chosen once and handed in."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

import torch

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.base.validation import of_type
from gsplat_edu.engine.room import Room
from gsplat_edu.ops.adam import AdamKernel
from gsplat_edu.ops.losses import LossKernel
from gsplat_edu.ops.noise import NoiseKernel
from gsplat_edu.ops.recolor import RecolorKernel
from gsplat_edu.render.camera_tensors import CameraTensors
from gsplat_edu.render.output import Extra, RenderOutput
from gsplat_edu.render.resident import MakesRun
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.scene.camera import Camera
from gsplat_edu.scene.gaussians import Gaussians

Rasterize = Callable[[Gaussians, "Camera | CameraTensors", RenderSettings, Extra], RenderOutput]
"""Renders validated arguments; `gsplat_edu.render.api.render` validates them."""

FEATURES = {
    "lens": "renders other lenses than the pinhole, and rolling shutters",
    "stop": "stops compositing pixel by pixel (RenderSettings.stop)",
    "processes": "shares a step among processes",
    "statistics": "collects statistics of each Gaussian (RenderOutput.collect)",
    "forecast": "has a forecast of the time and memory of a training",
}
"""Features that a backend may lack: name, and description for messages."""


@dataclass(frozen=True)
class Backend:
    """The kernels of one processor.

    `gsplat_edu.render.backends.load_backend` makes those that exist; each has a room of its name beside this module. No
    other module asks which backend it has.

    Args:
        name: Its name; see `gsplat_edu.render.settings.BACKENDS`.
        device: The device on which it needs its tensors.
        rasterize: Renders Gaussians, differentiably.
        loss: Computes (1 - k) L1 + k (1 - SSIM), differentiably in the image.
        adam: Takes a step of Adam for one tensor, in place. `RenderOutput.defer` takes the same step.
        add_noise: Moves means at random along their covariances, in place.
        recolored: Applies a matrix of colours to an image, differentiably.
        lacks: Names of `FEATURES` that it does not offer.
        resident: Makes a training on the device. `training` uses it if the device can do all of its parts, and warns
            if it cannot. None if there is none.
        room: Says what that device has room for; None for the processor and CUDA.
        photo_room: Bytes of photos that a training keeps on the device; None for as many as it keeps by itself.
    """

    name: str
    device: torch.device
    rasterize: Rasterize
    loss: LossKernel
    adam: AdamKernel
    add_noise: NoiseKernel
    recolored: RecolorKernel
    lacks: frozenset[str] = field(default_factory=frozenset)
    resident: MakesRun | None = None
    room: Callable[[], Room] | None = None
    photo_room: int | None = None

    def require(self, feature: str, what: str) -> None:
        """Check that the backend offers a feature.

        Args:
            feature: A name of `FEATURES`.
            what: The argument or setting that needs it, and its value, for the message: "stop: 'pixel'".

        Raises:
            ArgumentError: the backend lacks the feature.
        """
        if feature in self.lacks:
            raise ArgumentError(
                f"{what} needs a backend that {FEATURES[feature]}, which {self.name} does not; use the backend cpu"
            )


Host = Callable[[], Backend]
"""Returns the kernels for tensors on the processor, which other backends use for what they do not do themselves."""

PROCESSOR = torch.device("cpu")
"""The device of tensors in main memory."""


class BackendRoom(Protocol):
    """What `gsplat_edu.render.NAME.backend` has to say of a backend."""

    def why_unavailable(self, host: Host, device: torch.device | None = None) -> str | None:
        """Return why the backend cannot run on this machine, and what to do; None if it can."""

    def gpu(self) -> str | None:
        """Return the name of the GPU on which it runs, and its interface; None on the processor."""

    def device(self) -> torch.device:
        """Return the device on which it needs its tensors."""

    def make(self, host: Host) -> Backend:
        """Return the backend, once it is known that it can run."""


def check_backend_value(backend: object) -> None:
    """Check that a backend is one, and not its name.

    Raises:
        ArgumentError: it is something else; the message says what to write.
    """
    if isinstance(backend, str):
        raise ArgumentError(f"backend: is {backend!r}, but has to be a Backend: load_backend({backend!r})")
    of_type("backend", backend, Backend)

"""What a backend offers that keeps a whole training on its device, and the values that pass between it and the host.

`Backend.resident` makes a `ResidentRun`. It holds the raw parameters, Adam's moments, the statistics of density control
and the photos; a step sends a camera and a few numbers, and returns four sums when they are asked for.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import NamedTuple, Protocol, runtime_checkable

from jaxtyping import Bool, Float32, UInt8
from torch import Tensor

from gsplat_edu.ops.moments import AdamNumbers
from gsplat_edu.ops.noise import NoiseNumbers
from gsplat_edu.render.settings import RenderSettings
from gsplat_edu.scene.camera import Camera


class RunState(NamedTuple):
    """Everything that a step changes, as tensors on the CPU.

    Args:
        gaussians: The raw parameters by name.
        first: Adam's first moments, by the same names.
        second: Its second moments.
        norm_sums: (N,) sums of the gradient norms of the means in the image.
        times_visible: (N,) how often a Gaussian was drawn.
    """

    gaussians: Mapping[str, Tensor]
    first: Mapping[str, Tensor]
    second: Mapping[str, Tensor]
    norm_sums: Tensor
    times_visible: Tensor


@dataclass(frozen=True, eq=False)
class RunTarget:
    """What a step's image is compared with.

    Args:
        index: The view's number.
        image: (H, W, 3) the photo, uint8 or float32 from 0 to 1.
        mask: (H, W) true for pixels that count; None if all do.
        constant: What the photo belongs to: it is the same whenever this is. None if it is another each time.
    """

    index: int
    image: UInt8[Tensor, "H W 3"] | Float32[Tensor, "H W 3"]
    mask: Bool[Tensor, "H W"] | None
    constant: object | None


@dataclass(frozen=True)
class RunRules:
    """The objective of a step, and what it collects.

    Args:
        ssim_weight: k in (1 - k) L1 + k (1 - SSIM).
        opacity_weight: Weight of the mean opacity.
        least_share: The mean opacity is that of the visible Gaussians if they are a smaller fraction than this.
        scale_weight: Weight of the mean scale.
        shell: Centre and radius of the sphere of far splats, whose scale counts as 0 and which get no noise; None for
            none. A splat is far if it is farther than half the radius from the centre.
        collects: Whether norms and visibility are added to the statistics.
    """

    ssim_weight: float
    opacity_weight: float = 0.0
    least_share: float = 0.0
    scale_weight: float = 0.0
    shell: tuple[float, float, float, float] | None = None
    collects: bool = False


@dataclass(frozen=True)
class RunSums:
    """What a step reports.

    Args:
        photo: (1 - k) L1 + k (1 - SSIM).
        opacity: The weighted mean opacity.
        scale: The weighted mean scale.
        pairs: Pairs of Gaussian and tile.
    """

    photo: float
    opacity: float
    scale: float
    pairs: int


@runtime_checkable
class ResidentRun(Protocol):
    """A training on a device. Its methods raise a `BackendUnavailableError` if the device fails or has no room."""

    def load(self, state: RunState) -> None:
        """Begin with this state."""
        ...

    def read(self) -> RunState:
        """Wait for all steps, and return the state."""
        ...

    def image(self) -> Tensor:
        """Wait for all steps, and return the last one's image, (H, W, 3)."""
        ...

    def step(
        self,
        camera: Camera,
        settings: RenderSettings,
        target: RunTarget,
        rates: Mapping[str, AdamNumbers],
        rules: RunRules,
    ) -> Callable[[], RunSums]:
        """Take a step, without waiting for it; what it returns waits."""
        ...

    def add_noise(self, numbers: NoiseNumbers, rules: RunRules) -> None:
        """Move the means at random after the last step, as `Backend.add_noise` does."""
        ...


@runtime_checkable
class MakesRun(Protocol):
    """Makes a training on a device."""

    def __call__(self, harmonics: int, photo_room: int | None = None) -> ResidentRun:
        """Make a training.

        Args:
            harmonics: K, per Gaussian besides the first.
            photo_room: Bytes of photos to keep on the device at most; None for as many as it keeps by itself.
        """
        ...

"""How a capture is read. It imports nothing heavy: the command line checks its options first."""

from __future__ import annotations

from dataclasses import dataclass

from gsplat_edu.errors import ArgumentError
from gsplat_edu.validation import float64_array, in_range, whole_number


@dataclass(frozen=True)
class DataSettings:
    """How a capture is read.

    Args:
        resolution: None: as the photos are. Below 32: a factor to divide both sizes by, 2 for half. From 32 on:
            the longest side in px; nothing is enlarged.
        test_every: Every n-th view by sorted name is for testing, 0 for none; a split that the capture has of
            its own is then dissolved. None: the capture's own split if it has one, else every 8th.
        background: (r, g, b), 0 to 1: photos with alpha are put over it when read. None keeps the alpha, for a
            background that is chosen later.
        image_memory: Bytes of decoded photos kept in memory; the others are read again when they are needed.

    Raises:
        ArgumentError: a value is not one of these, or the split would leave no view to train on.
    """

    resolution: float | None = None
    test_every: int | None = None
    background: tuple[float, float, float] | None = (0.0, 0.0, 0.0)
    image_memory: int = 4 * 2**30

    def __post_init__(self) -> None:
        if self.resolution is not None and (in_range("resolution", self.resolution, 1.0) > 1e6):
            raise ArgumentError("resolution: is above 1e6; give a factor below 32, or the longest side in px")
        if self.test_every is not None and whole_number("test_every", self.test_every, 0) == 1:
            raise ArgumentError(
                "test_every: is 1, which leaves no view to train on; give 0 for none, or 2 and more"
            )
        if self.background is not None:
            r, g, b = (
                in_range(f"background[{i}]", value, 0.0, 1.0)
                for i, value in enumerate(float64_array("background", self.background, (3,)))
            )
            object.__setattr__(self, "background", (r, g, b))
        whole_number("image_memory", self.image_memory, 0)

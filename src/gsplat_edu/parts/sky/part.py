"""The part that adds a sky: the setting `sky`."""

from __future__ import annotations

from gsplat_edu.base.errors import ArgumentError
from gsplat_edu.train.config import TrainConfig
from gsplat_edu.train.part import Part
from gsplat_edu.train.part_values import Setup


class SkyPart(Part):
    """Starts a run with a shell of splats far behind the scene."""

    def begin(self, settings: TrainConfig, setup: Setup) -> None:
        """Check that the start has the shell, which `gsplat_edu.parts.sky.start` makes of a capture.

        Raises:
            ArgumentError: it has none.
        """
        if settings.sky != "none" and setup.shell is None:
            raise ArgumentError(
                f"sky: is {settings.sky!r}, but start has no shell of splats; gsplat_edu.parts.sky.start makes it, or"
                " set sky='none'"
            )


SKY = SkyPart()

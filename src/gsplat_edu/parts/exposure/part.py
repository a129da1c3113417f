"""The part that corrects exposures: the setting `appearance`."""

from __future__ import annotations

from gsplat_edu.parts.exposure.model import Exposure
from gsplat_edu.train.config import TrainConfig
from gsplat_edu.train.part import Part
from gsplat_edu.train.part_values import Begun, Setup


class ExposurePart(Part):
    """Measures the exposure of each photo, and its vignetting if asked for."""

    def begin(self, settings: TrainConfig, setup: Setup) -> Begun | None:
        """Return the view model that corrects the images."""
        if settings.appearance == "none":
            return None
        length, vignetting = settings.means_rate_iterations, settings.appearance == "vignetting"
        like, recolor = setup.gaussians.means, setup.backend.recolored
        return Begun(view_model=Exposure(len(setup.views), length, like, recolor, vignetting))


EXPOSURE = ExposurePart()
